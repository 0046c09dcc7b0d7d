"""Estimates the noise level of a record from its differences, and finds where a decay is all noise."""

import math

import numpy as np
from jaxtyping import Num

from capsule_id.rig.filters import PIECE

#: Median of |z| for a standard normal z.
NORMAL_QUARTILE = 0.6745
#: Part of the energy of a decay before it is all noise.
ENERGY = 0.99


def noise_level(values: Num[np.ndarray, " n"], order: int = 3) -> float:
    """Standard deviation of the white noise on an evenly sampled record, by the median of its differences.

    Differencing removes a smooth motion. The median ignores contacts and stops, which take a small part of the time.
    Of a long record the middle is taken.
    Order 3 suits a well-sampled decay; order 6 removes a forced motion too.

    Parameters
    ----------
    values : (n,), n > ``order``
    order : of the differences; those of unit white noise have the variance binomial(2 order, order)
    """
    if len(values) >= 2 * PIECE:
        values = values[(len(values) - PIECE) // 2 :][:PIECE]
    differences = np.abs(np.diff(values, order))
    return float(np.median(differences) / (NORMAL_QUARTILE * math.sqrt(math.comb(2 * order, order))))


def length_of_motion(values: Num[np.ndarray, " n"]) -> int:
    """Number of the first samples of a decay that hold most of its energy, before it is all noise."""
    energy = np.cumsum((values - np.mean(values)) ** 2)
    return min(int(np.searchsorted(energy, ENERGY * energy[-1])) + 1, len(values))
