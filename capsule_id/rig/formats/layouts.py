"""Readers of text exports of any layout, and of LabVIEW measurement files."""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice, takewhile
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.filters import FEWEST_SAMPLES
from capsule_id.rig.formats.raw import (
    MOST_TITLES,
    NO_READING,
    Export,
    Layout,
    Place,
    RawTable,
    TextFile,
    lines_of,
    refuse_line,
    refuse_wide,
)
from capsule_id.rig.formats.text import (
    BLANKS,
    COMMENTS,
    Shape,
    bare,
    cells_of,
    is_comment,
    is_row,
    is_stamp,
    number_in,
    place_of_cell,
    rows_of,
    texts_of,
)
from capsule_id.rig.toml import shown
from capsule_id.views import counted

# any layout: Reads text exports of any layout: titles, headers, rows of units, comments, and any separator.
#
# Headers are found in the lines above the numbers that have as many cells as the rows. Lines that begin with # or % are
# comments; above the numbers they may hold the headers.


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
    file = _file(content, path, layout)
    head = _head(file, layout)
    first, row = len(head) - 1, head.pop()
    delimiter = delimiter_of(row, layout)
    _refuse_ambiguous_comma(file, first, delimiter, layout)
    for cell, position in cells_of(row, delimiter):
        if cell.count('"') % 2:  # rows such as "10,2","1,5": the separator would cut quoted numbers in two
            rule = "a cell in quotation marks must not hold the separator of the cells"
            remedy = "export with a decimal point, or with semicolons between the cells"
            raise InputError(rule, shown(row.strip()), remedy, path, first + 1, position)
    *cells, last = texts_of(row, delimiter)
    blank = bool(cells) and not last
    trailing = blank and all(not texts_of(line, delimiter)[-1] for line in file.lines(first) if is_row(line))
    width = len(cells) + (not trailing)
    refuse_wide(width, path, first + 1)
    above = range((layout.data_from_line or first + 1) - 2, -1, -1)
    named = row.lstrip().startswith('"')  # R writes no header above the names of its rows
    found = [(i, names) for i in above if (names := _headers(head[i], delimiter, width, named))]
    headers = tuple(names for _, names in found)
    wanted = [k for k in range(width) if layout.columns is None or is_wanted(k, headers, layout.columns)]
    decimal = "." if delimiter == "," else layout.decimal
    stated = decimal is not None and layout.decimal == decimal
    shape = Shape(first, delimiter, width, decimal, trailing, stated)
    rows = rows_of(file, shape, wanted, layout.missing)
    lines = rows.lines

    def place(row: int | None, column: int) -> Place:
        line = int(lines[row]) - 1 if row is not None else found[0][0] if found else first
        return path, line + 1, place_of_cell(file.line(line), delimiter, column)

    def every() -> Iterator[list[str]]:
        return (split_bare(line, delimiter) for line in filter(is_row, file.lines(first)))

    return Export(
        path,
        headers,
        width,
        lines,
        rows.column,
        place,
        file.encoding,
        cells=every,
        marks=rows.marks,
        blanks=rows.blanks,
    )


def _file(content: bytes, path: Path, layout: Layout) -> TextFile:
    """The text down to ``data_to_line``, where that is stated."""
    file = TextFile(content, path, layout.data_to_line)
    for key in ("data_from_line", "data_to_line"):
        stated = getattr(layout, key) or 0
        if stated and stated > (number := sum(text.count(b"\n") for _, text in file.blocks())):
            rule, remedy = f"{key} must be a line of the file, which has {number}", "state the line of that reading"
            raise InputError(rule, str(stated), remedy, path, max(number, 1), 1)
    return file


def is_wanted(column: int, headers: tuple[tuple[str, ...], ...], wanted: tuple[str | int, ...]) -> bool:
    """Whether a column is named by its number or by a header."""
    return column + 1 in wanted or any(names[column] in wanted for names in headers)


#: What may stand behind a number that is no number alone.
PER_CENT = " %"


def _head(file: TextFile, layout: Layout) -> list[str]:
    """The lines up to the first row of numbers, that row included.

    Raises
    ------
    InputError
        If there is none, or the first line with a number is no row of readings.
    """
    stated = layout.data_from_line
    lines = islice(file.lines(), MOST_TITLES if stated is None else None)
    rows = ((k, line) for k, line in enumerate(lines) if not is_comment(line))
    if stated is not None:
        begun = next((k for k, line in rows if k + 1 >= stated and line.strip()), None)
    else:
        begun = next(
            (k for k, line in rows if any(is_number(cell.rstrip(PER_CENT)) for cell in _cells(line, layout))), None
        )
    if begun is None:
        raise InputError(
            f"a table must have rows of numbers, the first one in the first {MOST_TITLES} lines",
            "none",
            "export the readings as numbers, a row in each line",
            file.path,
            1 if stated is None else sum(1 for _ in file.lines()),
            1,
        )
    head = list(islice(file.lines(), begun + 1))
    if stated is not None or _are_readings(_mapped(head, layout), layout):
        return head
    row = next((k for k, line in rows if _are_readings(_cells(line, layout), layout)), begun)
    raise InputError(
        "the first line with a number must be a row of readings, or data_from_line stated",
        shown(head[begun].strip()),
        f"state data_from_line = {row + 1}, or the line of the first reading",
        file.path,
        begun + 1,
        1,
    )


def _cells(line: str, layout: Layout) -> list[str]:
    """The cells of a line by its own separator."""
    return split_bare(line, delimiter_of(line, layout))


def _are_readings(cells: list[str], layout: Layout) -> bool:
    """Whether some of these cells are not empty, and all of those are readings."""
    return any(cells) and all(not cell or _is_reading(cell, layout) for cell in cells)


def _mapped(lines: list[str], layout: Layout) -> list[str]:
    """The cells of the first row with a number, the last of ``lines``, that are read as numbers; all without a map."""
    *above, row = lines
    cells = _cells(row, layout)
    found = (_headers(line, delimiter_of(row, layout), len(cells)) for line in above)
    headers = tuple(names for names in found if names)
    wanted = [k for k in range(len(cells)) if is_wanted(k, headers, layout.columns or ())]
    return [cells[k] for k in wanted if not is_wanted(k, headers, layout.words)] or cells


def _headers(line: str, delimiter: str | None, width: int, named: bool = False) -> tuple[str, ...]:
    """The headers in a line above the numbers; () if it holds none. Above rows that are ``named`` the first may be left out."""
    bare = line.lstrip(" " if delimiter == "\t" else BLANKS).lstrip("".join(COMMENTS))  # a first cell may be empty
    for cells in _header_cells(bare, delimiter):
        if len(cells) == width + 1 and not cells[-1]:
            cells.pop()
        cells = ["", *cells] if named and len(cells) == width - 1 else cells
        if len(cells) == width and any(cells) and not any(is_number(cell) for cell in cells):
            return tuple(" ".join(cell.split()) for cell in cells)
    return ()


def _header_cells(line: str, delimiter: str | None) -> Iterator[list[str]]:
    """Ways to split a line of headers: as the readings, else with quotation marks, or with another separator."""
    yield split_bare(line, delimiter)
    if delimiter is None:  # headers of several words, two spaces or more between them
        yield re.split(r"\s{2,}", line.strip())
    for mark in (delimiter, "\t", ";", ","):
        if mark is not None and mark in line and (mark == delimiter or delimiter is None or delimiter not in line):
            with suppress(csv.Error):
                (cells,) = csv.reader([line], delimiter=mark, skipinitialspace=True)
                yield [bare(cell) for cell in cells]


def split_bare(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line without blanks and quotation marks around them."""
    return [bare(cell) for cell in texts_of(line, delimiter)]


def delimiter_of(line: str, layout: Layout) -> str | None:
    """The separator of a row: tab, semicolon, comma, or None for spaces; a comma may be the decimal mark."""
    for mark in "\t;":
        if mark in line:
            return mark
    words = texts_of(line, None)
    if layout.decimal == ",":  # a tab separates nothing in a line with one cell
        return None if len(words) > 1 else "\t"
    if "," not in line:
        return None if len(words) > 1 else ","
    if all(_is_reading(cell, layout) for cell in split_bare(line, ",")):
        return ","
    return None if len(words) > 1 and all(_is_reading(word, layout) for word in words) else ","


def _refuse_ambiguous_comma(file: TextFile, first: int, delimiter: str | None, layout: Layout) -> None:
    """Refuse rows such as ``1,25``: two whole numbers, or one number with a decimal comma.

    Rows of a record whose whole parts increase from row to row are times and a reading.
    """
    if delimiter != "," or layout.decimal is not None:
        return
    wholes = list[int]()
    for line in filter(is_row, file.lines(first)):
        if (found := _COMMA_BETWEEN_DIGITS.fullmatch(line)) is None:
            return
        wholes.append(int(found[1][:18]))
    if len(wholes) >= FEWEST_SAMPLES and np.all(np.diff(wholes) > 0):
        return
    raise InputError(
        "a comma between digits must be stated as a separator or a decimal mark",
        shown(file.line(first).strip()),
        'state decimal = "," for one column of numbers, decimal = "." for two',
        file.path,
        first + 1,
        1,
    )


def is_number(cell: str) -> bool:
    """Whether a cell is a number with either decimal mark."""
    return number_in(cell, ".") is not None or number_in(cell, ",") is not None


def _is_reading(cell: str, layout: Layout) -> bool:
    """Whether a cell is a number, with a sign of per cent or not, a time stamp, or a stated missing marker."""
    return is_number(cell.rstrip(PER_CENT)) or cell in layout.missing or is_stamp(cell)


# csv: Reads CSV tables: a header ``name [unit]`` per column, then rows of numbers as any text export has them.


_BLANK = ("lines between the first and the last must not be blank", "a blank line", "remove the line")
_ONE_MARK = "correct the cell: a table has one decimal mark"
_HEADER_CELL = re.compile(r"([A-Za-z][A-Za-z0-9_]*)\s*\[([^\[\]]*)\]")


def read_csv(content: bytes, path: Path) -> RawTable:
    """Read a CSV table; rows with a missing cell (``NO_READING``) are left out.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines

    Raises
    ------
    InputError
        Naming line and column of the first fault.
    """
    file = TextFile(content, path)
    if not file.line(0).strip():
        empty = (
            "a table must not be empty",
            "no text at all",
            "head each column `name [unit]` and write a row per reading",
        )
        raise InputError(*(_BLANK if any(line.strip() for line in file.lines()) else empty), path, 1, 1)
    mark, units = units_of_header(file)
    blocks = ((number, block) for number, block in file.blocks(1) if re.search(rb'["#%]', block))
    for line, row in ((number + k, row) for number, block in blocks for k, row in enumerate(lines_of(block), 1)):
        quoted = (each for each in cells_of(row, mark) if '"' in each[0] and bare(each[0]) not in NO_READING)
        for cell, column in [(row.strip(), 1)] if is_comment(row) else quoted:  # a mark may be left of a damaged cell
            remedy = "remove comments and quotation marks from the table"
            raise InputError("a row must be numbers", shown(cell), remedy, path, line, column)
    line, row = next(((k, row) for k, row in enumerate(file.lines(1), 2) if is_row(row)), (1, ""))
    if not row:
        raise InputError("a table must have rows", "a header only", "add a row per reading", path, 1, 1)
    if (width := len(texts_of(row, mark))) != len(units):
        rule, found = f"a row must have {counted(len(units), 'cell')}, as the header has", counted(width, "cell")
        place = place_of_cell(row, mark, len(units), len(row) + 1)
        raise InputError(rule, found, "correct the row, or the header", path, line, place)
    layout = Layout(line, missing=NO_READING, decimal="." if mark == "," and width > 1 else None)
    export = read_text(content, path, layout)
    _refuse_two_marks(export)
    bare_rows = _lines_without_cells(file, export.lines)
    last = [np.full(len(export.lines), np.nan)] * (width - export.width)  # every last cell is empty
    columns = (*map(export.values, range(export.width)), *last)
    raw = RawTable(tuple(units), tuple(units.values()), columns, export.lines, export.place, export.encoding)
    missing = np.any(np.isnan(columns), axis=0)
    if missing.all():  # the first cell of the first row that holds none
        here = raw.place(0, int(np.argmax([np.isnan(column[0]) for column in columns])))
        remedy = "write a number; a table must have a row without missing cells"
        raise InputError("a cell must not be empty", "nothing", remedy, *here)
    lost = np.sort(np.append(export.lines[missing], bare_rows).astype(int))
    return replace(raw.taken(np.flatnonzero(~missing)), lost=lost)


def _refuse_two_marks(export: Export) -> None:
    """Refuse a table with decimal points in one column and decimal commas in another: a mark stands in a damaged cell."""
    marks = {column: mark for column, mark in export.marks.items() if mark}
    for column, mark in marks.items():
        if mark != next(iter(marks.values())):
            assert export.cells is not None, "a text has cells"
            row, cell = next((k, each[column]) for k, each in enumerate(export.cells()) if mark in each[column])
            raise InputError("a cell must be a number", shown(cell), _ONE_MARK, *export.place(row, column))


def _lines_without_cells(file: TextFile, rows: np.ndarray) -> list[int]:
    """1-based lines, besides the ``rows`` of a table, that hold separators alone; a blank line between rows is refused."""
    if len(rows) == sum(text.count(b"\n") for _, text in file.blocks(1)):
        return []
    known = {*rows.tolist()}
    others = [(number, text.strip()) for number, text in enumerate(file.lines(1), 2) if number not in known]
    for number in (number for number, text in others if not text and number < rows[-1]):
        raise InputError(*_BLANK, file.path, number, 1)
    return [number for number, text in others if text]


def units_of_header(file: TextFile) -> tuple[str, dict[str, str]]:
    """Separator of a CSV table, and the units of its columns by name.

    Raises
    ------
    InputError
        At the first cell of the first line that is no header ``name [unit]``.
    """
    units, line = dict[str, str](), file.line(0)
    mark = next((mark for mark in "\t;," if mark in line), ",")
    refuse_wide(line.count(mark) + 1, file.path, 1)
    for cell, column in cells_of(line, mark):
        found = _HEADER_CELL.fullmatch(bare(cell).strip())
        if found is None or not found[2].strip():
            rule, remedy = (
                "the first line must be headers `name [unit]`",
                "head each column `name [unit]`, e.g. `time [s]` ([1]: no unit)",
            )
            raise InputError(rule, shown(bare(cell)), remedy, file.path, 1, column)
        if found[1] in units:
            twice = f"a second {found[1]}", "remove or rename it"
            raise InputError("column names must be unique", *twice, file.path, 1, column)
        units[found[1]] = found[2].strip()
    return mark, units


# lvm: Reads LabVIEW measurement files (``.lvm``): a header of the file, then segments with a header and rows of
# numbers.
#
# The layout is that of "LabVIEW Measurement File", National Instruments. The package lvm_read reads a damaged cell
# as NaN and loads pickled copies that lie beside a file, so this reader is the package's own.


_END = "***End_of_Header***"
_SPECIAL, _END_SPECIAL = "***Start_Special***", "***End_Special***"
_TIMES, _COMMENT = "X_Value", "Comment"
_REMEDY = "rename a file of plain columns to .txt, or export the record again"


@dataclass(frozen=True)
class _Segment:
    """One segment: cells of its header by key, names of the columns, 0-based lines of its first row and behind its last."""

    keys: dict[str, list[str]]
    names: tuple[str, ...]
    first: int
    stop: int


def read_lvm(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the columns of a LabVIEW measurement file; segments follow one another.

    ``X_Value`` is the column of times (or another abscissa). A file without such columns has them computed from X0 and
    Delta_X: one where they are the same for every channel, else one before each channel. Comments are left out.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold texts of cells

    Raises
    ------
    InputError
        If the headers are incomplete, or segments have different channels.
    """
    refuse_line(replace(layout, decimal=None), path)
    text = TextFile(content, path)
    separator, head, segments = _take_apart(text)
    names, (stated, computed) = (
        segments[0].names,
        ([*head.get(key, []), ""][0] for key in ("Decimal_Separator", "X_Columns")),
    )
    decimal = stated if stated in (".", ",") else layout.decimal
    sources, clocks = list(range(len(names))), dict[int, list[tuple[float, float]]]()
    if computed.lower() == "no":  # -k: the computed times of channel k
        clocks = {-k: [_clock(segment, k, decimal, path) for segment in segments] for k in sources[1:]}
        alike = all(clock == clocks[-1] for clock in clocks.values())
        sources = [-1, *sources[1:]] if alike else [source for k in sources[1:] for source in (-k, k)]
    headers = [tuple(_TIMES if source < 0 else names[source] for source in sources)]
    # A label a channel; the names of the channels stand behind their times.
    labels, channels = segments[0].keys.get("Y_Unit_Label", []), [name for name in names if name != _TIMES]
    units = dict(zip(channels, labels, strict=False)) if len({*channels}) == len(channels) else {}
    headers += [tuple(units.get(name, "") for name in headers[0])] if any(units.values()) else []
    lines, stored = _by_cells(text, segments, separator, decimal, layout.missing)

    def values(column: int) -> np.ndarray:
        if (source := sources[column]) >= 0:
            return stored(source)
        pairs = zip(clocks[source], segments, strict=True)
        return np.concatenate([start + step * np.arange(part.stop - part.first) for (start, step), part in pairs])

    def place(row: int | None, column: int) -> Place:
        line = text.line(number := int(lines[0] - 2 if row is None else lines[row] - 1))
        return path, number + 1, place_of_cell(line, separator, max(sources[column], 0), len(line) + 1)

    return Export(path, tuple(headers), len(sources), lines, values, place, text.encoding)


def _clock(segment: _Segment, channel: int, decimal: str | None, path: Path) -> tuple[float, float]:
    """First time and step of a channel, counted from 1.

    Raises
    ------
    InputError
        If the header of the segment states none.
    """
    cells = [([*segment.keys.get(key, []), *[""] * channel])[channel - 1] for key in ("X0", "Delta_X")]
    start, step = (number_in(cell, decimal or ".") for cell in cells)
    if start is None or step is None or not np.isfinite([start, step]).all() or step <= 0.0:
        raise InputError(
            "a file without times must state X0 and a positive Delta_X for every channel",
            shown(" ".join(cells)),
            _REMEDY,
            path,
            segment.first + 1,
            1,
        )
    return start, step


def _by_cells(
    text: TextFile, segments: Sequence[_Segment], separator: str, decimal: str | None, missing: Sequence[str]
) -> tuple[np.ndarray, Callable[[int], np.ndarray]]:
    """1-based lines of all rows, and the numbers of a column; blank cells at the end of a segment are no readings."""
    width, lines = len(segments[0].names), [*text.lines()]
    table = [""] * len(lines)
    for number in chain.from_iterable(range(segment.first, segment.stop) for segment in segments):
        cells = (lines[number] + separator * width).split(separator)[:width]
        # A row that begins as a comment does is one of cells.
        table[number] = separator.join(f'"{cell}' if is_comment(cell) else cell for cell in cells)
    file, shape = TextFile("\n".join(table).encode(), text.path), Shape(segments[0].first, separator, width, decimal)
    rows = rows_of(file, shape, range(width), missing)

    def column(index: int) -> np.ndarray:
        kept = np.ones(len(table), dtype=bool)
        for segment in segments:
            upwards = (texts_of(row, separator)[index] for row in table[segment.stop - 1 : segment.first : -1])
            kept[segment.stop - len([*takewhile(lambda cell: not cell.strip('"'), upwards)]) : segment.stop] = False
        return rows.column(index)[kept[rows.lines - 1]]

    return rows.lines, column


def _take_apart(text: TextFile) -> tuple[str, dict[str, list[str]], list[_Segment]]:
    """Separator, cells of the file's header by key, and segments; special blocks between them are skipped."""
    lines, special, segments = list[str](), False, list[_Segment]()
    for line in text.lines():
        special = (special or line.startswith(_SPECIAL)) and not line.startswith(_END_SPECIAL)
        lines.append("" if special or line.startswith(_END_SPECIAL) else line)
    separator = "," if any(line.startswith("Separator,") for line in lines) else "\t"

    def header(first: int, stop: int) -> dict[str, list[str]]:
        cells = ([cell.strip() for cell in line.split(separator)] for line in lines[first:stop])
        return {key: others for key, *others in cells if key}

    lines += ["", ""]  # a header at the end of the file has neither names nor rows
    end, *ends = [k for k, line in enumerate(lines) if line.strip().startswith(_END)] or [0]
    stop = end + 1
    for number in ends:
        found = [" ".join(name.split()) for name in lines[number + 1].split(separator)]
        while found and found[-1] in ("", _COMMENT):
            found.pop()
        below = (lines[k] for k in range(number + 2, len(lines)))
        rows = takewhile(lambda line: line.strip() and not line.startswith(("***", "Channels")), below)
        keys, first = header(stop, number), number + 2
        segments.append(_Segment(keys, tuple(found), first, stop := first + len([*rows])))
    names = {segment.names for segment in segments}
    labels = {" ".join(segment.keys.get("Y_Unit_Label", ())).strip(): segment.first for segment in segments}
    units = {text: number for text, number in labels.items() if text}
    for holds, rule, number in (
        (end, f"a .lvm file must have a header that ends with {_END}", 1),
        *((one.stop > one.first, "a segment must have rows", one.first) for one in segments),
        (len(names) < 2, "segments must have the same columns", stop),
        (
            len(units) < 2,
            f"segments must have the same units, not {' and '.join(units)}",
            max(labels.values(), default=1),
        ),
        (not header(stop, len(lines)), f"a header must end with {_END}", stop + 1),
        (min(map(len, names), default=0) > 1, "a LabVIEW measurement file must have a segment with channels", stop),
    ):
        if not holds:
            remedy = "export a file of each segment" if rule.startswith("segments") else _REMEDY
            raise InputError(rule, shown(lines[number - 1]), remedy, text.path, number, 1)
    return separator, header(0, end), segments
