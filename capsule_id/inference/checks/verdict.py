"""The checks of a fit that need no second fit, the error of its model, and which of its numbers may be quoted."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from capsule_id.experiments.base import LEVEL, Experiment, correlated_records, refit
from capsule_id.experiments.statistics import LAGS, judged, weighted_mean
from capsule_id.inference.checks.posterior import (
    PRIOR_PULL,
    check_maximum,
    check_priors,
    check_starts,
    check_statistics,
    default_scatter,
    in_doubt,
)
from capsule_id.inference.checks.settings import MOST_FLAGGED, check_trials, outliers
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.point_stage import PHASES, SampledFit, Widening
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling import LENGTH_IN_TAU, MAX_RHAT
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import is_stated
from capsule_id.records.tones import length_of_motion
from capsule_id.views import Finding, Trust

# trust: Which numbers of a fit may be quoted, from its findings.
#
# A failed check makes the parameters that its experiment informs not trusted. Without a sample, where the data do not
# inform a parameter, where a warning names it, and where every table that informs it has too few rows to show its
# scatter, its number is not judged: no check can tell.


def concerned(finding: Finding, experiments: Sequence[Experiment]) -> frozenset[str] | None:
    """Names of the parameters that ``finding`` is about; None for all."""
    if finding.parameters:
        return frozenset(finding.parameters)
    named = [e for e in experiments if finding.experiment in (e.label, e.table.label)]
    return frozenset(row.name for e in named for row in e.parameters) if named else None


def with_scaled(finding: Finding, experiments: Sequence[Experiment]) -> Finding:
    """``finding`` with the parameters that its scales multiply: those of the tables and masses that it names.

    One that leaves its table ``unjudged`` is about all parameters of that table.
    """
    scales, unjudged = finding.facts.get("scales", ()), finding.facts.get("unjudged", False)
    masses, labels = {"m1", "m2"}.intersection(scales), {name.rpartition(".")[0] for name in scales} - {""}
    labels |= {finding.experiment} if unjudged else set()
    others = {"g", "slope", "N0"}.intersection(scales)  # all friction depends on them
    read = [e for e in experiments if others or masses & {*e.masses} or labels & {e.label, e.table.label}]
    names = dict.fromkeys([*sorted(masses), *(row.name for e in read for row in e.parameters)])
    return replace(finding, parameters=tuple(names)) if scales or unjudged else finding


def trust_words(sampled: SampledFit, informed: np.ndarray) -> dict[str, Trust]:
    """Word of every sampled parameter, by name.

    Parameters
    ----------
    informed : (d,) whether the data narrow the prior of each parameter
    """
    failed = [concerned(f, sampled.experiments) for f in sampled.findings if f.level == "fail"]
    doubtful = {name for f in sampled.findings if f.level == "warn" for name in f.parameters}
    few = {f.experiment for f in sampled.findings if f.code == "readings.few"}
    enough = {row.name for e in sampled.experiments if e.table.label not in few for row in e.parameters}
    read = {row.name for e in sampled.experiments for row in e.parameters}
    doubtful |= {name for name in read - enough if not is_stated(name)}
    words: dict[str, Trust] = {}
    for row, known in zip(sampled.target.parameters, informed, strict=True):
        judged = sampled.posterior is not None and (known or is_stated(row.name)) and row.name not in doubtful
        words[row.name] = "trusted" if judged else "not judged"
        if any(names is None or row.name in names for names in failed):
            words[row.name] = "not trusted"
    return words


# experiment checks: Residual checks of every experiment at the point fit.
#
# Every check of level ``fail`` has a family-wise false-alarm rate of ``LEVEL`` over its experiments (Bonferroni).


def check_whiteness(s: SampledFit) -> list[Finding]:
    """Check that the residuals of every record are white (Ljung–Box)."""
    correlated, records = correlated_records(s.experiments, s.values)
    findings = []
    for one in correlated:
        # Not the experiment itself, which holds classes: the finding of a saved result could not be read back.
        facts = {name: fact for name, fact in one._asdict().items() if name != "experiment"}
        facts |= one.experiment.noise_facts()
        findings.append(Finding("residuals.white", "fail", facts, one.experiment.label))
    return findings or [Finding("residuals.white", "ok", {"records": records, "lags": LAGS})] * bool(records)


def check_outliers(s: SampledFit) -> tuple[list[Finding], dict[str, list[int]]]:
    """Check every table for outliers; also return the flagged row indices, by label."""
    tables = [e for e in s.experiments if not e.time_series]
    findings, flagged = [], {}
    for e in tables:
        theta = e.local(s.values)
        found = outliers(e, theta, LEVEL / len(tables))
        if not found:
            continue
        rows = [o.row for o in found]
        flagged[e.label] = rows
        without = refit(e, theta, rows)
        facts = {
            "file": e.table.file,
            "lines": sorted(int(e.table.rows[row]) for row in rows),
            "score": abs(found[0].score),
            "p": found[0].p,
            "most": MOST_FLAGGED,
            "estimates": [
                (row.name, row.unit, s.values[row.name], without[row.symbol][0])
                for row in e.parameters
                if row.symbol in without
            ],
        }
        findings.append(Finding("outliers", "fail", facts, e.label))
    return findings or [Finding("outliers", "ok")] * bool(tables), flagged


def check_stated_errors(s: SampledFit) -> list[Finding]:
    """Check that stated reading errors explain the scatter (chi-square)."""
    cases = []
    for e in (e for e in s.experiments if e.scale_known and e.label not in s.flagged):
        square = float(np.sum(np.asarray(e.residuals(e.local(s.values), np))[: e.n] ** 2))
        p = float(stats.chi2.sf(square, e.n - 2)) if e.n > 2 else 1.0
        cases.append((e.label, p, {"freedom": e.n - 2, "chi_square": square, "p": p}))
    return judged("errors.stated", cases, LEVEL)


# verdict: All checks of a fit: each finding states the experiment, the expected value, the observed value and a remedy.
#
# A rig without faults passes all checks together in more than 95 of 100 cases (measured in the calibration study).


#: The data inform a parameter where posterior sd / prior sd (in u) is at most this, dimensionless.
INFORMED_RATIO = 0.9


def run_checks(sampled: SampledFit) -> SampledFit:
    """Run the checks of a fit: return ``sampled`` with their findings and flagged outliers; ``check_fit`` adds the others."""
    whiteness = check_whiteness(sampled)
    outliers, flagged = check_outliers(sampled)
    sampled = replace(sampled, flagged=flagged)
    trials = check_trials(sampled)
    pairs = zip(sampled.target.parameters, informed(sampled.target, sampled.posterior, sampled.fit), strict=True)
    # No other reading narrows a stated mass or slope. A scatter with a stated reading error may be zero.
    vague = [row.name for row, known in pairs if row.physical and not is_stated(row.name) and not known]
    findings = [
        *check_starts(sampled.fit, sampled.target, sampled.posterior),
        *check_maximum(sampled),
        *_chains(sampled),
        *whiteness,
        *outliers,
        *check_stated_errors(sampled),
        *trials,
        *check_statistics(sampled, {finding.experiment for finding in trials if finding.level == "fail"}),
        *_declared_findings(sampled, bench=True),
        Finding("parameters.informed", "warn" if vague else "ok", {"names": ", ".join(vague)}),
        *check_priors(sampled),
        *_boundary(sampled),
        *_declared_findings(sampled, bench=False),
    ]
    return replace(sampled, findings=tuple(findings))


def _declared_findings(sampled: SampledFit, bench: bool) -> Iterator[Finding]:
    """Findings of the checks that experiments declare; one without an experiment is about those that declare it."""
    for check in declared(sampled.experiments, "checks", bench):
        names = dict.fromkeys(row.name for e in check.args[0] for row in e.parameters)
        for finding in check(sampled):
            general = finding.level == "fail" and not (finding.experiment or finding.parameters)
            yield replace(finding, parameters=tuple(names)) if general else finding


def declared(
    experiments: Sequence[Experiment], what: Literal["checks", "tables"], bench: bool
) -> list[partial[list[Any]]]:
    """Return every check (or table) that bench tests or runs declare, with the experiments that declare it."""
    members: dict[Callable[..., list[Any]], list[Experiment]] = {}
    for experiment in experiments:
        for function in getattr(experiment, what) if experiment.bench == bench else ():
            members.setdefault(function, []).append(experiment)
    return [partial(function, own) for function, own in members.items()]


def _chains(s: SampledFit) -> list[Finding]:
    p = s.posterior
    if p is None:
        return [Finding("chains.converged", "warn")]
    worst_tau, worst_rhat = int(np.argmax(p.tau)), int(np.argmax(p.rhat))
    sizes = np.minimum(p.ess_bulk, p.ess_tail)
    facts = {
        "draws": p.draws.shape[1],
        "length": p.draws.shape[1] / p.tau[worst_tau],
        "slowest": p.names[worst_tau],
        "rhat": p.rhat[worst_rhat],
        "worst": p.names[worst_rhat],
        "size": np.min(sizes),
        "smallest": p.names[int(np.argmin(sizes))],
        "size_wanted": p.ess_wanted,
        "length_wanted": LENGTH_IN_TAU,
        "rhat_wanted": MAX_RHAT,
    }
    if p.converged:
        return [Finding("chains.converged", "ok", facts)]
    # What no check can judge is not judged: the draws may be right.
    short = (p.rhat > MAX_RHAT) | (sizes < p.ess_wanted) | (p.draws.shape[1] < LENGTH_IN_TAU * p.tau)
    names = tuple(name for name, own in zip(p.names, short, strict=True) if own)
    return [Finding("chains.converged", "warn", {**facts, "names": ", ".join(names)}, parameters=names)]


def informed(target: LogPosterior, posterior: Posterior | None, fit: PointFit) -> np.ndarray:
    """(d,) whether posterior sd / prior sd of u is at most ``INFORMED_RATIO`` (Laplace without a sample)."""
    if posterior is None:
        sd = np.sqrt(np.diag(fit.covariance))
    else:
        flat = posterior.draws.reshape(-1, len(posterior.names))
        sd = np.std(target.unconstrain(flat), axis=0)
    return sd <= INFORMED_RATIO * target.prior_sd


def _boundary(s: SampledFit) -> list[Finding]:
    """Find parameters whose posterior lies in the tail of the prior; ``check_priors`` finds scatters by default priors."""
    z = np.abs(s.target.prior_residuals(s.fit.u))
    judged = [(row.name, pull) for row, pull in zip(s.target.parameters, z, strict=True) if not default_scatter(s, row)]
    names = [name for name, pull in judged if pull > PRIOR_PULL]
    out = {name for name in names if not is_stated(name)} - in_doubt(s)
    keys = [row.prior_key for row in s.target.parameters if row.name in out]
    furthest, pull = max(judged, key=lambda one: one[1], default=("none", 0.0))
    facts = {"names": ", ".join(names), "keys": ", ".join(filter(None, keys)), "furthest": furthest, "pull": pull}
    return [Finding("priors.tails", "warn" if names else "ok", facts, parameters=tuple(names))]


# widening: Error of the model, from the scatter of a parameter between parts of the data.
#
# residuals and Jacobian at the fit -> derivative with respect to one parameter, the others refitted
#     -> step of that parameter from every part -> chi-square between the parts (``widening``)
#
# Where a check of a bench test fails, the tests of its kind are divided into parts, else the run that fails. Each part
# gives a Gauss-Newton step of one parameter and its sd, at the scatters of the fit, which hold the misfit already. Their
# weighted chi-square over its degrees of freedom is the squared factor of the sd (Birge 1932), and Student's t gives the
# interval. A misfit that repeats with every period shows between phases only. The widest interval counts.


#: Fewest parts of the data, and most of one table: long parts show slow errors, many parts show them more surely.
FEWEST_PARTS, MOST_PARTS = 4, 8
#: Number of the priors, which every part meets. Without them the step of a parameter that the data leave open has no end.
PRIORS = -2
#: Largest sd of a part that determines a parameter, relative to its value.
LARGEST_RELATIVE_SD = 0.5
#: Smallest factor of an sd that counts.
SMALLEST_FACTOR = 1.01
#: Numbers of the parts of the n readings of a test; None where it cannot be divided in this way.
Division = Callable[[Experiment], Int[np.ndarray, " n"] | None]


def widenings(s: SampledFit) -> dict[str, Widening]:
    """Error of the model of every physical parameter that a failed check of its test concerns, by name."""
    failed = {f.experiment for f in s.findings if f.level == "fail" and f.experiment}
    kinds = {e.kind for e in s.experiments if e.bench and {e.label, e.table.label} & failed}
    tests = [e for e in s.experiments if e.kind in kinds or {e.label, e.table.label} & failed]
    # Stated values are no estimates from the parts: ``beside_stated`` adds their share of the sd.
    located = s.target.located[[not is_stated(s.target.names[i]) for i in s.target.located]]
    informed = {row.name for e in tests for row in e.parameters if row.physical}
    if not informed:
        return {}
    residuals, jacobian = linearised(s.target, s.fit.u)
    jacobian = jacobian[:, np.isin(s.target.located, located)]
    if not np.isfinite(jacobian).all():  # no start of the fit has found a maximum
        return {}
    found: dict[str, Widening] = {}
    for division in (by_phase, by_load, *(partial(by_time, number=i) for i in range(FEWEST_PARTS, MOST_PARTS + 1))):
        parts = normal_equations(jacobian, residuals, parts_of_residuals(s, tests, division))
        for k, (i, name) in enumerate((i, s.target.names[i]) for i in located):
            largest_sd = LARGEST_RELATIVE_SD * (1.0 if s.target.positive[i] else abs(s.fit.u[i]))
            pairs = steps_of_parts(parts, k) if name in informed else []
            pairs = [pair for pair in pairs if pair[1] < largest_sd]
            one = widening(pairs) if len(pairs) >= FEWEST_PARTS else None
            if one and one.factor > 1.0 and (name not in found or one.stretch > found[name].stretch):
                found[name] = one
    return found


def beside_stated(s: SampledFit, found: Mapping[str, Widening]) -> dict[str, Widening]:
    """Widen only that part of every variance which the readings give, not that of stated masses and slopes.

    The parts share the stated values, so their scatter says nothing of them. The share of the readings is the variance
    with the stated values held, from the covariance at the maximum.
    """
    stated = [i for i, name in enumerate(s.target.names) if is_stated(name)]
    result = {}
    for name, one in found.items():
        i = s.target.names.index(name)
        variance, with_stated = s.fit.covariance[i, i], s.fit.covariance[np.ix_(stated, [i])]
        given = float((with_stated.T @ np.linalg.pinv(s.fit.covariance[np.ix_(stated, stated)]) @ with_stated).item())
        share = float(np.clip(1.0 - given / variance, 0.0, 1.0))
        factor, stretch = (float(np.sqrt(1.0 - share + share * size**2)) for size in (one.factor, one.stretch))
        if factor >= SMALLEST_FACTOR:
            result[name] = Widening(factor, stretch / factor, one.parts)
    return result


def model_errors(s: SampledFit) -> dict[str, Widening]:
    """Error of the model by name of the parameter: from parts of the data, and what the readings allow (forces, a hold)."""
    found = beside_stated(s, widenings(s))
    for facts in (f.facts for f in s.findings if f.level == "warn" and f.code in ("decays.hidden", "decays.held")):
        one = found.get(facts["name"], Widening(1.0, 1.0, 0))
        low, high = one.limits or (np.inf, -np.inf)
        found[facts["name"]] = replace(one, limits=(min(low, facts["low"]), max(high, facts["high"])))
    return found


def widening(pairs: Sequence[tuple[float, float]]) -> Widening:
    """Factor and quantile from estimates and standard errors of parts."""
    chi_square, freedom = weighted_mean(*zip(*pairs, strict=True))[2], len(pairs) - 1
    quantile = float(stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975))
    return Widening(max(1.0, float(np.sqrt(chi_square / freedom))), quantile, len(pairs))


def by_time(e: Experiment, number: int = MOST_PARTS) -> Int[np.ndarray, " n"] | None:
    """Successive parts, of whole periods of a run; -1: the end of a decay, which is all noise."""
    if e.event_driven:
        cycle = (e.cycles - e.cycles[0]).astype(int) if e.cycles is not None and number == MOST_PARTS else None
        return cycle if cycle is None else cycle * min(int(cycle[-1]) + 1, number) // (int(cycle[-1]) + 1)
    rows = np.arange(e.n if e.cycles is None else len(e.cycles))
    # Most of the energy of a record lies before it is all noise.
    end = length_of_motion(e.observed[: len(rows)]) if e.time_series else len(rows)
    return np.where(rows < end, rows * min(number, max(end // 2, 1)) // end, -1)


def by_phase(e: Experiment) -> Int[np.ndarray, " n"] | None:
    """The same parts of every excitation period; None of other tests: the period of a decay is not exactly known."""
    return None if e.cycles is None or not e.event_driven else (e.cycles % 1.0 * PHASES).astype(int) % PHASES


def by_load(e: Experiment) -> Int[np.ndarray, " n"] | None:
    """Trials of one normal force, of similar ones where there are many."""
    if e.loads is None:
        return None
    levels, index = np.unique(e.loads[0], return_inverse=True)
    return index * min(len(levels), MOST_PARTS) // len(levels)


def parts_of_residuals(s: SampledFit, tests: Sequence[Experiment], division: Division) -> Int[np.ndarray, " m"]:
    """Part of each of ``LogPosterior.residuals``; -1, one more part, for other experiments; ``PRIORS`` for priors."""
    parts, used = [], 0
    for e in s.experiments:
        own = np.full(len(e.residuals(e.local(s.values), np)), -1)
        numbers = next((division(one) for one in tests if one is e), None)
        if numbers is not None:
            channels = e.n // len(numbers)
            own[: channels * len(numbers)] = np.tile(np.where(numbers < 0, -1, used + numbers), channels)
            used += int(np.max(numbers)) + 1
        parts.append(own)
    return np.concatenate([*parts, np.full(s.target.dimension, PRIORS)])


class Parts(NamedTuple):
    """Normal equations of the parts of the data, in units of the columns of the Jacobian.

    ``scale`` (d,) of these units; ``numbers`` (p,) of the parts; ``matrices`` (p, d, d); ``gradients`` (p, d).
    """

    scale: np.ndarray
    numbers: np.ndarray
    matrices: np.ndarray
    gradients: np.ndarray


def normal_equations(
    jacobian: Float[np.ndarray, "m d"], residuals: Float[np.ndarray, " m"], part: Int[np.ndarray, " m"]
) -> Parts:
    """Normal matrix and gradient of every part: a rig may have thousands of parts and 1e5 residuals."""
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    order = np.argsort(part, kind="stable")
    numbers, first = np.unique(part[order], return_index=True)
    jacobian, residuals = jacobian[order] / scale, residuals[order]
    pieces = [slice(*ends) for ends in pairwise([*first, len(order)])]
    matrices = np.array([jacobian[rows].T @ jacobian[rows] for rows in pieces])
    return Parts(scale, numbers, matrices, np.array([jacobian[rows].T @ residuals[rows] for rows in pieces]))


def steps_of_parts(parts: Parts, k: int) -> list[tuple[float, float]]:
    """Gauss-Newton step of parameter k and its sd from every part that informs it.

    A part meets the other parameters as the rest of the data gives them: the fit to all of the data has adapted them
    to the misfit of the part itself. A part without which the fit has no solution, or one less certain than the part, gives
    no step: the first period of a strong decay holds most of what the record tells.
    """
    # The derivative with respect to parameter k, the others refitted, as a combination of those of all parameters.
    whole, own = np.sum(parts.matrices, axis=0), np.eye(len(parts.scale))[k]
    unit, others = own.copy(), own == 0.0
    own[others] = -np.linalg.lstsq(whole[np.ix_(others, others)], whole[others, k], rcond=None)[0]
    pairs = []
    for number, matrix, gradient in zip(parts.numbers, parts.matrices, parts.gradients, strict=True):
        rest, information = whole - matrix, own @ matrix @ own
        if number == PRIORS or not information > 0.0 or np.linalg.matrix_rank(rest, hermitian=True) < len(own):
            continue
        effect = unit - own @ matrix / information
        if effect @ np.linalg.solve(rest, effect) > 1.0 / information:
            continue
        step = -np.linalg.solve(rest, np.sum(parts.gradients, axis=0) - gradient)
        value = step[k] - own @ (gradient + matrix @ step) / information
        pairs.append((value / parts.scale[k], information**-0.5 / parts.scale[k]))
    return pairs
