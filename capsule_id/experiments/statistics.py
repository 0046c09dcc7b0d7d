"""Statistics of residuals and of estimates that several checks share: autocorrelation, F tests, random orders."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

from capsule_id.parameters import SAME
from capsule_id.views import Facts, Finding

# series: Autocorrelation of a time series and a test of whiteness.

#: Number of lags of the whiteness test and of a panel, and smallest number of samples per lag of the test.
LAGS, SHOWN_LAGS, SAMPLES_PER_LAG = 20, 60, 5


def autocorrelation(residuals: np.ndarray, lags: int | None = None) -> np.ndarray:
    """(lags,) sample autocorrelation at lags 1 .. lags, by default those of a panel; NaN of equal residuals."""
    r, lags = residuals - np.mean(residuals), lags or min(SHOWN_LAGS, len(residuals) // 4)
    power = float(r @ r) or np.nan
    return np.array([float(r[lag:] @ r[:-lag]) for lag in range(1, lags + 1)]) / power


def ljung_box(residuals: np.ndarray) -> tuple[float, float, int]:
    """Ljung–Box Q of residuals (n,), its p-value and the number of lags, fewer for short records (Ljung & Box 1978)."""
    n = len(residuals)
    lags = min(LAGS, n // SAMPLES_PER_LAG)
    rho = autocorrelation(residuals, lags)
    q = n * (n + 2.0) * float(np.sum(rho**2 / (n - np.arange(1, lags + 1))))
    return q, float(stats.chi2.sf(q, lags)), lags


# further columns: What columns explain of residuals beside those that the fitted parameters can take up.


#: Directions of columns that are shorter than this, relative to the longest one, are combinations of the others.
COMBINATION = 1e-8


def basis_of(columns: np.ndarray) -> np.ndarray:
    """(n, rank) orthonormal columns with the span of ``columns`` (n, p).

    Columns of nuisances may span those of parameters, as discrepancies do that all trials of a setting share.
    """
    u, size, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, size > COMBINATION * np.max(size, initial=0.0)]


def further_columns(known: np.ndarray, further: np.ndarray, left: np.ndarray) -> tuple[float, float, np.ndarray]:
    """F test for the columns ``further`` (n, q) beside those ``known`` (n, p), and the effect (q,) of each of them.

    Returns
    -------
    F and its p-value, NaN for too few readings; correlation of the residuals ``left`` (n,) with each column, times their
    length. What the known columns take up is projected out of both. Columns that are combinations of others count once.
    """
    own, columns = without(known, left, further)
    basis = basis_of(columns)
    effects = columns.T @ own / np.maximum(np.linalg.norm(columns, axis=0), COMBINATION)
    rank, freedom = basis.shape[1], len(own) - np.count_nonzero(known.any(axis=0)) - basis.shape[1]
    if freedom < rank:
        return np.nan, np.nan, effects
    explained = float(np.sum((basis.T @ own) ** 2))
    F = explained / rank * freedom / max(float(own @ own) - explained, np.finfo(float).tiny)
    return F, float(stats.f.sf(F, rank, freedom)), effects


def without(known: np.ndarray, *parts: np.ndarray) -> list[np.ndarray]:
    """What the columns ``known`` (n, p) leave of each of ``parts``, (n,) or (n, q)."""
    size = np.linalg.norm(known, axis=0)
    basis = np.linalg.qr(known[:, size > 0.0] / size[size > 0.0])[0]
    return [part - basis @ (basis.T @ part) for part in parts]


def weighted_mean(values: Sequence[float], sds: Sequence[float]) -> tuple[float, float, float]:
    """Mean of independent estimates, weighted by their standard errors; its standard error; and chi-square about it."""
    value, weight = np.asarray(values), np.asarray(sds) ** -2.0
    mean = np.average(value, weights=weight)
    return float(mean), float(np.sum(weight) ** -0.5), float(np.sum(weight * (value - mean) ** 2))


# judgement: p-values of random orders, and findings of one check of several experiments.


#: Readings that are ordered at a time: all orders of a long table together would take 160 kB a row.
ORDERED = 2_000_000


def permutation_p(values: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], number: int) -> float:
    """Probability that a random order of ``values`` (n,) has as large a ``statistic`` (...), of orders (..., n).

    The ``number`` of orders are the same ones each time.
    """
    rng, found = np.random.default_rng(0), statistic(values)
    larger, step = 0, max(ORDERED // len(values), 1)
    for start in range(0, number, step):
        orders = rng.permuted(np.tile(values, (min(step, number - start), 1)), axis=1)
        larger += np.sum(statistic(orders) >= found - SAME * np.abs(found))
    return float((1 + larger) / (1 + number))


def of_neighbours(values: np.ndarray) -> np.ndarray:
    """Sum of the products of neighbours, (...) of (..., n): large where neighbours have one sign."""
    return np.sum(values[..., 1:] * values[..., :-1], axis=-1)


def judged(
    code: str, cases: Sequence[tuple[str, float, Facts]], level: float, number: Facts | None = None
) -> list[Finding]:
    """Findings of one check of several experiments with this family-wise false-alarm rate (Bonferroni); [] without any.

    Parameters
    ----------
    cases : label of the experiment, p-value and facts
    number : facts of the finding where no case fails
    """
    failed = [Finding(code, "fail", facts, label) for label, p, facts in cases if p * len(cases) < level]
    return failed or [Finding(code, "ok", number or {})] * bool(cases)
