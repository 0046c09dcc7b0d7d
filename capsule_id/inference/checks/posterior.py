"""Checks of the sampled posterior: agreement of experiments, modes, priors, predictions."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import fft, ndimage, special, stats

from capsule_id.experiments.base import LEVEL, Experiment
from capsule_id.experiments.lint import wrong_prefix
from capsule_id.experiments.statistics import basis_of
from capsule_id.inference.checks.settings import SMALLEST_SCATTER, design
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.moves import geyer_size
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.prediction import LARGEST_SHAPE, smoothed_weights
from capsule_id.inference.result import PointFit, Pointwise, Posterior
from capsule_id.inference.target import LogPosterior, prior_of, stated_prior
from capsule_id.parameters import SAME, Parameter, is_stated
from capsule_id.views import Finding

# agreement: Check that forced runs and bench tests give consistent parameters.


#: Family-wise false-alarm rate of the comparison between bench tests and runs, dimensionless.
AGREEMENT_LEVEL = 0.02
#: Part of a sample in each of the tails, where Student's t continues it.
TAIL = 0.005
#: Degrees of freedom of the tails without a sample: those of three trials, the fewest that show their own scatter.
FREEDOM_WITHOUT_SAMPLE = 2


def runs_alone(target: LogPosterior, fit: PointFit) -> dict[str, tuple[float, float]]:
    """Estimate from runs and priors: one Gauss–Newton step from the joint ``fit`` without bench residuals.

    Return u and its sd of every located parameter, by name.
    """
    located = target.located
    misses, jacobian = linearised(target, fit.u)
    rows = np.array([owner is None or not owner.bench for owner in target.residual_owners(fit.u)])
    kept = jacobian[rows]
    covariance = np.linalg.inv(kept.T @ kept)
    u = fit.u[located] - covariance @ (kept.T @ misses[rows])
    pairs = zip(u.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True)
    return dict(zip((target.names[i] for i in located), pairs, strict=True))


@dataclass(frozen=True)
class Distance:
    """Bench estimate minus run estimate of one parameter.

    Attributes
    ----------
    sd : difference in units of its Laplace standard deviation
    z : standard normal quantile of the tail probability of the difference. The tails are those of the bench sample,
        where one exists.
    """

    sd: float
    z: float


def disagreement(
    shared: Sequence[str], runs: Mapping[str, tuple[float, float]], bench: PointFit, sample: Posterior | None
) -> dict[str, Distance]:
    """Return the distance of every ``shared`` parameter, by name; bench and ``runs``, u and its sd, are independent."""
    found = {}
    for name in shared:
        (u, own), j = runs[name], bench.names.index(name)
        z = sd = float((bench.u[j] - u) / np.sqrt(bench.covariance[j, j] + own**2))
        if sample is not None:
            # Every shared parameter is positive: u is its logarithm.
            draws = np.log(sample.draws[..., j].ravel())
            blurred = draws + own * np.random.default_rng(j).standard_normal(draws.size)
            z = _by_sample(blurred, u, sd)
        found[name] = Distance(sd, z)
    return found


def _by_sample(draws: np.ndarray, value: float, laplace: float) -> float:
    """Standard normal quantile of the rank of ``value`` among ``draws``, with the sign of ``laplace``.

    Beyond the outermost 1 % a Student t tail, fitted to the outer quantiles, extrapolates the sample.
    """
    below, centre = np.mean(draws < value), float(np.median(draws))
    if TAIL < below < 1.0 - TAIL:
        return float(-stats.norm.ppf(below))
    # The outer quantiles at two levels give the number of degrees of freedom of the tail.
    levels = np.array([TAIL, 10.0 * TAIL])
    outer, inner = np.abs(np.quantile(draws, levels if value < centre else 1.0 - levels) - centre)
    grid = np.geomspace(1.0, 1e3, 200)
    ratio = np.divide(*stats.t.isf(levels[:, None], grid))
    freedom = float(grid[np.argmin(np.abs(ratio - outer / inner))])
    scale = outer / stats.t.isf(TAIL, freedom)
    tail = stats.t.logsf(abs(value - centre) / scale, freedom)
    # z with the same log(1 - Phi(z)), also where the tail itself underflows.
    return float(np.copysign(special.ndtri_exp(tail), laplace))


def check_agreement(s: SampledFit) -> list[Finding]:
    """Check that bench tests and runs are consistent (two-sided, Šidák over the shared parameters).

    Masses, slopes and errors of instruments are excluded, because both estimates contain what is stated of them.
    """
    runs = [row.name for e in s.experiments if not e.bench for row in e.parameters]
    known = {name for name in runs if not is_stated(name)}
    shared = [] if s.bench is None else [name for name in s.bench.names if name in known]
    if s.bench is None or not shared:
        return []
    found = disagreement(shared, runs_alone(s.target, s.fit), s.bench, s.bench_sample)
    tests = {
        name: [e.label for e in s.experiments if e.bench and name in {row.name for row in e.parameters}]
        for name in found
    }
    return [agreement(found, s.bench_sample is not None, tests)]


def agreement(
    found: Mapping[str, Distance], sampled: bool, tests: Mapping[str, Sequence[str]] | None = None
) -> Finding:
    """Convert the distances of ``disagreement`` to a finding.

    Without a bench sample a disagreement is a failure only where Student's t with ``FREEDOM_WITHOUT_SAMPLE`` excludes
    it too, because the Laplace approximation of few trials underestimates their tails.

    Among the parameters that disagree significantly, the largest disagreement, in sd, is reported.
    The distance in sd measures how much the error of one parameter explains. An error in one parameter also shifts
    the parameters correlated with it (v_s with mu). Heavy tails make z a poor measure of its origin.
    ``tests`` are the labels of the bench tests that inform each parameter; those of the largest disagreement are named.
    """
    p = {name: _sidak(stats.norm.sf(abs(one.z)), len(found)) for name, one in found.items()}
    lost = [name for name, one in found.items() if not (np.isfinite(one.sd) and np.isfinite(one.z))]
    far = [name for name in found if p[name] < AGREEMENT_LEVEL and name not in lost]
    far.sort(key=lambda name: -abs(found[name].sd))
    if lost and not far:
        return Finding("bench_and_runs.estimates", "warn", {"shared": len(found), "missing": lost})
    heavy = [
        _sidak(stats.t.sf(abs(found[name].sd), FREEDOM_WITHOUT_SAMPLE), len(found)) < AGREEMENT_LEVEL for name in far
    ]
    level = "ok" if not far else "fail" if sampled or any(heavy) else "warn"
    named = far or [min(p, key=lambda name: p[name])]
    facts = {
        "distances": [(name, found[name].sd, p[name]) for name in named],
        "shared": len(found),
        "sampled": sampled,
        "tests": ", ".join((tests or {}).get(named[0], ())),
    }
    return Finding("bench_and_runs.agree", level, facts)


def _sidak(tail: Any, number: int) -> float:
    """p-value of the largest of ``number`` scores with this one-sided ``tail``."""
    with np.errstate(divide="ignore"):  # tail 0.5: log(0), and p = 1
        return float(-np.expm1(number * np.log1p(-2.0 * tail)))


# modes: Maximum of the posterior against its sample: distance, several modes, starts that ended at other maxima.
#
# Residual checks and curves are those of the maximum, the quoted number is the median of the sample. Both must describe
# the same part of the posterior.


#: Largest distance of the maximum from the median, in standard deviations of u (68 % quantiles). The mode of an
#: exponential density is 0.8 from its median.
FARTHEST_MAXIMUM = 3.0
#: Smallest weight of a mode, and largest density of the valley between two modes relative to the lower one.
SMALLEST_MODE, DEEPEST_VALLEY = 0.05, 0.5
#: Number of bins of a marginal density, over its central 99.9 %.
BINS = 256
#: A maximum this far below the best one in log-posterior holds negligible mass, with a converged sample and without.
NEGLIGIBLE, NEGLIGIBLE_UNSAMPLED = 4.0, 20.0


def check_maximum(s: SampledFit) -> list[Finding]:
    """Check that the sample of every physical parameter has one mode, at the maximum of the posterior."""
    if s.posterior is None:
        return []
    findings = []
    u = s.target.unconstrain(s.posterior.draws.reshape(-1, len(s.posterior.names)))
    for i, row in enumerate(s.target.parameters):
        if not row.physical:
            continue
        facts = {"name": row.name, "key": row.prior_key, "unit": row.unit, "maximum": s.values[row.name]}
        low, median, high = np.quantile(u[:, i], [0.15865, 0.5, 0.84135])
        # A weighed constant with an sd of rounding size has no spread to compare with.
        distance = float(abs(s.fit.u[i] - median) / max(0.5 * (high - low), 1e-12))
        found = modes(u[:, i], float(s.posterior.ess[i]))
        if len(found) > 1:
            centres = np.exp([c for c, _ in found]) if row.positive else np.array([c for c, _ in found])
            facts |= {"modes": list(zip(centres.tolist(), (w for _, w in found), strict=True))}
            findings.append(Finding("sample.modes", "fail", facts, parameters=_block(s, i)))
        elif distance > FARTHEST_MAXIMUM:
            values = s.posterior.draws[..., i]
            facts |= {"median": np.median(values), "sd": np.std(values), "distance": distance}
            findings.append(Finding("sample.maximum", "fail", facts, parameters=_block(s, i)))
    return findings or [Finding("sample.maximum", "ok")]


def _block(s: SampledFit, i: int) -> tuple[str, ...]:
    """Names of the parameters that share data with parameter ``i``, itself first."""
    (block,) = [block for block in s.target.blocks if i in block]
    return (s.target.names[i], *(s.target.names[j] for j in block if j != i and s.target.parameters[j].physical))


def modes(u: np.ndarray, size: float) -> list[tuple[float, float]]:
    """Centre and weight of every mode of draws ``u`` (n,) with effective sample ``size``, in ascending order.

    A kernel estimate of the density is divided at its valleys (Silverman 1986, section 3.4, bandwidth). Two modes
    count as one where the valley is shallower than ``DEEPEST_VALLEY`` or one of them is lighter than ``SMALLEST_MODE``.
    """
    low, high = np.quantile(u, [0.0005, 0.9995])
    if not high - low > BINS * np.spacing(max(abs(low), abs(high))):  # nothing but rounding
        return [(float(np.median(u)), 1.0)]
    count, edges = np.histogram(u, BINS, (low, high))
    spread = min(float(np.std(u)), float(np.subtract(*np.quantile(u, [0.75, 0.25]))) / 1.34)
    # The size is NaN where a walker never moved; the bandwidth is then that of few draws.
    bandwidth = 0.9 * spread * max(10.0, size) ** -0.2 / (edges[1] - edges[0])
    density = ndimage.gaussian_filter1d(count.astype(float), max(bandwidth, 1.0), mode="constant")
    # Each mode is a range of bins; ranges merge until every valley is deep and every mode has weight.
    inner = np.flatnonzero((density[1:-1] <= density[:-2]) & (density[1:-1] < density[2:])) + 1
    cuts = [0, *inner.tolist(), BINS]
    while len(cuts) > 2:
        parts = [slice(a, b) for a, b in pairwise(cuts)]
        weight = np.array([np.sum(count[part]) for part in parts]) / np.sum(count)
        peak = np.array([np.max(density[part]) for part in parts])
        # A range without draws has no peak; it merges because it has no weight.
        depth = density[cuts[1:-1]] / np.maximum(np.minimum(peak[:-1], peak[1:]), np.finfo(float).tiny)
        light = np.minimum(weight[:-1], weight[1:]) < SMALLEST_MODE
        worst = int(np.argmax(np.where(light, 2.0, depth)))
        if not light[worst] and depth[worst] < DEEPEST_VALLEY:
            break
        del cuts[worst + 1]
    found = []
    for a, b in pairwise(cuts):
        inside = (u >= (edges[a] if a else -np.inf)) & (u < (edges[b] if b < BINS else np.inf))
        found.append((float(np.median(u[inside])), float(np.mean(inside))))
    return found


def check_starts(fit: PointFit, target: LogPosterior | None = None, sample: Posterior | None = None) -> list[Finding]:
    """Check that every start of the point fit ends at the same maximum, or at one with negligible mass.

    A start that stalls at the maximum that another one found counts as agreeing: rounding stops the solver there.

    Parameters
    ----------
    target, sample : a converged sample shows the mass of other maxima
    """
    facts = {"starts": len(fit.starts), "stalled": int(fit.stalled.sum()), "elsewhere": int(fit.at_other_maximum.sum())}
    if fit.agree:
        return [Finding("starts.agree", "fail" if fit.stalled.all() else "ok", facts)]
    distance = np.abs(fit.ends - fit.u) / np.sqrt(np.diag(fit.covariance))
    away = np.where(np.isfinite(distance), distance, np.inf).max(axis=1)
    worst = int(np.argmax(np.where(fit.at_other_maximum, away, -np.inf)))
    below = np.max(fit.log_posterior) - np.where(np.isfinite(fit.log_posterior), fit.log_posterior, -np.inf)
    facts |= {
        "distance": away[worst],
        "name": fit.names[int(np.argmax(distance[worst]))],
        "below": float(np.min(below[fit.at_other_maximum])),
    }
    if target is not None and sample is not None and sample.converged:
        u = target.unconstrain(sample.draws.reshape(-1, len(sample.names)))
        low, high = np.min(u, axis=0), np.max(u, axis=0)
        seen = np.all((fit.ends >= low) & (fit.ends <= high), axis=1)
        harmless = bool(np.all((seen | (below > NEGLIGIBLE))[fit.at_other_maximum]))
    else:
        # A local maximum far below the best one in log-posterior holds no posterior mass.
        harmless = bool(np.all(below[fit.at_other_maximum] > NEGLIGIBLE_UNSAMPLED))
        harmless = harmless and np.sum(~fit.at_other_maximum) >= 2
    return [Finding("starts.agree", "warn" if harmless else "fail", facts)]


# priors: Conflict of a stated prior, a weighing or a default prior with the rest of the data.
#
# Without the prior N(c, w²) of a parameter x with posterior N(x, S) the remaining data give the estimate
# c + (x - c)/(1 - S/w²) with variance S/(1 - S/w²). Its distance from the prior is z = (x - c)/sqrt(w² - S), standard
# normal where prior and data agree (Evans & Moshonov 2006). x is the logarithm where the prior is log-normal.


#: Smallest part of a prior's variance that the data count as removing: below, rounding of the sample decides.
SMALLEST_REDUCTION = 0.2
#: A parameter this many widths from the centre of its prior is pulled by it. A scatter is then too small, and so is every
#: sd that it gives.
PRIOR_PULL = 2.5


def conflicts(s: SampledFit) -> dict[str, dict[str, float]]:
    """Distance of the priors of physical parameters and scatters, and of every stated one, by name, as facts.

    A scatter far above its prior is one by which the fit explains what its law does not; one below is harmless.

    Returns
    -------
    ``z``, distance of a prior from the rest of the data in sd, standard normal where both agree; ``value`` and ``sd``, the
    estimate from the rest of the data, SI; ``informed``, the fraction of the prior's variance that the data remove: near 0
    the estimate is unreliable.
    """
    centre, sd = _location(s)
    found = {}
    for i, row in enumerate(s.target.parameters):
        if not (row.physical or row.scatter or is_stated(row.name) or stated_prior(s.rig, row)):
            continue
        prior = s.target.priors.at(i, np)
        middle, width = float(prior.centre), float(prior.width)
        informed = max(1.0 - float(sd[i] / width) ** 2, SMALLEST_REDUCTION)
        alone, alone_sd = middle + (centre[i] - middle) / informed, sd[i] / np.sqrt(informed)
        value, scale = (np.exp(alone), np.exp(alone)) if prior.lognormal else (alone, 1.0)
        z = (centre[i] - middle) / (width * np.sqrt(informed))
        z = max(z, 0.0) if default_scatter(s, row) else z
        found[row.name] = {"z": float(z), "value": float(value), "sd": float(scale * alone_sd), "informed": informed}
    return found


def default_scatter(s: SampledFit, row: Parameter) -> bool:
    """Whether ``row`` is a scatter without a stated prior."""
    return row.scatter and stated_prior(s.rig, row) is None


def in_doubt(s: SampledFit) -> set[str]:
    """Names of the parameters with an unusual scale: a wrong unit explains them, so no other prior is proposed."""
    return {name for finding in s.findings if "scales" in finding.facts for name in finding.parameters}


def check_priors(s: SampledFit) -> list[Finding]:
    """Check every stated prior, weighing and default prior of a physical parameter against the rest of the data."""
    findings, found = [], conflicts(s)
    for name, conflict in found.items():
        p = float(2.0 * stats.norm.sf(abs(conflict["z"])))
        row = s.target.parameters[s.target.names.index(name)]
        if p * len(found) < LEVEL or (default_scatter(s, row) and conflict["z"] > PRIOR_PULL):
            findings.append(_finding(s, row, conflict, p))
    findings = findings or [Finding("priors.conflict", "ok", {"number": len(found)})]
    names = {key for row in s.target.parameters for key in (row.name, row.symbol)}
    idle = ", ".join(key for key in s.rig.priors if key not in names)
    whole = {table.kind for table in s.rig.tables} == {e.kind for e in s.experiments}
    return [*findings, Finding("priors.idle", "warn", {"keys": idle})] if idle and whole else findings


def _location(s: SampledFit) -> tuple[np.ndarray, np.ndarray]:
    """(d,) posterior location and sd of every parameter, in the variable of its prior."""
    lognormal = np.asarray(s.target.priors.lognormal)
    if s.posterior is None:
        value, sd = s.target.theta(s.fit.u), np.sqrt(np.diag(s.fit.covariance))
        return np.where(lognormal, s.fit.u, value), sd * np.where(lognormal | ~s.target.positive, 1.0, value)
    draws = s.posterior.draws.reshape(-1, len(s.posterior.names))
    x = np.where(lognormal, s.target.unconstrain(draws), draws)
    return np.median(x, axis=0), np.std(x, axis=0)


def _finding(s: SampledFit, row: Parameter, conflict: Mapping[str, float], p: float) -> Finding:
    """The conflict of one parameter; it concerns all parameters of the experiments that read it."""
    name = row.name
    readers = [e for e in s.experiments if name in e.masses or name in {own.name for own in e.parameters}]
    prior = prior_of(row)
    stated = stated_prior(s.rig, row) is not None
    unit = stated and prior.kind == "lognormal" and wrong_prefix(conflict["value"] / prior.median)
    facts = {
        "name": name,
        "key": "" if is_stated(name) or unit or name in in_doubt(s) else row.prior_key,
        "is_unit": unit,
        "unit": "" if row.unit == "1" else f" {row.unit}",
        "prior": prior.describe(),
        "signed": prior.kind == "normal",
        "stated": "rig" if is_stated(name) else "prior" if stated else "scatter" if row.scatter else "",
        "experiments": ", ".join(dict.fromkeys(e.table.label for e in readers)),
        "fitted": s.values[name],
        "p": p,
        **conflict,
    }
    names = dict.fromkeys([name, *(own.name for e in readers for own in e.parameters)])
    return Finding("priors.conflict", "fail", facts, parameters=tuple(names))


# predictive: Predictive checks by statistics that a fitted scatter cannot absorb.
#
# The residuals of an experiment are projected off its own parameters and nuisances, and divided by their rms.
# Replicates are white noise, projected and divided in the same way, so that like is compared with like: to first
# order in the parameters the p-values hold for any noise level, and for parameters that other experiments share.


#: Numbers of the replicates that are drawn, and of their readings together above the smaller number.
MOST_REPLICATES, FEWEST_REPLICATES, REPLICATED_READINGS = 4000, 1000, 4_000_000
#: Longer records are not judged: their replicates take too much memory.
MOST_READINGS = 5000
#: Fewest residual degrees of freedom that can be judged.
FEWEST_FREE = 6
#: Fewest replicates that give a p-value by their number; below it follows the exponential tail of the largest replicates.
FEWEST_BEYOND, FARTHEST = 10, 100
#: Number of the slowest cosines that the trend counts.
SLOWEST = 3


#: Statistics of each row of residuals (m, n): minus the number of sign changes, so that long runs of one sign are large; the
#: largest size of studentised ones; the power in the ``SLOWEST`` cosines, the constant left out.
STATISTICS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "sign runs": lambda r: -np.sum(np.signbit(r[:, 1:]) != np.signbit(r[:, :-1]), axis=1).astype(float),
    "largest": lambda r: np.max(np.abs(r), axis=1),
    "trend": lambda r: np.sum(np.asarray(fft.dct(r, axis=1, norm="ortho"))[:, 1 : 1 + SLOWEST] ** 2, axis=1),
}


def p_values(residuals: np.ndarray, columns: np.ndarray, number: int = 0) -> dict[str, float]:
    """Probability of each statistic of (n,) residuals in replicates; ties count half.

    Parameters
    ----------
    columns : (n, p) effect of the fitted parameters on the residuals
    number : of replicates; 0: few, and more where these are too few for a small p-value
    """
    n, basis = len(residuals), basis_of(columns)
    # A reading with much leverage pulls the fit to itself: its residual is smaller than its error.
    spread = np.sqrt(np.maximum(1.0 - np.sum(basis**2, axis=1), 1e-3))
    most = REPLICATED_READINGS // n
    number = number or min(MOST_REPLICATES, max(FEWEST_REPLICATES, most))
    noise = np.random.default_rng(0).standard_normal((number, n))

    def reduced(r: np.ndarray) -> np.ndarray:
        rest = r - (r @ basis) @ basis.T
        return rest / np.sqrt(np.mean(rest**2, axis=1, keepdims=True))

    seen, drawn = reduced(residuals[None, :]), reduced(noise)
    found = {}
    for name, statistic in STATISTICS.items():
        scale = spread if name == "largest" else 1.0
        here, there = statistic(seen / scale)[0], statistic(drawn / scale)
        tie = SAME * max(1.0, abs(here))
        larger, equal = np.sum(there > here + tie), np.sum(np.abs(there - here) <= tie)
        found[name] = float((0.5 + larger + 0.5 * equal) / (1 + number))
        if larger + equal < FEWEST_BEYOND:
            # Tails of these statistics fall no more slowly than an exponential. Steps of counts may hide how fast: the
            # mean excess of a normal variable is 0.38 sd here.
            tail = np.sort(there)[-FARTHEST:]
            mean = max(float(np.mean(tail)) - tail[0], 0.3 * float(np.std(there)), np.finfo(float).tiny)
            found[name] = min(found[name], FARTHEST / number * float(np.exp((tail[0] - here) / mean)))
    few = number < most and min(found.values()) < FEWEST_BEYOND / number
    return p_values(residuals, columns, most) if few else found


def experiment_p_values(e: Experiment, theta: Mapping[str, float]) -> dict[str, float]:
    """The p-values of one bench test at ``theta``; {} where too few residuals are free or they are rounding."""
    residuals, columns = design(e, theta)
    if len(residuals) - columns.shape[1] < FEWEST_FREE or np.std(residuals) <= SMALLEST_SCATTER:
        return {}
    # Rows of a calibration line or of slides may have any order: they follow their abscissa.
    abscissa = next((getattr(e, name) for name in ("x", "speed") if hasattr(e, name)), np.arange(len(residuals)))
    order = np.argsort(abscissa, kind="stable") if len(abscissa) == len(residuals) else np.arange(len(residuals))
    if e.cycles is not None and len(e.observed) == len(residuals):
        # The rounding of a record that stands still is no noise: equal neighbours tell nothing of its order.
        moves = np.pad(np.diff(e.observed) != 0.0, 1, constant_values=True)
        order = np.flatnonzero(moves[1:] & moves[:-1])
        if len(order) - columns.shape[1] < FEWEST_FREE:
            return {}
    found = p_values(residuals[order], columns[order])
    return {name: p for name, p in found.items() if name != "trend" or not e.explains_trend}


def check_statistics(s: SampledFit, known: Collection[str] = ()) -> list[Finding]:
    """Compare runs of signs, largest residual and trend of every bench test with replicates.

    ``LEVEL`` is the probability that clean data give a finding of any test.
    Tests with outliers, and the ``known`` ones, whose trials are known not to be alike, are left out: their residuals
    have a named cause.
    """
    findings = []
    tests = [e for e in s.experiments if e.bench and not e.event_driven and e.n <= MOST_READINGS]
    tests = [e for e in tests if e.label not in {*s.flagged, *known}]
    judged = [(e, found) for e in tests if (found := experiment_p_values(e, e.local(s.values)))]
    for e, found in judged:
        small = {name: p for name, p in found.items() if p * len(found) * len(judged) < LEVEL}
        # One large residual hardly moves a record's fit, and tables have their own check of outliers.
        worst = min(small, key=lambda name: (name == "largest", small[name]), default=None)
        if worst is not None:
            level = "warn" if worst == "largest" else "fail"
            findings.append(Finding("residuals.statistics", level, {"statistic": worst, "p": small[worst]}, e.label))
    return findings or [Finding("residuals.statistics", "ok", {"number": len(judged)})] * bool(judged)


def decisive_readings(pointwise: Pointwise, draws: np.ndarray) -> Finding:
    """Name the readings without which the sample cannot predict them, because they decide a parameter.

    The shape of a term is the larger one of two tails, whose lengths are those for independent weights, and for weights
    of a sample ``draws`` (ensemble, draw, walker, d) with its effective size, as ArviZ has it.
    """
    size, named, number = float(np.mean(geyer_size(draws))), list[tuple[float, str, int]](), 0
    for label, density in pointwise.log_likelihood.items():
        terms = density.reshape(-1, density.shape[-1]).T
        number += len(terms)
        for own, row in zip(terms, pointwise.rows[label], strict=True):
            shape = max(smoothed_weights(-own, relative)[1] for relative in (1.0, size / len(own)))
            named += [(shape, label, int(row) + 1)] if shape > LARGEST_SHAPE else []
    rows = ", ".join(f"{label} reading {row} ({shape:.2f})" for shape, label, row in sorted(named, reverse=True))
    facts = {"number": number, "far": len(named), "rows": rows, "limit": LARGEST_SHAPE}
    return Finding("readings.decisive", "ok", facts)
