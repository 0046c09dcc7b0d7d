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
    columns : of each name (rows,) numbers, finite, in the units written
    rows : (rows,) 1-based line number of every row
    place : (row index or None for the header, column index) -> 1-based (line, column) in the file
    encoding : of the text, or "UTF-8"
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: tuple[np.ndarray, ...]
    rows: np.ndarray
    place: Callable[[int | None, int], tuple[int, int]]
    encoding: str = "UTF-8"

    @property
    def values(self) -> np.ndarray:
        """A copy of the numbers, (rows, columns)."""
        return np.column_stack(self.columns)
