"""Misfit of the trials of a progression, linear about the most probable friction of each session."""

from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.misfit import Misfit
from capsule_id.experiments.progression.density.sessions import MIDDLE, NODES, edges, lines

if TYPE_CHECKING:
    from capsule_id.experiments.progression.experiment import Progression


def linear_misfit(e: "Progression", theta: ValuesBySymbol, X2: Any, xp: ModuleType = jnp) -> Misfit:
    """The misfit at the ``responses`` (cases, nodes), m, the motion of a session linear about its most probable z.

    With heavy tails the outlying trials are those of the most probable alternative of each setting.
    """
    rows, columns = xp.asarray(e.sessions.rows), xp.asarray(e.sessions.columns)
    usual = _relative_variance(e, theta, X2, xp)
    start, slope, expected = _most_probable_lines(e, theta, xp.asarray(X2), 1.0 / usual, xp)
    discrepancy = theta["discrepancy"] * e.setting * e.time[None]
    design = xp.concatenate([(rows @ columns) * (slope @ columns)[None], discrepancy], axis=1)
    variance = e.reading_variance + (theta["trial_scatter"] * (rows @ expected)) ** 2
    return Misfit(e.distance - rows @ start, usual * variance, xp.sqrt(usual), design)


def _relative_variance(e: "Progression", theta: ValuesBySymbol, X2: Any, xp: ModuleType) -> Any:
    """(n,) variance of each trial relative to the usual one."""
    groups = e.groups
    if not e.heavy:
        return xp.ones(e.n)
    density = e.trials_of(theta, X2, xp).of_alternatives(xp.asarray(theta["trial_sd"]).reshape(1), xp)[0]
    own = xp.asarray(e.setting) @ (xp.arange(len(e.settings))[:, None] == xp.asarray(groups.setting)[None])
    best = xp.argmax(xp.where(own > 0.0, density[None], -xp.inf), axis=1)
    return xp.take_along_axis(xp.asarray(groups.variance), best[None], axis=0)[0]


def _most_probable_lines(
    e: "Progression", theta: ValuesBySymbol, X2: Any, weight: Any, xp: ModuleType
) -> tuple[Any, ...]:
    """(cases,) value at z = 0 and slope of the line with the most probable z, and its displacement there, m.

    The slope is 0 where this z is at a kink: no small change of it explains more.

    Parameters
    ----------
    weight : (n,) of each trial
    """
    start, slope = lines(X2, NODES, xp)
    rows = xp.asarray(e.sessions.rows)
    count = weight @ rows
    r = ((weight * e.distance) @ rows / count)[:, None] - start
    time = xp.asarray(e.time)[xp.asarray(e.sessions.setting).astype(int)][:, None]
    variance = e.reading_variance + (theta["trial_scatter"] * X2[:, MIDDLE, None]) ** 2 + theta["trial_sd"] ** 2
    w = variance / count[:, None] + (theta["discrepancy"] * time) ** 2
    low, high = (xp.asarray(edge[None]) for edge in edges(NODES))
    z = xp.clip(slope * r / (w + slope**2), low, high)
    best = xp.argmin(z**2 + (r - slope * z) ** 2 / w, axis=1)[:, None]
    expected, inside = start + slope * z, (z > low) & (z < high)
    found = xp.where(inside, start, expected), xp.where(inside, slope, 0.0), expected
    return tuple(xp.take_along_axis(x, best, axis=1)[:, 0] for x in found)
