"""Stages of the point fit: bench tests in closed form, division of unpredictable runs, joint fit.

experiments -> fit of the bench tests in closed form -> divide runs that amplify initial errors -> LogPosterior -> joint fit
    -> where residuals of runs are correlated: second joint fit with coloured noise, and fits with other friction laws
"""

from collections.abc import Mapping
from dataclasses import dataclass

from capsule_id.experiments import make_experiments, paper_estimates, select_tables
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.registry import Registry
from capsule_id.inference.fit.joint_fit import joint_fit
from capsule_id.inference.fit.point_fit import point_fit
from capsule_id.inference.fit.second_fits import compare_laws, fit_coloured
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling.ensembles import sample
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.marginal import MarginalPosterior
from capsule_id.interruption import threads
from capsule_id.views import Finding

#: emcee steps of the bench sample, which measures the precision gained from runs and their agreement.
BENCH_BUDGET = 1000
#: Largest number of fits. Each fit follows a correction of the kinds of initial state that the last one contradicts.
ROUNDS = 3


@dataclass(frozen=True)
class BenchFit:
    """Fit and sample of the bench tests in closed form alone, ``event_driven`` false.

    Both are None where there are none; the sample is None where nothing was sampled.
    """

    fit: PointFit | None = None
    sample: Posterior | None = None


@dataclass(frozen=True)
class PointStage:
    """Result of the point fit; ``target`` holds the experiments as fitted, with divided records."""

    target: LogPosterior
    fit: PointFit
    bench: BenchFit
    seed: int
    findings: tuple[Finding, ...] = ()


def fit_points(target: LogPosterior, registry: Registry, seed: int, sampled: bool) -> PointStage:
    """Fit the experiments of ``target``.

    Parameters
    ----------
    registry : kinds of experiments of the rig, for rough values from bench tests that are not fitted
    seed : seed of the starting points and of the bench sample
    sampled : whether a sample follows: then sample the bench tests alone too
    """
    closed = [e for e in target.experiments if not e.event_driven]
    if len(closed) == len(target.experiments):
        return PointStage(target, point_fit(target, seed), BenchFit(), seed)
    alone = LogPosterior(target.rig, closed) if closed else None
    bench = None if alone is None else point_fit(alone, seed)
    known = _paper_values(target, registry) if bench is None else dict(bench.values)
    target, findings = cut_unpredictable(target, known)
    # The joint fit takes one core most of the time: the bench is sampled on another one.
    with threads(1) as beside:
        own = None
        if alone and bench and sampled:
            own = beside.submit(sample, MarginalPosterior(alone, bench), seed, BENCH_BUDGET)
        target, joint, wavering = _fit_with_right_starts(target, known, seed)
        target, joint, second = fit_coloured(target, joint, seed)
        second += compare_laws(target, joint, seed)
        bench_fit = BenchFit(bench, None if own is None else own.result())
    return PointStage(target, joint, bench_fit, seed, (*findings, *wavering, *second))


def _fit_with_right_starts(
    target: LogPosterior, known: Mapping[str, float], seed: int
) -> tuple[LogPosterior, PointFit, list[Finding]]:
    """Repeat the joint fit while it contradicts the kind of initial state of a run; report what remains."""
    first = None
    for remaining in reversed(range(ROUNDS)):
        joint = joint_fit(target, known, seed, first)
        corrected = correct_starts(target, joint)
        if corrected is None:
            return target, joint, []
        if remaining:
            target, first = LogPosterior(target.rig, corrected[0]), corrected[1]
    doubtful = [a.label for a, b in zip(target.experiments, corrected[0], strict=True) if a is not b]
    facts = {"labels": ", ".join(doubtful), "rounds": ROUNDS}
    return target, joint, [Finding("runs.start", "fail", facts, doubtful[0])]


def _paper_values(target: LogPosterior, registry: Registry) -> dict[str, float]:
    """Return the paper's estimates from the rig's bench tests, including tests that ``target`` lacks."""
    bench = [e for e in target.experiments if e.bench]
    if not bench and select_tables(target.rig, "bench"):
        bench = make_experiments(target.rig, "bench", registry)
    return paper_estimates(bench, registry)


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
