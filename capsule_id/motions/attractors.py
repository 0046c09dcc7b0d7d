"""Which motions are the same attractor: by direction and period, contacts, and the points of the Poincaré section."""

import numpy as np

from capsule_id.motions.points import MotionColumns
from capsule_id.motions.response import SAME_POSITION, SAME_VELOCITY

# Two settled motions that are the same have come within this many times the tolerance of the section's repetition.
SLACK = 10.0


def attractors_of(columns: MotionColumns) -> np.ndarray:
    """(n,) int32: number of the attractor of each of n motions *at one set of parameters*; -1 where the run failed.

    columns : as ``points.settled_columns``, of n motions

    Periodic motions are one attractor if their labels agree and the points of one period of their sections agree up
    to where they begin. Aperiodic motions count as one: their points, and the sign of a slow drift, cannot be matched.
    """
    label, period = columns["label"], columns["period"]
    numbers = np.full(len(label), -1, np.int32)
    found: list[int] = []
    for i in range(len(label)):
        if label[i] == "failed":
            continue
        for number, j in enumerate(found):
            if label[i] == label[j] and (period[i] == 0 or _same_orbit(columns, i, j, int(period[i]))):
                numbers[i] = number
                break
        else:
            numbers[i] = len(found)
            found.append(i)
    return numbers


def _same_orbit(columns: MotionColumns, i: int, j: int, period: int) -> bool:
    """Whether the last ``period`` points of motions i and j are the same but for a shift along the orbit."""
    (x, x_other), (w, w_other) = ((columns[name][[i, j], -period:]) for name in ("x_rel", "rate"))
    return any(
        np.abs(np.roll(x, shift) - x_other).max() <= SLACK * SAME_POSITION
        and np.abs(np.roll(w, shift) - w_other).max() <= SLACK * SAME_VELOCITY
        for shift in range(period)
    )
