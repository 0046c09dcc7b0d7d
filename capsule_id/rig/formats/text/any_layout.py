"""Reads text exports of any layout: titles, headers, rows of units, comments, and any separator.

Headers are found in the lines above the numbers that have as many cells as the rows. Lines that begin with # or % are
comments; above the numbers they may hold the headers.
"""

import csv
import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.text.blocks import Content, TextFile, occurrences
from capsule_id.rig.formats.text.cells import BLANKS, bare, cells_of, number_in, place_of_cell, shown_cell
from capsule_id.rig.formats.text.rows import COMMENTS, Shape, any_rows, is_comment, is_row, plain_rows

_MANY_ROWS = 50  # whose whole parts do not increase by chance
_COMMA_BETWEEN_DIGITS = re.compile(r"\s*([+-]?[0-9]+),[0-9]+(?:[eE][+-]?[0-9]+)?\s*")


def read_text(content: Content, path: Path, layout: Layout) -> Export:
    """Read a text export.

    Parameters
    ----------
    content : the bytes of the file, or where they lie
    path : its name, for error lines
    layout : what ``rig.toml`` states about it

    Raises
    ------
    InputError
        If the rows of numbers are not found, or a row has another number of cells than the first one.
    """
    file = _file(content, path, layout)
    head = _head(file, layout)
    first, row = len(head) - 1, head.pop()
    delimiter = delimiter_of(row, layout)
    _refuse_ambiguous_comma(file, first, delimiter, layout)
    _refuse_separator_in_quotes(file, first, row, delimiter)
    *cells, last = (cell for cell, _ in cells_of(row, delimiter))
    blank = bool(cells) and not last
    trailing = blank and all(not cells_of(line, delimiter)[-1][0] for line in file.lines(first) if is_row(line))
    width = len(cells) + (not trailing)
    above = range((layout.data_from_line or first + 1) - 2, -1, -1)
    found = [(i, names) for i in above if (names := _headers(head[i], delimiter, width, layout))]
    headers = tuple(names for _, names in found)
    wanted = [k for k in range(width) if layout.columns is None or is_wanted(k, headers, layout.columns)]
    decimal = "." if delimiter == "," else layout.decimal
    shape = Shape(first, delimiter, width, decimal or ("," if "," in row else "."), trailing)
    words = [k for k in wanted if is_wanted(k, headers, layout.words)]
    rows = None if words else plain_rows(file, shape, wanted)
    rows = rows or any_rows(file, replace(shape, decimal=decimal), wanted, layout.missing, words)

    lines = rows.lines

    def values(column: int) -> np.ndarray:
        return rows.column(column)

    def place(row: int | None, column: int) -> tuple[int, int]:
        line = int(lines[row]) - 1 if row is not None else found[0][0] if found else first
        return line + 1, place_of_cell(file.line(line), delimiter, column)

    return Export(path, headers, width, lines, values, place, file.encoding, rows.words)


def _file(content: Content, path: Path, layout: Layout) -> TextFile:
    """The text down to ``data_to_line``, where that is stated."""
    whole, last = TextFile(content, path), layout.data_to_line
    if last is None:
        return whole
    number = sum(occurrences("\n", text) for _, text in whole.blocks())
    if last > number:
        rule, remedy = (
            f"data_to_line must be a line of the file, which has {number}",
            "state the line of the last reading",
        )
        raise InputError(rule, str(last), remedy, path, max(number, 1), 1)
    return TextFile(content, path, last)


def is_wanted(column: int, headers: tuple[tuple[str, ...], ...], wanted: tuple[str | int, ...]) -> bool:
    """Whether a column is named by its number or by a header."""
    return column + 1 in wanted or any(names[column] in wanted for names in headers)


def _head(file: TextFile, layout: Layout) -> list[str]:
    """The lines up to the first row of numbers, that row included.

    Raises
    ------
    InputError
        If there is none, or the first line with a number is no row of readings.
    """
    lines: list[str] = []
    begun = None
    for i, line in enumerate(file.lines()):
        lines.append(line)
        if is_comment(line):
            continue
        if layout.data_from_line is not None:
            if i + 1 >= layout.data_from_line and line.strip():
                return lines
            continue
        cells = _split(line, delimiter_of(line, layout))
        if begun is None and any(is_number(cell) for cell in cells):
            begun, cells = i, _mapped(cells, lines, layout)
        if begun is not None and all(not cell or _is_reading(cell, layout) for cell in cells) and any(cells):
            if i == begun:
                return lines
            remedy = f"state data_from_line = {i + 1}, or the line of the first reading"
            rule = "the first line with a number must be a row of readings"
            raise InputError(rule, shown_cell(lines[begun].strip()), remedy, file.path, begun + 1, 1)
    if layout.data_from_line is not None and layout.data_from_line > len(lines):
        rule = f"data_from_line must be a line of the file, which has {len(lines)}"
        remedy = "state the line of the first reading"
        raise InputError(rule, str(layout.data_from_line), remedy, file.path, max(len(lines), 1), 1)
    if begun is None:
        line = 1 if layout.data_from_line is None else len(lines)
        remedy = "export the readings as text"
        raise InputError("a table must have rows of numbers", "none", remedy, file.path, line, 1)
    remedy = f"state data_from_line = {begun + 1}, or the line of the first reading"
    rule = "data_from_line must be stated where no row has numbers only"
    raise InputError(rule, shown_cell(lines[begun].strip()), remedy, file.path, begun + 1, 1)


def _mapped(cells: list[str], lines: list[str], layout: Layout) -> list[str]:
    """The cells of the first row with a number, the last of ``lines``, that are read as numbers; all without a map."""
    *above, row = lines
    found = (_headers(line, delimiter_of(row, layout), len(cells), layout) for line in above)
    headers = tuple(names for names in found if names)
    wanted = [k for k in range(len(cells)) if is_wanted(k, headers, layout.columns or ())]
    return [cells[k] for k in wanted if not is_wanted(k, headers, layout.words)] or cells


def _headers(line: str, delimiter: str | None, width: int, layout: Layout) -> tuple[str, ...]:
    """The headers in a line above the numbers; () if it holds none."""
    bare = line.lstrip(" " if delimiter == "\t" else BLANKS).lstrip("".join(COMMENTS))  # a first cell may be empty
    for cells in _header_cells(bare, delimiter):
        if len(cells) == width + 1 and not cells[-1]:
            cells.pop()
        if len(cells) == width and any(cells) and not any(is_number(cell) for cell in cells):
            return tuple(" ".join(cell.split()) for cell in cells)
    return ()


def _header_cells(line: str, delimiter: str | None) -> Iterator[list[str]]:
    """Ways to split a line of headers: as the readings, else with quotation marks, or with another separator."""
    yield _split(line, delimiter)
    if delimiter is None:  # headers of several words, two spaces or more between them
        yield re.split(r"\s{2,}", line.strip())
    for mark in (delimiter, "\t", ";", ","):
        if mark is not None and mark in line and (mark == delimiter or delimiter is None or delimiter not in line):
            with suppress(csv.Error):
                (cells,) = csv.reader([line], delimiter=mark, skipinitialspace=True)
                yield [bare(cell) for cell in cells]


def _split(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line without blanks and quotation marks around them."""
    return [bare(cell) for cell, _ in cells_of(line, delimiter)]


def delimiter_of(line: str, layout: Layout) -> str | None:
    """The separator of a row: tab, semicolon, comma, or None for spaces; a comma may be the decimal mark."""
    for mark in "\t;":
        if mark in line:
            return mark
    words = [word for word, _ in cells_of(line, None)]
    if layout.decimal == ",":  # a tab separates nothing in a line with one cell
        return None if len(words) > 1 else "\t"
    if "," not in line:
        return None if len(words) > 1 else ","
    if all(_is_reading(cell, layout) for cell in _split(line, ",")):
        return ","
    return None if len(words) > 1 and all(_is_reading(word, layout) for word in words) else ","


def _refuse_separator_in_quotes(file: TextFile, first: int, row: str, delimiter: str | None) -> None:
    """Refuse rows such as ``"10,2","1,5"``: the separator would cut quoted numbers in two."""
    for cell, position in cells_of(row, delimiter):
        if cell.count('"') % 2:
            rule = "a cell in quotation marks must not hold the separator of the cells"
            remedy = "export with a decimal point, or with semicolons between the cells"
            raise InputError(rule, shown_cell(row.strip()), remedy, file.path, first + 1, position)


def _refuse_ambiguous_comma(file: TextFile, first: int, delimiter: str | None, layout: Layout) -> None:
    """Refuse rows such as ``1,25``: two whole numbers, or one number with a decimal comma.

    Many rows whose whole parts increase from row to row are times and a reading.
    """
    if delimiter != "," or layout.decimal is not None:
        return
    rows, before, increasing = 0, -math.inf, True
    for line in file.lines(first):
        if not is_row(line):
            continue
        found = _COMMA_BETWEEN_DIGITS.fullmatch(line)
        if found is None:
            return
        whole = int(found[1][:18])
        rows, before, increasing = rows + 1, whole, increasing and before < whole
    if rows >= _MANY_ROWS and increasing:
        return
    rule = "a comma between digits must be stated as a separator or a decimal mark"
    remedy = 'state decimal = "," for one column of numbers, decimal = "." for two'
    raise InputError(rule, shown_cell(file.line(first).strip()), remedy, file.path, first + 1, 1)


def is_number(cell: str) -> bool:
    """Whether a cell is a number with either decimal mark."""
    return number_in(cell, ".") is not None or number_in(cell, ",") is not None


def _is_reading(cell: str, layout: Layout) -> bool:
    """Whether a cell is a number or a stated missing marker."""
    return is_number(cell) or cell in layout.missing
