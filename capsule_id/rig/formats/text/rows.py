"""Reads rows of numbers from a text in blocks: quickly where all cells are numbers, else cell by cell."""

import csv
import io
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.text.blocks import TextFile, lines_of, occurrences
from capsule_id.rig.formats.text.cells import bare, cells_of, decimal_mark, place_of_cell, read_column
from capsule_id.views import counted

COMMENTS = ("#", "%")
_NO_CELLS = " \t\r\f\v\n,;"  # spreadsheets write blank rows as separators alone
_PLAIN = "0123456789+-eE \t"  # characters of rows of numbers, without the separator and the decimal mark
_SHORT = 1_000_000  # characters of a text that NumPy reads before pandas is imported


@dataclass(frozen=True)
class Shape:
    """The rows of a text.

    Attributes
    ----------
    first : 0-based line of the first one
    delimiter : separator; None: any number of spaces and tabs
    width : cells of a row
    decimal : decimal mark; None: that of each column
    trailing : every row ends with a separator and a blank cell, which is not counted
    """

    first: int
    delimiter: str | None
    width: int
    decimal: str | None
    trailing: bool = False


class Rows:
    """Numbers of some columns of a text; a column with another cell holds the error about it.

    Of the columns ``words`` the texts are kept too.
    """

    def __init__(self, columns: Sequence[int], words: Sequence[int] = ()) -> None:
        self._codes: dict[int, list[np.ndarray]] = {column: [] for column in words}
        self._texts: dict[int, dict[str, int]] = {column: {} for column in words}
        self._lines: list[np.ndarray] = []
        self._columns: dict[int, list[np.ndarray] | InputError] = {column: [] for column in columns}

    @property
    def lines(self) -> np.ndarray:
        """(rows,) 1-based line of every row."""
        return np.concatenate([np.empty(0, int), *self._lines])

    def column(self, index: int) -> np.ndarray:
        """The numbers of a column, (rows,).

        Raises
        ------
        InputError
            At the first cell that is neither a number nor a missing marker.
        """
        column = self._columns[index]
        if isinstance(column, InputError):
            raise column
        return np.concatenate([np.empty(0), *column])

    def words(self, index: int) -> tuple[np.ndarray, tuple[str, ...]]:
        """Numbers of the texts of a column, (rows,), and the texts."""
        return np.concatenate([np.empty(0, int), *self._codes[index]]), tuple(self._texts[index])

    def add_words(self, index: int, texts: Sequence[str]) -> None:
        """Append texts to a column."""
        known = self._texts[index]
        self._codes[index].append(np.array([known.setdefault(text, len(known)) for text in texts], int))

    def add_lines(self, numbers: np.ndarray | Sequence[int]) -> None:
        """Append rows by their 0-based lines."""
        self._lines.append(np.asarray(numbers, int) + 1)

    def add(self, index: int, values: np.ndarray | InputError) -> None:
        """Append numbers to a column; the first error of a column stays."""
        column = self._columns[index]
        if isinstance(column, InputError):
            return
        if isinstance(values, InputError):
            self._columns[index] = values
        else:
            column.append(values)


def is_comment(line: str) -> bool:
    """Whether a line is a comment."""
    return line.lstrip().startswith(COMMENTS)


def is_row(line: str) -> bool:
    """Whether a line has a cell, and is no comment."""
    return bool(line.strip(_NO_CELLS)) and not is_comment(line)


def plain_block(text: bytes, shape: Shape, columns: Sequence[int]) -> np.ndarray | None:
    """The (rows, columns) numbers of lines that hold numbers alone, by a reader in C; None for any other lines.

    Parameters
    ----------
    text : lines in UTF-8, each with a line feed
    columns : indices of the columns that are returned
    """
    delimiter, decimal, count = shape.delimiter, shape.decimal or ".", occurrences("\n", text)
    allowed = f"{_PLAIN}{delimiter or ''}{decimal}\n".encode()
    if not text.strip() or text.translate(None, allowed):
        return None
    # Rows with a last cell have all cells, by the number of separators. Cells between spaces are counted by the reader.
    if delimiter is not None and occurrences(delimiter, text) != count * (shape.width - 1 + shape.trailing):
        return None
    used = list(range(shape.width)) if delimiter is None else sorted({*columns, shape.width - 1})
    values = _parse(text.replace(b",", b".") if decimal == "," else text, delimiter, used)
    if values is None or values.shape != (count, len(used)) or not np.isfinite(values).all():
        return None
    return values[:, np.searchsorted(used, columns)]


def _parse(text: bytes, delimiter: str | None, columns: list[int]) -> np.ndarray | None:
    """The numbers of the columns of a text, correctly rounded; None where a cell is no number."""
    usecols = None if delimiter is None else columns
    try:
        if len(text) < _SHORT:
            lines = io.StringIO(text.decode())
            return np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2, usecols=usecols)
        import pandas as pd

        with warnings.catch_warnings():
            # pandas 2 rounds correctly by this option alone; pandas 3 always does so, and warns of the option.
            warnings.simplefilter("ignore")
            frame = pd.read_csv(
                io.BytesIO(text),
                sep=delimiter or r"\s+",
                header=None,
                usecols=usecols,
                dtype=np.float64,
                na_filter=False,
                quoting=csv.QUOTE_NONE,
                float_precision="round_trip",
                low_memory=False,
            )
    except ValueError:
        return None
    return frame.to_numpy()


def plain_rows(file: TextFile, shape: Shape, columns: Sequence[int]) -> Rows | None:
    """The rows of a text without missing, empty or other cells; None for any other text."""
    rows = Rows(columns)
    for number, text in file.blocks(shape.first):
        numbers: np.ndarray | list[int] = np.arange(number, number + occurrences("\n", text), dtype=np.int32)
        values = plain_block(text, shape, columns)
        if values is None:
            kept = list(_rows_in(number, text))
            if not kept:
                continue
            numbers, lines = [line for line, _ in kept], [line for _, line in kept]
            if len(lines) < occurrences("\n", text):  # blank lines or comments
                values = plain_block("\n".join([*lines, ""]).encode(), shape, columns)
        if values is None:
            return None
        rows.add_lines(numbers)
        for index, column in enumerate(columns):
            rows.add(column, values[:, index])
    return rows


def any_rows(
    file: TextFile, shape: Shape, columns: Sequence[int], missing: Sequence[str], words: Sequence[int] = ()
) -> Rows:
    """The rows of a text, with NaN at a missing marker, and the texts of the columns ``words``.

    Raises
    ------
    InputError
        If a row has another number of cells than the first one.
    """
    rows = Rows(columns, words)
    marks = dict.fromkeys(columns, shape.decimal)
    for number, text in file.blocks(shape.first):
        kept = list(_rows_in(number, text))
        cells = [_cells(line, text, shape, file.path) for line, text in kept]
        rows.add_lines([line for line, _ in kept])
        for column in columns:
            texts = [bare(row[column]) for row in cells]
            if column in words:
                rows.add_words(column, texts)
            marks[column] = marks[column] or decimal_mark(texts, missing)

            def place(k: int, column: int = column, kept: list[tuple[int, str]] = kept) -> tuple[Path, int, int]:
                line, text = kept[k]
                return file.path, line + 1, place_of_cell(text, shape.delimiter, column)

            try:
                rows.add(column, read_column(texts, marks[column] or ".", missing, place))
            except InputError as error:
                rows.add(column, error)
    return rows


def _rows_in(number: int, text: bytes) -> Iterator[tuple[int, str]]:
    """The rows of a block with their 0-based lines; ``number`` is that of the first line."""
    return ((line, row) for line, row in enumerate(lines_of(text), number) if is_row(row))


def _cells(line: int, text: str, shape: Shape, path: Path) -> list[str]:
    """The cells of a row, as many as the first row has."""
    cells = [cell for cell, _ in cells_of(text, shape.delimiter)]
    cells = cells[:-1] if shape.trailing else cells
    if len(cells) != shape.width:
        rule = f"a row must have {counted(shape.width, 'cell')}, as line {shape.first + 1} has"
        remedy = (
            f"correct the row, or state data_to_line = {line} if the readings end above it, or data_from_line = {line + 1} if "
            f"they begin here"
        )
        raise InputError(rule, counted(len(cells), "cell"), remedy, path, line + 1, 1)
    return cells
