"""Sessions of a progression: how the friction of each one enters, and the runs of the capsule that follow.

Session j has friction multiplied by exp(session_sd z_j), z_j ~ N(0, 1). Where it has several settings, z_j is a
parameter; at most eight sessions are. All others are integrated out, in each of their settings alone, with a motion that
is piecewise linear in z_j between runs. There are more runs where the setting has several of these sessions,
because they determine z_j apart from the discrepancy, also far from 0.
"""

from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.progression.declaration import SESSIONS

#: z beyond which a session has no weight.
FAR = 1e3
#: z of the runs of a session that is integrated out. One that has its setting for itself has the inner ones only. The
#: outer lines go on beyond their runs.
NODES = np.array([-2.5, -1.25, 0.0, 1.25, 2.5])
INNER, MIDDLE = slice(1, 4), 2


class Sessions(eqx.Module):
    """Cases, each a setting in a session, and their runs, in the order of the cases.

    Attributes
    ----------
    rows : (n, cases) 1 where a trial belongs to a case
    setting : (cases,) index of its setting
    alone : (cases,) 1 where z is integrated out
    columns : (cases, lone) 1 where a case is the one of these that has this number
    shared : (cases,) 1 where z of another session of the setting is integrated out too
    at : (cases, nodes) index of the run at each of ``NODES``, or of the nearest one
    case, node : (runs,) index of the case; z of a session that is integrated out, else 0
    own : (runs, parameters) 1 where z is this parameter
    """

    rows: np.ndarray
    setting: np.ndarray
    alone: np.ndarray
    columns: np.ndarray
    shared: np.ndarray
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
        shared = alone & (np.bincount(cases[:, 0], weights=alone)[cases[:, 0]] > 1.0)
        self.rows, self.setting = np.eye(len(cases))[case], cases[:, 0]
        self.alone, self.columns, self.shared = 1.0 * alone, np.eye(len(cases))[:, alone], 1.0 * shared
        kept = np.arange(len(NODES))
        nodes = [
            kept if many else kept[INNER] if one else kept[[MIDDLE]] for one, many in zip(alone, shared, strict=True)
        ]
        runs = np.array(list(map(len, nodes)))
        self.case, self.node = np.repeat(np.arange(len(cases)), runs), NODES[np.concatenate(nodes)]
        self.at = (np.cumsum(runs) - runs)[:, None] + np.array(
            [np.clip(kept - own[0], 0, len(own) - 1) for own in nodes]
        )
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
        """(..., cases, nodes) X2 of every case at ``NODES``, from (..., runs): beyond the outer runs linear."""
        X = jnp.asarray(X2)[..., _index(self.at)]
        outer = jnp.stack([2.0 * X[..., 1] - X[..., 2], 2.0 * X[..., 3] - X[..., 2]], axis=-1)
        beyond = jnp.concatenate([outer[..., :1], X[..., INNER], outer[..., 1:]], axis=-1)
        return jnp.where((jnp.asarray(self.shared) > 0.0).reshape(*(1,) * (X.ndim - 2), -1, 1), X, beyond)


def _index(numbers: Any) -> Any:
    # The log-posterior stores all numbers of experiments as floats.
    return jnp.asarray(numbers).astype(int)


def lines(X: Any, nodes: np.ndarray, xp: ModuleType = jnp) -> tuple[Any, Any]:
    """(..., lines) value at z = 0 and slope of the lines between X (..., nodes)."""
    z = xp.asarray(nodes.reshape(*(1,) * (X.ndim - 1), -1))
    slope = (X[..., 1:] - X[..., :-1]) / (z[..., 1:] - z[..., :-1])
    return X[..., 1:] - slope * z[..., 1:], slope


def edges(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(lines,) z where each line begins and ends; the outer ones go on."""
    return np.append(-FAR, nodes[1:-1]), np.append(nodes[1:-1], FAR)


def parameters_of(
    setting: Float[np.ndarray, "n settings"], session: Float[np.ndarray, "n sessions"]
) -> Int[np.ndarray, " sessions"]:
    """Index of the parameter of each session, -1 where it is integrated out, in each of its settings alone.

    Sessions with several settings have parameters, at most as many as there are ``SESSIONS``: those with most settings.
    """
    settings = np.sum((session.T @ setting) > 0.0, axis=1)
    most = np.argsort(-settings, kind="stable")[: len(SESSIONS)]
    chosen = np.sort(most[settings[most] > 1])
    found = np.full(len(settings), -1)
    found[chosen] = np.arange(len(chosen))
    return found
