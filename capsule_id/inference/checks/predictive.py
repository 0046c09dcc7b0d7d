"""Predictive checks by statistics that a fitted scatter cannot absorb.

The residuals of an experiment are projected off its own parameters and nuisances, and divided by their rms. Replicates
are white noise, projected and divided in the same way, so that like is compared with like: to first order in the
parameters the p-values hold for any noise level, and for parameters that other experiments share.
"""

from collections.abc import Callable, Collection, Mapping

import numpy as np
from scipy.fft import dct

from capsule_id.experiments.base import Experiment
from capsule_id.inference.checks.order import SMALLEST_SCATTER
from capsule_id.inference.checks.regression import DIFFERENCE, moving_symbols
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.inference.choice.importance import LARGEST_SHAPE, smoothed_weights
from capsule_id.inference.fit.curvature import jacobian
from capsule_id.inference.result import Pointwise
from capsule_id.views import Finding

#: Numbers of the replicates that are drawn, and of their readings together above the smaller number.
MOST_REPLICATES, FEWEST_REPLICATES, REPLICATED_READINGS = 4000, 1000, 4_000_000
#: Longer records are not judged: their replicates take too much memory.
MOST_READINGS = 5000
#: Fewest residual degrees of freedom that can be judged.
FEWEST_FREE = 6
#: Probability that clean data give a finding of an experiment. The smallest p-value is half of one replicate.
LEVEL = 0.002
#: Number of the slowest cosines that the trend counts.
SLOWEST = 3


def sign_runs(r: np.ndarray) -> np.ndarray:
    """Minus the number of sign changes along each row of (m, n): long runs of one sign are large."""
    return -np.sum(np.signbit(r[:, 1:]) != np.signbit(r[:, :-1]), axis=1).astype(float)


def largest(r: np.ndarray) -> np.ndarray:
    """Largest absolute residual of each row of (m, n), studentised ones."""
    return np.max(np.abs(r), axis=1)


def trend(r: np.ndarray) -> np.ndarray:
    """Power of each row of (m, n) in its ``SLOWEST`` cosines, the constant left out."""
    cosines = np.asarray(dct(r, axis=1, norm="ortho"))
    return np.sum(cosines[:, 1 : 1 + SLOWEST] ** 2, axis=1)


STATISTICS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "sign runs": sign_runs,
    "largest": largest,
    "trend": trend,
}


def p_values(residuals: np.ndarray, columns: np.ndarray, seed: int = 0) -> dict[str, float]:
    """Probability of each statistic of (n,) residuals in replicates; ties count half.

    Parameters
    ----------
    columns : (n, p) effect of the fitted parameters on the residuals
    """
    n = len(residuals)
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    basis = left[:, size > 1e-10 * np.max(size, initial=0.0)]
    # A reading with much leverage pulls the fit to itself: its residual is smaller than its error.
    spread = np.sqrt(np.maximum(1.0 - np.sum(basis**2, axis=1), 1e-3))
    number = min(MOST_REPLICATES, max(FEWEST_REPLICATES, REPLICATED_READINGS // n))
    noise = np.random.default_rng(seed).standard_normal((number, n))

    def reduced(r: np.ndarray) -> np.ndarray:
        rest = r - (r @ basis) @ basis.T
        return rest / np.sqrt(np.mean(rest**2, axis=1, keepdims=True))

    seen, drawn = reduced(residuals[None, :]), reduced(noise)
    found = {}
    for name, statistic in STATISTICS.items():
        scale = spread if name == "largest" else 1.0
        here, there = statistic(seen / scale)[0], statistic(drawn / scale)
        equal = np.abs(there - here) <= 1e-9 * max(1.0, abs(here))
        found[name] = float(
            (0.5 + np.sum(there > here + 1e-9) + 0.5 * np.sum(equal & (there <= here + 1e-9))) / (1 + number)
        )
    return found


def experiment_p_values(e: Experiment, theta: Mapping[str, float]) -> dict[str, float]:
    """The p-values of one bench test at ``theta``; {} where too few residuals are free or they are rounding."""
    residuals, columns = _linearised(e, theta)
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


def _linearised(e: Experiment, theta: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) at the conditional mean of the nuisances; effect (n, p) of parameters and nuisances on them."""
    symbols = moving_symbols(e)

    def residuals(v: np.ndarray) -> np.ndarray:
        return np.asarray(e.residuals({**theta, **dict(zip(symbols, v, strict=True))}, np))[: e.n]

    misfit, at = e.misfit(theta), np.array([float(theta[symbol]) for symbol in symbols])
    effects = jacobian(residuals, at, DIFFERENCE * np.maximum(np.abs(at), 1e-12)) if symbols else np.zeros((e.n, 0))
    columns = np.concatenate([effects, misfit.design / misfit.sd[:, None]], axis=1)
    size = np.linalg.norm(columns, axis=0)
    return residuals(at), columns[:, size > 0.0] / size[size > 0.0]


def check_statistics(s: SampledFit, known: Collection[str] = ()) -> list[Finding]:
    """Compare runs of signs, largest residual and trend of every bench test with replicates.

    Tests with outliers, and the ``known`` ones, whose trials are known not to be alike, are left out: their residuals
    have a named cause.
    """
    findings, judged = [], 0
    for e in s.experiments:
        if not e.bench or e.event_driven or e.n > MOST_READINGS or e.label in {*s.flagged, *known}:
            continue
        found = experiment_p_values(e, e.local(s.values))
        judged += bool(found)
        small = {name: p for name, p in found.items() if p * len(found) < LEVEL}
        # One large residual hardly moves a record's fit, and tables have their own check of outliers.
        worst = min(small, key=lambda name: (name == "largest", small[name]), default=None)
        if worst is not None:
            level = "warn" if worst == "largest" else "fail"
            findings.append(Finding("residuals.statistics", level, {"statistic": worst, "p": small[worst]}, e.label))
    return findings or [Finding("residuals.statistics", "ok", {"number": judged})] * bool(judged)


def decisive_readings(pointwise: Pointwise) -> Finding:
    """Name the readings without which the sample cannot predict them, because they decide a parameter."""
    named, number = [], 0
    for label, density in pointwise.log_likelihood.items():
        terms = density.reshape(-1, density.shape[-1]).T
        shapes = [smoothed_weights(-own)[1] for own in terms]
        number += len(shapes)
        named += [(shape, label, int(row) + 1) for shape, row in zip(shapes, pointwise.rows[label], strict=True)]
    far = sorted((one for one in named if one[0] > LARGEST_SHAPE), reverse=True)
    rows = ", ".join(f"{label} reading {row} ({shape:.2f})" for shape, label, row in far)
    return Finding("readings.decisive", "ok", {"number": number, "far": len(far), "rows": rows, "limit": LARGEST_SHAPE})
