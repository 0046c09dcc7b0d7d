"""Density of the trials of a progression from sums over cases: the trials of one setting in one session.

Trials of a case differ only by their own scatter, so their number, mean and spread are sufficient. Given the
parameters, settings are independent. The discrepancy of a setting is integrated out in closed form, and so is the
session of a case that has none as a parameter: its motion is linear in z between runs. Where a setting has several of
these, they share its discrepancy, which is integrated by a sum.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special as jax_special
import numpy as np
import scipy.special as scipy_special
from jaxtyping import Float

from capsule_id.experiments.linear import LOG_2PI
from capsule_id.experiments.progression.sessions import EDGES, Sessions, lines

#: Discrepancies of a setting with several sessions that are integrated out, in its conditional sds.
GRID = np.linspace(-5.0, 5.0, 101)
#: Within these z a line may explain the readings, for the variance of a trial that depends on its displacement.
FARTHEST_Z = 3.0


class TrialGroups(eqx.Module):
    """Cases of trials by setting; a setting with fewer than g cases is padded with empty ones.

    Attributes
    ----------
    count, mean, spread : (settings, g) number of trials, mean, m, and sum of squares about it, m^2
    case : (settings, g) index of the case
    alone : (settings, g) 1 where its session is integrated out
    several : (settings,) 1 where there is more than one of these
    grid : of the discrepancy, in its conditional sds; () where no session is integrated out
    """

    count: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    case: np.ndarray
    alone: np.ndarray
    several: np.ndarray
    grid: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, distance: Float[np.ndarray, " n"], sessions: Sessions) -> None:
        """Group trials by their distance, m."""
        members = [np.flatnonzero(sessions.setting == b) for b in range(1 + int(np.max(sessions.setting)))]
        shape = len(members), max(map(len, members))
        self.count, self.mean, self.spread, self.alone = (np.zeros(shape) for _ in range(4))
        self.case = np.zeros(shape, dtype=int)
        for b, found in enumerate(members):
            x = [distance[sessions.rows[:, one] > 0.0] for one in found]
            filled = b, slice(len(found))
            self.count[filled], self.mean[filled] = list(map(len, x)), list(map(np.mean, x))
            self.spread[filled] = [len(one) * np.var(one) for one in x]
            self.case[filled], self.alone[filled] = found, sessions.alone[found]
        most = np.sum(self.alone, axis=1)
        self.several = 1.0 * (most > 1)
        self.grid = tuple(GRID.tolist()) if np.any(most > 1) else (0.0,) * int(np.any(most > 0))


@dataclass(frozen=True)
class TrialMisfit:
    """Trials against their model, at any value of ``trial_sd``.

    Attributes
    ----------
    X2 : (cases, nodes) displacements at z = ``NODES``, m; equal where z is a parameter
    reading_variance, trial_scatter : variance of a reading, m^2, and relative scatter of a trial
    discrepancy : (settings,) its standard deviation, m
    """

    groups: TrialGroups
    X2: Any
    reading_variance: float
    trial_scatter: Any
    discrepancy: Any

    def log_density(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the trials at ``scatter`` (...), m; (...)."""
        return xp.sum(self.of_settings(scatter, xp), axis=-1)

    def of_settings(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """(..., settings) that of the trials of each setting, at ``scatter`` (...), m."""
        groups, scatter = self.groups, xp.asarray(scatter)
        # The log-posterior stores all numbers of experiments as floats. Axes: scatter, setting, case, line.
        start, slope = lines(self.X2[xp.asarray(groups.case).astype(int)], xp)
        v = self._variance(start, slope, xp)[None] + scatter.reshape(-1, 1, 1, 1) ** 2
        known, first = 1.0 - groups.alone, v[..., 0]
        weight, y = (known * groups.count)[None] / first, (groups.mean - start[..., 0])[None]
        inside = (known * groups.count)[None] * (LOG_2PI + xp.log(first)) + (known * groups.spread)[None] / first
        # What the discrepancy explains of the trials of known friction, and its normal density given these.
        prior, moment = (self.discrepancy**2)[None], xp.sum(weight * y, axis=2)
        gain = 1.0 + prior * xp.sum(weight, axis=2)
        variance = prior / gain
        density = -0.5 * (xp.sum(inside + weight * y**2, axis=2) - variance * moment**2 + xp.log(gain))
        if groups.grid:
            density = density + self._of_lone_sessions(start, slope, v, (variance * moment, variance), xp)
        return density.reshape(*scatter.shape, -1)

    def _variance(self, start: Any, slope: Any, xp: ModuleType) -> Any:
        """(settings, cases, lines) of a trial without ``trial_sd``, where the line is nearest to the readings."""
        edges = np.clip(EDGES, -FARTHEST_Z, FARTHEST_Z)[None, None]
        low, high = start + slope * edges[..., :-1], start + slope * edges[..., 1:]
        nearest = xp.clip(self.groups.mean[..., None], xp.minimum(low, high), xp.maximum(low, high))
        return self.reading_variance + (self.trial_scatter * nearest) ** 2

    def _of_lone_sessions(self, start: Any, slope: Any, v: Any, discrepancy: tuple[Any, Any], xp: ModuleType) -> Any:
        """(scatter, settings) density of the trials whose z is integrated out.

        Parameters
        ----------
        start, slope : (settings, cases, lines) of ``lines``
        v : (scatter, settings, cases, lines) variance of a trial, m^2
        discrepancy : (scatter, settings) its mean, m, and variance, m^2, given all other trials
        """
        groups, special = self.groups, scipy_special if xp is np else jax_special
        # Axes: scatter, setting, case, line, discrepancy.
        start, slope, v = start[None, ..., None], slope[None, ..., None], v[..., None]
        count, measured, spread = (
            x[None, :, :, None, None] for x in (xp.maximum(groups.count, 1.0), groups.mean, groups.spread)
        )
        mean, variance, several = (x[..., None, None, None] for x in (*discrepancy, groups.several[None]))
        # Where only one session is integrated out, the variance of the discrepancy stays in the closed form.
        grid = np.array(groups.grid).reshape(1, 1, 1, 1, -1)
        r = measured - start - (mean + xp.sqrt(variance * several) * grid)
        w = v / count + variance * (1.0 - several)
        total = w + slope**2
        inside = (count - 1.0) * (LOG_2PI + xp.log(v)) + xp.log(count) + spread / v
        density = -0.5 * (inside + LOG_2PI + xp.log(total) + r**2 / total)
        # Given the readings and its line, z is normal; the part of it that belongs to this line counts.
        z, precision, edges = slope * r / total, xp.sqrt(total / w), EDGES.reshape(1, 1, 1, -1, 1)
        inner = _log_probability((edges[..., :-1, :] - z) * precision, (edges[..., 1:, :] - z) * precision, special, xp)
        cases = xp.sum(groups.alone[None, :, :, None] * special.logsumexp(density + inner, axis=3), axis=2)
        weights = -0.5 * grid[0, 0] ** 2
        return special.logsumexp(cases + weights - scipy_special.logsumexp(weights), axis=2)


def _log_probability(lower: Any, upper: Any, special: ModuleType, xp: ModuleType) -> Any:
    """Logarithm of the standard normal probability between ``lower`` and ``upper``, in either tail."""
    right = lower > 0.0
    lower, upper = xp.where(right, -upper, lower), xp.where(right, -lower, upper)
    high = special.log_ndtr(upper)
    return high + xp.log1p(-xp.exp(special.log_ndtr(lower) - high))
