"""Functions of many draws of the parameters, in compiled batches on all cores."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.physics.batches import pool

if TYPE_CHECKING:
    from capsule_id.experiments.progression.experiment import Progression

#: Draws of one compiled batch.
DRAWS_OF_A_BATCH = 16


def batched(
    function: Callable[..., Any],
    e: "Progression",
    draws: Sequence[ValuesBySymbol],
    s: np.ndarray,
    settings: np.ndarray,
) -> np.ndarray:
    """``function(e, theta, s, settings)`` at every draw and row of ``s``, in batches of one size, on all cores."""
    symbols = tuple(name for name in draws[0] if np.ndim(draws[0][name]) == 0)
    rows = np.concatenate([np.array([[draw[name] for name in symbols] for draw in draws]), s], axis=1)
    padded = np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % DRAWS_OF_A_BATCH, axis=0)])
    parts = np.split(padded, len(padded) // DRAWS_OF_A_BATCH)
    found = pool().map(lambda part: np.asarray(_of_rows(function, e, symbols, part, settings)), parts)
    return np.concatenate(list(found))[: len(rows)]


@eqx.filter_jit
def _of_rows(function: Callable[..., Any], e: "Progression", symbols: tuple[str, ...], rows: Any, settings: Any) -> Any:
    def one(row: Any) -> Any:
        theta = dict(zip(symbols, row[: len(symbols)], strict=True))
        return function(e, theta, row[len(symbols) :], settings)

    return jax.vmap(one)(rows)
