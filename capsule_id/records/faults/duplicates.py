"""Finds readings that occur twice: equal tables, and equal blocks of rows within or across tables.

Two independent readings agree by chance with probability q/s: q is the reading step, s the width of the scatter. A block
counts as repeated where agreement by chance is practically impossible, so coarse readings that agree are no duplicates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capsule_id.records.noise import noise_level

#: Expected number of blocks that agree by chance, below which a block counts as repeated.
CHANCE = 1e-6
#: Shortest block of a record, samples; shortest record whose noise level is estimated.
SHORTEST_BLOCK, SHORTEST_RECORD = 8, 50
#: Width of a scatter, in standard deviations; scatter of a table of single readings, relative to its range.
WIDTH, TABLE_SCATTER = 3.5, 0.01
#: Most decimal places of a reading step.
MOST_DECIMALS = 15
#: Distance of a level from an even spacing, in spacings; share of the levels that must be within it.
LEVEL_TOLERANCE, REGULAR_LEVELS = 0.2, 0.9


@dataclass(frozen=True)
class Readings:
    """Readings of one table: (n, columns) in one unit per column, without time; ``record``: a time series."""

    label: str
    values: np.ndarray
    record: bool


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
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * scale]
    if 2 < len(gaps) < 0.5 * len(values):
        spacing = float(np.median(gaps[gaps < 1.5 * np.min(gaps)]))
        if np.mean(np.abs(gaps / spacing - np.round(gaps / spacing)) < LEVEL_TOLERANCE) > REGULAR_LEVELS:
            return spacing
    first = -int(np.floor(np.log10(scale)))
    for decimals in range(first, first + MOST_DECIMALS):
        if np.allclose(np.round(values, decimals), values, rtol=0.0, atol=1e-9 * 10.0**-decimals + 4e-16 * scale):
            return 10.0**-decimals
    return 0.0


def chance_of_equality(readings: Readings) -> float:
    """Probability that two independent rows agree in all columns; 1 where the reading step hides the scatter."""
    chance = 1.0
    for values in readings.values.T:
        step, width = reading_step(values), TABLE_SCATTER * float(np.ptp(values))
        if readings.record and len(values) >= SHORTEST_RECORD:
            width = WIDTH * noise_level(values)
        # A step of 0 is that of float64.
        chance *= min(1.0, max(step, 4e-16 * float(np.max(np.abs(values)))) / width) if width > 0.0 else 1.0
    return chance


def repeated_blocks(tables: Sequence[Readings]) -> list[Repeated]:
    """Return the longest repeated block of each pair of tables, and of each table with itself.

    Parameters
    ----------
    tables : readings with the same columns, so that their rows can be compared
    """
    found = []
    for index, later in enumerate(tables):
        for earlier in tables[: index + 1]:
            block = _longest_block(earlier, later)
            if block is not None:
                found.append(block)
    return found


def _longest_block(earlier: Readings, later: Readings) -> Repeated | None:
    """The longest run of consecutive rows of ``later`` that are rows of ``earlier``; None where chance explains it."""
    chance = max(chance_of_equality(earlier), chance_of_equality(later))
    pairs = len(earlier.values) * len(later.values)
    if chance >= 0.5:
        # The readings are too coarse for blocks; equal tables of several rows remain.
        if earlier is not later and len(later.values) > 2 and np.array_equal(earlier.values, later.values):
            return Repeated(later.label, 0, earlier.label, 0, len(later.values))
        return None
    # With ``shortest`` rows the expected number of chance agreements is below CHANCE.
    shortest = int(np.ceil(np.log(CHANCE / pairs) / np.log(chance)))
    shortest = max(shortest, SHORTEST_BLOCK if later.record else 1)
    if min(len(earlier.values), len(later.values)) < shortest + (earlier is later):
        return None
    _, rows = np.unique(np.concatenate([earlier.values, later.values]), axis=0, return_inverse=True)
    rows = rows.reshape(-1)
    one, other = rows[: len(earlier.values)], rows[len(earlier.values) :]
    first = {}
    for start in range(len(one) - shortest + 1):
        first.setdefault(one[start : start + shortest].tobytes(), start)
    best: Repeated | None = None
    # Samples of a channel at rest repeat anyway.
    changes = np.concatenate([[0], np.cumsum(np.diff(other) != 0)])
    for start in range(len(other) - shortest + 1):
        where = first.get(other[start : start + shortest].tobytes())
        if where is None or (earlier is later and where >= start):
            continue
        if later.record and changes[start + shortest - 1] - changes[start] < shortest // 2:
            continue
        most = min(len(one) - where, len(other) - start)
        equal = one[where : where + most] == other[start : start + most]
        count = most if equal.all() else int(np.argmin(equal))
        if best is None or count > best.count:
            best = Repeated(later.label, start, earlier.label, where, count)
    return best
