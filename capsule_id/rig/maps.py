"""Column maps of ``rig.toml``: what they state, and the columns that they select, combine and scale."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from capsule_id.rig.formats.raw import Export, Layout, RawTable
from capsule_id.rig.model import Quantity
from capsule_id.rig.schema import ColumnRule, KindRule
from capsule_id.rig.toml import (
    ANY,
    KeyPath,
    TomlDocument,
    closest,
    read_choice,
    read_quantity,
    read_string,
    read_table,
    read_unit,
    refuse_unknown_keys,
    shown,
)
from capsule_id.rig.units import UNKNOWN, UnitError, factor_to_si

# clock: Puts the times of a record on the clock of another logger: ``clock = { offset = {...}, drift = {...} }``.
#
# Only times change; no reading is interpolated. Channels of two loggers are two experiments, each with its own times.
# A stated sd of the drift makes the drift a parameter of the fit (``capsule_id.experiments.base``).


_CLOCK_EXAMPLE = '{ offset = { value = 0.3, unit = "ms" }, drift = { value = 20, sd = 2, unit = "ppm" } }'
#: Largest offset, s, and drift. A time in s has a resolution of 2 us at this offset; times since 1970 are smaller.
LARGEST_OFFSET, LARGEST_DRIFT = 1e10, 0.1


class StatedClock(NamedTuple):
    """The clock t = offset + (1 + drift) t' of times t'; s and 1."""

    offset: Quantity
    drift: Quantity


def read_clock(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> StatedClock | None:
    """The clock of the experiment at ``path``, None where it states none.

    Raises
    ------
    InputError
        At the key or value that is wrong.
    """
    if "clock" not in entry:
        return None
    place = (*path, "clock")
    stated = read_table(document, place, entry["clock"], _CLOCK_EXAMPLE)
    refuse_unknown_keys(document, place, stated, ("offset", "drift"))
    if not stated:
        raise document.error(place, "a clock must have an offset or a drift", "none", f"write {_CLOCK_EXAMPLE}")
    clock = StatedClock(
        *(
            read_quantity(document, (*place, key), stated[key], si, ANY, has_sd=True)
            if key in stated
            else Quantity(0.0)
            for key, si in (("offset", "s"), ("drift", "1"))
        )
    )
    for key, quantity, largest, unit, remedy in (
        ("offset", clock.offset, LARGEST_OFFSET, " s", "check number and unit"),
        ("drift", clock.drift, LARGEST_DRIFT, "", 'check number and unit; 20 ppm is { value = 20, unit = "ppm" }'),
    ):
        for word, number in ((key, quantity.value), (f"sd of {key}", quantity.sd)):
            if abs(number) > largest:
                rule = f"{word} must lie between -{largest:g}{unit} and {largest:g}{unit}"
                raise document.error((*place, key), rule, f"{number:g}{unit}", remedy)
    return clock


def on_reference(document: TomlDocument, path: KeyPath, raw: RawTable, clock: StatedClock) -> RawTable:
    """The table with its times t' replaced by offset + (1 + drift) t'.

    Raises
    ------
    InputError
        If the table has no times.
    """
    if "time" not in raw.names:
        value = " ".join(raw.names)
        raise document.error((*path, "clock"), "clock needs a record with times", value, "remove clock", of_key=True)
    index = raw.names.index("time")
    try:
        factor = factor_to_si(raw.units[index], "s")
    except UnitError:  # reported at its place, where the column is converted
        return raw
    columns = list(raw.columns)
    columns[index] = clock.offset.value / factor + (1.0 + clock.drift.value) * columns[index]
    return replace(raw, columns=tuple(columns))


# declared: Reads the column map of an experiment in ``rig.toml``: ``columns`` and the keys that go with it.


#: Keys of an experiment that go with ``columns``.
MAP_KEYS = ("columns", "files", "data_from_line", "data_to_line", "missing", "decimal", "where", "plateaus")
#: Largest finite number; whole numbers of TOML may be larger.
LARGEST = sys.float_info.max
_EXAMPLE = '{ from = "...", unit = "..." }'
Header = str | int  #: a header, or a column's number counted from 1


@dataclass(frozen=True)
class Source:
    """Where a column comes from: (``header`` - ``minus``) * ``scale`` + ``offset``, in ``unit``.

    Attributes
    ----------
    header, minus : columns of the file (``minus`` None: nothing is subtracted)
    unit : of the result, as written
    scale, offset : factor, and a constant in ``unit`` that is added after it
    rate : sampling rate, Hz, of a time that no column holds; else None
    """

    header: Header = 1
    minus: Header | None = None
    unit: str = "s"
    scale: float = 1.0
    offset: float = 0.0
    rate: float | None = None


@dataclass(frozen=True)
class Range:
    """Numbers from ``min`` to ``max``, both included, in the unit of the file."""

    min: float
    max: float

    def __str__(self) -> str:
        if self.max == inf:
            return f"{self.min:.15g} or more"
        return f"{self.max:.15g} or less" if self.min == -inf else f"{self.min:.15g} to {self.max:.15g}"


#: What selects the rows of a column: a number in the unit of the file, a range of them, or a text.
Wanted = float | str | Range


@dataclass(frozen=True)
class ColumnMap:
    """The column map of an experiment.

    Attributes
    ----------
    sources : by column of the experiment
    layout : what is stated about the layout of the files
    where : what a row has in a column, by its header or number: other rows are not read
    """

    sources: Mapping[str, Source]
    layout: Layout
    where: Mapping[str, Wanted]


def read_map(
    document: TomlDocument, path: KeyPath, entry: Mapping[str, Any], kind: KindRule, propose: Callable[[Layout], str]
) -> ColumnMap | None:
    """The column map of the experiment at ``path``, None where it states none.

    ``propose`` gives the map that reads its first file, for remedies.

    Raises
    ------
    InputError
        At the key or value of ``rig.toml`` that is wrong.
    """
    layout = Layout(*_lines(document, path, entry), _markers(document, path, entry), _decimal(document, path, entry))
    if "columns" not in entry:
        for key in MAP_KEYS[1:]:
            if key in entry:
                remedy = f"add {propose(layout)}"
                raise document.error((*path, key), f"{key} needs a column map", "no columns", remedy, of_key=True)
        return None
    place = (*path, "columns")
    if not isinstance(entry["columns"], dict):
        read_table(document, place, entry["columns"], propose(layout))
    stated = entry["columns"]
    if not stated:
        raise document.error(place, "a column map must have columns", "none", f"write {propose(layout)}")
    # Plateaus are readings of a time trace, whatever the columns of the kind.
    rules = {**({"time": ColumnRule("s")} if "plateaus" in entry else {}), **kind.columns}
    refuse_unknown_keys(document, place, stated, tuple(rules))
    sources = {name: _source(document, (*place, name), stated[name], rules[name]) for name in stated}
    where = _where(document, path, entry)
    named = [header for source in sources.values() for header in (source.header, source.minus) if header is not None]
    # A key of ``where`` is a header, or the number of a column.
    keys = [
        (form, value)
        for key, value in where.items()
        for form in (" ".join(key.split()), *([int(key)] if key.isdecimal() else []))
    ]
    words = tuple(form for form, value in keys if isinstance(value, str))
    layout = replace(layout, columns=(*named, *(form for form, _ in keys)), words=words)
    return ColumnMap(MappingProxyType(sources), layout, MappingProxyType(where))


def _source(document: TomlDocument, path: KeyPath, value: object, rule: ColumnRule) -> Source:
    """One entry of ``columns``."""
    entry = read_table(document, path, value, _EXAMPLE)
    if "rate" in entry:
        refuse_unknown_keys(document, path, entry, ("rate",))
        if rule.si != "s":
            remedy = f"write {_EXAMPLE}"
            raise document.error((*path, "rate"), "rate is for times", str(path[-1]), remedy, of_key=True)
        return Source(rate=read_quantity(document, (*path, "rate"), entry["rate"], "Hz").value)
    refuse_unknown_keys(document, path, entry, ("from", "minus", "unit", "scale", "offset"))
    if "from" not in entry:
        raise document.error(path, f"{path[-1]} must have a from", shown(entry), f"write {_EXAMPLE}")
    header = _header(document, (*path, "from"), entry["from"])
    read_unit(document, path, entry, rule.si)
    scale, offset = (
        _number(document, (*path, key), entry.get(key, zero)) for key, zero in (("scale", 1.0), ("offset", 0.0))
    )
    if scale == offset == 0.0:
        remedy = "write 1, or -1 for the other sign; for a constant, state it as offset"
        raise document.error((*path, "scale"), "scale must not be 0", "0", remedy)
    return Source(
        header,
        _header(document, (*path, "minus"), entry["minus"]) if "minus" in entry else None,
        entry["unit"],
        scale,
        offset,
    )


def _header(document: TomlDocument, path: KeyPath, value: object) -> Header:
    """A header, or a number counted from 1."""
    if isinstance(value, int) and not isinstance(value, bool):
        if value < 1:
            raise document.error(path, "columns are counted from 1", str(value), "write 1 for the first column")
        return value
    if not isinstance(value, str):
        rule = f"{path[-1]} must be a header or the number of a column"
        raise document.error(path, rule, shown(value), f'write {path[-1]} = 1 or {path[-1]} = "<header>"')
    if value == UNKNOWN:
        remedy = "write its header, or its number counted from 1"
        raise document.error(path, f"{path[-1]} must name the column that holds {path[-2]}", shown(value), remedy)
    return " ".join(read_string(document, path, value).split())


def _number(document: TomlDocument, path: KeyPath, value: object) -> float:
    """A finite number without unit."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise document.error(path, f"{path[-1]} must be a finite number", shown(value), "write a number without quotes")
    return float(value)


def _lines(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> tuple[int | None, int | None]:
    """``data_from_line`` and ``data_to_line``, None where they are not stated."""
    found = []
    for key, which in (("data_from_line", "first"), ("data_to_line", "last")):
        value = entry.get(key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            rule = f"{key} must be a line, counted from 1"
            raise document.error((*path, key), rule, shown(value), f"write the line of the {which} reading, such as 2")
        found.append(value)
    first, last = found
    if first is not None and last is not None and last < first:
        rule = f"data_to_line must not be above data_from_line = {first}"
        raise document.error((*path, "data_to_line"), rule, str(last), "exchange them")
    return first, last


def _markers(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> tuple[str, ...]:
    """The texts of ``missing``; "" stands for an empty cell."""
    place, value = (*path, "missing"), entry.get("missing", [])
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        remedy = 'write missing = ["--", "NaN"]'
        raise document.error(place, "missing must be a list of texts", shown(value), remedy)
    return tuple(value)


def _decimal(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> str | None:
    """``decimal``, None where it is not stated."""
    place = (*path, "decimal")
    return read_choice(document, place, entry["decimal"], (".", ",")) if "decimal" in entry else None


def _where(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> dict[str, Wanted]:
    """The numbers, ranges and texts of ``where``, by header or number."""
    place = (*path, "where")
    stated = read_table(document, place, entry.get("where", {}), "where = { <header> = <value> }")
    return {key: _wanted(document, (*place, key), value) for key, value in stated.items()}


def _wanted(document: TomlDocument, path: KeyPath, value: object) -> Wanted:
    """One value of ``where``."""
    if isinstance(value, str):
        return value.strip()
    if not isinstance(value, dict):
        return _number(document, path, value)
    refuse_unknown_keys(document, path, value, ("min", "max"))
    if not value:
        raise document.error(
            path, "a range must have min or max", "none", "write { min = 2, max = 10 }, or one of them"
        )
    for key in value:
        if isinstance(value[key], float) and not abs(value[key]) <= LARGEST:
            raise document.error((*path, key), f"{key} must be a finite number", shown(value[key]), f"leave {key} out")
    ends = [_number(document, (*path, key), value[key]) if key in value else None for key in ("min", "max")]
    found = Range(*(side if end is None else end for side, end in zip((-inf, inf), ends, strict=True)))
    if found.min > found.max:
        raise document.error(path, "min must not exceed max", str(found), "exchange them")
    return found


# mapped: Applies a column map: selects, combines and scales the columns of one file or several.


#: Relative difference below which a column that several files hold is the same.
ROUNDING = 1e-9
#: Numbers of a file equal one of ``where`` within this many units in the last place.
ULPS = 4
_MOST_VALUES = 6  # shown of a column where no row has the value wanted


@dataclass(frozen=True)
class Mapped:
    """A table made by a column map.

    Attributes
    ----------
    raw : columns with the names of the kind, in the stated units; ``rows`` are lines of the file, or rows of the
        table where several files are put one below the other
    file_of : (row index or None for the header, column index) -> the file of a cell
    missing : rows dropped because a used cell holds a missing marker
    other : rows outside ``where``
    """

    raw: RawTable
    file_of: Callable[[int | None, int], Path]
    missing: int
    other: int


@dataclass(frozen=True)
class _Found:
    """One column of a part: its numbers, and where it stands."""

    values: np.ndarray
    export: Export
    column: int


@dataclass(frozen=True)
class _Selected:
    """Rows that a key of ``where`` selects, those without a value, (n,) each; where it selects none, what there is."""

    rows: np.ndarray
    unknown: np.ndarray
    seen: str


@dataclass(frozen=True)
class _Cell:
    """Where the cells of a column stand."""

    path: Path
    place: Callable[[int | None, int], tuple[int, int]]
    column: int


def apply_map(document: TomlDocument, path: KeyPath, exports: Sequence[Export], column_map: ColumnMap) -> Mapped:
    """The table of the experiment at ``path``.

    Files with the same headers are put one below the other; else side by side, and a column that several of them hold
    must be the same within rounding.

    Raises
    ------
    InputError
        If a column is not found, cells are no numbers, columns have different lengths, or no row is left.
    """
    first = exports[0]
    alike = all((each.headers, each.width) == (first.headers, first.width) for each in exports)
    parts = [_Part(document, path, [each]) for each in exports] if alike else [_Part(document, path, exports)]
    place = (*path, "columns")
    sources = {name: source for name, source in column_map.sources.items() if source.rate is None}
    found = [
        {name: part.find((*place, name, "from"), source.header) for name, source in sources.items()} for part in parts
    ]
    # The numbers of the files are not kept beside the table.
    cells = [
        {name: _Cell(each.export.path, each.export.place, each.column) for name, each in here.items()} for here in found
    ]
    values: dict[str, np.ndarray] = {}
    for name, source in sources.items():
        values[name] = np.concatenate(
            [_scaled(part, here.pop(name), (*place, name), source) for part, here in zip(parts, found, strict=True)]
        )
    where = {key: _selected_by(parts, (*path, "where", key), value) for key, value in column_map.where.items()}
    first_rows = np.cumsum([0, *(part.rows for part in parts)])
    keep, missing, other = _kept(document, path, values, where, column_map.where)
    for name, source in column_map.sources.items():
        if (rate := source.rate) is not None:
            values[name] = np.arange(first_rows[-1]) / rate
    names = tuple(column_map.sources)
    columns = tuple(_selected(values.pop(name), keep) for name in names)
    origin = None if keep is None else np.flatnonzero(keep)

    def cell(row: int | None, column: int) -> tuple[_Cell, int | None]:
        index = 0 if row is None else row if origin is None else int(origin[row])
        part = 0 if row is None else int(np.searchsorted(first_rows, index, side="right")) - 1
        here = cells[part].get(names[column], next(iter(cells[part].values())))
        return here, None if row is None else index - int(first_rows[part])

    def place_of(row: int | None, column: int) -> tuple[int, int]:
        here, index = cell(row, column)
        return here.place(index, here.column)

    units = tuple(column_map.sources[name].unit for name in names)
    # Arrays of a file may have other lengths than those that the map names.
    lines = exports[0].lines[: int(first_rows[-1])]
    rows = _selected(lines, keep) if len(parts) == 1 else np.arange(1, 1 + len(columns[0]))
    raw = RawTable(names, units, columns, rows, place_of)
    return Mapped(raw, lambda row, column: cell(row, column)[0].path, missing, other)


def _selected(values: np.ndarray, keep: np.ndarray | None) -> np.ndarray:
    """The rows ``keep`` of a column; None: all, without a copy."""
    return values if keep is None else values[keep]


class _Part:
    """Files side by side: the columns of one are found in any of them."""

    def __init__(self, document: TomlDocument, path: KeyPath, exports: Sequence[Export]) -> None:
        self.document, self.path, self.exports = document, path, exports
        self._rows: int | None = None  # of the columns found, None before the first one

    @property
    def rows(self) -> int:
        """Number of rows of the columns found."""
        return self._rows or 0

    def find(self, place: KeyPath, header: Header) -> _Found:
        """The column ``header``, stated at ``place`` of ``rig.toml``."""
        found = [_Found(export.values(column), export, column) for export, column in self._columns(place, header)]
        first = found[0]
        self._rows = first.values.size if self._rows is None else self._rows
        for each in found:
            self._require_rows(place, header, each.values.size)
            if each is first:
                continue
            scale = float(np.nanmax(np.abs(first.values), initial=0.0))
            if not np.allclose(each.values, first.values, rtol=0.0, atol=ROUNDING * scale, equal_nan=True):
                rule = f"{shown(header)} must be the same in {first.export.path.name} and {each.export.path.name}"
                value = f"a difference of {np.nanmax(np.abs(each.values - first.values)):.3g}"
                raise self.document.error(place, rule, value, "name files that were recorded together")
        return first

    def words(self, place: KeyPath, header: Header) -> np.ndarray:
        """The texts of the column ``header``, stated at ``place`` of ``rig.toml``, (n,)."""
        found: list[np.ndarray] = []
        for export, column in self._columns(place, header):
            if export.words is None:
                rule = f"where takes numbers for a {export.path.suffix} file"
                raise self.document.error(place, rule, "a text", "write a number, or export the file as CSV")
            codes, texts = export.words(column)
            self._require_rows(place, header, len(codes))
            found.append(np.array(texts)[codes])
            if differ := np.flatnonzero(found[-1] != found[0]).tolist():
                rule, row = f"{shown(header)} must be the same in all files that have it", differ[0]
                value = f"{shown(str(found[0][row]))} and {shown(str(found[-1][row]))}"
                raise self.document.error(place, rule, value, "name files that were recorded together")
        return found[0]

    def _require_rows(self, place: KeyPath, header: Header, rows: int) -> None:
        """Refuse a column with another number of rows than those found before."""
        if rows != self.rows:
            rule, value = f"columns must have equal lengths ({self.rows})", f"{shown(header)}: {rows}"
            remedy = "map columns of equal length, or make an experiment of each file, with a clock"
            raise self.document.error(place, rule, value, remedy)

    def _columns(self, place: KeyPath, header: Header) -> list[tuple[Export, int]]:
        """The files that have the column ``header``, each with its index there; at least one."""
        found = [
            (export, column) for export in self.exports if (column := self._column(place, export, header)) is not None
        ]
        if not found:
            known = [name for export in self.exports for row in export.headers for name in row if name]
            close = closest(str(header), known)
            remedy = f'write "{close}"' if close else "write the number of the column, counted from 1"
            value = f"{shown(header)}; headers: {shown(' '.join(known)) if known else 'none'}"
            raise self.document.error(place, f"{place[-1]} must be a header of the file", value, remedy)
        return found

    def _column(self, place: KeyPath, export: Export, header: Header) -> int | None:
        """Index of a column in one file; None if the file does not have the header."""
        if isinstance(header, int):
            if len(self.exports) > 1:
                rule = "columns of files with different headers are named by their headers"
                raise self.document.error(place, rule, str(header), f'write {place[-1]} = "<header>"')
            if header > export.width:
                rule = f"{place[-1]} must be one of the {export.width} columns of the file"
                remedy = f"write a number from 1 to {export.width}"
                raise self.document.error(place, rule, str(header), remedy)
            return header - 1
        for row in export.headers:
            numbers = [index for index, name in enumerate(row) if name == header]
            if len(numbers) > 1:
                value = f"{shown(header)} in columns {' '.join(str(index + 1) for index in numbers)}"
                where = place[-2] == "where"
                remedy = (
                    f"write its number, {f'{numbers[0] + 1} = ...' if where else f'{place[-1]} = {numbers[0] + 1}'}"
                )
                raise self.document.error(place, "a header must be unique", value, remedy, of_key=where)
            if numbers:
                return numbers[0]
        return None


def _where_header(part: _Part, key: str) -> Header:
    """A key of ``where`` as a header, or as a number where no file has the header."""
    stated = any(key in row for export in part.exports for row in export.headers)
    return int(key) if key.isascii() and key.isdigit() and int(key) > 0 and not stated else " ".join(key.split())


def _selected_by(parts: Sequence[_Part], place: KeyPath, wanted: Wanted) -> _Selected:
    """The rows whose column, named by the last key of ``place``, has what is ``wanted``."""
    key = str(place[-1])
    if isinstance(wanted, str):
        texts = np.concatenate([part.words(place, _where_header(part, key)) for part in parts])
        rows = texts == wanted
        return _Selected(
            rows, texts == "", "" if rows.any() else _some([shown(str(text)) for text in np.unique(texts)])
        )
    column = np.concatenate([part.find(place, _where_header(part, key)).values for part in parts])
    if isinstance(wanted, Range):
        # 0.1 + 0.2 is 0.3; times since 1970 in microseconds keep their digits.
        own = [np.spacing(end) if np.isfinite(end) else 0.0 for end in np.abs([wanted.min, wanted.max])]
        rows = (column >= wanted.min - ULPS * own[0]) & (column <= wanted.max + ULPS * own[1])
    else:
        rows = np.abs(column - wanted) <= ULPS * np.spacing(abs(wanted))
    return _Selected(rows, np.isnan(column), "" if rows.any() else _numbers_of(column, isinstance(wanted, Range)))


def _some(texts: Sequence[str]) -> str:
    return " ".join(texts[:_MOST_VALUES]) + (" …" if len(texts) > _MOST_VALUES else "")


def _numbers_of(column: np.ndarray, is_range: bool) -> str:
    """The range of the numbers of a column, or some of them, in words; "" where it has none."""
    numbers = column[np.isfinite(column)]
    if is_range and numbers.size:
        return f"{np.min(numbers):.15g} to {np.max(numbers):.15g}"
    return _some([f"{value:.15g}" for value in np.unique(numbers)[: _MOST_VALUES + 1]])


def _scaled(part: _Part, found: _Found, place: KeyPath, source: Source) -> np.ndarray:
    """The values of a column in its stated unit."""
    values = found.values
    if source.minus is not None:
        values = values - part.find((*place, "minus"), source.minus).values
    if source.scale == 1.0 and source.offset == 0.0:
        return values
    with np.errstate(over="ignore"):
        return values * source.scale + source.offset


def _kept(
    document: TomlDocument,
    path: KeyPath,
    values: Mapping[str, np.ndarray],
    where: Mapping[str, _Selected],
    wanted: Mapping[str, Wanted],
) -> tuple[np.ndarray | None, int, int]:
    """Which rows are used (None: all), and how many are dropped: for a missing cell, and outside ``where``."""
    if not where and not any(np.isnan(column).any() for column in values.values()):
        return None, 0, 0
    unknown = np.any([selected.unknown for selected in where.values()], axis=0) if where else np.array(False)
    inside = np.ones(next(iter(values.values())).size, bool)
    for key, selected in where.items():
        if not selected.rows.any():
            value = wanted[key]
            rule = f"where must keep a row; column {shown(key)} holds {selected.seen or 'no number'}"
            found = (
                shown(value) if isinstance(value, str) else f"{value:.15g}" if isinstance(value, float) else str(value)
            )
            remedy = "widen the range" if isinstance(value, Range) else "write one of the values of the column"
            raise document.error((*path, "where", key), rule, found, remedy)
        inside &= selected.rows
    empty = np.zeros_like(inside)
    for column in values.values():
        empty |= np.isnan(column)
    keep = inside & ~empty
    if not keep.any():
        remedy = "correct where, or map another column"
        raise document.error((*path, "columns"), "a table must have rows", "none is left", remedy)
    if keep.all():
        return None, 0, 0
    missing = int(np.sum(inside & empty)) + int(np.sum(unknown & ~inside))
    return keep, missing, inside.size - int(np.sum(keep)) - missing
