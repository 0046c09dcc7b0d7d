"""Statistics of a time series: autocorrelation and a test of whiteness."""

import numpy as np
from scipy import stats

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
