"""A table of any layout, as a logger or a program exports it; a column map of ``rig.toml`` selects its columns."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Layout:
    """What ``rig.toml`` states about the layout of the files of an experiment.

    Attributes
    ----------
    data_from_line, data_to_line : 1-based lines of the first and the last row of numbers (None: the first line that holds
        a number, and the last line of the file)
    missing : texts of cells without a reading, such as ``--`` or ``NaN``
    decimal : decimal mark of a text table, "." or "," (None: found in the file)
    columns : headers, or numbers counted from 1, of the columns that a text reader keeps (None: all)
    words : headers, or numbers counted from 1, of those whose texts it keeps too
    """

    data_from_line: int | None = None
    data_to_line: int | None = None
    missing: tuple[str, ...] = ()
    decimal: str | None = None
    columns: tuple[str | int, ...] | None = None
    words: tuple[str | int, ...] = ()


@dataclass(frozen=True)
class Export:
    """One file with all its columns, read or not.

    Attributes
    ----------
    path : of the file
    headers : rows of headers, the last one first; each row has one header a column
    width : number of columns
    lines : (rows,) 1-based line of every row
    values : index of a column that ``Layout.columns`` names -> (rows,) numbers in the file's units, NaN at a stated
        missing marker; it raises ``InputError`` at the first other cell
    place : (row index or None for the header, column index) -> 1-based (line, column) in the file
    encoding : of a text
    words : index of a column that ``Layout.words`` names -> (rows,) numbers of its texts, and the texts; None: the format
        has no texts
    """

    path: Path
    headers: tuple[tuple[str, ...], ...]
    width: int
    lines: np.ndarray
    values: Callable[[int], np.ndarray]
    place: Callable[[int | None, int], tuple[int, int]]
    encoding: str = "UTF-8"
    words: Callable[[int], tuple[np.ndarray, tuple[str, ...]]] | None = None
