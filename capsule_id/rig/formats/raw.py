"""A table as written: numbers in the units of the file, and the place of each cell."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RawTable:
    """The result of every reader in ``formats``.

    Attributes
    ----------
    names, units : of every column, as written
    values : (rows, columns), finite, in the units written
    rows : (rows,) 1-based line number of every row
    place : (row index or None for the header, column index) -> 1-based (line, column) in the file
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    rows: np.ndarray
    place: Callable[[int | None, int], tuple[int, int]]
