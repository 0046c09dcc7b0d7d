"""Stages of the point fit: bench tests in closed form, joint fit, second fits where residuals of runs are correlated."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import optimize, stats

from capsule_id.console import threads
from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment, Tension, Whiteness, correlated_records
from capsule_id.experiments.friction_model import FrictionModel, SurfaceExperiment, model_lines
from capsule_id.experiments.kind import Registry, make_experiments, paper_estimates, select_tables
from capsule_id.inference.joint_fit import joint_fit
from capsule_id.inference.marginal import MarginalPosterior
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling import sample
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import is_stated
from capsule_id.physics.forces import CoulombStribeck
from capsule_id.rig.model import Rig
from capsule_id.views import Finding

# tension: Likelihood-ratio test of a parameter that two groups of experiments share (friction: tilts and slides).


def tension(rig: Rig, one: Sequence[Experiment], other: Sequence[Experiment]) -> Tension:
    """Likelihood-ratio test that two groups of experiments share their parameters (one shared parameter: mu).

    Priors regularise both fits (a scatter from four trials needs one). They enter without their normalisation, so that
    a second copy of a vague prior does not change the statistic.
    """
    joint, *apart = (_maximum(LogPosterior(rig, group)) for group in ([*one, *other], one, other))
    statistic = max(2.0 * (apart[0][0] + apart[1][0] - joint[0]), 0.0)
    return Tension(float(stats.chi2.sf(statistic, 1)), apart[0][1], apart[1][1])


def _maximum(target: LogPosterior) -> tuple[float, dict[str, float]]:
    """Largest penalised log-likelihood and its parameters, by name; NumPy suffices for a few readings."""
    proposed = target.starts()
    start = target.unconstrain(np.array([proposed[name].centre for name in target.names]))
    # The masses change only a steady force here, so they keep their measured values.
    free = np.array([row.symbol not in ("m1", "m2") for row in target.parameters])

    def objective(v: np.ndarray) -> float:
        u = start.copy()
        u[free] = v
        values = target.mapping(target.theta(u))
        likelihood = sum(float(e.log_likelihood(e.local(values), np)) for e in target.experiments)
        penalty = 0.5 * float(np.sum(target.prior_residuals(u)[free] ** 2))
        return penalty - likelihood

    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        best = optimize.minimize(objective, start[free], method="BFGS", options={"gtol": 1e-6})
    u = start.copy()
    u[free] = best.x
    return -float(best.fun), target.mapping(target.theta(u))


# sampled fit: What checks and tables read of a fit.


#: Largest factor of an sd beside which the fit still gives a number.
LARGEST_FACTOR = 30.0


@dataclass(frozen=True)
class Widening:
    """Error of the model of one parameter.

    Attributes
    ----------
    factor : of its sd, at least 1
    quantile : Student's t quantile over the normal one, for the ends of the 95 % interval
    parts : number of parts of the data; 0 where only ``limits`` widen the interval
    limits : that the 95 % interval must hold too, SI
    """

    factor: float
    quantile: float
    parts: int
    limits: tuple[float, float] | None = None

    @property
    def stretch(self) -> float:
        """Factor of the half-length of the 95 % interval."""
        return self.factor * self.quantile

    @property
    def no_number(self) -> bool:
        """Whether the parts contradict each other so far that the fit gives no number."""
        return not self.factor <= LARGEST_FACTOR


@dataclass(frozen=True)
class SampledFit:
    """A point fit, its sample (None before and without one) and its findings so far.

    ``target`` holds the experiments as fitted, with divided records.

    Checks and tables of experiments read it as ``capsule_id.experiments.base.Fitted``.

    Attributes
    ----------
    bench, bench_sample : fit and sample of the bench tests in closed form alone, where runs were fitted too
    seed : seed of the starting points of further point fits
    widened : error of the model by name of the parameter, where a check failed
    """

    target: LogPosterior
    fit: PointFit
    posterior: Posterior | None
    values: Mapping[str, float]
    draws: Sequence[Mapping[str, float]] = ()
    seed: int = 0
    flagged: Mapping[str, Sequence[int]] = field(default_factory=dict)
    findings: Sequence[Finding] = ()
    bench: PointFit | None = None
    bench_sample: Posterior | None = None
    widened: Mapping[str, Widening] = field(default_factory=dict)

    @property
    def rig(self) -> Rig:
        return self.target.rig

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        return self.target.experiments

    def tension(self, one: Sequence[Experiment], other: Sequence[Experiment]) -> Tension:
        return tension(self.rig, one, other)

    def correlation(self, names: Sequence[str]) -> np.ndarray:
        if self.draws:
            return np.atleast_2d(np.corrcoef([[draw[name] for draw in self.draws] for name in names]))
        chosen = [self.target.names.index(name) for name in names]
        sd = np.sqrt(np.diag(self.fit.covariance))[chosen]
        return self.fit.covariance[np.ix_(chosen, chosen)] / np.outer(sd, sd)


# second fits: Further fits of runs whose residuals are correlated: coloured noise, then other friction laws.
#
# first joint fit -> residuals correlated -> joint fit with AR(1) noise, quoted where it explains more
#     -> residuals still correlated -> joint fits with other friction laws, which are named and never quoted


#: Friction laws that are compared, the simplest first.
LAWS = (FrictionModel(constant=True), FrictionModel(), FrictionModel(free=("ratio",)))
#: Difference of penalised log-posteriors, or of log-evidence, that rejects a simpler model: a factor of 20, "strong" (Kass &
#: Raftery 1995); and standard errors of the difference, where it has any.
STRONG, ERRORS = 3.0, 2.0
#: Parts of an excitation period. They are long beside most waves of a misfit, so that they are independent.
PHASES = 6


@dataclass(frozen=True)
class _Fit:
    """A target and its point fit."""

    target: LogPosterior
    fit: PointFit

    def with_law(self, law: FrictionModel, seed: int) -> "_Fit":
        """Fit another friction law from this fit alone: the motion is known, and only a comparison needs the result."""
        experiments = [
            e.with_friction(replace(law, contact=e.friction.contact)) if isinstance(e, SurfaceExperiment) else e
            for e in self.target.experiments
        ]
        target = LogPosterior(self.target.rig, experiments)
        values = {**{name: start.centre for name, start in target.starts().items()}, **self.values}
        start = target.unconstrain(np.array([values[name] for name in target.names]))
        return _Fit(target, joint_fit(target, values, seed, starts=start[None]))

    @property
    def values(self) -> Mapping[str, float]:
        """Parameters and constants by name, SI."""
        return self.target.mapping(self.target.theta(self.fit.u))

    @property
    def correlated(self) -> list[Whiteness]:
        """Records whose residuals are not white."""
        return correlated_records(self.target.experiments, self.values)[0]

    @property
    def height(self) -> float:
        """Largest log-posterior, less Schwarz's penalty for the number of parameters."""
        readings = sum(e.n for e in self.target.experiments)
        return float(np.max(self.fit.log_posterior)) - 0.5 * self.target.dimension * float(np.log(readings))

    @property
    def physical(self) -> list[str]:
        """Names of the physical parameters that are no stated values."""
        return [row.name for row in self.target.parameters if row.physical and not is_stated(row.name)]

    def row(self, name: str) -> dict[str, Any]:
        """Row of a table that compares fits of the same readings."""
        values, errors = self.fit.values, self.fit.standard_errors
        return {
            "fit": name,
            "parameters": ", ".join(f"{own} = {values[own]:.5g} ± {errors[own]:.2g}" for own in self.physical),
            "log-posterior": float(np.max(self.fit.log_posterior)),
            "residuals white": "no" if self.correlated else "yes",
        }

    def densities(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Cycle, and log-density up to a constant, of every reading of each record (n,)."""
        values, found = self.values, []
        for e in self.target.experiments:
            if e.cycles is not None:
                misfit, channels = e.misfit(e.local(values)), e.n // len(e.cycles)
                density = -0.5 * misfit.at_nuisance_mean(np)[0] ** 2 - np.log(misfit.sd)
                found.append((np.tile(e.cycles, channels), density[: channels * len(e.cycles)]))
        return found


def fit_coloured(target: LogPosterior, first: PointFit, seed: int) -> tuple[LogPosterior, PointFit, list[Finding]]:
    """Fit runs again with coloured noise where their residuals are correlated and the settings state no noise.

    The second fit is returned where it explains the readings better, and a finding that shows both.
    """
    white = _Fit(target, first)
    values, correlated = white.values, {one.experiment.shares_noise for one in white.correlated}
    changed = [
        e.with_coloured_noise(e.local(values)) if e.shares_noise in correlated else None for e in target.experiments
    ]
    if not any(changed):
        return target, first, []
    experiments = [e if new is None else new[0] for e, new in zip(target.experiments, changed, strict=True)]
    starts = {name: value for new in changed if new is not None for name, value in new[1].items()}
    other = LogPosterior(target.rig, experiments)
    coloured = _Fit(other, joint_fit(other, {**values, **starts}, seed))
    if coloured.height < white.height:
        return target, first, []
    rows = [white.row("first, white noise"), coloured.row("quoted, AR(1) noise")]
    records = list(dict.fromkeys(e.shares_noise for e, new in zip(target.experiments, changed, strict=True) if new))
    finding = Finding("runs.second_fit", "warn", {"records": records, "alternatives": rows}, records[0])
    return coloured.target, coloured.fit, [finding]


def compare_laws(target: LogPosterior, fit: PointFit, seed: int) -> list[Finding]:
    """Fit other friction laws to runs whose residuals are correlated; a finding names the simplest of the best ones.

    Only where runs alone measure friction: friction tests compare the laws themselves.
    """
    quoted, own = _Fit(target, fit), law_of_runs(target.experiments)
    correlated = [one.experiment for one in quoted.correlated if one.experiment.event_driven]
    if own is None or not correlated:
        return []
    fits = {own: quoted}
    for law in LAWS:
        if law != own:
            with suppress(InputError):  # no motion with this law is finite
                fits[law] = quoted.with_law(law, seed)
    best = max(fits.values(), key=lambda one: one.height)
    behind = {law: _behind(one, best) for law, one in fits.items()}
    close = [law for law, (difference, error) in behind.items() if difference <= max(STRONG, ERRORS * error)]
    chosen = min(close, key=lambda law: (len(law.parameters), law != own))
    new = fits[chosen].fit.values
    facts = {
        "own": own.name,
        "law": chosen.name,
        "line": model_lines(chosen, target.rig.model),
        "better": own not in close,
        "gain": behind[own][0] - behind[chosen][0],
        "moved": [(name, quoted.values[name], new[name]) for name in quoted.physical if name in new],
        "alternatives": [
            {**fits[law].row(law.name), "behind the best": f"{difference:.0f} ± {error:.0f}"}
            for law, (difference, error) in sorted(behind.items(), key=lambda item: item[1][0])
        ],
    }
    return [Finding("runs.laws", "ok" if chosen == own else "warn", facts, correlated[0].label)]


def _behind(one: _Fit, best: _Fit) -> tuple[float, float]:
    """Penalised log-posterior of the ``best`` fit less that of ``one``, and its standard error.

    Where the best fit leaves white residuals, the standard error is 0. Else every model has an error, and likelihoods
    count the readings as more than they are: the standard error is that of a sum over parts of the records, over whole
    periods or over phases of the excitation, whichever is larger.
    """
    difference = best.height - one.height
    if one is best or not best.correlated:
        return difference, 0.0
    by_period, by_phase = [], []
    for (cycles, high), (_, low) in zip(best.densities(), one.densities(), strict=True):
        by_period.append(np.bincount((cycles - cycles[0]).astype(int), high - low))
        by_phase.append(np.bincount((cycles % 1.0 * PHASES).astype(int), high - low))
    return difference, max(error_of_sum(np.concatenate(parts)) for parts in (by_period, by_phase))


def error_of_sum(parts: np.ndarray) -> float:
    """Standard error of the sum of independent ``parts`` (n,); 0 for a single one, which tells nothing of it."""
    return float(np.sqrt(len(parts) * np.var(parts, ddof=1))) if len(parts) > 1 else 0.0


def law_of_runs(experiments: Sequence[Experiment]) -> FrictionModel | None:
    """The friction law of the runs; None where other tests measure friction, or the law is a user's own."""
    symbols = {row.symbol for row in CoulombStribeck.parameters}
    users = [e for e in experiments if symbols & {row.symbol for row in e.parameters}]
    laws = [e.friction for e in users if isinstance(e, SurfaceExperiment) and e.event_driven and e.time_series]
    return laws[0] if laws and len(laws) == len(users) and laws[0].law is CoulombStribeck else None


# point stage: Stages of the point fit: bench tests in closed form, division of unpredictable runs, joint fit.
#
# experiments -> fit of the bench tests in closed form -> divide runs that amplify initial errors -> LogPosterior
#     -> joint fit
#     -> where residuals of runs are correlated: second joint fit with coloured noise, and fits with other friction laws


#: emcee steps of the bench sample, which measures the precision gained from runs and their agreement.
BENCH_BUDGET = 1000
#: Largest number of fits. Each fit follows a correction of the kinds of initial state that the last one contradicts.
STAGE_ROUNDS = 3


def fit_points(target: LogPosterior, registry: Registry, seed: int, sampled: bool) -> SampledFit:
    """Fit the experiments of ``target``.

    Parameters
    ----------
    registry : kinds of experiments of the rig, for rough values from bench tests that are not fitted
    seed : seed of the starting points and of the bench sample
    sampled : whether a sample follows: then sample the bench tests alone too
    """
    closed = [e for e in target.experiments if not e.event_driven]
    if len(closed) == len(target.experiments):
        fit = point_fit(target, seed)
        return SampledFit(target, fit, None, {**target.fixed, **fit.values}, seed=seed)
    alone = LogPosterior(target.rig, closed) if closed else None
    bench = None if alone is None else point_fit(alone, seed)
    if bench is None:
        # The paper's estimates from the rig's bench tests, including tests that ``target`` lacks.
        tests = [e for e in target.experiments if e.bench]
        if not tests and select_tables(target.rig, "bench"):
            tests = make_experiments(target.rig, "bench", registry)
        known = paper_estimates(tests, registry)
    else:
        known = dict(bench.values)
    target, findings = cut_unpredictable(target, known)
    # The joint fit takes one core most of the time: the bench is sampled on another one.
    with threads(1) as beside:
        own = (
            beside.submit(sample, MarginalPosterior(alone, bench), seed, BENCH_BUDGET)
            if alone and bench and sampled
            else None
        )
        target, joint, wavering = _fit_with_right_starts(target, known, seed)
        target, joint, second = fit_coloured(target, joint, seed)
        second += compare_laws(target, joint, seed)
        bench_sample = None if own is None else own.result()
    found, values = (*findings, *wavering, *second), {**target.fixed, **joint.values}
    return SampledFit(target, joint, None, values, (), seed, findings=found, bench=bench, bench_sample=bench_sample)


def _fit_with_right_starts(
    target: LogPosterior, known: Mapping[str, float], seed: int
) -> tuple[LogPosterior, PointFit, list[Finding]]:
    """Repeat the joint fit while it contradicts the kind of initial state of a run; report what remains."""
    first = None
    for remaining in reversed(range(STAGE_ROUNDS)):
        joint = joint_fit(target, known, seed, first)
        corrected = correct_starts(target, joint)
        if corrected is None:
            return target, joint, []
        if remaining:
            target, first = LogPosterior(target.rig, corrected[0]), corrected[1]
    doubtful = [a.label for a, b in zip(target.experiments, corrected[0], strict=True) if a is not b]
    facts = {"labels": ", ".join(doubtful), "rounds": STAGE_ROUNDS}
    return target, joint, [Finding("runs.start", "fail", facts, doubtful[0])]


def cut_unpredictable(target: LogPosterior, known: Mapping[str, float]) -> tuple[LogPosterior, list[Finding]]:
    """Divide every run that amplifies errors of its initial state too much; return findings too.

    Parameters
    ----------
    known : estimates by name; a missing parameter takes the starting value of a fit
    """
    values = {**target.fixed, **{name: start.centre for name, start in target.starts().items()}, **known}
    kept: list[Experiment] = []
    findings: list[Finding] = []
    for e in target.experiments:
        parts, found = e.predictable_parts(e.local(values))
        kept += parts
        findings += found
    return (LogPosterior(target.rig, kept) if len(kept) > len(target.experiments) else target), findings


def correct_starts(target: LogPosterior, fit: PointFit) -> tuple[list[Experiment], dict[str, float]] | None:
    """Replace initial conditions that the record contradicts at ``fit``; return experiments and starting values.

    None: the record contradicts no initial condition.
    """
    values = target.mapping(target.theta(fit.u))
    corrected = [e.corrected_start(e.local(values)) for e in target.experiments]
    if not any(corrected):
        return None
    for found in corrected:
        values |= {} if found is None else found[1]
    pairs = zip(target.experiments, corrected, strict=True)
    return [e if found is None else found[0] for e, found in pairs], values
