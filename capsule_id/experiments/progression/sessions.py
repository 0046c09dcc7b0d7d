"""Sessions of a progression: how the friction of each one enters, and the runs of the capsule that follow.

Session j has friction multiplied by exp(session_sd z_j), z_j ~ N(0, 1). Where a session has several settings, its
trials determine z_j well, and the motion is no straight line in it: z_j is a parameter. A session with one setting
enters linearly, by runs at z = ± 1, and is integrated out. The error of this is one of its setting, as a discrepancy is.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.progression.declaration import SESSIONS


class Sessions(eqx.Module):
    """Cases, each a setting in a session, and their runs: first one of every case, then the second ends of linear ones.

    Attributes
    ----------
    rows : (n, cases) 1 where a trial belongs to a case
    setting : (cases,) index of its setting
    linear : (n, s) 1 where a trial belongs to a session that enters linearly; the other cases have a column each
    shared : (n, r) the columns of ``linear`` of sessions that enter linearly
    case, sign : (runs,) index of the case; z of a session that enters linearly, else 0
    own : (runs, parameters) 1 where z is this parameter
    second : (cases,) index of the run at the other end; of the same run where z is a parameter
    """

    rows: np.ndarray
    setting: np.ndarray
    linear: np.ndarray
    shared: np.ndarray
    case: np.ndarray
    sign: np.ndarray
    own: np.ndarray
    second: np.ndarray

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
        first, linear = np.arange(len(cases)), np.flatnonzero(of < 0)
        self.rows, self.setting = np.eye(len(cases))[case], cases[:, 0]
        shared = np.stack([cases[:, 1], np.where(of < 0, -1, cases[:, 0])], axis=1)
        link = np.unique(shared, axis=0, return_inverse=True)[1]
        self.linear = np.eye(1 + int(np.max(link)))[link[case]]
        self.shared = self.linear[:, np.unique(link[of < 0])]
        self.case = np.concatenate([first, linear])
        self.sign = np.concatenate([np.where(of < 0, 1.0, 0.0), -np.ones(len(linear))])
        self.own = 1.0 * (of[self.case][:, None] == np.arange(1 + int(np.max(parameter))))
        self.second = first.copy()
        self.second[linear] = len(cases) + np.arange(len(linear))

    @property
    def symbols(self) -> tuple[str, ...]:
        """Of the parameters z."""
        return tuple(row.symbol for row in SESSIONS[: self.own.shape[1]])

    def log_friction(self, theta: ValuesBySymbol) -> Any:
        """(runs,) logarithm of what multiplies the friction."""
        known = [theta[symbol] for symbol in self.symbols]
        z = self.sign + (self.own @ jnp.stack(known) if known else 0.0)
        return theta["session_sd"] * z

    @property
    def setting_of_run(self) -> Any:
        """(runs,) index of the setting of each run."""
        return _index(self.setting)[_index(self.case)]

    def responses(self, X2: Any) -> tuple[Any, Any]:
        """(..., cases) mean of X2 over what is not a parameter, m, and its change per sd of a session, m, from (..., runs)."""
        second = _index(self.second)
        upper, lower = X2[..., : len(second)], jnp.asarray(X2)[..., second]
        return 0.5 * (upper + lower), 0.5 * (upper - lower)


def _index(numbers: Any) -> Any:
    # The log-posterior stores all numbers of experiments as floats.
    return jnp.asarray(numbers).astype(int)


def parameters_of(
    setting: Float[np.ndarray, "n settings"], session: Float[np.ndarray, "n sessions"]
) -> Int[np.ndarray, " sessions"]:
    """Index of the parameter of each session, -1 where it enters linearly.

    Sessions with several settings have parameters, at most as many as there are ``SESSIONS``: those with most settings.
    """
    settings = np.sum((session.T @ setting) > 0.0, axis=1)
    most = np.argsort(-settings, kind="stable")[: len(SESSIONS)]
    chosen = np.sort(most[settings[most] > 1])
    found = np.full(len(settings), -1)
    found[chosen] = np.arange(len(chosen))
    return found
