"""Scatters of which only the product with other parameters changes the motion."""

from typing import NamedTuple

import numpy as np


class Scale(NamedTuple):
    """Indices of the scatter, of the parameters that it multiplies, and of those that balance a shift of all of these.

    The motion depends on scatter times factor, and on balance times exp(scatter times factor).
    """

    scatter: int
    factors: np.ndarray
    balance: np.ndarray
