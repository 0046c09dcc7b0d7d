"""A zero of the sensor that jumps where the rod turns, as of an encoder that loses counts or of a loose sensor."""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.free_vibration.readings.blocks import block_size
from capsule_id.experiments.free_vibration.second_fit.sensitivities import sensitivities
from capsule_id.experiments.free_vibration.settings import decay_window

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Half swings that are looked at, from the release on, and fewest of them.
MOST_HALF_SWINGS, FEWEST_HALF_SWINGS = 60, 8
#: Most and fewest readings, or means of readings, per half swing.
MOST_READINGS, FEWEST_READINGS = 64, 8


class Jumps(NamedTuple):
    """Zeros of half swings.

    Attributes
    ----------
    size : rms change of the zero from one half swing to the next, SI
    ratio : sum of squares that zeros of half swings leave, relative to a zero that moves in straight lines from the middle
        of each half swing to that of the next. Both have the same number of parameters
    half_swings : number of zeros
    """

    size: float
    ratio: float
    half_swings: int


def zero_jumps(e: "FreeVibration", theta: ValuesBySymbol) -> Jumps | None:
    """Zeros of the half swings of a record of displacement; None for too few readings.

    What the fitted parameters can take up, and a zero of its own for each direction of the motion (dry friction and
    hysteresis do that), is projected out of both descriptions.
    """
    time, values = e.whole
    end = time[0] + MOST_HALF_SWINGS * np.pi / e.rough_decrement().Omega_o
    if e.order > 0 or np.count_nonzero(time <= end) < FEWEST_HALF_SWINGS * FEWEST_READINGS:
        return None
    settings = replace(e.table.settings, stop=float(decay_window(e.table)[0][0] + min(end, time[-1])))
    thin = block_size(time[time <= end], values[time <= end], 2.0 * MOST_READINGS)
    model = replace(e.model, thin=thin, noise="white", drift="none")
    part = type(e)(replace(e.table, settings=settings), e.rig, e.friction, model)
    left, design, moved = sensitivities(part, theta)
    ahead = np.gradient(part.values - left, part.time) > 0.0
    turns = np.diff(ahead)
    # A mean of readings on both sides of a turning point belongs to no half swing.
    whole = ~(np.append(turns, False) | np.insert(turns, 0, False))
    number = np.unique(np.insert(np.cumsum(turns), 0, 0)[whole], return_inverse=True)[1]
    count = np.bincount(number)
    if len(count) < FEWEST_HALF_SWINGS or np.median(count) < FEWEST_READINGS:
        return None
    middle = np.bincount(number, weights=part.time[whole]) / count
    own = np.eye(len(count))
    lines = np.stack([np.interp(part.time[whole], middle, zero) for zero in own], axis=1)
    known = np.column_stack([design, np.where(ahead, 1.0, -1.0), *moved.values()])[whole]
    jumping, zeros = _least_squares(known, own[number], left[whole])
    moving, _ = _least_squares(known, lines, left[whole])
    return Jumps(float(np.sqrt(np.mean(np.diff(zeros) ** 2))), jumping / moving if moving > 0.0 else 1.0, len(count))


def _least_squares(known: np.ndarray, columns: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of squares that ``known`` (n, p) and ``columns`` (n, q) leave of ``values``, and the coefficients (q,)."""
    size = np.linalg.norm(known, axis=0)
    table = np.hstack([known[:, size > 0.0] / size[size > 0.0], columns])
    found = np.linalg.lstsq(table, values)[0]
    return float(np.sum((values - table @ found) ** 2)), found[-columns.shape[1] :]
