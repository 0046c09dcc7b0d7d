"""Splits the lines of a text table into cells and reads their numbers. Places are 1-based."""

import json
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
BLANKS = " \t"  # around a cell; other white space, such as a form feed, is an error
_SWAP_MARKS = str.maketrans(",.", ".,")  # the other mark is then no decimal mark
_NUMBER_CHARACTERS = frozenset("0123456789+-eE")  # plus the decimal mark
_LONGEST_QUOTED = 40  # characters of a faulty cell in an error line


def cells_of(line: str, delimiter: str | None) -> list[tuple[str, int]]:
    """The cells of a line without spaces and tabs around them, and the 1-based character at which each begins.

    A ``delimiter`` of None stands for any number of spaces and tabs.
    """
    if delimiter is None:
        return [(found[0], found.start() + 1) for found in re.finditer(rf"[^{BLANKS}]+", line)]
    cells, start = [], 0
    for cell in line.split(delimiter):
        bare = cell.strip(BLANKS)
        cells.append((bare, start + (len(cell) - len(cell.lstrip(BLANKS)) if bare else 0) + 1))
        start += len(cell) + 1
    return cells


def place_of_cell(line: str, delimiter: str | None, column: int) -> int:
    """1-based character at which a cell begins; 1 where the line has no such cell."""
    cells = cells_of(line, delimiter)
    return cells[column][1] if column < len(cells) else 1


def bare(cell: str) -> str:
    """A cell without blanks and quotation marks around it."""
    return cell.strip(BLANKS).strip('"')


def number_in(cell: str, decimal: str) -> float | None:
    """The number in a cell with the decimal mark ``decimal``, None if it is no plain number."""
    written = cell.translate(_SWAP_MARKS) if decimal == "," else cell
    return None if _NUMBER.fullmatch(written) is None else float(written)


def read_number(cell: str, decimal: str, path: Path, line: int, column: int) -> float:
    """One cell as a finite number.

    Raises
    ------
    InputError
        At ``line`` and ``column`` if it is no number.
    """
    if not cell:
        remedy = "write a number or delete the row"
        raise InputError("a cell must not be empty", "nothing", remedy, path, line, column)
    value = number_in(cell, decimal)
    if value is None:
        if cell.lower().lstrip("+-") in ("nan", "inf", "infinity"):
            raise InputError("a cell must be a finite number", cell, "delete the row", path, line, column)
        remedy = "write a plain number such as 1.25 or 3e-4, with one decimal mark throughout the file"
        raise InputError("a cell must be a number", shown_cell(cell), remedy, path, line, column)
    if not np.isfinite(value):
        remedy = "write a smaller number: float64 ends at 1.8e308"
        raise InputError("a cell must be a finite number", shown_cell(cell), remedy, path, line, column)
    return value


def decimal_mark(texts: Sequence[str], missing: Sequence[str]) -> str | None:
    """The first point or comma of the cells of a column, None where they have none."""
    found = re.search("[.,]", "\n".join(text for text in texts if text not in missing))
    return found[0] if found else None


def read_column(
    texts: Sequence[str],
    decimal: str | None,
    missing: Sequence[str],
    place: Callable[[int], tuple[Path, int, int]],
) -> np.ndarray:
    """The numbers of one column, (n,); NaN at a missing marker.

    Parameters
    ----------
    texts : the cells
    decimal : decimal mark (None: the first point or comma of the column)
    missing : texts of cells without a reading
    place : file, line and column of a cell, for error lines

    Raises
    ------
    InputError
        At the first cell that is neither a finite number nor a marker.
    """
    mark = decimal or decimal_mark(texts, missing) or "."
    if (_NUMBER_CHARACTERS | {mark}).issuperset("".join(texts)):  # quickly, where all are numbers
        with suppress(ValueError):
            values = np.array([float(text.replace(mark, ".")) for text in texts])
            if np.isfinite(values).all():
                return values
    values = np.full(len(texts), np.nan)
    for k, text in enumerate(texts):
        if text in missing:
            continue
        value = number_in(text, mark)
        if value is None:
            remedy = (
                f"correct the cell, or add {json.dumps(text, ensure_ascii=False)} to missing = [...] to drop its row"
            )
            raise InputError("a cell must be a number", shown_cell(text), remedy, *place(k))
        values[k] = value if np.isfinite(value) else read_number(text, mark, *place(k))
    return values


def shown_cell(cell: str) -> str:
    """A faulty cell for an error line: printable and short."""
    text = repr(cell)
    return text if len(text) <= _LONGEST_QUOTED else text[:_LONGEST_QUOTED] + "…"
