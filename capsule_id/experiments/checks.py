"""Statistics of residuals, and estimates from one experiment alone, for the checks of experiments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from capsule_id.experiments.base import Experiment, ValuesBySymbol
from capsule_id.parameters import is_stated

# series: Statistics of a time series: autocorrelation and a test of whiteness.


#: Family-wise false-alarm rate of a check over its experiments, dimensionless.
LEVEL = 0.002
#: Number of lags of the whiteness test, and smallest number of samples per lag.
LAGS, SAMPLES_PER_LAG = 20, 5


def autocorrelation(residuals: np.ndarray, lags: int) -> np.ndarray:
    """(lags,) sample autocorrelation at lags 1 .. lags; NaN of equal residuals."""
    r = residuals - np.mean(residuals)
    power = float(r @ r) or np.nan
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


# refit: Estimates from one experiment alone, with or without some of its readings.


#: Residuals, in units of the noise, where the model has no solution.
UNFIT = 1e9


@dataclass(frozen=True)
class Refit:
    """Estimates of the physical parameters of one experiment.

    Attributes
    ----------
    pairs : estimate and its standard error where the variance of the readings is that of the point fit, by symbol, SI
    scale : variance of the readings over that of the point fit, from the misfit; 1 where it is known
    freedom : degrees of freedom of ``scale``
    """

    pairs: Mapping[str, tuple[float, float]]
    scale: float
    freedom: int

    def scaled(self, scale: float) -> dict[str, tuple[float, float]]:
        """Estimates, and their standard errors with ``scale``."""
        return {symbol: (value, float(np.sqrt(scale)) * sd) for symbol, (value, sd) in self.pairs.items()}


def refit(experiment: Experiment, theta: ValuesBySymbol, left_out: Sequence[int]) -> dict[str, tuple[float, float]]:
    """Estimate and standard error of the experiment's physical parameters without some readings, SI; see ``estimate``."""
    found = estimate(experiment, theta, left_out)
    return found.scaled(found.scale)


def estimate(experiment: Experiment, theta: ValuesBySymbol, left_out: Sequence[int]) -> Refit:
    """Estimate the experiment's physical parameters without some readings.

    Parameters that rig.toml states stay at the point fit: one experiment alone may not determine them. Scatters stay
    there too when nothing is left out, and are rescaled by the remaining misfit otherwise.
    SciPy's Levenberg-Marquardt on NumPy residuals takes 1 to 8 ms; compiling JAX residuals takes a second.

    Parameters
    ----------
    theta : the point fit
    left_out : row indices
    """
    symbols = [row.symbol for row in experiment.parameters if row.physical and not is_stated(row.name)]
    keep = np.setdiff1d(np.arange(experiment.n), left_out)
    signed = experiment.estimates_may_be_negative
    at = np.array([float(theta[s]) for s in symbols])

    def values_of(w: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):  # of a parameter without information; its step is then shortened
            return at * w if signed else at * np.exp(w)

    def residuals(w: np.ndarray) -> np.ndarray:
        moved = {**theta, **dict(zip(symbols, values_of(w), strict=True))}
        with np.errstate(invalid="ignore"):
            misfit = experiment.misfit(moved)
        sd = misfit.sd[keep]
        y = misfit.raw[keep] / sd
        a = misfit.design[keep] / sd[:, None]
        if not np.all(np.isfinite(a)):
            # An overdamped decay has no solution; the solver then shortens its step.
            return np.full(len(y), UNFIT)
        return y - a @ np.linalg.lstsq(a, y, rcond=None)[0] if a.shape[1] else y

    start = np.ones(len(at)) if signed else np.zeros(len(at))
    solution = least_squares(residuals, start, method="lm", x_scale="jac")
    nuisances = experiment.misfit(theta).design.shape[1]
    freedom = max(len(keep) - len(symbols) - nuisances, 1)
    # A model that is not finite (an overdamped decay) determines nothing.
    finite = bool(np.isfinite(solution.jac).all())
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac) if finite else np.full((len(at), len(at)), np.inf)
    values = values_of(solution.x)
    # Rounding may leave a variance of no positive value, where two parameters have the same effect.
    variances = np.where(np.diag(covariance) > 0.0, np.diag(covariance), np.inf)
    errors = np.where(np.isfinite(variances), np.abs(at if signed else values), 1.0) * np.sqrt(variances)
    return Refit(
        {s: (float(v), float(e)) for s, v, e in zip(symbols, values, errors, strict=True)},
        1.0 if experiment.scale_known else float(2.0 * solution.cost / freedom),
        freedom,
    )
