"""Emulator of the runs of a progression."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.emulator import Emulator
from capsule_id.experiments.progression.density.sessions import Sessions
from capsule_id.physics.batches import pool


class RunEmulator(eqx.Module):
    """One emulator of the runs of each session that is a parameter, and one of all others.

    A run depends on the friction of its own session alone, and inputs without effect make an emulator less accurate.

    Attributes
    ----------
    symbols : of the parameters of sessions
    parts : the emulators that are needed
    place : (runs,) place of each run among the outputs of ``parts``
    """

    symbols: tuple[str, ...] = eqx.field(static=True)
    parts: tuple[Emulator, ...]
    place: np.ndarray

    def __init__(
        self,
        sessions: Sessions,
        positive: Mapping[str, bool],
        draws: Sequence[ValuesBySymbol],
        motions: Float[np.ndarray, "n runs"],
    ) -> None:
        """Fit to the ``motions`` at ``draws``; ``positive``: parameters of the motion, and whether each is positive."""
        self.symbols = sessions.symbols
        groups = [({**positive, "session_sd": True}, np.all(sessions.own == 0.0, axis=1))]
        groups += [({**positive, name: False}, sessions.own[:, j] > 0.0) for j, name in enumerate(self.symbols)]
        groups = [(inputs, np.flatnonzero(own)) for inputs, own in groups if np.any(own)]
        known = [self._inputs(draw) for draw in draws]
        self.parts = tuple(pool().map(lambda group: Emulator(group[0], known, motions[:, group[1]]), groups))
        self.place = np.argsort(np.concatenate([own for _, own in groups]))

    def __call__(self, theta: ValuesBySymbol) -> Any:
        """(runs,) motions at parameters by symbol, () each."""
        inputs = self._inputs(theta)
        return jnp.concatenate([part(inputs) for part in self.parts])[jnp.asarray(self.place).astype(int)]

    def _inputs(self, theta: ValuesBySymbol) -> dict[str, Any]:
        """Sessions enter by the logarithm of their friction."""
        return {**theta, **{symbol: theta["session_sd"] * theta[symbol] for symbol in self.symbols}}
