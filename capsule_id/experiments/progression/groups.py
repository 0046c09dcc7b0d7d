"""Density of the trials of a progression from sums over cases: the trials of one setting in one session.

Trials of a case differ only by their own scatter, so their number, mean and spread are sufficient. Cases that share a
setting or a session, directly or through others, form a component; components are independent given the parameters.
The discrepancy of a setting is integrated out first, then the sessions of a component, of which there are few.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from capsule_id.experiments.linear import LOG_2PI, marginal_log_density


class TrialGroups(eqx.Module):
    """Cases (components, g) of trials; a component with fewer than g cases is padded with empty ones.

    Attributes
    ----------
    count, mean, spread : (components, g) number of trials, mean, m, and sum of squares about it, m^2
    case : (components, g) index of the case
    own_setting : (components, g, b) 1 where the case belongs to a setting of its component
    own_session : (components, g, s) 1 where the case belongs to a session of its component
    """

    count: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    case: np.ndarray
    own_setting: np.ndarray
    own_session: np.ndarray

    def __init__(self, distance: Float[np.ndarray, " n"], setting: np.ndarray, session: np.ndarray) -> None:
        """Group trials by their distance, m, and memberships (n, settings) and (n, sessions); cases in that order."""
        rows = np.stack([np.argmax(setting, axis=1), np.argmax(session, axis=1)], axis=1)
        pairs, group = np.unique(rows, axis=0, return_inverse=True)
        settings, number = setting.shape[1], setting.shape[1] + session.shape[1]
        ends = (pairs[:, 0], settings + pairs[:, 1])
        label = connected_components(csr_array((np.ones(len(pairs)), ends), shape=(number, number)))[1][pairs[:, 0]]
        members = [np.flatnonzero(label == k) for k in np.unique(label)]
        shape = len(members), max(map(len, members))
        self.count, self.mean, self.spread = (np.zeros(shape) for _ in range(3))
        self.case = np.zeros(shape, dtype=int)
        for k, found in enumerate(members):
            x = [distance[group == one] for one in found]
            filled = k, slice(len(found))
            self.count[filled], self.mean[filled] = list(map(len, x)), list(map(np.mean, x))
            self.spread[filled], self.case[filled] = [len(one) * np.var(one) for one in x], found
        self.own_setting, self.own_session = (_members(pairs[:, i], members, shape[1]) for i in range(2))


def _members(owner: np.ndarray, members: list[np.ndarray], width: int) -> np.ndarray:
    """(components, width, m) 1 where a group has an owner, owners being counted within their component."""
    own = [np.unique(owner[found], return_inverse=True)[1] for found in members]
    found = np.zeros((len(members), width, 1 + max(map(np.max, own))))
    for k, index in enumerate(own):
        found[k, np.arange(len(index)), index] = 1.0
    return found


@dataclass(frozen=True)
class TrialMisfit:
    """Trials against their model, at any value of ``trial_sd``.

    Attributes
    ----------
    expected, per_sd, fixed_variance, discrepancy : (cases,) mean displacement, m, its change per standard deviation
        of a session, m, variance of a trial without ``trial_sd``, m^2, standard deviation of the discrepancy, m
    """

    groups: TrialGroups
    expected: Any
    per_sd: Any
    fixed_variance: Any
    discrepancy: Any

    def log_density(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the trials at ``scatter`` (...), m; (...)."""
        groups, scatter = self.groups, xp.asarray(scatter)
        # The log-posterior stores all numbers of experiments as floats. Axes: scatter k, component c, group g.
        index = xp.asarray(groups.case).astype(int)
        y, a = groups.mean - self.expected[index], self.per_sd[index][..., None] * groups.own_session
        v = self.fixed_variance[index][None] + scatter.reshape(-1, 1, 1) ** 2
        w, count = groups.count[None] / v, xp.broadcast_to(groups.count, v.shape)
        alone = xp.sum(count * (LOG_2PI + xp.log(v)) + groups.spread[None] / v, axis=(1, 2))
        # Sums over the groups of a setting b, and what its discrepancy explains of them.
        variance = xp.max(groups.own_setting * self.discrepancy[index][..., None], axis=1)[None] ** 2
        gain = 1.0 + variance * xp.einsum("kcg,cgb->kcb", w, groups.own_setting)
        part = variance / gain
        wy = xp.einsum("kcg,cg,cgb->kcb", w, y, groups.own_setting)
        wa = xp.einsum("kcg,cgs,cgb->kcbs", w, a, groups.own_setting)
        yy = xp.einsum("kcg,cg->kc", w, y**2) - xp.sum(part * wy**2, axis=-1)
        ay = xp.einsum("kcg,cg,cgs->kcs", w, y, a) - xp.einsum("kcb,kcbs->kcs", part * wy, wa)
        aa = xp.einsum("kcg,cgs,cgr->kcsr", w, a, a) - xp.einsum("kcb,kcbs,kcbr->kcsr", part, wa, wa)
        integrated = marginal_log_density(yy, ay, aa, 0, xp) - 0.5 * xp.sum(xp.log(gain), axis=-1)
        return (xp.sum(integrated, axis=1) - 0.5 * alone).reshape(scatter.shape)
