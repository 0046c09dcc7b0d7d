"""Reads CSV tables: a header ``name [unit]`` per column, then a row of numbers per line.

Cells are separated by comma, semicolon or tab. The decimal mark is a point, or a comma if commas do not separate cells.
NumPy's C reader reads the whole body. If it fails, the cells are read one by one to locate the first fault. Places are
1-based: the line of the file, and the character of that line at which the cell begins.
"""

import io
import re
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.decode import decode
from capsule_id.rig.formats.raw import RawTable

_HEADER_CELL = re.compile(r"([A-Za-z][A-Za-z0-9_]*)\s*\[([^\[\]]*)\]")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_NUMBER_CHARACTERS = frozenset("0123456789+-eE \t\n")  # plus the decimal mark
_BLANKS = " \t"  # around a cell; other white space, such as a form feed, is an error
_SWAP_MARKS = str.maketrans(",.", ".,")  # the other mark is then no decimal mark
_LONGEST_QUOTED = 40  # characters of a faulty cell in an error line


def read_csv(content: bytes, path: Path) -> RawTable:
    """Read a CSV table.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines

    Raises
    ------
    InputError
        Naming line and column of the first fault.
    """
    lines = _lines(content, path)
    delimiter = next((mark for mark in "\t;," if mark in lines[0]), ",")
    names, units = _header(lines[0], delimiter, path)
    if len(lines) == 1:
        raise InputError("a table must have rows", "a header only", "add a row per reading", path, 1, 1)
    body = "\n".join(lines[1:])
    first_mark = re.search("[.,]", body) if delimiter != "," else None
    decimal = first_mark[0] if first_mark else "."
    values = _read_fast(body, delimiter, decimal, len(names), len(lines) - 1)
    if values is None:
        values = _read_cells(lines, delimiter, decimal, len(names), path)

    def place(row: int | None, column: int) -> tuple[int, int]:
        line = 0 if row is None else row + 1
        return line + 1, _cells(lines[line], delimiter)[column][1]

    return RawTable(names, units, values, np.arange(2, len(lines) + 1), place)


def _lines(content: bytes, path: Path) -> list[str]:
    """The lines without line ends. Trailing blank lines are dropped; another blank line is an error."""
    lines = decode(content, path).split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        remedy = "write a header `name [unit]` per column and one row per reading"
        raise InputError("a table must not be empty", "no text at all", remedy, path, 1, 1)
    for number, line in enumerate(lines, 1):
        if not line.strip():
            remedy = "remove the line" if number > 1 else "put the header on the first line"
            raise InputError(
                "lines between the first and the last must not be blank", "a blank line", remedy, path, number, 1
            )
    return lines


def _cells(line: str, delimiter: str) -> list[tuple[str, int]]:
    """The cells of a line without spaces and tabs around them, and the 1-based character at which each begins."""
    cells, start = [], 0
    for cell in line.split(delimiter):
        bare = cell.strip(_BLANKS)
        cells.append((bare, start + (len(cell) - len(cell.lstrip(_BLANKS)) if bare else 0) + 1))
        start += len(cell) + 1
    return cells


def _header(line: str, delimiter: str, path: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns."""
    units: dict[str, str] = {}
    remedy = "head each column `name [unit]`, e.g. `time [s]` ([1]: no unit)"
    for cell, column in _cells(line, delimiter):
        bare = cell[1:-1].strip() if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell
        if not bare:
            raise InputError("every column must have a header", "an empty cell", remedy, path, 1, column)
        found = _HEADER_CELL.fullmatch(bare)
        if found is None or not found[2].strip():
            raise InputError("the first line must be headers `name [unit]`", _shown(bare), remedy, path, 1, column)
        if found[1] in units:
            raise InputError(
                "column names must be unique", f"a second {found[1]}", "remove or rename it", path, 1, column
            )
        units[found[1]] = found[2].strip()
    return tuple(units), tuple(units.values())


def _read_fast(body: str, delimiter: str, decimal: str, columns: int, rows: int) -> np.ndarray | None:
    """The (rows, columns) numbers, or None if a cell or row is faulty."""
    if not frozenset(body) <= _NUMBER_CHARACTERS | {delimiter, decimal}:
        return None
    if decimal == ",":
        body = body.replace(",", ".")
    try:
        values = np.loadtxt(io.StringIO(body), delimiter=delimiter, comments=None, ndmin=2, dtype=np.float64)
    except ValueError:
        return None
    return values if values.shape == (rows, columns) and np.isfinite(values).all() else None


def _read_cells(lines: list[str], delimiter: str, decimal: str, columns: int, path: Path) -> np.ndarray:
    """The (rows, columns) numbers, read cell by cell; raises at the first fault."""
    values = np.empty((len(lines) - 1, columns))
    for row, line in enumerate(lines[1:]):
        cells = _cells(line, delimiter)
        if line.lstrip().startswith("#"):
            remedy = "remove comments from the table"
            raise InputError("a row must be numbers", _shown(line.strip()), remedy, path, row + 2, 1)
        if len(cells) != columns:
            remedy = "give every row one cell per header"
            if delimiter == "," and len(cells) == 2 * columns:
                remedy += " (a decimal comma needs semicolons or tabs between the cells)"
            place = cells[columns][1] if len(cells) > columns else len(line) + 1
            raise InputError(f"a row must have {columns} cells", f"{len(cells)} cells", remedy, path, row + 2, place)
        for index, (cell, column) in enumerate(cells):
            values[row, index] = _number(cell, decimal, path, row + 2, column)
    return values


def _number(cell: str, decimal: str, path: Path, line: int, column: int) -> float:
    """One cell as a finite number."""
    if not cell:
        remedy = "write a number or delete the row"
        raise InputError("a cell must not be empty", "nothing", remedy, path, line, column)
    written = cell.translate(_SWAP_MARKS) if decimal == "," else cell
    if _NUMBER.fullmatch(written) is None:
        if cell.lower().lstrip("+-") in ("nan", "inf", "infinity"):
            raise InputError("a cell must be a finite number", cell, "delete the row", path, line, column)
        remedy = "write a plain number such as 1.25 or 3e-4, with one decimal mark throughout the file"
        raise InputError("a cell must be a number", _shown(cell), remedy, path, line, column)
    value = float(written)
    if not np.isfinite(value):
        remedy = "write a smaller number: float64 ends at 1.8e308"
        raise InputError("a cell must be a finite number", _shown(cell), remedy, path, line, column)
    return value


def _shown(cell: str) -> str:
    """A faulty cell for an error line: printable and short."""
    text = repr(cell)
    return text if len(text) <= _LONGEST_QUOTED else text[:_LONGEST_QUOTED] + "…"
