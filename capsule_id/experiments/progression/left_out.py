"""Densities of the trials of a progression at one setting, given the parameters and the trials at all other settings."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.linear import LOG_2PI

if TYPE_CHECKING:
    from capsule_id.experiments.progression.experiment import Progression


def conditional_densities(e: "Progression", draws: Sequence[ValuesBySymbol]) -> Float[np.ndarray, "draws settings"]:
    """Log-densities at each draw: the trials are jointly normal, discrepancies and linear sessions integrated out."""
    means, per_sd = e.sessions.responses(e.motions_of_draws(draws))
    rows = [np.flatnonzero(column) for column in e.setting.T]
    return np.stack([_conditional(e, *one, rows) for one in zip(draws, means, per_sd, strict=True)])


def _conditional(
    e: "Progression", theta: ValuesBySymbol, mean: np.ndarray, per_sd: np.ndarray, rows: list[np.ndarray]
) -> Float[np.ndarray, " settings"]:
    """From the precision matrix K: y_b given the others has precision K_bb, and residual K_bb^-1 (K y)_b.

    NaN where the covariance is singular or not finite, as at absurd values far outside any posterior.
    """
    misfit = e.misfit_of(theta, mean, per_sd, np).at(theta["trial_sd"], np)
    covariance = np.diag(misfit.sd**2) + misfit.design @ misfit.design.T
    if not (np.all(np.isfinite(misfit.raw)) and np.all(np.isfinite(covariance))):
        return np.full(len(rows), np.nan)
    try:
        precision = np.linalg.inv(covariance)
        weighted = precision @ misfit.raw
        return np.array([_log_density(precision[np.ix_(own, own)], weighted[own]) for own in rows])
    except np.linalg.LinAlgError:
        return np.full(len(rows), np.nan)


def _log_density(precision: Float[np.ndarray, "b b"], weighted: Float[np.ndarray, " b"]) -> float:
    """Normal log-density with this precision, at a residual that is the inverse precision times ``weighted``."""
    square = float(weighted @ np.linalg.solve(precision, weighted))
    return 0.5 * (float(np.linalg.slogdet(precision)[1]) - len(weighted) * LOG_2PI - square)
