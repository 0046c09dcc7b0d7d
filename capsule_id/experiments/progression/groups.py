"""Density of the trials of a progression from sums over cases: the trials of one setting in one session.

Trials of a case differ only by their own scatter, so their number, mean and spread are sufficient. Given the
parameters, settings are independent. The discrepancy of a setting is integrated out in closed form, and so is the
session of a case that has none as a parameter: its motion is linear in z on either side of 0. Where a setting has
several of these, they share its discrepancy, which is integrated by a sum.
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
from capsule_id.experiments.progression.sessions import SIDES, Sessions, lines

#: Discrepancies of a setting with several sessions that are integrated out, in its conditional sds.
GRID = np.linspace(-5.0, 5.0, 101)
#: Within these z a line may explain the readings, for the variance of a trial that depends on its displacement.
FARTHEST_Z = 3.0
#: Least probability of a side of z = 0.
LEAST = 1e-300


class TrialGroups(eqx.Module):
    """Cases of trials: those whose session is known, by setting, and those whose session is integrated out.

    Attributes
    ----------
    count, mean, spread : (cases,) number of trials, mean, m, and sum of squares about it, m^2
    known, filled : (settings, g) index of the cases of a setting that are known, and 1 where there is one
    lone : (lone,) index of the other cases
    of_setting : (lone, settings) 1 where a case belongs to a setting
    several : (settings,) 1 where it has more than one of these
    grid : of the discrepancy, in its conditional sds; () where no session is integrated out
    """

    count: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    known: np.ndarray
    filled: np.ndarray
    lone: np.ndarray
    of_setting: np.ndarray
    several: np.ndarray
    grid: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, distance: Float[np.ndarray, " n"], sessions: Sessions) -> None:
        """Group trials by their distance, m."""
        trials = [distance[own > 0.0] for own in sessions.rows.T]
        self.count, self.mean = np.array(list(map(len, trials)), dtype=float), np.array(list(map(np.mean, trials)))
        self.spread = np.array([len(own) * np.var(own) for own in trials])
        settings = np.arange(1 + int(np.max(sessions.setting)))
        known = [np.flatnonzero((sessions.setting == b) & (sessions.alone == 0.0)) for b in settings]
        self.filled = 1.0 * (np.arange(max(1, *map(len, known))) < np.array(list(map(len, known)))[:, None])
        self.known = np.zeros(self.filled.shape, dtype=int)
        self.known[self.filled > 0.0] = np.concatenate(known)
        self.lone = np.flatnonzero(sessions.alone)
        self.of_setting = 1.0 * (sessions.setting[self.lone][:, None] == settings)
        most = np.sum(self.of_setting, axis=0)
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
        flat = scatter.reshape(-1, 1, 1)
        # Axes: scatter, setting, case.
        X2, y, count, spread = self._cases(groups.known, xp)
        v = self.reading_variance + (self.trial_scatter * X2[None, ..., 0]) ** 2 + flat**2
        weight, y = (groups.filled * count)[None] / v, (y - X2[..., 0])[None]
        inside = (groups.filled * count)[None] * (LOG_2PI + xp.log(v)) + (groups.filled * spread)[None] / v
        # What the discrepancy explains of the trials of known friction, and its normal density given these.
        prior, moment = (self.discrepancy**2)[None], xp.sum(weight * y, axis=2)
        gain = 1.0 + prior * xp.sum(weight, axis=2)
        variance = prior / gain
        density = -0.5 * (xp.sum(inside + weight * y**2, axis=2) - variance * moment**2 + xp.log(gain))
        if groups.grid:
            density = density + self._of_lone_sessions(flat, variance * moment, variance, xp)
        return density.reshape(*scatter.shape, -1)

    def _cases(self, index: Any, xp: ModuleType) -> tuple[Any, Any, Any, Any]:
        """``X2`` (..., nodes), mean, number and spread of cases ``index`` (...)."""
        index = xp.asarray(index).astype(int)  # The log-posterior stores all numbers of experiments as floats.
        groups = self.groups
        return self.X2[index], *(xp.asarray(x)[index] for x in (groups.mean, groups.count, groups.spread))

    def _of_lone_sessions(self, scatter: Any, mean: Any, variance: Any, xp: ModuleType) -> Any:
        """(scatter, settings) density of the trials whose z is integrated out.

        Parameters
        ----------
        scatter : (scatter, 1, 1) m
        mean, variance : (scatter, settings) of the discrepancy given all other trials, m and m^2
        """
        groups, special = self.groups, scipy_special if xp is np else jax_special
        X2, y, count, spread = self._cases(groups.lone, xp)
        start, slope = lines(X2, xp)
        sides = SIDES[None]
        far = start + FARTHEST_Z * sides * slope
        nearest = xp.clip(y[:, None], xp.minimum(start, far), xp.maximum(start, far))
        # Axes: scatter, case, line, discrepancy.
        v = (self.reading_variance + (self.trial_scatter * nearest[None]) ** 2 + scatter**2)[..., None]
        start, slope, sides = (x[None, ..., None] for x in (start, slope, sides))
        y, count, spread = (x[None, :, None, None] for x in (y, count, spread))
        # Where only one session is integrated out, the variance of the discrepancy stays in the closed form.
        own, several, grid = groups.of_setting.T, groups.several[None], np.array(groups.grid).reshape(1, 1, 1, -1)
        mean, inner, outer = (
            (x @ own)[..., None, None] for x in (mean, variance * (1.0 - several), variance * several)
        )
        r, w = y - start - (mean + xp.sqrt(outer) * grid), v / count + inner
        total = w + slope**2
        inside = (count - 1.0) * (LOG_2PI + xp.log(v)) + xp.log(count) + spread / v
        # Given the readings and its line, z is normal; the part of it on the side of the line counts. Where both parts
        # are 0 in floating point, the readings are about 38 sds from all that the session can explain.
        part = 0.5 * special.erfc(-sides * slope * r / xp.sqrt(2.0 * w * total))
        density = -0.5 * (inside + LOG_2PI + xp.log(total) + r**2 / total)
        cases = special.logsumexp(density, axis=2, b=xp.maximum(part, LEAST))
        weights = -0.5 * grid[0] ** 2 - scipy_special.logsumexp(-0.5 * grid**2)
        return special.logsumexp(xp.einsum("kcd,cb->kbd", cases, groups.of_setting) + weights, axis=2)
