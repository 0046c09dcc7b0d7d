"""Finds stretches of a record with far more noise than the rest, as where a hand still moves the rig."""

import math

import numpy as np

#: Windows in a period, and fewest samples of one.
WINDOWS, SHORTEST = 8, 8
#: Noise of a burst, relative to that of the middle window, and fewest windows that it fills.
LOUD, FEWEST_WINDOWS = 3.0, 3
#: Quiet windows within a burst.
GAP = 1
#: Order of the differences that remove the oscillation.
ORDER = 3


def noisy_stretch(values: np.ndarray, period: float, row: int) -> slice | None:
    """Return the rows of the burst of noise around ``row``; None where there is none.

    Parameters
    ----------
    values : (n,) evenly sampled oscillation
    period : samples
    """
    width = max(SHORTEST, round(period / WINDOWS))
    number = len(values) // width
    if number <= 2 * FEWEST_WINDOWS:
        return None
    differences = np.diff(values, ORDER, prepend=values[:1], append=values[-1:].repeat(ORDER - 1))
    squares = (differences[: number * width] ** 2).reshape(number, width)
    noise = np.sqrt(np.mean(squares, axis=1) / math.comb(2 * ORDER, ORDER))
    loud = np.flatnonzero(noise > LOUD * max(float(np.median(noise)), 1e-300))
    if not len(loud):
        return None
    for chain in np.split(loud, np.flatnonzero(np.diff(loud) > GAP + 1) + 1):
        first, last = int(chain[0]), int(chain[-1])
        if len(chain) >= FEWEST_WINDOWS and first - GAP <= row // width <= last + GAP:
            return slice(first * width, min((last + 1) * width, len(values)))
    return None
