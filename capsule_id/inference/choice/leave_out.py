"""Expected log predictive density of settings left out, by Pareto-smoothed importance sampling (PSIS-LOO).

For each draw the readings of a setting are normal given all other readings: session effects and discrepancies are
integrated out. Draws come from the Laplace approximation at the maximum, widened, and are weighted by the posterior.
(A. Vehtari, A. Gelman, J. Gabry, *Practical Bayesian model evaluation using leave-one-out cross-validation and WAIC*,
Statistics and Computing 27, 2017, 1413.)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy.special import logsumexp

from capsule_id.errors import InputError
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference.fit.joint_starts import weigh
from capsule_id.inference.result import PointFit
from capsule_id.inference.target.log_posterior import LogPosterior

#: Draws of the Laplace approximation, their degrees of freedom, and its widening.
DRAWS, FREEDOM, WIDENING = 256, 8.0, 1.1
#: Importance weights with a larger Pareto shape are not reliable.
LARGEST_SHAPE = 0.7


@dataclass(frozen=True)
class LeftOut:
    """Log predictive density of every setting given the others, and the Pareto shape of its weights, (settings,)."""

    density: np.ndarray
    shape: np.ndarray


@dataclass(frozen=True)
class WeightedDraws:
    """Draws (m, d) in u, and log importance weights (m,) towards the posterior."""

    u: np.ndarray
    log_weight: np.ndarray


def laplace_draws(target: LogPosterior, fit: PointFit, seed: int) -> WeightedDraws:
    """Draws about the maximum with their weights; a draw without a finite log-posterior has weight 0."""
    rng, d = np.random.default_rng(seed), target.dimension
    root = WIDENING * np.linalg.cholesky(fit.covariance + 1e-12 * np.diag(np.diag(fit.covariance)))
    z = rng.standard_normal((DRAWS, d)) * np.sqrt(FREEDOM / rng.chisquare(FREEDOM, (DRAWS, 1)))
    u = fit.u + z @ root.T
    proposed = -0.5 * (FREEDOM + d) * np.log1p(np.sum(z**2, axis=1) / FREEDOM)
    return WeightedDraws(u, weigh(target, u) - proposed)


def leave_settings_out(target: LogPosterior, e: Progression, draws: WeightedDraws) -> LeftOut:
    """Leave out every setting of ``e`` in turn."""
    usable = np.isfinite(draws.log_weight)
    values = [target.mapping(theta) for theta in target.theta(draws.u[usable])]
    density = conditional_densities(e, [e.local(value) for value in values])
    own = np.nan_to_num(density, nan=-1e9, neginf=-1e9)
    log_weight = draws.log_weight[usable, None] - own
    smoothed, shape = _smooth(log_weight.T)
    return LeftOut(np.asarray(logsumexp(smoothed + own.T, axis=1)), shape)


def conditional_densities(e: Progression, draws: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """(draws, settings) log-density of the readings of each setting, given the parameters and all other readings."""
    means, per_sd = e.responses_of_draws(draws)
    rows = [np.flatnonzero(column) for column in e.setting.T]
    return np.stack([_conditional(e, *one, rows) for one in zip(draws, means, per_sd, strict=True)])


def _conditional(
    e: Progression, theta: Mapping[str, Any], mean: np.ndarray, per_sd: np.ndarray, rows: list[np.ndarray]
) -> np.ndarray:
    """(settings,) from the precision matrix K: y_b given the others has precision K_bb, and residual K_bb^-1 (K y)_b."""
    misfit = e.misfit_of(theta, mean, per_sd, np).at(theta["trial_sd"], np)
    covariance = np.diag(misfit.sd**2) + misfit.design @ misfit.design.T
    if not np.isfinite(covariance).all():
        return np.full(len(rows), -np.inf)
    precision = np.linalg.inv(covariance)
    weighted = precision @ misfit.raw
    found = []
    for own in rows:
        block = precision[np.ix_(own, own)]
        square = float(weighted[own] @ np.linalg.solve(block, weighted[own]))
        found.append(0.5 * (float(np.linalg.slogdet(block)[1]) - len(own) * LOG_2PI - square))
    return np.array(found)


def _smooth(log_weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normalised log-weights (settings, draws) smoothed by ArviZ, and their Pareto shapes (settings,)."""
    try:
        psislw: Any = import_module("arviz").psislw
    except (ImportError, AttributeError):
        rule, remedy = "comparing models needs the package arviz", "pip install 'capsule-id[compare]'"
        raise InputError(rule, "not installed", remedy) from None
    smoothed, shape = psislw(log_weight)
    return np.asarray(smoothed), np.asarray(shape)
