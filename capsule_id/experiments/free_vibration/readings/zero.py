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
#: Most and fewest readings, or means of readings, per half swing, and fewest of all, without those near turning points.
MOST_READINGS, FEWEST_READINGS, FEWEST_OF_ALL = 64, 6, 200
#: Readings nearer to a turning point than this part of a half swing are left out: a zero may jump a little later.
NEAR = 0.1
#: A rod moves where it is faster than this part of its largest speed.
MOVING = 1e-6


class Jumps(NamedTuple):
    """Zeros of half swings.

    Attributes
    ----------
    size : rms change of the zero from one half swing to the next, SI, without what alternates
    ratio : sum of squares of the residuals that zeros of half swings leave, relative to that of a zero that moves in straight
        lines from the middle of each half swing to that of the next. Both have the same number of parameters
    half_swings : number of zeros
    """

    size: float
    ratio: float
    half_swings: int


def zero_jumps(e: "FreeVibration", theta: ValuesBySymbol) -> Jumps | None:
    """Zeros of the half swings of a record; None for too few readings, and where the readings are no displacement.

    Three things are projected out of both descriptions: what the fitted parameters can take up, a zero for each direction
    of the motion (as of dry friction or hysteresis), and one in proportion to the amplitude.
    """
    time, values = e.whole
    half = np.pi / e.rough_decrement().Omega_o
    end = MOST_HALF_SWINGS * half
    if e.order > 0 or np.count_nonzero(time <= end) < FEWEST_OF_ALL:
        return None
    begin = float(decay_window(e.table)[0][0])
    settings = replace(e.table.settings, start=begin, stop=begin + float(min(end, time[-1])))
    thin = block_size(time[time <= end], values[time <= end], 2.0 * MOST_READINGS)
    model = replace(e.model, thin=thin, noise="white", drift="none")
    part = type(e)(replace(e.table, settings=settings), e.rig, e.friction, model)
    left, design, moved = sensitivities(part, theta)
    curve = part.values - left
    rate = np.gradient(curve, part.time)
    # A rod that has stopped turns no more; the sign of its rate is that of rounding errors.
    moving = np.arange(len(rate)) <= np.flatnonzero(np.abs(rate) >= MOVING * np.max(np.abs(rate)))[-1]
    turns = np.flatnonzero(np.diff(rate[moving] > 0.0))
    turned = 0.5 * (part.time[turns] + part.time[turns + 1])
    if len(turns) < FEWEST_HALF_SWINGS - 1:
        return None
    kept = moving & (np.min(np.abs(part.time[:, None] - turned), axis=1) > NEAR * half)
    number = np.unique(np.searchsorted(turned, part.time[kept]), return_inverse=True)[1]
    count = np.bincount(number)
    if len(count) < FEWEST_HALF_SWINGS or np.median(count) < FEWEST_READINGS or len(number) < FEWEST_OF_ALL:
        return None
    middle = np.bincount(number, weights=part.time[kept]) / count
    own = np.eye(len(count))
    lines = np.stack([np.interp(part.time[kept], middle, zero) for zero in own], axis=1)
    ahead = np.where(rate > 0.0, 1.0, -1.0)
    amplitude = np.interp(part.time, turned[:-1], 0.5 * np.abs(np.diff(curve[turns])))
    known = np.column_stack([design, ahead, ahead * amplitude, *moved.values()])[kept]
    jumping, zeros = _least_squares(known, own[number], left[kept])
    # What a zero for each direction could take up is shared between both at will: it is left out of the jumps.
    shared = np.stack([np.bincount(number, weights=x[kept]) / count for x in (ahead, ahead * amplitude)], axis=1)
    zeros = zeros - shared @ np.linalg.lstsq(shared, zeros)[0]
    moving_slowly, _ = _least_squares(known, lines, left[kept])
    ratio = jumping / moving_slowly if moving_slowly > 0.0 else 1.0
    return Jumps(float(np.sqrt(np.mean(np.diff(zeros) ** 2))), ratio, len(count))


def _least_squares(known: np.ndarray, columns: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of squares that ``known`` (n, p) and ``columns`` (n, q) leave of ``values``, and the coefficients (q,)."""
    size = np.linalg.norm(known, axis=0)
    table = np.hstack([known[:, size > 0.0] / size[size > 0.0], columns])
    found = np.linalg.lstsq(table, values)[0]
    return float(np.sum((values - table @ found) ** 2)), found[-columns.shape[1] :]
