"""Density of the trials of a progression from sums over cases: the trials of one setting in one session.

Trials of a case differ only by their own scatter, so their number, mean and spread are sufficient. Given the
parameters, settings are independent. The discrepancy of a setting is integrated out in closed form, and so is the
session of a case that has none as a parameter: its motion is piecewise linear in z. Where a setting has several of
these, they share its discrepancy, which is integrated by Gauss-Hermite quadrature about a normal approximation.
With heavy tails the density is a sum over the choices of outlying trials, see
``capsule_id.experiments.progression.outliers``.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special as jax_special
import numpy as np
import scipy.special as scipy_special
from jaxtyping import Float
from numpy.polynomial.hermite_e import hermegauss

from capsule_id.experiments.linear import LOG_2PI
from capsule_id.experiments.progression.outliers import configurations
from capsule_id.experiments.progression.sessions import INNER, MIDDLE, NODES, Sessions, edges, lines

#: Nodes of the discrepancy of a setting with several sessions that are integrated out. Errors are below 0.01 where it is
#: up to 3 sds of the mean of a case, and reach 2 at 10 sds where a motion is flat on one side of a kink and steep beyond.
DISCREPANCIES = 13
#: Within these z a line may explain the readings, for the variance of a trial that depends on its displacement.
FARTHEST_Z = 3.0
#: Smallest probability that is computed as such; the logarithm of a smaller one is that of the tail of a normal density.
LEAST = 1e-300


class TrialGroups(eqx.Module):
    """Cases of trials: those whose session is known, by setting, and those whose session is integrated out.

    Attributes
    ----------
    trials : (cases,) number of trials
    variance : (configurations, n) of every trial, relative to the usual one; its inverse is the weight of a trial
    log_share : (configurations, settings) log-probability
    count, mean, spread : (configurations, cases) sum of the weights, weighted mean, m, and sum of squares about it, m^2
    measure : (configurations, cases) sum of the logarithms of ``variance``
    known, filled : (settings, g) index of the cases of a setting that are known, and 1 where there is one; else any case
    lone : index of the other cases: of those alone in their setting, apart from known ones, and of those that share it
    of_setting : for both, (cases, settings) 1 where a case belongs to a setting
    """

    trials: np.ndarray
    variance: np.ndarray
    log_share: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    measure: np.ndarray
    known: np.ndarray
    filled: np.ndarray
    lone: tuple[np.ndarray, np.ndarray]
    of_setting: tuple[np.ndarray, np.ndarray]

    def __init__(self, distance: Float[np.ndarray, " n"], sessions: Sessions, heavy: bool = False) -> None:
        """Group trials by their distance, m."""
        settings = np.arange(1 + int(np.max(sessions.setting)))
        self.trials = np.sum(sessions.rows, axis=0)
        membership = sessions.rows @ (sessions.setting[:, None] == settings)
        self.variance, self.log_share = configurations(membership, heavy)
        weight = 1.0 / self.variance
        self.count, self.measure = weight @ sessions.rows, np.log(self.variance) @ sessions.rows
        self.mean = (weight * distance) @ sessions.rows / self.count
        self.spread = (weight * (distance - self.mean @ sessions.rows.T) ** 2) @ sessions.rows
        known = [np.flatnonzero((sessions.setting == b) & (sessions.alone == 0.0)) for b in settings]
        self.filled = 1.0 * (np.arange(max(1, *map(len, known))) < np.array(list(map(len, known)))[:, None])
        first = np.array([np.argmax(sessions.setting == b) for b in settings])
        self.known = np.repeat(first[:, None], self.filled.shape[1], axis=1)
        self.known[self.filled > 0.0] = np.concatenate(known)
        self.lone = np.flatnonzero(sessions.alone > sessions.shared), np.flatnonzero(sessions.shared)
        first, second = (1.0 * (sessions.setting[own][:, None] == settings) for own in self.lone)
        self.of_setting = first, second


@dataclass(frozen=True)
class TrialMisfit:
    """Trials against their model, at any value of ``trial_sd``.

    Attributes
    ----------
    X2 : (cases, nodes) displacements at z = ``NODES``, m; where z is a parameter, the middle one counts
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
        scatter = xp.asarray(scatter)
        found = self.of_configurations(scatter.reshape(-1), xp) + xp.asarray(self.groups.log_share)[:, None]
        special = scipy_special if xp is np else jax_special
        return special.logsumexp(found, axis=0).reshape(*scatter.shape, -1)

    def of_configurations(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """(configurations, scatter, settings) that of the trials of each setting, at ``scatter`` (scatter,), m."""
        number = self.groups.log_share.shape[0]
        flat = xp.tile(scatter, number).reshape(-1, 1, 1)
        # Axes: row (a configuration and a scatter), setting, case.
        own = self._cases(self.groups.known, len(scatter), xp)
        v = self.reading_variance + (self.trial_scatter * own.X2[None, ..., MIDDLE]) ** 2 + flat**2
        filled = xp.asarray(self.groups.filled)[None]
        weight, y = filled * own.count / v, own.mean - own.X2[None, ..., MIDDLE]
        inside = filled * (own.trials[None] * (LOG_2PI + xp.log(v)) + own.measure + own.spread / v)
        # What the discrepancy explains of the trials of known friction, and its normal density given these.
        prior, moment = (self.discrepancy**2)[None], xp.sum(weight * y, axis=2)
        gain = 1.0 + prior * xp.sum(weight, axis=2)
        variance = prior / gain
        density = -0.5 * (xp.sum(inside + weight * y**2, axis=2) - variance * moment**2 + xp.log(gain))
        for shared in np.flatnonzero([own.shape[0] > 0 for own in self.groups.lone]):
            density = density + self._of_lone_sessions(int(shared), flat, (variance * moment, variance), xp)
        return density.reshape(number, len(scatter), -1)

    def _cases(self, index: Any, scatters: int, xp: ModuleType) -> "_Cases":
        """Trials of the cases ``index`` (...), each configuration with every one of so many scatters."""
        index = xp.asarray(index).astype(int)  # The log-posterior stores all numbers of experiments as floats.
        groups = self.groups
        repeats = scatters if groups.log_share.shape[0] > 1 else 1
        of_rows = (groups.count, groups.mean, groups.spread, groups.measure)
        taken = (xp.repeat(xp.asarray(x)[:, index], repeats, axis=0) for x in of_rows)
        return _Cases(self.X2[index], xp.asarray(groups.trials)[index], *taken)

    def _of_lone_sessions(self, shared: int, scatter: Any, discrepancy: tuple[Any, Any], xp: ModuleType) -> Any:
        """(rows, settings) density of the trials whose z is integrated out.

        The variance of a trial is taken where its line is nearest to the mean of the trials.

        Parameters
        ----------
        shared : 0 for cases that have a setting for themselves, 1 for those that share it
        scatter : (rows, 1, 1) m
        discrepancy : (rows, settings) its mean, m, and variance, m^2, given the trials of known friction
        """
        special, of_setting = scipy_special if xp is np else jax_special, self.groups.of_setting[shared]
        nodes, chosen = (NODES, slice(None)) if shared else (NODES[INNER], INNER)
        own = self._cases(self.groups.lone[shared], len(scatter) // self.groups.log_share.shape[0], xp)
        start, slope = lines(own.X2[:, chosen], nodes, xp)
        low, high = (start + slope * np.clip(z, -FARTHEST_Z, FARTHEST_Z)[None] for z in edges(nodes))
        nearest = xp.clip(own.mean[..., None], xp.minimum(low, high)[None], xp.maximum(low, high)[None])
        # Axes: row, case, line, discrepancy.
        v = (self.reading_variance + (self.trial_scatter * nearest) ** 2 + scatter**2)[..., None]
        start, slope = (x[None, ..., None] for x in (start, slope))
        y, count, spread, measure = (x[..., None, None] for x in (own.mean, own.count, own.spread, own.measure))
        trials = own.trials[None, :, None, None]
        mean, variance = ((x @ of_setting.T)[..., None, None] for x in discrepancy)
        at, weights = hermegauss(DISCREPANCIES if shared else 1)
        t, correction = xp.zeros((1, 1, 1, 1)), xp.zeros((1, 1, 1))
        if shared:
            t, correction = self._discrepancies(own, scatter, discrepancy, at, xp)
            t = xp.einsum("kbd,cb->kcd", t, of_setting)[:, :, None]
        r = y - start - (mean + xp.sqrt(variance) * t)
        # One case of a setting has the variance of the discrepancy in closed form.
        w = v / count + (0.0 if shared else variance)
        total = w + slope**2
        inside = (trials - 1.0) * (LOG_2PI + xp.log(v)) + xp.log(count) + measure + spread / v
        # Given the readings and its line, z is normal; the part of it that belongs to the line counts.
        z, precision = slope * r / total, xp.sqrt(total / w)
        lower, upper = ((edge.reshape(1, 1, -1, 1) - z) * precision for edge in edges(nodes))
        part = _log_probability(lower, upper, special, xp)
        cases = special.logsumexp(part - 0.5 * (inside + LOG_2PI + xp.log(total) + r**2 / total), axis=2)
        log_weights = correction + np.log(weights / np.sum(weights)).reshape(1, 1, -1)
        settings = xp.einsum("kcd,cb->kbd", cases, of_setting)
        return special.logsumexp(settings + log_weights, axis=2)

    def _discrepancies(
        self, own: "_Cases", scatter: Any, discrepancy: tuple[Any, Any], at: np.ndarray, xp: ModuleType
    ) -> tuple[Any, Any]:
        """(rows, settings, d) discrepancies in sds from their mean, and logarithms of the factors of their weights.

        The nodes ``at`` lie about a normal approximation: each motion is taken as linear between the inner runs.
        """
        of_setting = self.groups.of_setting[1]
        X2 = own.X2.reshape(1, *own.X2.shape)
        slope = (X2[..., INNER][..., -1] - X2[..., INNER][..., 0]) / (NODES[INNER][-1] - NODES[INNER][0])
        v = self.reading_variance + (self.trial_scatter * X2[..., MIDDLE]) ** 2 + scatter[..., 0] ** 2
        q = 1.0 / (v / own.count + slope**2)
        mean, variance = discrepancy
        r = own.mean - X2[..., MIDDLE] - mean @ of_setting.T
        gain = 1.0 + variance * (q @ of_setting)
        centre = xp.sqrt(variance) * ((q * r) @ of_setting) / gain
        u = at.reshape(1, 1, -1)
        t = centre[..., None] + u / xp.sqrt(gain)[..., None]
        return t, 0.5 * (u**2 - t**2 - xp.log(gain)[..., None])


class _Cases(NamedTuple):
    """Trials of some cases; see ``TrialGroups``. All but the first two have an axis of rows in front.

    Attributes
    ----------
    X2 : (..., nodes) displacements, m
    trials : (...) number
    count, mean, spread, measure : (rows, ...), where there is one configuration (1, ...)
    """

    X2: Any
    trials: Any
    count: Any
    mean: Any
    spread: Any
    measure: Any


def _log_probability(lower: Any, upper: Any, special: ModuleType, xp: ModuleType) -> Any:
    """Logarithm of the standard normal probability between ``lower`` and ``upper``, which differ by 1 or more."""
    right = lower > 0.0
    near, far = xp.where(right, lower, -upper), xp.where(right, upper, -lower)
    found = 0.5 * (special.erfc(near / np.sqrt(2.0)) - special.erfc(far / np.sqrt(2.0)))
    tail = -0.5 * (near**2 + LOG_2PI) - xp.log(xp.maximum(near, 1.0))
    return xp.where(found > LEAST, xp.log(xp.maximum(found, LEAST)), tail)
