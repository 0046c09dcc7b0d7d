"""Finds gaps and rounded times in the time column, and drop-outs in a channel."""

from dataclasses import dataclass

import numpy as np

from capsule_id.records.faults.duplicates import reading_step

#: Share of steps that must equal the sampling step before a longer one counts as a gap.
REGULAR_SHARE = 0.9
#: Largest distance of a step from a multiple of the sampling step, in sampling steps.
STEP_TOLERANCE = 0.1
#: Smallest and largest rounding of times, in sampling steps: below it is harmless.
ROUNDING = (0.02, 1.01)
#: A drop-out departs from both neighbours by this fraction of the range of the other samples.
DROPOUT_RANGE = 0.5
#: A single value this many ranges away is a drop-out by itself.
EXTREME = 50.0
#: Most samples of one drop-out; fewest equal values of a frozen sensor.
LONGEST_DROPOUT, FROZEN = 3, 6


@dataclass(frozen=True)
class Gaps:
    """Gaps after the samples ``rows`` (k,); ``lost`` (k,) samples in each by the sampling step ``step``, s."""

    rows: np.ndarray
    lost: np.ndarray
    step: float


def find_gaps(time: np.ndarray) -> Gaps | None:
    """Return gaps of an otherwise even record: steps of two or more sampling steps; None where there are none.

    Parameters
    ----------
    time : (n,) s, increasing
    """
    steps = np.diff(time)
    if len(steps) < 8:
        return None
    step = float(np.median(steps))
    multiple = np.round(steps / step)
    regular = np.abs(steps / step - 1.0) <= STEP_TOLERANCE
    rows = np.flatnonzero((multiple >= 2) & (np.abs(steps / step - multiple) <= STEP_TOLERANCE * np.sqrt(multiple)))
    if len(rows) == 0 or np.mean(regular) < REGULAR_SHARE:
        return None
    return Gaps(rows, multiple[rows].astype(int) - 1, step)


def time_rounding(time: np.ndarray) -> float | None:
    """Return the step to which the times of an even record were rounded, s; None where it is harmless.

    Parameters
    ----------
    time : (n,) s, increasing
    """
    if len(time) < 8:
        return None
    step = float(np.median(np.diff(time)))
    written = reading_step(time)
    even = time[0] + np.arange(len(time)) * (time[-1] - time[0]) / (len(time) - 1)
    off = np.max(np.abs(time - even))
    rounded = ROUNDING[0] * step <= written <= ROUNDING[1] * step
    # Rounding moves a time by half the written step, and the ends of the even grid by as much again.
    return written if rounded and ROUNDING[0] * step / 2.0 < off <= 1.01 * written else None


def dropouts(values: np.ndarray) -> np.ndarray:
    """Return indices of drop-outs: short runs of one exact value, far away from the samples on both sides.

    Parameters
    ----------
    values : (n,) readings of one channel
    """
    starts = np.concatenate([[0], np.flatnonzero(np.diff(values) != 0.0) + 1])
    lengths = np.diff(np.concatenate([starts, [len(values)]]))
    inside = (starts > 0) & (starts + lengths < len(values)) & (lengths <= LONGEST_DROPOUT)
    starts, lengths = starts[inside], lengths[inside]
    before, after, own = values[starts - 1], values[starts + lengths], values[starts]
    # Nine in ten samples hold no drop-out, so their range is that of the motion.
    low, high = np.quantile(values, [0.05, 0.95])
    jump = np.minimum(np.abs(own - before), np.abs(own - after))
    far = (jump > DROPOUT_RANGE * (high - low)) & (np.abs(after - before) < 0.5 * jump)
    far &= np.sign(own - before) == np.sign(own - after)
    # An impact is a short peak too, but its height differs each time. A drop-out repeats one value.
    levels, counts = np.unique(own[far], return_counts=True)
    repeated = np.isin(own, levels[counts > 1])
    extreme = np.maximum(low - own, own - high) > EXTREME * (high - low)
    chosen = far & (repeated | extreme | (own == 0.0))
    pairs = zip(starts[chosen], lengths[chosen], strict=True)
    return np.concatenate([np.arange(s, s + n) for s, n in pairs]) if chosen.any() else np.arange(0)


def frozen_samples(values: np.ndarray) -> np.ndarray:
    """Return indices of samples of a frozen channel: equal values in sequence where the record otherwise never repeats.

    Runs at the limits of the record belong to clipping and to rest, and are left out.
    """
    repeats = np.concatenate([[False], np.diff(values) == 0.0])
    starts = np.flatnonzero(np.diff(np.concatenate([[False], repeats])[:].astype(int)) == 1)
    if len(starts) == 0 or len(values) < 50:
        return np.arange(0)
    ends = np.array([start + int(np.argmin(np.append(repeats[start:], False))) for start in starts])
    long = ends - starts + 1 >= FROZEN
    inside = (values[starts] < np.max(values)) & (values[starts] > np.min(values)) & (starts > 1) & (ends < len(values))
    chosen = long & inside
    # A channel read in coarse steps, or at rest, repeats its values anyway.
    others = np.sum(repeats) - np.sum((ends - starts)[chosen])
    if others > 0.01 * len(values):
        return np.arange(0)
    spans = [np.arange(s - 1, e) for s, e in zip(starts[chosen], ends[chosen], strict=True)]
    return np.concatenate(spans) if spans else np.arange(0)
