"""Finds readings that occur twice: equal tables, and equal blocks of rows within or across tables."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from capsule_id.parameters import SAME
from capsule_id.records.tones import noise_level
from capsule_id.rig.filters import FEWEST_SAMPLES, PIECE, thinned

# duplicates: Finds readings that occur twice: equal tables, and equal blocks of rows within or across tables.
#
# Two independent readings agree by chance with probability q/s: q is the reading step, s the width of the scatter.
# A block counts as repeated where agreement by chance is practically impossible, so coarse readings that agree are
# no duplicates.


#: Expected number of blocks that agree by chance, below which a block counts as repeated.
CHANCE = 1e-6
#: Chance of equal rows above which only equal tables count as repeated.
COARSE = 0.5
#: Shortest block of a record, samples.
SHORTEST_BLOCK = 8
#: Width of a normal scatter, in standard deviations: two values lie within a small step of each other with the probability
#: step / width. Scatter of a table of single readings, relative to its range.
WIDTH, TABLE_SCATTER = 2.0 * np.sqrt(np.pi), 0.01
#: Rows that are compared at a time.
COMPARED = 4096
#: Most decimal places of a reading step; rounding error of a float64 relative to the largest one.
MOST_DECIMALS, EPSILON = np.finfo(float).precision, 2.0 * np.finfo(float).eps
#: Distance of a level from an even spacing, in spacings; share of the levels that must be within it.
LEVEL_TOLERANCE, REGULAR_LEVELS = 0.2, 0.9
#: A gap between levels is large beyond so many steps; levels are uneven where this share of the gaps is large.
LARGE_GAP, MANY_LARGE_GAPS = 3.0, 0.3
#: Largest number of levels per reading of a table and of a record: at a high amplitude most levels are read once.
MOST_LEVELS, MOST_LEVELS_OF_RECORD = 0.5, 0.9


@dataclass(frozen=True)
class Readings:
    """Readings of one table without time.

    Attributes
    ----------
    values : (n, columns), in units that are the same in all tables
    record : a time series
    to_display : (columns,) factors to the units in which the readings were written; (): 1
    """

    label: str
    values: np.ndarray
    record: bool
    to_display: tuple[float, ...] = ()


@dataclass(frozen=True)
class Repeated:
    """``count`` rows of ``label`` from index ``row`` equal those of ``first`` from index ``first_row``."""

    label: str
    row: int
    first: str
    first_row: int
    count: int


def reading_step(values: np.ndarray) -> float:
    """Reading step of ``values`` (n,), in their unit: a power of ten, or the spacing of their levels; 0 without one."""
    scale = float(np.max(np.abs(values), initial=0.0))
    if scale == 0.0:
        return 0.0
    values = thinned(values)
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > SAME * scale]
    most = MOST_LEVELS if len(values) < FEWEST_SAMPLES else MOST_LEVELS_OF_RECORD
    if 2 < len(gaps) < most * len(values):
        spacing = float(np.median(gaps[np.round(gaps / np.min(gaps)) < 2.0]))
        if np.mean(np.abs(gaps / spacing - np.round(gaps / spacing)) < LEVEL_TOLERANCE) > REGULAR_LEVELS:
            return spacing
    first = -int(np.floor(np.log10(scale)))
    rounded = ((k, np.round(values, k), 1e-9 * 10.0**-k) for k in range(first, first + MOST_DECIMALS))
    fits = (k for k, own, error in rounded if np.max(np.abs(own - values)) <= error + EPSILON * scale)
    return next((10.0**-k for k in fits), 0.0)


def chance_of_equality(readings: Readings) -> float:
    """Probability that two independent rows agree in all columns; 1 where the reading step hides the scatter."""
    chance = 1.0
    factors = readings.to_display or (1.0,) * readings.values.shape[1]
    for values, factor in zip(readings.values.T, factors, strict=True):
        # A step of 0.1 deg is a decimal one in deg alone.
        step, width = reading_step(factor * thinned(values)) / factor, TABLE_SCATTER * float(np.ptp(values))
        if readings.record and len(values) >= FEWEST_SAMPLES:
            step, width = max(step, _uneven_spacing(values, step)), WIDTH * noise_level(values)
        # A step of 0 is that of float64.
        own = min(1.0, max(step, EPSILON * float(np.max(np.abs(values)))) / width) if width > 0.0 else 1.0
        # Rows that agree in one column but not in all show a setting that recurs, such as a load.
        chance *= own if readings.record else max(own, _equal_share(values) - _equal_share(readings.values))
    return chance


def _uneven_spacing(values: np.ndarray, step: float) -> float:
    """Mean gap between the levels of a record (n,) where many are far larger than the reading step; else 0.

    An encoder may read on several grids that are shifted against each other. A few large gaps are jumps of the motion.
    """
    thin = thinned(values)
    gaps = np.diff(np.unique(thin))
    several = 1 < len(gaps) < MOST_LEVELS * len(thin)
    uneven = several and np.mean(gaps > LARGE_GAP * step) > MANY_LARGE_GAPS
    return float(np.mean(gaps[gaps <= LARGE_GAP * np.quantile(gaps, 0.75)])) if uneven else 0.0


def _equal_share(rows: np.ndarray) -> float:
    """Share of the pairs of rows (n,) or (n, columns) that are equal."""
    sizes, number = np.unique(rows, axis=0, return_counts=True)[1], len(rows)
    return float(np.sum(sizes * (sizes - 1)) / max(number * (number - 1), 1))


def repeated_blocks(tables: Sequence[Readings]) -> list[Repeated]:
    """Return the longest repeated block of each pair of tables, and of each table with itself, where there is one.

    Parameters
    ----------
    tables : readings with the same columns, so that their rows can be compared
    """
    chances = [chance_of_equality(each) for each in tables]
    blocks = (
        _longest_block(tables[i], tables[j], max(chances[i], chances[j])) for i, j in _candidates(tables, chances)
    )
    return [block for block in blocks if block is not None]


def _candidates(tables: Sequence[Readings], chances: Sequence[float]) -> Iterable[tuple[int, int]]:
    """Indices of the earlier and the later table of each pair that may share a block, each table with itself included.

    They share a window of the shortest length that counts for any pair, or all rows where ``chances`` leave no shorter
    block.
    """
    number, fewest = len(tables), max(min((len(each.values) for each in tables), default=1), 1)
    fine = [k for k in range(number) if chances[k] < COARSE]
    length = min((_shortest(tables[k], chances[k], len(tables[k].values) * fewest) for k in fine), default=1)
    windows = []
    for each, chance in zip(tables, chances, strict=True):
        if chance >= COARSE:
            windows.append(np.array([hash((each.values + 0.0).tobytes()) & (1 << 63) - 1], np.uint64))
            continue
        moves = np.cumsum([0, *np.any(each.values[1:] != each.values[:-1], axis=1)])
        hashes = np.concatenate([np.empty(0, np.uint64), *(found for _, found in _hashes(each.values, length))])
        # At rest all windows are equal, and a repeated block of a record has more changes.
        moving = moves[length - 1 :] - moves[: len(hashes)] >= length // 4
        windows.append(np.unique(hashes[moving] if each.record else hashes))
    codes = {k * number + k for k in range(number)}
    hashes, owners = np.concatenate(windows), np.repeat(np.arange(number), [len(found) for found in windows])
    order = np.argsort(hashes, kind="stable")
    hashes, owners, shift = hashes[order], owners[order], 1
    while (equal := hashes[shift:] == hashes[:-shift]).any():
        codes.update(np.unique(owners[shift:][equal] * number + owners[:-shift][equal]).tolist())
        shift += 1
    return ((code % number, code // number) for code in sorted(codes))


def _shortest(readings: Readings, chance: float, pairs: int) -> int:
    """Rows of the shortest block of which fewer than ``CHANCE`` agree by chance among ``pairs`` of rows."""
    return max(int(np.ceil(np.log(CHANCE / pairs) / np.log(chance))), SHORTEST_BLOCK if readings.record else 1)


def _longest_block(earlier: Readings, later: Readings, chance: float) -> Repeated | None:
    """The longest run of consecutive rows of ``later`` that are rows of ``earlier``; None where chance explains it.

    ``chance`` is the larger ``chance_of_equality``.
    """
    pairs = len(earlier.values) * len(later.values)
    if chance >= COARSE:
        # The readings are too coarse for blocks; equal tables of several rows remain.
        if earlier is not later and len(later.values) > 2 and np.array_equal(earlier.values, later.values):
            return Repeated(later.label, 0, earlier.label, 0, len(later.values))
        return None
    shortest = _shortest(later, chance, pairs)
    if min(len(earlier.values), len(later.values)) < shortest + (earlier is later):
        return None
    best: Repeated | None = None
    ends: dict[int, int] = {}  # by distance of the two blocks: the end of the last one
    for where, start in _equal_windows(earlier.values, later.values, shortest, earlier is later):
        if start < ends.get(start - where, 0):
            continue
        # Samples of a channel at rest repeat anyway.
        window = later.values[start : start + shortest]
        if later.record and np.sum(np.any(window[1:] != window[:-1], axis=1)) < shortest // 2:
            continue
        count = _equal_rows(earlier.values[where:], later.values[start:])
        ends[start - where] = start + count
        # Trials of one load that are read in coarse steps agree, even where the whole table looks fine: the rows of the
        # block itself show how often rows are equal.
        if not later.record and pairs * _equal_share(later.values[start : start + count]) ** count > CHANCE:
            continue
        if count >= shortest and (best is None or count > best.count):
            best = Repeated(later.label, start, earlier.label, where, count)
    return best


def _equal_rows(one: np.ndarray, other: np.ndarray) -> int:
    """Number of rows at the beginning of both tables that are equal."""
    most = min(len(one), len(other))
    for first in range(0, most, COMPARED):
        last = min(first + COMPARED, most)
        equal = np.all(one[first:last] == other[first:last], axis=1)
        if not equal.all():
            return first + int(np.argmin(equal))
    return most


def _equal_windows(earlier: np.ndarray, later: np.ndarray, length: int, same: bool) -> Iterable[tuple[int, int]]:
    """First rows of windows of ``length`` rows with equal hashes: in ``earlier``, the first such one, and in ``later``."""
    hashes = np.concatenate([found for _, found in _hashes(earlier, length)])
    index = np.argsort(hashes, kind="stable")
    known = hashes[index]
    for begin, found in _hashes(later, length):
        place = np.minimum(np.searchsorted(known, found), len(known) - 1)
        where, start = index[place], begin + np.arange(len(found))
        equal = (known[place] == found) & ((where < start) if same else True)
        yield from zip(where[equal].tolist(), start[equal].tolist(), strict=True)


def _hashes(values: np.ndarray, length: int) -> Iterable[tuple[int, np.ndarray]]:
    """Hashes of all windows of ``length`` rows, piece by piece, each with the row of its first window."""
    factors = np.random.default_rng(0).integers(1, 1 << 62, (values.shape[1], length), dtype=np.uint64) | np.uint64(1)
    for begin in range(0, len(values) - length + 1, PIECE):
        rows = (values[begin : begin + PIECE + length - 1] + 0.0).view(np.uint64)  # -0.0 + 0.0 is 0.0
        rows ^= rows >> np.uint64(29)
        yield begin, np.sum([np.correlate(*pair) for pair in zip(rows.T, factors, strict=True)], axis=0)
