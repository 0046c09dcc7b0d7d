"""Finds clipped records: flat tops, samples that share exactly the largest or smallest value."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from capsule_id.records.faults.duplicates import reading_step
from capsule_id.rig.filters import thinned

#: Fewest samples at the limit; how many times as many as at the neighbouring values.
FEWEST_CLIPPED, EXCESS = 3, 5.0
#: Number of neighbouring values. The peak of a sine that is read in steps has 3.4 times their mean number.
NEIGHBOURS = 5
#: Readings of at least this part of a limit have its step, where there are so many.
LARGE, FEWEST_LARGE = 0.3, 20
#: A record held at its limit for longer than this fraction of a period before its release is not clipped.
LONGEST_HOLD = 0.2


@dataclass(frozen=True)
class Clipped:
    """``rows`` (k,) of the samples at ``level``, in the unit of the record; ``side`` of the limit."""

    side: Literal["upper", "lower"]
    level: float
    rows: np.ndarray


def clipped_samples(values: np.ndarray, period: float) -> list[Clipped]:
    """Return the clipped samples of a record at its upper and lower limit.

    Parameters
    ----------
    values : (n,) readings in the unit of the file
    period : of the oscillation, samples; infinite where it is unknown
    """
    if np.ptp(values) == 0.0:
        return []
    few = thinned(values)
    sides: tuple[tuple[Literal["upper", "lower"], float], ...] = (("upper", 1.0), ("lower", -1.0))
    limits = float(np.max(values)), float(np.min(values))
    found = []
    for (side, sign), limit in zip(sides, limits, strict=True):
        # Readings with so many significant digits have finer steps near zero than at a limit.
        large = few[few / limit >= LARGE] if limit else few
        step = reading_step(large if len(large) >= FEWEST_LARGE else few)
        tolerance = max(0.25 * step, 4e-16 * max(abs(limit) for limit in limits))
        rows = _at_limit(values, (limit, sign), (tolerance, step), period)
        if len(rows):
            found.append(Clipped(side, limit, rows))
    return found


def _at_limit(
    values: np.ndarray, limit: tuple[float, float], resolution: tuple[float, float], period: float
) -> np.ndarray:
    """Indices of the samples at a limit, () where a smooth peak has as many.

    Parameters
    ----------
    limit : largest value and 1, or smallest value and -1
    resolution : distance at which values count as equal, and reading step
    """
    (level, sign), (tolerance, step) = limit, resolution

    depth = sign * (level - values)
    rows = np.flatnonzero(depth <= tolerance)
    near = np.flatnonzero((depth > tolerance) & (depth <= (NEIGHBOURS + 0.25) * step))
    if len(rows) < FEWEST_CLIPPED + EXCESS * (len(near) + _one_sided(near, rows)) / NEIGHBOURS:
        return rows[:0]
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    if runs[0][0] == 0 and len(runs[0]) > LONGEST_HOLD * period:
        runs = runs[1:]
    # Noise makes single samples equal to the limit by rounding; a clipped peak gives neighbours.
    runs = [run for run in runs if len(run) > 1]
    return np.concatenate(runs) if sum(map(len, runs)) >= FEWEST_CLIPPED else rows[:0]


def _one_sided(near: np.ndarray, rows: np.ndarray) -> int:
    """Surplus of samples ``near`` the limit on one side of the peaks with samples at it, ``rows``; indices.

    A clipped peak begins and ends abruptly. A peak that sticks, or begins the record, has one gradual side.
    """
    together = np.concatenate([near, rows])
    order = np.argsort(together, kind="stable")
    surplus = 0
    for peak in np.split(order, np.flatnonzero(np.diff(together[order]) > 1) + 1):
        at_limit = np.flatnonzero(peak >= len(near))
        surplus += len(peak) - 1 - at_limit[-1] - at_limit[0] if len(at_limit) else 0
    return abs(int(surplus))
