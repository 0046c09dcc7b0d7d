"""Readers of text tables: cells, time stamps, rows of numbers."""

import io
import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.raw import (
    Place,
    TextFile,
    lines_of,
    numbers_of,
)
from capsule_id.rig.toml import shown
from capsule_id.views import counted

# cells: Splits the lines of a text table into cells and reads their numbers. Places are 1-based.


_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
BLANKS = " \t"  # around a cell; other white space, such as a form feed, is an error
_SWAP_MARKS = str.maketrans(",.", ".,")  # the other mark is then no decimal mark
#: A number whose thousands are separated; by decimal mark, one that shows by which mark they are.
_GROUPED = re.compile(
    "[+-]?[1-9][0-9]{0,2}(?P<mark>[.,'\u2019 \u00a0\u202f])[0-9]{3}(?:(?P=mark)[0-9]{3})*(?:[.,][0-9]*)?"
)
_SHORT = re.compile("[+-]?[0-9]{1,3}")
#: Cells such as 1,234 among which whole numbers show that their comma separates thousands.
FEWEST_APART = 20
_APART = {
    mark: re.compile(rf"(?m)^[+-]?[1-9][0-9]{{0,2}}(?:(?:{other}[0-9]{{3}})+[{mark}]|(?:{other}[0-9]{{3}}){{2,}}$)")
    for mark, other in ((",", "[.]"), (".", ","))
}
# Only with such an exponent may a number be below the smallest float64: its cells are then read one by one.
_TINY = re.compile("[eE]-0*(?:[1-9][0-9]{3}|[3-9][0-9]{2})")
_NUMBER_CHARACTERS = frozenset("0123456789+-eE")  # plus the decimal mark


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


def texts_of(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line without their places, as ``cells_of``, in half the time."""
    if delimiter is None:
        return re.findall(rf"[^{BLANKS}]+", line)
    return [cell.strip(BLANKS) for cell in line.split(delimiter)]


def place_of_cell(line: str, delimiter: str | None, column: int, absent: int = 1) -> int:
    """1-based character at which a cell begins; ``absent`` where the line has no such cell."""
    cells = cells_of(line, delimiter)
    return cells[column][1] if column < len(cells) else absent


def bare(cell: str) -> str:
    """A cell without blanks and quotation marks around it."""
    return cell.strip(BLANKS).strip('"')


def number_in(cell: str, decimal: str, apart: bool = False) -> float | None:
    """The number in a cell with the decimal mark ``decimal``, None if it is no plain number.

    Its thousands may be separated; by a point or a comma alone only where it is known that they are ``apart``: 1,234.
    """
    cell = cell.replace("\u2212", "-")  # a typographic minus
    if (found := _GROUPED.fullmatch(cell)) and (mark := found["mark"]) != decimal:
        sure = apart or mark not in ".," or decimal in cell or cell.count(mark) > 1
        cell = cell.replace(mark, "") if sure else cell
    written = cell.translate(_SWAP_MARKS) if decimal == "," else cell
    return None if _NUMBER.fullmatch(written) is None else float(written)


def no_number(cell: str, value: float | None, place: Place) -> InputError:
    """The error about a cell that is no number (None), or whose ``value`` float64 does not hold."""
    text = json.dumps(cell, ensure_ascii=False)
    causes = (
        (value == 0.0, "number that float64 holds", "write 0: float64 begins at 5e-324"),
        (
            value is not None or cell.lower().lstrip("+-") in ("inf", "infinity"),
            "finite number",
            "write a smaller number: float64 ends at 1.8e308",
        ),
        (
            cell.endswith("%"),
            "number alone",
            "remove the signs of per cent (in a sheet: give the cells no such format)",
        ),
        (True, "number", f"correct the cell, or add {text} to missing = [...] to drop its row"),
    )
    rule, remedy = next((rule, remedy) for holds, rule, remedy in causes if holds)
    return InputError(f"a cell must be a {rule}", shown(cell), remedy, *place)


def is_beyond_floats(value: float, written: str) -> bool:
    """Whether ``value``, read from ``written``, is infinite, or 0 where another number is written."""
    return not math.isfinite(value) or (value == 0.0 and re.search("[1-9]", re.split("[eE]", written)[0]) is not None)


def decimal_mark(texts: Sequence[str], missing: Sequence[str]) -> str | None:
    """The first point or comma of the cells of a column that separates no thousands, None where they have none."""
    written = "\n".join(text for text in texts if text not in missing)
    found = re.search("[.,]", written)
    return next(mark_apart(written), found[0] if found else None)


def mark_apart(written: str) -> Iterator[str]:
    """The decimal mark of lines with numbers such as 1.234,5 or 1,234,567, which show how their thousands are separated."""
    return (mark for mark, pattern in _APART.items() if pattern.search(written))


def read_column(
    texts: Sequence[str],
    mark: str,
    missing: Sequence[str],
    place: Callable[[int], Place],
) -> np.ndarray:
    """The numbers of one column, (n,); NaN at a missing marker.

    Parameters
    ----------
    texts : the cells
    mark : decimal mark
    missing : texts of cells without a reading
    place : file, line and column of a cell, for error lines

    Raises
    ------
    InputError
        At the first cell that is neither a finite number nor a marker.
    """
    markers, values = frozenset(missing), np.full(len(texts), np.nan)
    all_used = markers.isdisjoint(texts)
    used = range(len(texts)) if all_used else [k for k, text in enumerate(texts) if text not in markers]
    if (_NUMBER_CHARACTERS | {mark}).issuperset("".join([texts[k] for k in used])):  # quickly, where all are numbers
        with suppress(ValueError):
            values[used] = [float(texts[k].replace(mark, ".")) for k in used]
            if np.isfinite(values[used]).all() and (values[used].all() or not _TINY.search("\n".join(texts))):
                return values
    apart = mark in mark_apart("\n".join(texts))
    for k in used:
        value = number_in(texts[k], mark, apart)
        if value is None or is_beyond_floats(value, texts[k]):
            raise no_number(texts[k], value, place(k))
        values[k] = value
    return values


# stamps: Dates and times of day as seconds since the first one.


#: A date, which may be left out, and a time of day or of an hour: 2024-03-01T12:34:56.789+01:00, 12:34:56,789, 34:56.8.
_STAMP = re.compile(
    r"(?:(?:(?P<year>\d{4})[-/.](?P<month>\d\d?)[-/.](?P<day>\d\d?)|(?P<one>\d\d?)(?P<mark>[-/.])(?P<two>\d\d?)[-/.](?P<last>\d{4}|\d\d))"
    r"(?:T|,? +))?(?P<h>\d{1,3}):(?P<min>\d\d)(?::(?P<s>\d\d)(?:[.,:](?P<part>\d{1,9}))?|[.,](?P<tail>\d{1,9}))"
    r"(?: ?(?P<half>[AaPp])\.?[Mm]\.?)?(?: ?(?:Z|UTC|GMT|(?P<zone>[+-]\d\d):?(?P<zone_min>\d\d)))?"
)
_SECOND, _HOUR = 10**9, 3600 * 10**9  # ns


def is_stamp(cell: str) -> bool:
    """Whether a cell is a time stamp."""
    return ":" in cell and _STAMP.fullmatch(cell) is not None


def seconds_of_stamps(texts: Sequence[str], missing: Sequence[str], place: Callable[[int], Place]) -> np.ndarray:
    """Seconds since the first of these stamps, (n,); NaN at a missing one. Without a date, a fall is the next day, or hour.

    Raises
    ------
    InputError
        At the first text that is no stamp, or where the dates are none.
    """
    found = [_STAMP.fullmatch(text) for text in texts]
    known = [k for k, one in enumerate(found) if one]
    wrong = [k for k, one in enumerate(found) if not one and (not known or texts[k] not in missing)]
    if wrong:
        raise InputError(
            "a time stamp must be a time of day, such as 12:34:56.789, with or without a date",
            shown(texts[wrong[0]]),
            "correct the cell, or state the unit of the numbers, such as s",
            *place(wrong[0]),
        )
    stamps = [one for one in found if one]
    clocks = np.array([_clock(one) for one in stamps])
    days = list[np.ndarray]()
    for first in ("one", "two"):
        with suppress(ValueError):
            days.append(np.array([_day(one, first) for one in stamps]))
    if not days:
        raise InputError("the date of a time stamp must exist", shown(texts[known[0]]), "correct it", *place(known[0]))
    turn = 24 * _HOUR if stamps[0]["tail"] is None else _HOUR
    day = min(days, key=np.ptp)  # 03/04/2024: the order of day and month that makes the record shorter
    if not day.any():
        day = np.cumsum(np.diff(clocks, prepend=clocks[0]) < -turn // 2)
    total = day * turn + clocks
    values = np.full(len(texts), np.nan)
    values[known] = (total - total[0]) / _SECOND
    return values


def _clock(stamp: re.Match[str]) -> int:
    """The time of day of a stamp in Greenwich, ns; without seconds that of an hour."""
    units = [int(stamp["h"]), int(stamp["min"]), int(stamp["s"] or 0)]
    if stamp["half"]:
        units[0] = units[0] % 12 + 12 * (stamp["half"] in "Pp")
    units = units if stamp["tail"] is None else [0, *units[:2]]
    if stamp["zone"]:
        sign = -1 if stamp["zone"][0] == "-" else 1
        units = [units[0] - int(stamp["zone"]), units[1] - sign * int(stamp["zone_min"]), units[2]]
    seconds = (units[0] * 60 + units[1]) * 60 + units[2]
    return seconds * _SECOND + int((stamp["part"] or stamp["tail"] or "").ljust(9, "0"))


def _day(stamp: re.Match[str], first: str) -> int:
    """The number of the day of a stamp, 0 without a date; ``first``: which of two numbers is the day, if no point follows."""
    if stamp["year"]:
        return date(int(stamp["year"]), int(stamp["month"]), int(stamp["day"])).toordinal()
    if not stamp["one"]:
        return 0
    day, month = ("one", "two") if first == "one" or stamp["mark"] == "." else ("two", "one")
    year = int(stamp["last"])
    return date(year + 2000 * (year < 100), int(stamp[month]), int(stamp[day])).toordinal()


# rows: Reads rows of numbers from a text in blocks: quickly where all cells are numbers, else cell by cell.


COMMENTS = ("#", "%")
_NO_CELLS = " \t\r\f\v\n,;"  # spreadsheets write blank rows as separators alone
_PLAIN = "0123456789+-eE \t"  # characters of rows of numbers, without the separator and the decimal mark


@dataclass(frozen=True)
class Shape:
    """The rows of a text.

    Attributes
    ----------
    first : 0-based line of the first one
    delimiter : separator; None: any number of spaces and tabs
    width : cells of a row
    decimal : decimal mark; None: that of each column
    stated : ``rig.toml`` states the decimal mark: the other one separates thousands
    trailing : every row ends with a separator and a blank cell, which is not counted
    """

    first: int
    delimiter: str | None
    width: int
    decimal: str | None
    trailing: bool = False
    stated: bool = False


@dataclass(frozen=True)
class Rows:
    """Rows of a text, block by block.

    Attributes
    ----------
    numbers : of each column that is read: those of every block
    faults : of a column, the error at its first cell that is no number
    blocks : 1-based lines of the rows of every block
    marks : decimal mark of each column that is read; None: its numbers show none, or leave open what theirs parts
    """

    numbers: dict[int, list[np.ndarray]]
    marks: dict[int, str | None]
    faults: dict[int, InputError] = field(default_factory=dict)
    blocks: list[np.ndarray] = field(default_factory=list)
    #: Blank lines, counted from 1.
    blanks: list[int] = field(default_factory=list)

    @property
    def lines(self) -> np.ndarray:
        """(rows,) 1-based line of every row."""
        return np.concatenate([np.empty(0, np.int32), *self.blocks])

    def column(self, index: int) -> np.ndarray:
        """The numbers of a column, (rows,).

        Raises
        ------
        InputError
            At the first cell that is neither a number nor a missing marker.
        """
        if index in self.faults:
            raise self.faults[index]
        return np.concatenate([np.empty(0), *self.numbers[index]])


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
    delimiter, decimal, count = shape.delimiter, shape.decimal or ".", text.count(b"\n")
    allowed = f"{_PLAIN}{delimiter or ''}{decimal}\n".encode()
    # Rows with a last cell have all cells, by the number of separators. Cells between spaces are counted by the reader.
    separators = count * (shape.width - 1 + shape.trailing)
    parted = delimiter is None or text.count(delimiter.encode()) == separators
    if not (text.strip() and parted) or text.translate(None, allowed):
        return None
    used = list(range(shape.width)) if delimiter is None else sorted({*columns, shape.width - 1})
    lines = io.StringIO((text.replace(b",", b".") if decimal == "," else text).decode())
    usecols = None if delimiter is None else used
    try:
        values = np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2, usecols=usecols)
    except ValueError:
        return None
    whole = values.shape == (count, len(used)) and np.isfinite(values).all()
    # A number below the smallest float64 would be 0.
    exact = whole and (values.all() or not _TINY.search(text.decode()))
    return values[:, np.searchsorted(used, columns)] if exact else None


def rows_of(file: TextFile, shape: Shape, columns: Sequence[int], missing: Sequence[str]) -> Rows:
    """The rows of a text, with NaN at a missing marker.

    Blocks of numbers alone are read by the reader in C where their decimal mark is known, or no other can be meant.

    Raises
    ------
    InputError
        If a row has another number of cells than the first one.
    """
    marks, codes = dict.fromkeys(columns, shape.decimal), numbers_of(missing)
    rows = Rows({column: [] for column in columns}, marks)
    apart = None
    for number, block in file.blocks(shape.first):
        known = {mark for mark in (shape.decimal, *marks.values()) if mark}
        # The reader in C would take a code for a reading.
        plain = not codes and not apart and len(known) < 2 and (known or b"." not in block)
        of_block = replace(shape, decimal=max(known, default="."))
        values = plain_block(block, of_block, columns) if plain else None
        every = [*enumerate(lines_of(block) if values is None else (), number)]
        kept = [(line, row) for line, row in every if is_row(row)]
        rows.blanks.extend(line + 1 for line, row in every if not row.strip(_NO_CELLS))
        if values is None and plain and len(kept) < block.count(b"\n"):  # blank lines or comments
            values = plain_block("\n".join([*(text for _, text in kept), ""]).encode(), of_block, columns)
        lines = [line for line, _ in kept] if kept or values is None else np.arange(number, number + len(values))
        rows.blocks.append(np.array(lines, np.int32) + 1)
        if values is not None:
            for column, one in zip(columns, values.T, strict=True):
                rows.numbers[column].append(one)
            continue
        cells = [_cells(line, text, shape, file.path) for line, text in kept]
        turned = [*zip(*cells, strict=True)] or [()] * shape.width
        if apart is None:
            apart = apart_marks(turned, missing, shape.decimal) if shape.decimal is None or shape.stated else {}
        for column in columns:
            texts = [bare(cell) for cell in turned[column]] if b'"' in block else turned[column]
            texts = [text.replace(mark, "") for text in texts] if (mark := apart.get(column, "")) else texts
            if column in rows.faults:  # the first fault counts, and a later block may not show it
                continue

            def place(k: int, column: int = column, kept: list[tuple[int, str]] = kept) -> Place:
                line, text = kept[k]
                return file.path, line + 1, place_of_cell(text, shape.delimiter, column)

            try:
                if mark is None:
                    raise _ambiguous(texts, turned, place)
                marks[column] = marks[column] or decimal_mark(texts, missing)
                found = read_column(texts, marks[column] or ".", missing, place)
                rows.numbers[column].append(np.where(np.isin(found, codes), np.nan, found) if codes else found)
            except InputError as error:
                rows.faults[column] = error
    return rows


def _ambiguous(texts: Sequence[str], columns: Sequence[Sequence[str]], place: Callable[[int], Place]) -> InputError:
    """The error about the first of these numbers, one of the columns, with a mark before its last three digits."""
    k, text = next((k, text) for k, text in enumerate(texts) if text[-4:-3] in (".", ","))
    mark, other = ".,"[:: 1 if text[-4] == "." else -1]
    elsewhere = any(other in text for column in columns for text in column)
    decimals = (
        f"else write {text.replace(mark, other)}"
        if elsewhere
        else f'decimal = "{mark}" if it is {text.replace(mark, ".")}'
    )
    return InputError(
        "whether a mark parts thousands or decimals must be stated where the column does not tell",
        shown(text),
        f'state decimal = "{other}" if it is {text.replace(mark, "")}, {decimals}',
        *place(k),
    )


def apart_marks(columns: Sequence[Sequence[str]], missing: Sequence[str], decimal: str | None) -> dict[int, str | None]:
    """The point or the comma between thousands, by column, where all cells with it may be such numbers: 1,234 and 998.

    The other mark is the stated ``decimal`` one, or many cells stand beside a whole number of three digits at most that is
    above all of them as decimals. None: few do, or another column alone shows the other mark.
    """
    marks, lone = dict[int, str](), dict[int, bool | None]()
    for k, texts in enumerate(columns):
        mark = decimal_mark(texts := [bare(text) for text in texts], missing)
        marked = [text for text in texts if mark and mark in text]
        if mark and marked and number_in(marked[0], mark) is not None:  # a date shows no decimal mark
            marks[k] = mark
            if all((found := _GROUPED.fullmatch(text)) and text[-4] == found["mark"] for text in marked):
                # 2.501 is no number of a few beside -930 in its column.
                largest = max(abs(number_in(text, mark) or 0.0) for text in marked)
                above = any(_SHORT.fullmatch(text) and abs(int(text)) > largest for text in texts)
                shows = (above and len(marked) >= FEWEST_APART) or (None if above else False)
                lone[k] = shows if decimal is None else mark != decimal
    # A stated mark leaves nothing open.
    others = {mark for k, mark in marks.items() if k not in lone} if decimal is None else set[str]()
    return {
        k: marks[k] if sure else None for k, sure in lone.items() if sure is not False or others == {*",."} - {marks[k]}
    }


def _cells(line: int, text: str, shape: Shape, path: Path) -> list[str]:
    """The cells of a row, as many as the first row has."""
    cells = texts_of(text, shape.delimiter)
    cells = cells[:-1] if shape.trailing else cells
    if len(cells) != shape.width:
        first = f"line {shape.first + 1}" if line > shape.first else "the header"
        commas = " (decimal commas need semicolons or tabs between the cells)" * (shape.delimiter == ",")
        ends = f"state data_to_line = {line} if the readings end above it, or data_from_line = {line + 1} if they begin here"
        raise InputError(
            f"a row must have {counted(shape.width, 'cell')}, as {first} has",
            counted(len(cells), "cell"),
            f"correct the row{commas}, or {ends}",
            path,
            line + 1,
            place_of_cell(text, shape.delimiter, shape.width, len(text) + 1),
        )
    return cells
