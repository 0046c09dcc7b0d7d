"""Finds the layout of an export: the first row of readings, missing markers, headers, units, a stated sampling rate."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.importing.headers import is_units_row
from capsule_id.rig.formats import EXPORTS, suffix_of
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.text.blocks import COMPRESSED, TextFile

#: Texts that loggers and spreadsheets write where a reading is missing.
MARKERS = ("", "-", "--", "---", "NaN", "nan", "NAN", "NA", "N/A", "n/a", "null", "NULL", "#N/A", "?")
#: Largest share of missing readings in a column of readings.
MOST_MISSING = 0.5
_BEGINNING = 100_000  # characters in which the first row of readings is searched
_MOST_TITLES = 100  # lines
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
    """

    path: Path
    export: Export
    layout: Layout
    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: dict[int, np.ndarray]
    unread: dict[int, InputError]
    rate: float | None


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
    beginning = b""
    if text:
        beginning = _beginning(TextFile(content, path))
        layout = _text_layout(beginning, path.with_suffix("") if suffix.endswith(COMPRESSED) else path)
    else:
        layout = Layout(missing=MARKERS)
    export = EXPORTS[suffix](content, path, layout)
    columns, singles, unread = _readings(export)
    names, units = _headers(export, dimensions)
    return FoundLayout(path, export, layout, names, units, columns, unread, _rate(beginning, names, singles))


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
        for decimal in (None, ","):
            layout = Layout(line, MARKERS, decimal)
            try:
                export = read(beginning, path, layout)
            except InputError as error:
                first = first or error
                continue
            columns, _, unread = _readings(export)
            if not columns and unread:
                first = first or unread[min(unread)]
            if columns and len(export.lines) == 1:
                rule, remedy = "an export must have two rows of numbers or more", "export all readings into one file"
                first = first or InputError(rule, "one row", remedy, path, int(export.lines[0]))
            if columns and len(export.lines) > 1 and any(np.isfinite(values[0]) for values in columns.values()):
                return layout
    assert first is not None, "every layout was refused"
    raise first


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
