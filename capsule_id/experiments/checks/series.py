"""Statistics of a time series: autocorrelation and a test of whiteness."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import stats

if TYPE_CHECKING:
    from capsule_id.experiments.base import Experiment

#: Family-wise false-alarm rate of a check over its experiments, dimensionless.
LEVEL = 0.002
#: Number of lags of the whiteness test, and smallest number of samples per lag.
LAGS, SAMPLES_PER_LAG = 20, 5


def autocorrelation(residuals: np.ndarray, lags: int) -> np.ndarray:
    """(lags,) sample autocorrelation at lags 1 .. lags."""
    r = residuals - np.mean(residuals)
    power = float(r @ r)
    return np.array([float(r[lag:] @ r[:-lag]) for lag in range(1, lags + 1)]) / power


def ljung_box(residuals: np.ndarray, lags: int | None = None) -> tuple[float, float, int]:
    """Ljung–Box Q of residuals (n,), its p-value and the number of lags (Ljung & Box 1978).

    ``lags`` None: ``LAGS``, fewer for short records.
    """
    n = len(residuals)
    lags = lags or min(LAGS, n // SAMPLES_PER_LAG)
    rho = autocorrelation(residuals, lags)
    q = n * (n + 2.0) * float(np.sum(rho**2 / (n - np.arange(1, lags + 1))))
    return q, float(stats.chi2.sf(q, lags)), lags


class Whiteness(NamedTuple):
    """Ljung–Box test of the residuals of one record of an experiment; see ``ljung_box``."""

    experiment: "Experiment"
    record: str
    Q: float
    p: float
    lags: int


def correlated_records(experiments: Sequence["Experiment"], values: Mapping[str, float]) -> tuple[list[Whiteness], int]:
    """Records whose residuals at ``values`` are not white, with a family-wise false-alarm rate of ``LEVEL``.

    Also return the number of all records.
    """
    tests = [
        Whiteness(e, label, *ljung_box(residuals))
        for e in experiments
        if e.time_series
        for label, residuals in e.records(e.local(values))
    ]
    return [one for one in tests if one.p * len(tests) < LEVEL], len(tests)
