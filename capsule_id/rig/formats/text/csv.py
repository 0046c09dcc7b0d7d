"""Reads CSV tables: a header ``name [unit]`` per column, then a row of numbers per line.

Cells are separated by comma, semicolon or tab. The decimal mark is a point, or a comma if commas do not separate cells.
A reader in C reads the rows block by block. If it fails, the cells are read one by one to locate the first fault. Places are
1-based: the line of the file, and the character of that line at which the cell begins.
"""

import re
from array import array
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.formats.text.blocks import Content, TextFile
from capsule_id.rig.formats.text.cells import BLANKS, cells_of, read_number, shown_cell
from capsule_id.rig.formats.text.rows import Shape, plain_block
from capsule_id.views import counted

#: What exports write where there is no reading, in small letters, without signs.
_NO_READING = ("", "nan", "inf", "infinity", "na", "n/a", "#n/a", "null", "none")
HEADER_CELL = re.compile(r"([A-Za-z][A-Za-z0-9_]*)\s*\[([^\[\]]*)\]")


class MissingCellsError(InputError):
    """Cells without a reading: the error of the first one, with the ``texts`` of all."""

    def __init__(self, first: InputError, texts: tuple[str, ...]) -> None:
        super().__init__(first.rule, first.value, first.remedy, first.file, first.line, first.column)
        self.texts = texts


def read_csv(content: Content, path: Path) -> RawTable:
    """Read a CSV table.

    Parameters
    ----------
    content : the bytes of the file, or where they lie
    path : its name, for error lines

    Raises
    ------
    InputError
        Naming line and column of the first fault.
    """
    file = TextFile(content, path)
    header = file.line(0)
    if not header.strip():
        _refuse_blank(file)
    delimiter = next((mark for mark in "\t;," if mark in header), ",")
    names, units = _header(header, delimiter, path)
    marks = (re.search("[.,]", line) for line in file.lines(1)) if delimiter != "," else iter(())
    decimal = next((mark[0] for mark in marks if mark), ".")
    shape = Shape(1, delimiter, len(names), decimal)
    columns = _plain_columns(file, shape)
    if columns is None:
        columns = _read_cells(file, shape)

    def place(row: int | None, column: int) -> tuple[int, int]:
        line = 0 if row is None else row + 1
        return line + 1, cells_of(file.line(line), delimiter)[column][1]

    return RawTable(names, units, columns, np.arange(2, 2 + len(columns[0])), place, file.encoding)


def _refuse_blank(file: TextFile) -> None:
    """Raise where the first line is blank."""
    if not any(line.strip() for line in file.lines()):
        remedy = "write a header `name [unit]` per column and one row per reading"
        raise InputError("a table must not be empty", "no text at all", remedy, file.path, 1, 1)
    rule, remedy = "lines between the first and the last must not be blank", "put the header on the first line"
    raise InputError(rule, "a blank line", remedy, file.path, 1, 1)


def _plain_columns(file: TextFile, shape: Shape) -> tuple[np.ndarray, ...] | None:
    """The columns of a table of numbers alone, with blank lines at its end or none; None for any other table."""
    blocks, ended = [], False
    for _, text in file.blocks(shape.first):
        size = len(text.rstrip(f"{BLANKS}\n".encode()))
        # Blanks behind the last row may be cells.
        rows = text[: text.index(b"\n", size)] if size else b""
        if ended and rows:
            return None
        ended = len(rows) + 1 < len(text)
        if not rows:
            continue
        values = plain_block(rows + b"\n", shape, range(shape.width))
        if values is None:
            return None
        blocks.append(values)
    return tuple(np.concatenate(blocks).T.copy()) if blocks else None


def _header(line: str, delimiter: str, path: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns."""
    units: dict[str, str] = {}
    remedy = "head each column `name [unit]`, e.g. `time [s]` ([1]: no unit)"
    for cell, column in cells_of(line, delimiter):
        bare = cell[1:-1].strip() if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell
        if not bare:
            raise InputError("every column must have a header", "an empty cell", remedy, path, 1, column)
        found = HEADER_CELL.fullmatch(bare)
        if found is None or not found[2].strip():
            raise InputError("the first line must be headers `name [unit]`", shown_cell(bare), remedy, path, 1, column)
        if found[1] in units:
            raise InputError(
                "column names must be unique", f"a second {found[1]}", "remove or rename it", path, 1, column
            )
        units[found[1]] = found[2].strip()
    return tuple(units), tuple(units.values())


def _read_cells(file: TextFile, shape: Shape) -> tuple[np.ndarray, ...]:
    """The columns, read cell by cell; raises at the first fault, and at missing readings where there is no other."""
    path, columns, blank = file.path, shape.width, None
    missing: dict[str, InputError] = {}
    assert shape.delimiter is not None, "a table has a separator"
    values: list[array[float]] = [array("d") for _ in range(columns)]
    for line, text in enumerate(file.lines(shape.first), shape.first + 1):
        if not text.strip():
            blank = blank or line
            continue
        if blank is not None:
            rule = "lines between the first and the last must not be blank"
            raise InputError(rule, "a blank line", "remove the line", path, blank, 1)
        cells = cells_of(text, shape.delimiter)
        if text.lstrip().startswith("#"):
            remedy = "remove comments from the table"
            raise InputError("a row must be numbers", shown_cell(text.strip()), remedy, path, line, 1)
        if len(cells) != columns:
            remedy = "give every row one cell per header"
            if shape.delimiter == "," and len(cells) == 2 * columns:
                remedy += " (a decimal comma needs semicolons or tabs between the cells)"
            place = cells[columns][1] if len(cells) > columns else len(text) + 1
            rule = f"a row must have {counted(columns, 'cell')}"
            raise InputError(rule, counted(len(cells), "cell"), remedy, path, line, place)
        for (cell, column), numbers in zip(cells, values, strict=True):
            try:
                numbers.append(read_number(cell, shape.decimal or ".", path, line, column))
            except InputError as error:
                if cell.lower().strip("+-") not in _NO_READING:
                    raise
                missing.setdefault(cell, error)
    if missing:
        raise MissingCellsError(next(iter(missing.values())), tuple(missing))
    if not values[0]:
        raise InputError("a table must have rows", "a header only", "add a row per reading", path, 1, 1)
    return tuple(np.array(numbers) for numbers in values)
