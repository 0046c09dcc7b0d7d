"""Reads CSV tables: a header ``name [unit]`` per column, then a row of numbers per line.

Cells are separated by comma, semicolon or tab. The decimal mark is a point, or a comma if commas do not separate cells.
NumPy's C reader reads the whole body. If it fails, the cells are read one by one to locate the first fault. Places are
1-based: the line of the file, and the character of that line at which the cell begins.
"""

import re
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.formats.text.cells import cells_of, read_number, read_plain_rows, shown_cell
from capsule_id.rig.formats.text.decode import decode
from capsule_id.views import counted

_HEADER_CELL = re.compile(r"([A-Za-z][A-Za-z0-9_]*)\s*\[([^\[\]]*)\]")


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
    marks = (re.search("[.,]", line) for line in lines[1:]) if delimiter != "," else iter(())
    decimal = next((mark[0] for mark in marks if mark), ".")
    values = read_plain_rows(lines[1:], delimiter, decimal)
    if values is not None and values.shape[1] != len(names):
        values = None
    if values is None:
        values = _read_cells(lines, delimiter, decimal, len(names), path)

    def place(row: int | None, column: int) -> tuple[int, int]:
        line = 0 if row is None else row + 1
        return line + 1, cells_of(lines[line], delimiter)[column][1]

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


def _header(line: str, delimiter: str, path: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns."""
    units: dict[str, str] = {}
    remedy = "head each column `name [unit]`, e.g. `time [s]` ([1]: no unit)"
    for cell, column in cells_of(line, delimiter):
        bare = cell[1:-1].strip() if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell
        if not bare:
            raise InputError("every column must have a header", "an empty cell", remedy, path, 1, column)
        found = _HEADER_CELL.fullmatch(bare)
        if found is None or not found[2].strip():
            raise InputError("the first line must be headers `name [unit]`", shown_cell(bare), remedy, path, 1, column)
        if found[1] in units:
            raise InputError(
                "column names must be unique", f"a second {found[1]}", "remove or rename it", path, 1, column
            )
        units[found[1]] = found[2].strip()
    return tuple(units), tuple(units.values())


def _read_cells(lines: list[str], delimiter: str, decimal: str, columns: int, path: Path) -> np.ndarray:
    """The (rows, columns) numbers, read cell by cell; raises at the first fault."""
    values = np.empty((len(lines) - 1, columns))
    for row, line in enumerate(lines[1:]):
        cells = cells_of(line, delimiter)
        if line.lstrip().startswith("#"):
            remedy = "remove comments from the table"
            raise InputError("a row must be numbers", shown_cell(line.strip()), remedy, path, row + 2, 1)
        if len(cells) != columns:
            remedy = "give every row one cell per header"
            if delimiter == "," and len(cells) == 2 * columns:
                remedy += " (a decimal comma needs semicolons or tabs between the cells)"
            place = cells[columns][1] if len(cells) > columns else len(line) + 1
            rule = f"a row must have {counted(columns, 'cell')}"
            raise InputError(rule, counted(len(cells), "cell"), remedy, path, row + 2, place)
        for index, (cell, column) in enumerate(cells):
            values[row, index] = read_number(cell, decimal, path, row + 2, column)
    return values
