"""Intervals of admissible values."""

from dataclasses import dataclass
from math import inf, pi

import numpy as np


@dataclass(frozen=True)
class Domain:
    """An interval of SI values; ``text`` continues "<name> must ..."."""

    text: str
    low: float = -inf
    high: float = inf
    low_allowed: bool = False

    def holds(self, values: np.ndarray | float) -> np.ndarray:
        """Whether each value lies inside, elementwise."""
        values = np.asarray(values)
        return ((values >= self.low) if self.low_allowed else (values > self.low)) & (values < self.high)


#: Magnitudes of quantities that a rig may have, SI: their squares and ratios stay far from the limits of float64.
SMALLEST, LARGEST = 1e-30, 1e30


def is_plausible(values: np.ndarray | float) -> np.ndarray:
    """Whether each value is 0 or has a magnitude between ``SMALLEST`` and ``LARGEST``, elementwise."""
    size = np.abs(values)
    return (size == 0.0) | ((size >= SMALLEST) & (size <= LARGEST))


ANY = Domain("be a finite number")
POSITIVE = Domain("be greater than 0", low=0.0)
NOT_NEGATIVE = Domain("be 0 or greater", low=0.0, low_allowed=True)
#: A share, both ends included: the bound lies a rounding error of unit conversion above 1.
SHARE = Domain("lie between 0 and 100 %", low=0.0, high=1.0 + 1e-12, low_allowed=True)
ABOVE_ONE = Domain("be greater than 1", low=1.0)
#: A number of drive periods; the simulation of more takes minutes for each trial.
PERIODS = Domain("lie between 1 and 100000", low=1.0, high=1e5 + 0.5, low_allowed=True)
INCLINE = Domain("lie between -90 and 90 deg", low=-pi / 2, high=pi / 2)
SLOPE_ANGLE = Domain("lie between 0 and 90 deg", low=0.0, high=pi / 2)
