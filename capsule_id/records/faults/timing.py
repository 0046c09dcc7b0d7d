"""Finds gaps and rounded times in the time column, and drop-outs in a channel."""

from dataclasses import dataclass

import numpy as np

from capsule_id.records.faults.duplicates import reading_step
from capsule_id.records.noise import noise_level
from capsule_id.rig.filters import largest_offset, median_step, thinned

#: Share of steps that must equal the sampling step before a longer one counts as a gap.
REGULAR_SHARE = 0.9
#: Largest distance of a step from a multiple of the sampling step, in sampling steps.
STEP_TOLERANCE = 0.1
#: Smallest and largest rounding of times, in sampling steps: below it is harmless.
ROUNDING = (0.02, 1.01)
#: A drop-out departs from both neighbours by this fraction of the range of the other samples.
DROPOUT_RANGE = 0.5
#: In coarse steps a smooth top is a short run too. A drop-out departs by more than this many reading steps, and than this
#: many times the change of the readings beside it.
DROPOUT_STEPS, DROPOUT_CHANGES = 3.0, 2.0
#: Noise levels that count as that range where the motion is a small part of the record, and their largest share of the
#: whole range: of coarse samples the noise level shows the motion.
DROPOUT_NOISE, LARGEST_SHARE = 20.0, 0.5
#: A single value this many ranges away is a drop-out by itself.
EXTREME = 50.0
#: Most samples of one drop-out; fewest equal values of a frozen sensor.
LONGEST_DROPOUT, FROZEN = 3, 6
#: Samples from which a record shows its noise level.
FEWEST_OF_NOISE = 20


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
    if len(time) < 9:
        return None
    step = median_step(time)
    steps = np.diff(time) / step
    multiple = np.round(steps)
    rows = np.flatnonzero((multiple >= 2) & (np.abs(steps - multiple) <= STEP_TOLERANCE * np.sqrt(multiple)))
    regular = float(np.mean(np.abs(steps - 1.0) <= STEP_TOLERANCE))
    return Gaps(rows, multiple[rows].astype(int) - 1, step) if len(rows) and regular >= REGULAR_SHARE else None


def time_rounding(time: np.ndarray) -> float | None:
    """Return the step to which the times of an even record were rounded, s; None where it is harmless.

    Parameters
    ----------
    time : (n,) s, increasing
    """
    if len(time) < 8:
        return None
    step, written = median_step(time), reading_step(time)
    off = largest_offset(time, (time[-1] - time[0]) / (len(time) - 1))
    rounded = ROUNDING[0] * step <= written <= ROUNDING[1] * step
    # Rounding moves a time by half the written step, and the ends of the even grid by as much again.
    return written if rounded and ROUNDING[0] * step / 2.0 < off <= 1.01 * written else None


def dropouts(values: np.ndarray) -> np.ndarray:
    """Return indices of drop-outs: short runs of one exact value, far away from the samples on both sides.

    Parameters
    ----------
    values : (n,) readings of one channel
    """
    # Nine in ten samples hold no drop-out, so their range is that of the motion, or of the noise of a long rest.
    low, high = np.quantile(thinned(values), [0.05, 0.95])
    noise = DROPOUT_NOISE * noise_level(values) if len(values) > FEWEST_OF_NOISE else 0.0
    spread = max(high - low, min(noise, LARGEST_SHARE * float(np.ptp(values))))
    starts, ends = _far_runs(values, spread).T
    own = values[starts]
    # An impact is a short peak too, but its height differs each time. A drop-out repeats one value.
    levels, counts = np.unique(own, return_counts=True)
    repeated = np.isin(own, levels[counts > 1])
    extreme = np.maximum(low - own, own - high) > EXTREME * spread
    chosen = repeated | extreme | (own == 0.0)
    pairs = zip(starts[chosen], ends[chosen], strict=True)
    return np.concatenate([np.arange(s, e) for s, e in pairs]) if chosen.any() else np.arange(0)


def _far_runs(values: np.ndarray, spread: float) -> np.ndarray:
    """First sample and end, (k, 2), of short runs of one value that stand far off the samples on both sides."""
    starts = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1])
    lengths = np.diff(np.concatenate([starts, [len(values)]]))
    inside = (starts > 0) & (starts + lengths < len(values)) & (lengths <= LONGEST_DROPOUT)
    starts, lengths = starts[inside], lengths[inside]
    before, after, own = values[starts - 1], values[starts + lengths], values[starts]
    jump = np.minimum(np.abs(own - before), np.abs(own - after))
    far = (jump > DROPOUT_RANGE * spread) & (np.abs(after - before) < 0.5 * jump)
    far &= np.sign(own - before) == np.sign(own - after)
    ends = starts + lengths
    change = [
        np.abs(values[np.maximum(starts - 2, 0)] - before),
        np.abs(values[np.minimum(ends + 1, len(values) - 1)] - after),
    ]
    far &= jump > np.maximum(DROPOUT_CHANGES * np.minimum(*change), DROPOUT_STEPS * reading_step(values))
    return np.stack([starts, starts + lengths], axis=1)[far]


def frozen_samples(values: np.ndarray) -> np.ndarray:
    """Return indices of samples of a frozen channel: equal values in sequence where the record otherwise never repeats.

    Runs at the limits of the record belong to clipping and to rest, and are left out.
    """
    repeats = np.concatenate([[False], values[1:] == values[:-1], [False]])
    edges = np.flatnonzero(repeats[1:] != repeats[:-1]) + 1
    starts, ends = edges[::2], edges[1::2]
    if len(starts) == 0 or len(values) < 50:
        return np.arange(0)
    long = ends - starts + 1 >= FROZEN
    inside = (values[starts] < np.max(values)) & (values[starts] > np.min(values)) & (starts > 1) & (ends < len(values))
    chosen = long & inside
    # A channel read in coarse steps, or at rest, repeats its values anyway.
    others = np.sum(repeats) - np.sum((ends - starts)[chosen])
    if others > 0.01 * len(values):
        return np.arange(0)
    spans = [np.arange(s - 1, e) for s, e in zip(starts[chosen], ends[chosen], strict=True)]
    return np.concatenate(spans) if spans else np.arange(0)
