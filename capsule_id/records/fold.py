"""Folds a periodic record onto one period; the samples of each period lie between those of the others.

The sampling step rarely divides the period. Ten periods at 1 kHz then give one period at 10 kHz.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Local:
    """Local polynomials at (m,) places: value, rate per second, and their sd for unit noise."""

    value: Float[np.ndarray, " m"]
    rate: Float[np.ndarray, " m"]
    sd: Float[np.ndarray, " m"]
    rate_sd: Float[np.ndarray, " m"]


def local_polynomials(
    phase: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    period: float,
    places: Float[np.ndarray, " m"],
    half_width: float,
    order: int,
) -> Local:
    """Least-squares polynomials over windows of a folded record, the folded Savitzky–Golay filter.

    Parameters
    ----------
    phase : (n,) s, in [0, period)
    values : (n,)
    period : s
    places : (m,) s, where the polynomials are evaluated
    half_width : of the window, s; the window is half open and holds at least ``order`` + 1 different phases
    order : of the polynomial; with 0 the value is a mean and the rate is 0
    """
    sort = np.argsort(phase)
    axis = (phase[sort] + period * np.array([-1.0, 0.0, 1.0])[:, None]).ravel()
    y = np.tile(values[sort], 3)
    low = np.searchsorted(axis, places - half_width)
    count = np.searchsorted(axis, places + half_width) - low
    index = low[:, None] + np.arange(int(count.max()))
    inside = np.arange(index.shape[1]) < count[:, None]
    index = np.minimum(index, len(axis) - 1)
    u = np.where(inside, (axis[index] - places[:, None]) / half_width, 0.0)
    design = u[:, :, None] ** np.arange(order + 1) * inside[:, :, None]
    inverse = np.linalg.inv(np.einsum("mkp,mkq->mpq", design, design))
    weights = np.einsum("mpq,mkq->mpk", inverse, design)
    unknowns = np.einsum("mpk,mk->mp", weights, np.where(inside, y[index], 0.0))
    none = np.zeros(len(places))
    rate = unknowns[:, 1] / half_width if order else none
    rate_sd = np.sqrt(inverse[:, 1, 1]) / half_width if order else none
    return Local(unknowns[:, 0], rate, np.sqrt(inverse[:, 0, 0]), rate_sd)


def intervals_above(z: Float[np.ndarray, " n"], low: float, high: float) -> list[tuple[int, int]]:
    """Stretches of a cyclic sequence (n,) that begin above ``high`` and last until it has fallen below ``low``.

    Returns (first, length) of each, indices modulo n; a sequence that never falls below ``low`` is one stretch if it
    rises above ``high`` at all. The two levels keep noise about one level from splitting or joining stretches.
    """
    state = np.where(z > high, 1, np.where(z < low, 0, -1))
    if not (state == 1).any():
        return []
    if not (state == 0).any():
        return [(0, len(z))]
    first = int(np.flatnonzero(state == 0)[0])
    turned = np.roll(state, -first)
    # Between the levels the last state stays.
    held = turned[np.maximum.accumulate(np.where(turned >= 0, np.arange(len(z)), 0))]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], held, [0]])))
    return [((int(a) + first) % len(z), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
