"""Finds the free decay inside a record: rest or a push before the release, and a second excitation after it."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from capsule_id.errors import InputError
from capsule_id.records.noise import noise_level
from capsule_id.rig.filters import PIECE, dominant_frequency, loudest_part
from capsule_id.rig.formats.columns import release

#: Half cycles whose height is below this fraction of the largest one belong to the rest before the release.
REST_HEIGHT = 0.2
#: A half cycle this many times as high as an earlier one has received energy.
GROWTH = 1.15
#: Standard deviations of the noise below which a half cycle counts as noise.
NOISE_HEIGHT = 5.0
#: Shortest rest before the release that matters, in periods.
SHORTEST_REST = 0.5
#: Shortest free decay between two excitations, in periods.
SHORTEST_DECAY = 2.0
#: The motion begins where the record leaves its first value by this fraction of its range, and by the noise above.
DEPARTURE = 0.05
#: The free decay begins at the first half cycle of at least this fraction of the largest one.
FIRST_HEIGHT = 0.9
#: A release from a held deflection: the deflection is at least this fraction of the largest half cycle.
HELD_HEIGHT = 0.8
#: A deflection is held where the record stays above this fraction of its largest value for this many times as long as it
#: then takes to pass the rest position; a free oscillation stays there for less than one such time.
HOLD_LEVEL, HOLD_TIME = 0.9, 5.0
#: Fractions of the first turning point's height between which the motion before it is compared with that after it.
LOW_HEIGHT, HIGH_HEIGHT = 0.6, 0.95
#: A free decay is faster before a turning point than after it. From this ratio of durations on, a push has slowed it.
PUSHED = 1.2
#: Standard errors of a duration that noise explains.
DURATION_ERRORS = 4.0


@dataclass(frozen=True)
class FreeDecay:
    """The part of a record that is free decay.

    Attributes
    ----------
    start : time of the highest turning point, or of the release from a held deflection, s; the first sample where the
        record begins with free decay
    stop : time at which another excitation begins, s; None where there is none
    rest : duration of rest and excitation before ``start``, s; 0 where the record begins with the free decay
    pushed : whether the record begins with a push towards its first turning point, ``start``
    period : of the oscillation, s
    """

    start: float
    stop: float | None
    rest: float
    period: float
    pushed: bool = False


def find_free_decay(time: np.ndarray, values: np.ndarray, displacement: bool = False) -> FreeDecay | None:
    """Return the free decay inside a record; None where fewer than four half cycles exceed the noise.

    Parameters
    ----------
    time : (n,) s, increasing, evenly or unevenly spaced
    values : (n,) displacement, velocity or acceleration
    displacement : whether they are displacements; only these show a push before the first turning point
    """
    whole, (time, values) = time, shortened(time, values)
    if len(time) < len(whole):
        time[[0, -1]] = whole[[0, -1]]
    hold = _hold(time, values) if displacement else 0
    if hold > 0:
        decay = find_free_decay(time[hold:], values[hold:], displacement)
        if decay is not None:
            return replace(decay, rest=decay.start - float(time[0]))
    even = np.linspace(time[0], time[-1], len(time))
    on_grid = np.interp(even, time, values)
    noise = noise_level(on_grid)
    moves = _departure(on_grid, noise)
    moving_time, moving = even[moves:], on_grid[moves:]
    try:
        period = 1.0 / dominant_frequency(moving_time, moving)
    except (InputError, ZeroDivisionError):
        return None
    per_period = period / (even[1] - even[0])
    if not np.isfinite(period) or per_period < 4.0 or len(moving) < 2.0 * per_period:
        return None
    level = _rest_level(moving, per_period)
    times, heights = _half_cycles(moving_time, _smoothed(moving - level, per_period))
    if len(heights) < 4:
        return None
    swings = heights[:-1] + heights[1:]  # from one turning point to the next; a drift of the zero hardly changes them
    begins = swings[0] >= FIRST_HEIGHT * np.max(swings)
    largest = 0 if begins else int(np.argmax(heights >= FIRST_HEIGHT * np.max(heights)))
    held = abs(float(np.median(on_grid[: moves + 1])) - level) >= HELD_HEIGHT * heights[largest]
    start = float(moving_time[0]) if held else float(times[largest])
    pushed = displacement and largest == 0 and _pushed(even, on_grid - level, float(times[0]), period, noise)
    start = float(times[0]) if pushed else start
    before = start - float(time[0])
    starts_at_once = before < SHORTEST_REST * period and not pushed
    first, stop = largest, _growth(times[largest:], heights[largest:], noise)
    # A blow excites other modes too: the free decay of the slow one begins when they have died out.
    while stop is not None and stop - float(times[largest]) < SHORTEST_DECAY * period:
        after = np.flatnonzero((times > stop) & (times < stop + SHORTEST_DECAY * period))
        if not len(after):
            break
        largest = int(after[np.argmax(heights[after])])
        stop = _growth(times[largest:], heights[largest:], noise)
    if largest > first:
        return FreeDecay(float(times[largest]), stop, float(times[largest] - time[0]), period)
    start, before = (float(time[0]), 0.0) if starts_at_once else (start, before)
    return FreeDecay(start, stop, before, period, pushed)


def _growth(times: np.ndarray, heights: np.ndarray, noise: float) -> float | None:
    """Time before half cycles at ``times`` (h,), with ``heights`` (h,), grow; None where none does.

    The energy of a free decay never grows. Two half cycles must show it, so that one disturbed reading does not.
    """
    floor = max(NOISE_HEIGHT * noise, 0.25 * REST_HEIGHT * heights[0])
    pairs = np.maximum(heights[:-1], heights[1:])  # one low half cycle alone is a disturbance too
    lowest = np.minimum.accumulate(np.concatenate([heights[:1], heights[:1], pairs[:-1]]))
    grown = (heights > GROWTH * lowest + floor) & (heights > 2.0 * floor)
    twice = np.flatnonzero(grown[1:] & grown[:-1])
    return float(times[max(twice[0] - 1, 0)]) if len(twice) else None


def _pushed(time: np.ndarray, values: np.ndarray, turning: float, period: float, noise: float) -> bool:
    """Whether the record approaches its first turning point more slowly than it leaves it.

    At every displacement a free rod has more kinetic energy before the turning point than after it, whatever its spring
    and its damping. So it takes no longer from one displacement to the other.

    Parameters
    ----------
    time, values : (n,) s, evenly spaced, and displacements from the rest position
    turning : time of the turning point, s
    noise : sd of a reading
    """
    step = time[1] - time[0]
    width = max(1, int(period / step / 16.0))
    smooth = np.convolve(values, np.full(width, 1.0 / width), mode="valid")
    top = int(np.clip(round((turning - time[0]) / step) - width // 2, 0, len(smooth) - 1))
    size = abs(float(smooth[top]))
    height = np.sign(smooth[top]) * smooth / size
    low = max(LOW_HEIGHT, float(height[0]))
    falls = [np.flatnonzero(height[top:] < level) for level in (HIGH_HEIGHT, low)]
    if low >= HIGH_HEIGHT or not all(len(fall) for fall in falls):
        return False
    rise = int(np.argmax(height >= HIGH_HEIGHT)) - int(np.argmax(height >= low))
    fall = int(falls[1][0] - falls[0][0])
    # The slope of the height is least at the high level; two crossings have errors on each side.
    slope = 2.0 * np.pi / period * np.sqrt(1.0 - HIGH_HEIGHT**2)
    error = 2.0 * noise / np.sqrt(width) / size / slope
    return bool((rise - PUSHED * fall) * step > DURATION_ERRORS * error + step)


def shortened(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means of blocks of a long record, about ``PIECE`` of them and 32 or more in a period; a short record itself.

    Parameters
    ----------
    time, values : (n,) s, increasing, and readings
    """
    if len(time) < 2 * PIECE:
        return time, values
    part = loudest_part(values)
    grid = np.linspace(time[part][0], time[part][-1], len(time[part]))
    period = 1.0 / dominant_frequency(grid, np.interp(grid, time[part], values[part]))
    size = max(1, min(len(time) // PIECE, int(period / (grid[1] - grid[0]) / 32.0)))
    count = len(time) // size
    means = []
    for column in (time, values):
        means.append(column[: count * size].reshape(count, size).mean(axis=1))
        release(column)
    return means[0], means[1]


def _hold(time: np.ndarray, values: np.ndarray) -> int:
    """Index of the first sample of a deflection that is held before its release; 0 where there is none.

    A record that begins with it begins at its departure; see ``_departure``.
    """
    away = values - float(np.median(values[-max(1, len(values) // 4) :]))
    far = np.abs(away) >= HOLD_LEVEL * np.max(np.abs(away))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], far, [0]])))
    begins, ends = edges[::2], edges[1::2] - 1
    longest = int(np.argmax(time[ends] - time[begins]))
    begin, end = int(begins[longest]), int(ends[longest])
    passed = np.flatnonzero(np.sign(away[end:]) == -np.sign(away[end]))
    if not len(passed):
        return 0
    return begin if time[end] - time[begin] > HOLD_TIME * (time[end + passed[0]] - time[end]) else 0


def _departure(values: np.ndarray, noise: float) -> int:
    """Index of the last sample before the record leaves its first value for good."""
    first = float(np.median(values[: max(3, min(len(values) // 50, 50))]))
    limit = DEPARTURE * float(np.ptp(values)) + NOISE_HEIGHT * noise
    away = np.abs(values - first) > limit
    return max(int(np.argmax(away)) - 1, 0)


def _rest_level(values: np.ndarray, per_period: float) -> float:
    """Equilibrium: mean over whole periods at the end of the record, at most five."""
    periods = min(5, int(len(values) / per_period))
    return float(np.mean(values[-round(periods * per_period) :]))


def _smoothed(values: np.ndarray, per_period: float) -> np.ndarray:
    """Moving mean over a sixteenth of a period, which locates half cycles in noise."""
    width = max(1, int(per_period / 16.0))
    padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")


def _half_cycles(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time and height of the extremum of every half cycle, (k,) each; crossings by noise count as half cycles."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(np.signbit(values))) + 1, [len(values)]])
    index = [left + int(np.argmax(np.abs(values[left:right]))) for left, right in itertools.pairwise(edges)]
    return time[index], np.abs(values[index])
