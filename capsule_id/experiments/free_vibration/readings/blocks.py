"""Block means of a record: few readings that hold nearly all of its information on a decay.

A block of an evenly sampled record is ``size`` consecutive readings. An unevenly sampled record is divided into
intervals of ``size`` median steps, with any number of readings. The model's block mean is the two-point Gauss rule of
the reading times themselves, so it is exact for cubics of the time, at any sampling. Its error relative to the amplitude
is below (omega W)^4/4320 for blocks of duration W, and 0.0026 (omega W)^2 of twice F_dry/k1 where a rod with dry
friction turns inside the block. At ``READINGS_PER_PERIOD`` these are 4e-7 and 1e-4.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.filters import PIECE, dominant_frequency, loudest_part, median_step, sampling_step

#: Block means per period that replace a long record; with more, a decay's parameters gain less than 0.5 % in precision.
READINGS_PER_PERIOD = 32
#: Shorter records, in samples, are used whole; a block has at least two samples. Records of so many periods that more block
#: means are left than this have fewer per period, but at least so many: intervals are then some 3 % wider.
LONGEST_WHOLE, FEWEST_PER_PERIOD = 2000, 8


@dataclass(frozen=True)
class Blocks:
    """Means of N blocks of readings.

    Attributes
    ----------
    time, values : (N,) means of the times, s, and of the readings
    first, last : (N,) times of the first and the last reading of each block, s
    count : (N,) readings of each block
    nodes, weights : (N, q) s and 1: the block mean of a smooth function is the sum of its weighted values at the nodes
    """

    time: np.ndarray
    values: np.ndarray
    first: np.ndarray
    last: np.ndarray
    count: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray


def block_means(time: np.ndarray, values: np.ndarray, size: int, by_sample: bool = False) -> Blocks:
    """Divide a record into blocks of ``size`` samples; 1 leaves it as it is.

    Parameters
    ----------
    time, values : (n,) s, increasing, and readings. The last samples of an even record may not fill a block; they are
        left out
    by_sample : take every sample as a node. A velocity with dry friction has kinks and an acceleration jumps, so two
        nodes do not suffice
    """
    if size == 1:
        one = np.ones((len(time), 1))
        return Blocks(time, values, time, time, one[:, 0], time[:, None], one)
    if not is_even(time):
        width = size * median_step(time)
        number = np.unique(((time - time[0]) // width).astype(int), return_inverse=True)[1]
        return _means(time, values, number, by_sample)
    samples, step = len(time) // size * size, max(PIECE // size, 1) * size
    parts = []
    for first in range(0, samples, step):
        part = slice(first, min(first + step, samples))
        parts.append(_means(time[part], values[part], np.arange(part.stop - first) // size, by_sample))
    return Blocks(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Blocks)))


def _means(time: np.ndarray, values: np.ndarray, number: np.ndarray, by_sample: bool) -> Blocks:
    """Means of the readings with each ``number`` (n,), which counts blocks from 0."""
    count = np.bincount(number).astype(float)

    def mean(x: np.ndarray) -> np.ndarray:
        return np.bincount(number, weights=x) / count

    middle = mean(time)
    offset = time - middle[number]
    variance = mean(offset**2)
    lone = variance == 0.0
    variance[lone] = 1.0
    skew = np.where(lone, 0.0, mean(offset**3) / variance)
    root = np.sqrt(skew**2 + 4.0 * variance)
    sides = 0.5 * np.stack([skew + root, skew - root], axis=1)
    weights = np.stack([-sides[:, 1], sides[:, 0]], axis=1) / root[:, None]
    sides[lone] = 0.0
    nodes = middle[:, None] + sides
    edges = np.flatnonzero(np.diff(number, prepend=-1, append=number[-1] + 1))
    first, last = time[edges[:-1]], time[edges[1:] - 1]
    if by_sample:
        place = np.arange(int(np.max(count)))[None]
        inside = place < count[:, None]
        nodes = time[np.where(inside, edges[:-1, None] + place, edges[:-1, None])]
        weights = inside / count[:, None]
    return Blocks(middle, mean(values), first, last, count, nodes, weights)


def is_even(time: np.ndarray) -> bool:
    """Whether the record is evenly sampled, as filters require."""
    try:
        sampling_step(time)
    except InputError:
        return False
    return True


def block_size(time: np.ndarray, values: np.ndarray, per_period: float = READINGS_PER_PERIOD) -> int:
    """Samples per block that leave about ``per_period`` readings a period; 1 for a record that does not oscillate."""
    part = loudest_part(values)
    time, values = time[part], values[part]
    grid = np.linspace(time[0], time[-1], len(time))
    try:
        period = 1.0 / dominant_frequency(grid, np.interp(grid, time, values))
    except (InputError, ZeroDivisionError):
        return 1
    return max(1, int(period / per_period / median_step(time)))


def default_block_size(time: np.ndarray, values: np.ndarray) -> int:
    """Samples per block where the settings do not state it: 1 for records of at most ``LONGEST_WHOLE`` samples."""
    if len(time) <= LONGEST_WHOLE:
        return 1
    size = block_size(time, values)
    if len(time) <= size * LONGEST_WHOLE:
        return size
    return max(size, min(len(time) // LONGEST_WHOLE, block_size(time, values, FEWEST_PER_PERIOD)))


def block_mean(values: Any, weights: Any, xp: Any) -> Any:
    """Block means (N, ...) of a function from its values (N q, ...) at the nodes, row by row."""
    shape = (*weights.shape, *values.shape[1:])
    return xp.einsum("nq,nq...->n...", weights, xp.reshape(values, shape))
