"""Reads text exports of any layout: titles, headers, rows of units, comments, and any separator.

Headers are found in the lines above the numbers that have as many cells as the rows. Lines that begin with # or % are
comments; above the numbers they may hold the headers.
"""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.text.cells import BLANKS, cells_of, number_in, read_column, read_plain_rows, shown_cell
from capsule_id.rig.formats.text.decode import decode
from capsule_id.views import counted

_COMMENTS = ("#", "%")
_MANY_ROWS = 50  # whose whole parts do not increase by chance
_COMMA_BETWEEN_DIGITS = re.compile(r"\s*([+-]?[0-9]+),[0-9]+(?:[eE][+-]?[0-9]+)?\s*")


def read_text(content: bytes, path: Path, layout: Layout) -> Export:
    """Read a text export.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : what ``rig.toml`` states about it

    Raises
    ------
    InputError
        If the rows of numbers are not found, or a row has another number of cells than the first one.
    """
    lines = decode(content, path).split("\n")
    first = _first_row(lines, layout, path)
    numbers = [i for i in range(first, len(lines)) if lines[i].strip() and not _is_comment(lines[i])]
    if not numbers:
        raise InputError("a table must have rows of numbers", "none", "export the readings", path, len(lines), 1)
    delimiter = delimiter_of(lines[numbers[0]], layout)
    _refuse_ambiguous_comma([lines[i] for i in numbers], delimiter, layout, path, numbers[0] + 1)
    table = _plain_table([lines[i] for i in numbers], delimiter, layout)
    rows = [lines[i].split(delimiter) for i in (numbers if table is None else numbers[:1])]
    if len(rows[0]) > 1 and not any(row[-1].strip(BLANKS) for row in rows):  # a separator at the end of every line
        rows = [row[:-1] for row in rows]
    width = len(rows[0])
    for i, row in zip(numbers, rows, strict=False):
        if len(row) != width:
            rule = f"a row must have {counted(width, 'cell')}, as line {numbers[0] + 1} has"
            remedy = f"correct the row, or state data_from_line = {i + 1} if the readings begin here"
            raise InputError(rule, counted(len(row), "cell"), remedy, path, i + 1, 1)
    found = [(i, names) for i in range(first - 1, -1, -1) if (names := _headers(lines[i], delimiter, width, layout))]

    def values(column: int) -> np.ndarray:
        if table is not None:
            return table[:, column]
        texts = [_bare(row[column]) for row in rows]
        decimal = "." if delimiter == "," else layout.decimal
        return read_column(texts, decimal, layout.missing, lambda k: (path, *place(k, column)))

    def place(row: int | None, column: int) -> tuple[int, int]:
        line = numbers[row] if row is not None else found[0][0] if found else numbers[0]
        cells = cells_of(lines[line], delimiter)
        return line + 1, cells[column][1] if column < len(cells) else 1

    return Export(path, tuple(names for _, names in found), width, np.asarray(numbers) + 1, values, place)


def _plain_table(rows: list[str], delimiter: str | None, layout: Layout) -> np.ndarray | None:
    """All numbers of a file without missing, empty or other cells; None for any other file."""
    decimal = layout.decimal or "."
    if delimiter == ",":
        decimal = "."
    elif layout.decimal is None and "," in rows[0]:
        decimal = ","
    return read_plain_rows(rows, delimiter, decimal)


def _first_row(lines: list[str], layout: Layout, path: Path) -> int:
    """Index of the line with the first row of numbers."""
    if layout.data_from_line is not None:
        if layout.data_from_line > len(lines):
            remedy = "state the line of the first reading"
            rule = f"data_from_line must be a line of the file, which has {len(lines)}"
            raise InputError(rule, str(layout.data_from_line), remedy, path, len(lines), 1)
        return layout.data_from_line - 1
    begun = None
    for i, line in enumerate(lines):
        if _is_comment(line):
            continue
        cells = _split(line, delimiter_of(line, layout))
        if begun is None and any(_is_number(cell) for cell in cells):
            begun = i
        if begun is not None and all(not cell or _is_reading(cell, layout) for cell in cells) and any(cells):
            if i == begun:
                return i
            remedy = f"state data_from_line = {i + 1}, or the line of the first reading"
            rule = "the first line with a number must be a row of readings"
            raise InputError(rule, shown_cell(lines[begun].strip()), remedy, path, begun + 1, 1)
    if begun is None:
        remedy = "export the readings as text"
        raise InputError("a table must have rows of numbers", "none", remedy, path, 1, 1)
    remedy = f"state data_from_line = {begun + 1}, or the line of the first reading"
    rule = "data_from_line must be stated where no row has numbers only"
    raise InputError(rule, shown_cell(lines[begun].strip()), remedy, path, begun + 1, 1)


def _headers(line: str, delimiter: str | None, width: int, layout: Layout) -> tuple[str, ...]:
    """The headers in a line above the numbers; () if it holds none."""
    bare = line.lstrip(BLANKS).lstrip("".join(_COMMENTS))
    cells = _split(bare, delimiter)
    if delimiter is None and len(cells) != width:  # headers of several words, two spaces or more between them
        cells = re.split(r"\s{2,}", bare.strip())
    if len(cells) == width + 1 and not cells[-1]:
        cells.pop()
    if len(cells) != width or not any(cells) or any(_is_number(cell) for cell in cells):
        return ()
    return tuple(" ".join(cell.split()) for cell in cells)


def _split(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line without blanks and quotation marks around them."""
    return [_bare(cell) for cell in line.split(delimiter)]


def _bare(cell: str) -> str:
    """A cell without blanks and quotation marks around it."""
    return cell.strip(BLANKS).strip('"')


def delimiter_of(line: str, layout: Layout) -> str | None:
    """The separator of a row: tab, semicolon, comma, or None for spaces; a comma may be the decimal mark."""
    for mark in "\t;":
        if mark in line:
            return mark
    words = line.split()
    if layout.decimal == ",":  # a tab separates nothing in a line with one cell
        return None if len(words) > 1 else "\t"
    if "," not in line:
        return None if len(words) > 1 else ","
    if all(_is_reading(cell, layout) for cell in _split(line, ",")):
        return ","
    return None if len(words) > 1 and all(_is_reading(word, layout) for word in words) else ","


def _refuse_ambiguous_comma(rows: list[str], delimiter: str | None, layout: Layout, path: Path, line: int) -> None:
    """Refuse rows such as ``1,25``: two whole numbers, or one number with a decimal comma.

    Many rows whose whole parts increase from row to row are times and a reading.
    """
    if delimiter != "," or layout.decimal is not None:
        return
    found = [_COMMA_BETWEEN_DIGITS.fullmatch(row) for row in rows]
    whole = [int(match[1][:18]) for match in found if match is not None]
    if len(whole) < len(rows) or (len(rows) >= _MANY_ROWS and all(a < b for a, b in pairwise(whole))):
        return
    rule = "a comma between digits must be stated as a separator or a decimal mark"
    remedy = 'state decimal = "," for one column of numbers, decimal = "." for two'
    raise InputError(rule, shown_cell(rows[0].strip()), remedy, path, line, 1)


def _is_comment(line: str) -> bool:
    """Whether a line is a comment."""
    return line.lstrip().startswith(_COMMENTS)


def _is_number(cell: str) -> bool:
    """Whether a cell is a number with either decimal mark."""
    return number_in(cell, ".") is not None or number_in(cell, ",") is not None


def _is_reading(cell: str, layout: Layout) -> bool:
    """Whether a cell is a number or a stated missing marker."""
    return _is_number(cell) or cell in layout.missing
