"""What readers share: limits, errors, the text of a file, and a table as written with the place of each cell."""

import codecs
import gzip
import io
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np

from capsule_id.console import one_line, refusing_damage
from capsule_id.errors import InputError

# limits: Limits and errors that all readers of files share.


#: Largest decompressed size of a file, bytes; of a small one the larger of ``SMALL_CONTENT`` and ``SPREAD`` times its own
#: size. It stops files that grow without limit when they are unpacked.
LARGEST_CONTENT, SMALL_CONTENT, SPREAD = 1 << 30, 1 << 26, 10
#: Bytes that a reading and a row of a text count: a text needs two to ten for a reading.
READING, ROW = 4, 8
#: Most series of readings in one array.
MOST_SERIES = 200
#: Longest line of a text, bytes; most columns of a table; most lines above its rows of numbers.
LONGEST_LINE, MOST_COLUMNS, MOST_TITLES = 1 << 18, 2_000, 10_000


def largest(content: bytes) -> int:
    """Most bytes of text that the bytes of a file justify, or ``READING`` for each reading."""
    return min(LARGEST_CONTENT, max(SMALL_CONTENT, SPREAD * len(content)))


def refuse_large(size: int, content: bytes, path: Path) -> None:
    """Refuse a file that unpacks to more bytes than its own justify.

    Parameters
    ----------
    size : of what it holds: bytes of text, or ``READING`` for each reading
    content : the bytes of the file

    Raises
    ------
    InputError
        Naming the size.
    """
    most = largest(content)
    if size > most:
        raise InputError(
            f"a {path.suffix} file of this size must hold at most {most >> 20} MiB, decompressed",
            f"{size >> 20} MiB",
            "export a part of the record, or fewer channels, or text without compression",
            path,
        )


def refuse_wide(columns: int, path: Path, line: int | None = None) -> None:
    """Refuse a table with more than ``MOST_COLUMNS`` columns.

    Raises
    ------
    InputError
        Naming their number.
    """
    if columns > MOST_COLUMNS:
        raise InputError(
            f"a table must have at most {MOST_COLUMNS} columns",
            str(columns),
            "export fewer channels, a row per sample",
            path,
            line,
            line and 1,
        )


def require(package: str, path: Path) -> None:
    """Import the optional package that reads ``path``.

    Raises
    ------
    InputError
        If it is not installed, with the command that installs it.
    """
    try:
        import_module(package.lower())
    except ModuleNotFoundError:
        raise InputError(
            f"a {path.suffix} file needs the package {package}",
            "not installed",
            'run pip install "capsule-id[formats]"',
            path,
        ) from None


@contextmanager
def complete(path: Path, remedy: str) -> Iterator[None]:
    """``refusing_damage`` of a library that reads a file, whose warnings are not shown."""
    rule = f"a {path.suffix} file must be complete"
    with refusing_damage(rule, remedy, path, lambda error: one_line(error)[:200]), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


# blocks: The text of a file in blocks of whole lines.


COMPRESSED = ".gz"
#: Bytes of a block.
BLOCK = 1 << 20
WINDOWS = "Windows-1252"
_CODECS = {"UTF-16": "utf-16", WINDOWS: "cp1252"}
#: A number with commas in quotation marks, and one whose comma can separate thousands.
_QUOTED, _THOUSANDS = (
    re.compile(rb'"([+-]?[0-9]+,[0-9,]*(?:\.[0-9]*)?)"'),
    re.compile(rb"[+-]?[1-9][0-9]{0,2}(?:,[0-9]{3})+"),
)
_NOT_WINDOWS = re.compile(rb"[\x81\x8d\x8f\x90\x9d]")


class TextFile:
    """A text in UTF-8, in UTF-16 with a byte-order mark, or in Windows-1252, compressed where its name ends in ``.gz``.

    ``last`` is the number of the last line that is read, counted from 1 (None: all are read).

    Attributes
    ----------
    path : its name, for error lines
    encoding : its encoding

    Raises
    ------
    InputError
        If the content is no text, at its line and character, or a compressed file is damaged or too large.
    """

    def __init__(self, content: bytes, path: Path, last: int | None = None) -> None:
        self.path = path
        raw = _bytes_of(content, path)
        self.encoding = _encoding(raw, path)
        text = (
            raw.removeprefix(codecs.BOM_UTF8)
            if self.encoding == "UTF-8"
            else raw.decode(_CODECS[self.encoding]).encode()
        )
        text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text
        # A serial monitor writes an arrow behind the time stamp of each line.
        self._text = _with_points(re.sub(rb"(?m)^([0-9:.,]+) -> ", rb"\1\t", text) if b" -> " in text else text)
        if last is not None:
            ends = np.append(np.flatnonzero(np.frombuffer(self._text, np.uint8) == ord("\n")), len(self._text))
            self._text = self._text[: ends[min(last, len(ends)) - 1] + 1]
        begin = 0
        while begin + LONGEST_LINE < len(self._text):
            end = self._text.rfind(b"\n", begin, begin + LONGEST_LINE + 1) + 1
            if not end:
                raise InputError(
                    f"a line must have at most {LONGEST_LINE} bytes",
                    "a longer one",
                    "export a row per sample, in lines",
                    self.path,
                    self._text.count(b"\n", 0, begin) + 1,
                    1,
                )
            begin = end

    def blocks(self, first: int = 0) -> Iterator[tuple[int, bytes]]:
        """Blocks of lines from line ``first``, counted from 0: the number of their first line, and their text in UTF-8.

        Every line ends with a line feed, the last one too.
        """
        number = end = 0
        while end < len(self._text):
            begin, end = end, self._text.find(b"\n", end + BLOCK) + 1 or len(self._text)
            block = self._text[begin:end]
            text = block if block.endswith(b"\n") else block + b"\n"
            lines = text.count(b"\n")
            if number + lines > first:
                yield max(number, first), text.split(b"\n", first - number)[-1] if first > number else text
            number += lines

    def lines(self, first: int = 0) -> Iterator[str]:
        """The lines from line ``first`` on, counted from 0."""
        for _, text in self.blocks(first):
            yield from lines_of(text)

    def line(self, number: int) -> str:
        """Line ``number``, counted from 0; "" where the file has none."""
        return next(self.lines(number), "")


def _with_points(text: bytes) -> bytes:
    """Numbers that stand in quotation marks between commas, "1,234.5" or "0,25", as 1234.5 or 0.25.

    Which of the two a file means its numbers must show: "1,234" alone stays as it is.
    """
    found = [] if b'";' in text or b'"\t' in text else _QUOTED.findall(text)
    thousands = any(b"." in number for number in found)
    if not found or thousands != all(_THOUSANDS.fullmatch(number.split(b".")[0]) for number in found):
        return text
    return _QUOTED.sub(lambda one: one[1].replace(b",", b"" if thousands else b"."), text)


def _bytes_of(content: bytes, path: Path) -> bytes:
    """The bytes of a text, decompressed."""
    if path.suffix.lower() != COMPRESSED:
        return content
    with complete(path, "compress it again by gzip"), gzip.open(io.BytesIO(content)) as file:
        text = file.read(2 * largest(content) + BLOCK)
        # Rows and readings take more memory than their text. What is long for its readings counts half: it takes less.
        rows = max(map(text.count, (b"\n", b"\r")))
        separators = rows + sum(map(text.count, (b",", b";", b"\t", b" ")))
        size = max(len(text) // 2, ROW * rows, min(len(text), READING * separators))
        refuse_large(size, content, path)
    return text


def _encoding(raw: bytes, path: Path) -> str:
    """The encoding of a text; Windows-1252 where it is no UTF-8 and begins with ASCII.

    Raises
    ------
    InputError
        At the first byte that is no text.
    """
    rule, binary = (
        "the file must be text",
        ("a binary file (NUL byte)", "export it as text, in UTF-8"),
    )
    marked = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if not marked and (nul := raw.find(b"\0")) >= 0:
        raise InputError(rule, *binary, path, *place_of_byte(raw[:nul], "utf-8"))
    codec = "utf-16" if marked else "utf-8"
    try:
        raw.decode(codec)
        return "UTF-16" if marked else "UTF-8"
    except UnicodeDecodeError as error:
        fault = error.start
    if marked:
        raise InputError(rule, "damaged UTF-16", "save it as UTF-8", path, *place_of_byte(raw[:fault], codec))
    found = _NOT_WINDOWS.search(raw)
    if found is None and raw[:fault].isascii():
        return WINDOWS
    wrong = found.start() if found and raw[:fault].isascii() else fault
    value, place = f"byte 0x{raw[wrong : wrong + 1].hex()}", place_of_byte(raw[:wrong], codec)
    raise InputError("the file must be UTF-8 text", value, "save it as UTF-8", path, *place)


def lines_of(text: bytes) -> list[str]:
    """The lines of a block, without line feeds."""
    return text[:-1].decode().split("\n")


def place_of_byte(before: bytes, codec: str = "utf-8") -> tuple[int, int]:
    """1-based line and character of a byte; the bytes ``before`` it may be invalid too."""
    lines = re.split(r"\r\n?|\n", before.decode(codec, "replace"))
    return len(lines), len(lines[-1]) + 1


# raw: A table as written: numbers in the units of the file, and the place of each cell.


_CODE = r"[+-]?[0-9]+(?:[.,][0-9]*)?(?:[eE][+-]?[0-9]+)?"
#: Texts of cells without a reading.
NO_READING = tuple(
    dict.fromkeys(
        text
        for word in ("", "-", "--", "---", "NaN", "-NaN", "NA", "N/A", "#N/A", "null", "none")
        for text in (word, word.lower(), word.upper(), word.capitalize())
    )
)


def numbers_of(markers: Iterable[str]) -> list[float]:
    """The missing markers that are numbers, such as -999 or 99,99."""
    return [float(text.replace(",", ".")) for text in markers if re.fullmatch(_CODE, text)]


Place = tuple[Path, int, int]  #: file, and 1-based line and column, of a cell


@dataclass(frozen=True)
class RawTable:
    """The result of every reader in ``formats``.

    Attributes
    ----------
    names, units : of every column, as written
    columns : of each name (rows,) numbers, finite, in the units written
    rows : (rows,) 1-based line number of every row; of files put one below the other the number of the row
    place : (row index or None for the header, column index) -> where the cell stands
    encoding : of the text, or "UTF-8"
    lost : (k,) those of the rows left out for a missing cell
    other, rejected : number of rows left out: outside ``where``, as outliers
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: tuple[np.ndarray, ...]
    rows: np.ndarray
    place: Callable[[int | None, int], Place]
    encoding: str = "UTF-8"
    lost: np.ndarray = field(default_factory=partial(np.empty, 0, int))
    other: int = 0
    rejected: int = 0

    def taken(self, rows: np.ndarray) -> "RawTable":
        """The table with the rows of these indices, (k,), alone."""

        def place(row: int | None, column: int) -> Place:
            return self.place(None if row is None else int(rows[row]), column)

        return replace(self, columns=tuple(one[rows] for one in self.columns), rows=self.rows[rows], place=place)

    def divided(self, owners: np.ndarray) -> list["RawTable"]:
        """The tables of the rows that part 0, 1, ... owns, (n,); -1: none does. A lost row belongs to the row before it."""
        lost = owners[np.maximum(np.searchsorted(self.rows, self.lost) - 1, 0)]
        parts = range(int(np.max(owners)) + 1)
        return [replace(self.taken(np.flatnonzero(owners == k)), lost=self.lost[lost == k]) for k in parts]

    def error(self, row: int | None, name: str, rule: str, value: str, remedy: str) -> InputError:
        """The error about a cell, or about the header of a column if ``row`` is None."""
        return InputError(rule, value, remedy, *self.place(row, self.names.index(name)))


# export: A table of any layout, as a logger or a program exports it; a column map of ``rig.toml`` selects its columns.


@dataclass(frozen=True)
class Layout:
    """What ``rig.toml`` states about the layout of the files of an experiment.

    Attributes
    ----------
    data_from_line, data_to_line : 1-based lines of the first and the last row of numbers (None: the first line that holds
        a number, and the last line of the file)
    missing : texts of cells without a reading, such as ``--`` or ``NaN``, and numbers that stand for none, such as -999;
        a column map adds ``NO_READING``
    decimal : decimal mark of a text table, "." or "," (None: found in the file)
    columns : headers, or numbers counted from 1, of the columns that a text reader keeps (None: all)
    words : headers, or numbers counted from 1, of those whose cells are texts
    sheet : name of the sheet of a workbook (None: the first one with numbers)
    split_by : header, or number, of the column each text of which is an experiment
    """

    data_from_line: int | None = None
    data_to_line: int | None = None
    missing: tuple[str, ...] = ()
    decimal: str | None = None
    columns: tuple[str | int, ...] | None = None
    words: tuple[str | int, ...] = ()
    sheet: str | None = None
    split_by: str | None = None


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
    place : (row index or None for the header, column index) -> where the cell stands
    encoding : of a text
    sheet, others : names of the sheet of a workbook that was read, "" of another format, and of others with numbers
    cells : the texts of each row of a text or a sheet, read or not; None: the format has no such rows
    marks : decimal marks of the columns of a text, where their numbers show them
    blanks : 1-based blank lines of a text or a sheet
    """

    path: Path
    headers: tuple[tuple[str, ...], ...]
    width: int
    lines: np.ndarray
    values: Callable[[int], np.ndarray]
    place: Callable[[int | None, int], Place]
    encoding: str = "UTF-8"
    sheet: str = ""
    others: tuple[str, ...] = ()
    cells: Callable[[], Iterable[list[str]]] | None = None
    marks: Mapping[int, str | None] = field(default_factory=dict)
    blanks: Sequence[int] = ()


# arrays: Makes an export of named arrays: the form of every format without lines.


#: Names, in small letters, of a number that is the sampling rate, Hz, or its inverse, s; of an attribute, those of a unit.
RATE_NAMES = ("fs", "rate", "sampling_rate", "sample_rate", "samplerate", "samplingrate", "sampling_frequency")
STEP_NAMES = ("dt", "ts", "sample_time", "sampling_interval", "sample_interval")
UNIT_NAMES = ("unit", "units", "unit_string", "ni_unitdescription")
#: A matrix this many times as wide as high holds its channels in rows.
WIDE = 10


def refuse_line(layout: Layout, path: Path) -> None:
    """Refuse the keys of text files.

    Raises
    ------
    InputError
        If ``layout`` states ``data_from_line``, ``data_to_line`` or ``decimal``.
    """
    for key in ("data_from_line", "data_to_line", "decimal"):
        if (value := getattr(layout, key)) is not None:
            raise InputError(f"a {path.suffix} file has no {key}", f"{key} = {value}", f"remove {key}", path)


def export_of_arrays(arrays: Mapping[str, np.ndarray], path: Path, layout: Layout, units: Mapping[str, str]) -> Export:
    """The columns of named arrays: every vector, and every column of a matrix, ``data(:,2)`` for the second.

    A matrix far wider than high holds its channels in rows: ``data(2,:)`` for the second.

    Parameters
    ----------
    arrays : real numbers; arrays that are empty or have more than two dimensions are left out
    path : of the file, for error lines
    layout : ``missing`` may hold "NaN"
    units : by name of an array, as the file states them; a second row of headers

    Raises
    ------
    InputError
        If there is no column.
    """
    refuse_line(layout, path)
    columns, stated, widest = {}, [], 0
    # Scalars come last: columns may be named by their numbers.
    for name, array in sorted(arrays.items(), key=lambda item: item[1].ndim == 0):
        if array.size and name.isprintable() and array.ndim <= 2:
            own = {name: array.ravel()}
            if array.ndim == 2 and 1 not in array.shape:
                if min(array.shape) > MOST_SERIES:  # an image, or a covariance: no series of readings
                    widest = max(widest, *array.shape)
                    continue
                rows = array.shape[1] > WIDE * array.shape[0]
                form = "({},:)" if rows else "(:,{})"
                own = {name + form.format(i + 1): one for i, one in enumerate(array if rows else array.T)}
            columns |= own
            stated += [units.get(name, "")] * len(own)
    refuse_wide(len(columns) or widest, path)
    if not columns:
        raise InputError(
            f"a {path.suffix} file must hold real numeric vectors", "none", "export the readings as vectors", path
        )
    names = tuple(columns)

    def values(column: int) -> np.ndarray:
        found = columns[names[column]].astype(np.float64)
        refused = ~np.isfinite(found) & ~(np.isnan(found) & ("NaN" in layout.missing))
        if refused.any():
            row = int(np.argmax(refused))
            raise InputError(
                f"{names[column]} must be finite",
                f"{found[row]}",
                'add "NaN" to missing = [...] to drop its row' if np.isnan(found[row]) else "correct the value",
                *place(row, column),
            )
        found[np.isin(found, numbers_of(layout.missing))] = np.nan
        return found

    def place(row: int | None, column: int) -> Place:
        return path, 1 if row is None else row + 1, column + 1

    longest = max(vector.size for vector in columns.values())
    headers = (names, tuple(stated)) if any(stated) else (names,)
    return Export(path, headers, len(names), np.arange(1, longest + 1), values, place)
