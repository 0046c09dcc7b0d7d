"""Sessions of a progression: how the friction of each one enters, and the runs of the capsule that follow.

Session j has friction multiplied by exp(session_sd z_j), z_j ~ N(0, 1). Where it has several settings, or shares its
setting with other sessions, the trials determine z_j apart from the discrepancy: z_j is a parameter. A session that
has a setting for itself is integrated out, its motion linear in z_j on either side of 0, by runs at ``NODES``.
"""

from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.progression.declaration import SESSIONS

#: z of the runs of a session that is integrated out, and the side of 0 of each line between them; it has no other end.
NODES, SIDES = np.array([-1.25, 0.0, 1.25]), np.array([-1.0, 1.0])


class Sessions(eqx.Module):
    """Cases, each a setting in a session, and their runs, in the order of the cases.

    Attributes
    ----------
    rows : (n, cases) 1 where a trial belongs to a case
    setting : (cases,) index of its setting
    alone : (cases,) 1 where z is integrated out
    at : (cases, nodes) index of the run at each of ``NODES``; of the same run where z is a parameter
    case, node : (runs,) index of the case; z of a session that is integrated out, else 0
    own : (runs, parameters) 1 where z is this parameter
    """

    rows: np.ndarray
    setting: np.ndarray
    alone: np.ndarray
    at: np.ndarray
    case: np.ndarray
    node: np.ndarray
    own: np.ndarray

    def __init__(
        self,
        setting: Float[np.ndarray, "n settings"],
        session: Float[np.ndarray, "n sessions"],
        parameter: Int[np.ndarray, " sessions"],
    ) -> None:
        """Cases of trials with these memberships, see ``parameters_of`` for ``parameter``."""
        trials = np.stack([np.argmax(setting, axis=1), np.argmax(session, axis=1)], axis=1)
        cases, case = np.unique(trials, axis=0, return_inverse=True)
        of = parameter[cases[:, 1]]
        alone = of < 0
        self.rows, self.setting, self.alone = np.eye(len(cases))[case], cases[:, 0], 1.0 * alone
        runs = np.where(alone, len(NODES), 1)
        self.case = np.repeat(np.arange(len(cases)), runs)
        self.node = np.concatenate([NODES if one else [0.0] for one in alone])
        self.at = (np.cumsum(runs) - runs)[:, None] + alone[:, None] * np.arange(len(NODES))
        self.own = 1.0 * (of[self.case][:, None] == np.arange(1 + int(np.max(parameter))))

    @property
    def symbols(self) -> tuple[str, ...]:
        """Of the parameters z."""
        return tuple(row.symbol for row in SESSIONS[: self.own.shape[1]])

    def log_friction(self, theta: ValuesBySymbol) -> Any:
        """(runs,) logarithm of what multiplies the friction."""
        known = [theta[symbol] for symbol in self.symbols]
        z = self.node + (self.own @ jnp.stack(known) if known else 0.0)
        return theta["session_sd"] * z

    @property
    def setting_of_run(self) -> Any:
        """(runs,) index of the setting of each run."""
        return _index(self.setting)[_index(self.case)]

    def responses(self, X2: Any) -> Any:
        """(..., cases, nodes) X2 of every case at ``NODES``, from (..., runs)."""
        return jnp.asarray(X2)[..., _index(self.at)]


def _index(numbers: Any) -> Any:
    # The log-posterior stores all numbers of experiments as floats.
    return jnp.asarray(numbers).astype(int)


def lines(X: Any, xp: ModuleType = jnp) -> tuple[Any, Any]:
    """(..., lines) value at z = 0 and slope of the lines between X (..., nodes) at ``NODES``."""
    slope = (X[..., 1:] - X[..., :-1]) / xp.asarray(np.diff(NODES).reshape(*(1,) * (X.ndim - 1), -1))
    return xp.stack([X[..., 1], X[..., 1]], axis=-1), slope


def parameters_of(
    setting: Float[np.ndarray, "n settings"], session: Float[np.ndarray, "n sessions"]
) -> Int[np.ndarray, " sessions"]:
    """Index of the parameter of each session, -1 where it is integrated out, in each of its settings alone.

    There are at most as many parameters as ``SESSIONS``: of the sessions with most settings, then of those that share
    their setting with most others.
    """
    visits = (session.T @ setting) > 0.0
    settings, others = np.sum(visits, axis=1), visits.astype(int) @ (np.sum(visits, axis=0) - 1)
    most = np.lexsort([-others, -settings])[: len(SESSIONS)]
    chosen = np.sort(most[(settings[most] > 1) | (others[most] > 0)])
    found = np.full(len(settings), -1)
    found[chosen] = np.arange(len(chosen))
    return found
