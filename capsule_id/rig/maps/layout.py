"""Finds the layout of an export: the first row of readings, missing markers, headers, units, a stated sampling rate."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats import EXPORTS, suffix_of
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.text.any_layout import delimiter_of, is_number
from capsule_id.rig.formats.text.blocks import COMPRESSED, TextFile
from capsule_id.rig.formats.text.cells import bare, cells_of
from capsule_id.rig.formats.text.rows import is_row
from capsule_id.rig.maps.headers import is_units_row

#: Texts that loggers and spreadsheets write where a reading is missing.
MARKERS = ("", "-", "--", "---", "NaN", "nan", "NAN", "NA", "N/A", "n/a", "null", "NULL", "#N/A", "?")
#: Largest share of missing readings in a column of readings.
MOST_MISSING = 0.5
_BEGINNING = 100_000  # characters in which the first row of readings is searched
_MOST_TITLES = 100  # lines
#: Separator and number of cells of a line whose first cell is a number; None for any other line.
Cells = tuple[str | None, int] | None
_RATE = re.compile(r"([0-9]+(?:[.,][0-9]+)?)\s*(kHz|Hz|S/s|kS/s)\b", re.IGNORECASE)
_RATE_NAMES = ("fs", "rate", "sampling_rate", "sample_rate", "samplerate")


@dataclass(frozen=True)
class FoundLayout:
    """An export with its layout.

    Attributes
    ----------
    path, export : the file as read with ``layout``
    layout : what ``rig.toml`` must state, with all possible markers
    names, units : of every column, "" where the file has none
    columns : index of a column of readings -> (rows,) numbers, NaN where missing
    unread : index of any other column -> the error at its first cell that is no number
    rate : sampling rate that the file states, Hz
    blocks : first and last line of each block of readings, counted from 1, of a text with other lines between or below
        them, of which ``export`` holds the longest; else ()
    """

    path: Path
    export: Export
    layout: Layout
    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: dict[int, np.ndarray]
    unread: dict[int, InputError]
    rate: float | None
    blocks: tuple[tuple[int, int], ...] = ()


def find_layout(content: bytes, path: Path, dimensions: Sequence[str]) -> FoundLayout:
    """The layout of a file of a known format.

    Parameters
    ----------
    content : the bytes of the file
    path : its name
    dimensions : SI units of all columns of all kinds

    Raises
    ------
    InputError
        If the format is unknown, the file is damaged, or it holds no rows of numbers.
    """
    suffix = suffix_of(path)
    if suffix not in EXPORTS:
        known = " ".join(EXPORTS)
        raise InputError(f"a file must have a known format ({known})", path.name, "export it as CSV", path)
    text = suffix.removesuffix(COMPRESSED) in (".csv", ".txt", ".tsv", ".dat")
    beginning = _beginning(TextFile(content, path)) if text else b""
    blocks: tuple[tuple[int, int], ...] = ()
    layout = Layout(missing=MARKERS)
    try:
        if text:
            layout = _text_layout(beginning, path.with_suffix("") if suffix.endswith(COMPRESSED) else path)
        export = EXPORTS[suffix](content, path, layout)
    except InputError:
        blocks = _blocks(TextFile(content, path), layout) if text else ()
        if not blocks:
            raise
        first, last = max(blocks, key=lambda lines: lines[1] - lines[0])
        layout = replace(layout, data_from_line=first, data_to_line=last)
        export = EXPORTS[suffix](content, path, layout)
    columns, singles, unread = _readings(export)
    if not columns:
        nothing = ("a file must have a column of numbers", "none", "export the readings as numbers")
        raise next(iter(unread.values()), InputError(*nothing, path))
    names, units = _headers(export, dimensions)
    # Headers are printed: no character of them may command the terminal.
    names = tuple("".join(mark if mark.isprintable() else " " for mark in name) for name in names)
    return FoundLayout(path, export, layout, names, units, columns, unread, _rate(beginning, names, singles), blocks)


def _blocks(file: TextFile, layout: Layout) -> tuple[tuple[int, int], ...]:
    """First and last lines of the blocks of readings of a text.

    () where a single line with numbers interrupts or ends them, which is a damaged row.
    """
    runs, longest = _runs(file.lines(), layout)
    after_block = [run for before, run in pairwise(runs) if before[0] == longest]
    if any(cells is not None and len(numbers) == 1 for cells, numbers in after_block):
        return ()
    return tuple((numbers[0], numbers[-1]) for cells, numbers in runs if longest is not None and cells == longest)


def _skips_rows(beginning: bytes, layout: Layout, first: int) -> bool:
    """Whether rows like those of the longest block lie above the line ``first``."""
    runs, longest = _runs(beginning.decode().splitlines(), layout)
    return any(numbers[0] < first for cells, numbers in runs if longest is not None and cells == longest)


def _runs(lines: Iterable[str], layout: Layout) -> tuple[list[tuple[Cells, list[int]]], Cells]:
    """Runs of lines with equal cells, their numbers counted from 1, and the cells of the longest run of two rows or more.

    Blank lines and comments are left out.
    """
    kept = ((number, line) for number, line in enumerate(lines, 1) if is_row(line))
    rows = [(number, _cells_of_row(line, layout)) for number, line in kept]
    runs = [(cells, [number for number, _ in run]) for cells, run in groupby(rows, lambda row: row[1])]
    tables = [run for run in runs if run[0] is not None and len(run[1]) > 1]
    return runs, max(tables, key=lambda run: len(run[1]))[0] if tables else None


def _cells_of_row(line: str, layout: Layout) -> Cells:
    """Separator and number of cells of a line that begins with a number, or a missing one before others; else None."""
    delimiter = delimiter_of(line, layout)
    cells = cells_of(line, delimiter)
    texts = [bare(cell[0]) for cell in cells]
    begins = is_number(texts[0]) or (texts[0] in layout.missing and any(map(is_number, texts)))
    return (delimiter, len(cells)) if begins else None


def used_layout(found: FoundLayout, content: bytes, used: Sequence[int]) -> Layout:
    """The layout with the markers alone that occur in the ``used`` columns."""
    read = EXPORTS[suffix_of(found.path)]

    def reads(markers: tuple[str, ...]) -> bool:
        try:
            export = read(content, found.path, replace(found.layout, missing=markers))
            for column in used:
                export.values(column)
        except InputError:
            return False
        return True

    missing = () if reads(()) else MARKERS
    for marker in missing:
        fewer = tuple(each for each in missing if each != marker)
        missing = fewer if reads(fewer) else missing
    return replace(found.layout, missing=missing)


def _beginning(file: TextFile) -> bytes:
    """The first lines of a text in UTF-8, about ``_BEGINNING`` characters."""
    lines, size = [], 0
    for line in file.lines():
        size += len(line) + 1
        if lines and size > _BEGINNING:
            break
        lines.append(line)
    return "\n".join([*lines, ""]).encode()


def _text_layout(beginning: bytes, path: Path) -> Layout:
    """The layout under which the beginning of a text file has rows of numbers.

    Raises
    ------
    InputError
        The error of the default layout, where no line begins rows of numbers.
    """
    read = EXPORTS[suffix_of(path)]
    first: InputError | None = None
    lines = [None, *range(1, min(_MOST_TITLES, beginning.count(b"\n") + 1) + 1)]
    for line in lines:
        for decimal in (None, ".", ","):
            layout = Layout(line, missing=MARKERS, decimal=decimal)
            try:
                export = read(beginning, path, layout)
            except InputError as error:
                first = first or error
                continue
            if decimal == "." and not _names_columns(export):
                continue
            columns, _, unread = _readings(export)
            if not columns and unread:
                first = first or unread[min(unread)]
            if columns and len(export.lines) == 1:
                rule, remedy = "an export must have two rows of numbers or more", "export all readings into one file"
                first = first or InputError(rule, "one row", remedy, path, int(export.lines[0]))
            if columns and len(export.lines) > 1 and any(np.isfinite(values[0]) for values in columns.values()):
                if line is not None and _skips_rows(beginning, layout, line):
                    break
                return layout
    assert first is not None, "every layout was refused"
    raise first


def _names_columns(export: Export) -> bool:
    """Whether the header has a name for each of several columns: whole numbers between commas are then no decimals."""
    names = export.headers[0] if export.headers else ()
    return (
        export.width > 1 and len(names) == export.width and all(name.strip() and not is_number(name) for name in names)
    )


def _readings(export: Export) -> tuple[dict[int, np.ndarray], dict[int, float], dict[int, InputError]]:
    """The columns of readings, all of the most frequent length; the columns of one number; errors of all others."""
    columns: dict[int, np.ndarray] = {}
    singles: dict[int, float] = {}
    unread: dict[int, InputError] = {}
    for column in range(export.width):
        try:
            values = export.values(column)
        except InputError as error:
            unread[column] = error
            continue
        if values.size == 1:
            singles[column] = float(values[0])
        if values.size and np.mean(np.isnan(values)) <= MOST_MISSING:
            columns[column] = values
    sizes = [values.size for values in columns.values()]
    common = max(set(sizes), key=lambda size: (sizes.count(size), size)) if sizes else 0
    longest = max(sizes, default=0)
    common = longest if common == 1 else common
    return {column: values for column, values in columns.items() if values.size == common}, singles, unread


def _headers(export: Export, dimensions: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns, from the rows of headers nearest to the readings."""
    empty = ("",) * export.width
    rows = list(export.headers[:3])
    units = next((row for row in rows if is_units_row(row, dimensions)), None)
    names = next((row for row in rows if row is not units), None)
    if names is None and units is not None:  # the only row of headers is a row of units, or of short names
        return units, empty
    return names or empty, tuple(cell.strip(" []()") for cell in units) if units is not None else empty


def _rate(beginning: bytes, names: Sequence[str], singles: dict[int, float]) -> float | None:
    """The sampling rate stated in the titles of a text, or by a number with the name of a rate, Hz."""
    for column, value in singles.items():
        if names[column].lower() in _RATE_NAMES and value > 0.0:
            return value
    for line in beginning.decode("utf-8", "replace").splitlines()[:_MOST_TITLES]:
        found = _RATE.search(line)
        if found:
            return float(found[1].replace(",", ".")) * (1e3 if found[2].lower().startswith("k") else 1.0)
    return None
