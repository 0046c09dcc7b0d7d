"""Reads the files of one experiment: path check, bytes, hash, column map, columns in SI."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Any, Generic

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.filters import FEWEST_PERIODS, clock_starts
from capsule_id.rig.formats import EXPORTS, READERS, suffix_of
from capsule_id.rig.formats.raw import Layout, RawTable
from capsule_id.rig.formats.text import HEADER_CELL, MissingCellsError, TextFile
from capsule_id.rig.guess import find_layout, proposal
from capsule_id.rig.maps import ColumnMap, apply_map, on_reference, read_clock, read_map
from capsule_id.rig.model import NO_DRIFT, Column, Quantity, S, Table
from capsule_id.rig.plateaus import (
    Plateaus,
    Rejection,
    outlying_rows,
    read_plateaus,
    read_rejection,
    readings_of_plateaus,
)
from capsule_id.rig.schema import SHORTEST_RECORD, ColumnRule, KindRule, place_of
from capsule_id.rig.toml import LARGEST, SMALLEST, KeyPath, TomlDocument, closest, is_plausible, read_string, shown
from capsule_id.rig.units import UnitError, factor_to_si, scale
from capsule_id.views import counted

# order: Finds why the times of a table do not increase, and the remedy that cures this cause.


#: Largest share of rows with a repeated time where the clock stood still; of rounded times more are repeated.
STANDS = 0.05
_MOST_LINES = 20  # named in a remedy


def remedy_of_order(raw: RawTable, index: int) -> str:
    """The cause that keeps column ``index`` from increasing, tested on the rows, and its remedy; else what is seen."""
    time, name, step = raw.columns[index], raw.names[index], np.diff(raw.columns[index])
    back = 1 + np.flatnonzero(step <= 0.0)
    few, falls = len(back) * FEWEST_PERIODS < len(time), bool(np.any(step < 0.0))
    rising = [
        other for other, c in zip(raw.names, raw.columns, strict=True) if other != name and np.all(np.diff(c) > 0.0)
    ]
    copies = np.setdiff1d(np.arange(len(time)), np.unique(raw.values, axis=0, return_index=True)[1])
    order = np.argsort(time, kind="stable")
    rough = [sum(float(np.sum(np.abs(np.diff(c[rows])))) for c in raw.columns) for rows in (order, slice(None))]
    # A clock that stood still makes up for the lost time in one step.
    levels, counts = np.unique(time, return_counts=True)
    even = (time[-1] - time[0]) / (len(time) - 1)
    made_up = np.all(np.abs(np.diff(levels) - counts[:-1] * even)[counts[:-1] > 1] < 0.5 * even)
    where = f"line {' '.join(map(str, raw.rows[back][:_MOST_LINES]))}{' …' if len(back) > _MOST_LINES else ''}"
    files, rows = f"at {counted(len(back), 'row')} ({where}): write a file of each record", counted(len(back), "row")
    still = "the clock stands still and then goes on; delete the rows with a repeated time:"
    causes = (
        (rising and not few, f"{' '.join(rising)} increases in every row and {name} does not: exchange the headers of "
         f"{name} and {' '.join(rising)}, or their from in a column map"),
        (len(clock_starts(time)) and np.all(step[back - 1] < 0.0), f"the clock starts anew {files}"),
        (len(copies) and np.all(np.diff(np.delete(time, copies)) > 0.0),
         f"delete the repeated rows: line {' '.join(map(str, raw.rows[copies]))}"),
        (not falls and len(back) <= STANDS * len(time) and made_up, f"{still} {where}"),
        (not falls, f"the times are rounded, up to {counted(int(counts.max()), 'row')} share one: export them with more "
         "digits"),
        (len(levels) == len(time) and rough[0] <= rough[1],
         f"sort the rows by {name}: in that order the readings are smoother"),
        (few, f"the clock is set back {files}"),
    )  # fmt: skip
    other = f"{name} falls or stays in {rows} of {len(time)}: check which column holds the times"
    return next((text for holds, text in causes if holds), other)


# tables: Reads the files of one experiment: path check, bytes, hash, column map, columns in SI.


_A_TRIAL = "a row per trial"


@dataclass(frozen=True)
class TableFile:
    """A table in SI, with the raw table for the places of cells.

    Attributes
    ----------
    sha256 : of the bytes read, by name in ``rig.toml``, the first file first
    raw : the numbers as written, until they are converted
    columns : by name, still without reading errors
    file_of : (row index or None for the header, column index) -> the file, for error lines
    missing, other : rows that a column map drops: for a missing cell, and outside ``where``
    rejected : rows dropped as outliers
    encodings : of the texts, by name in ``rig.toml``
    drift : of the clock, 1
    """

    sha256: Mapping[str, str]
    raw: RawTable
    columns: Mapping[str, Column]
    file_of: Callable[[int | None, int], Path]
    missing: int = 0
    other: int = 0
    rejected: int = 0
    encodings: Mapping[str, str] = field(default_factory=dict)
    drift: Quantity = NO_DRIFT

    def error(self, row: int | None, name: str, rule: str, value: str, remedy: str) -> InputError:
        """The error about a cell, or about the header of a column if ``row`` is None."""
        index = self.raw.names.index(name)
        return InputError(rule, value, remedy, self.file_of(row, index), *self.raw.place(row, index))


def table_path(document: TomlDocument, path: KeyPath, name: str) -> Path:
    """The path of the table ``name``, a regular file inside the rig folder.

    Raises
    ------
    InputError
        At the ``file`` key of ``rig.toml``.
    """
    folder = document.path.parent
    remedy = "put the file into the rig folder and write its path relative to that folder"
    if Path(name).is_absolute() or PureWindowsPath(name).drive or not name.isprintable():
        raise document.error(path, "file must be a path relative to the rig folder", shown(name), remedy)
    file = folder / name
    try:
        inside = file.resolve().is_relative_to(folder.resolve())
        exists, regular = file.exists(), file.is_file()
    except (OSError, RuntimeError, ValueError) as error:
        raise document.error(path, "file must be a readable file", f"{shown(name)} ({error})", remedy) from None
    if not inside:
        raise document.error(path, "file must lie inside the rig folder, links followed", shown(name), remedy)
    if not exists:
        near = closest(
            name, [p.relative_to(folder).as_posix() for p in file.parent.glob("*") if suffix_of(p) in EXPORTS]
        )
        remedy = f'write "{near}"' if near else "correct the name or add the file"
        raise document.error(path, "file must exist", shown(name), remedy)
    if not regular:
        raise document.error(path, "file must be a regular file", shown(name), "name a table, not a folder or device")
    if suffix_of(file) not in EXPORTS:
        known = " ".join(EXPORTS)
        raise document.error(path, f"file must be a table of a known kind ({known})", shown(name), "export it as CSV")
    return file


def read_experiment_files(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any], kind: KindRule) -> TableFile:
    """Read the table of the experiment at ``path``, by its column map if it has one, and check its columns.

    Raises
    ------
    InputError
        At a key of ``rig.toml`` or at a place in a file.
    """
    places = _file_places(document, path, entry)
    files: dict[str, Path] = {}
    hashes: dict[str, str] = {}
    for place, name in places:
        file = table_path(document, place, name)
        if file in files.values():
            raise document.error(place, "files must be named once", shown(name), "remove the second one")
        try:
            with file.open("rb") as opened:
                files[name], hashes[name] = file, hashlib.file_digest(opened, "sha256").hexdigest()
        except OSError as error:
            value = f"{shown(name)} ({error.strerror})"
            raise document.error(place, "file must be readable", value, "check its permissions") from None
    first = places[0][1]
    rejection, plateaus = read_rejection(document, path, entry), read_plateaus(document, path, entry, kind)
    column_map = read_map(document, path, entry, kind, partial(_proposal, files[first], kind))
    if column_map is None:
        table = _read_plain(document, places[0][0], files[first], hashes, kind)
    else:
        _check_map_names(document, path, column_map, kind, plateaus)
        layout = column_map.layout
        exports = {name: EXPORTS[suffix_of(file)](file, file, layout) for name, file in files.items()}
        mapped = apply_map(document, path, list(exports.values()), column_map)
        encodings = {name: export.encoding for name, export in exports.items()}
        del exports
        table = TableFile(hashes, mapped.raw, {}, mapped.file_of, mapped.missing, mapped.other, encodings=encodings)
    if (clock := read_clock(document, path, entry)) is not None:
        table = replace(table, raw=on_reference(document, path, table.raw, clock), drift=clock.drift)
    if rejection is not None:
        table = _without_outliers(document, path, table, rejection)
    if plateaus is not None:
        raw, starts = readings_of_plateaus(document, path, table.raw, _times(table), plateaus)
        table = _with_rows(table, raw, starts)
    table.raw.rows.flags.writeable = False
    columns = {column: _to_si(table, index, kind.columns[column]) for index, column in enumerate(table.raw.names)}
    return replace(table, raw=replace(table.raw, columns=()), columns=columns)


def read_settings(path: Path, kind: KindRule, without: str) -> dict[str, Column]:
    """Columns of a file with the settings of new experiments: those of ``kind`` without the reading ``without``.

    Raises
    ------
    InputError
        At a place in the file.
    """
    if not path.is_file() or path.suffix.lower() not in READERS:
        remedy = f"name a file of {' '.join(READERS)}"
        raise InputError("the settings must be a table", "no such table", remedy, path)
    columns = {name: rule for name, rule in kind.columns.items() if name != without}
    sets = tuple(tuple(name for name in names if name != without) for names in kind.sets)
    raw = READERS[path.suffix.lower()](path, path)
    table = TableFile({}, raw, {}, lambda row, column: path)
    asked = replace(kind, columns=columns, sets=sets)
    _check_names(raw.names, asked, lambda name, *text: table.error(None, name, *text))
    return {name: _to_si(table, index, columns[name]) for index, name in enumerate(raw.names)}


def _file_places(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> list[tuple[KeyPath, str]]:
    """The files of an experiment, each with its place in ``rig.toml``."""
    if "files" not in entry:
        if "file" not in entry:
            raise document.error(path, "an experiment must have a file", "none", 'add file = "..."')
        return [((*path, "file"), read_string(document, (*path, "file"), entry["file"]))]
    place = (*path, "files")
    if "file" in entry:
        raise document.error(place, "an experiment has file or files", "both", "remove file", of_key=True)
    names = entry["files"]
    if not isinstance(names, list) or not names:
        raise document.error(place, "files must be a list of files", shown(names), 'write files = ["...", "..."]')
    return [((*place, index), read_string(document, (*place, index), name)) for index, name in enumerate(names)]


def _read_plain(
    document: TomlDocument, place: KeyPath, file: Path, hashes: Mapping[str, str], kind: KindRule
) -> TableFile:
    """A file with the column names of the kind; an error about its header proposes a column map."""
    suffix = suffix_of(file)
    if suffix not in READERS:
        remedy = f"add {_proposal(file, kind, Layout())}"
        raise document.error(place, f"a {suffix} file needs a column map", "no columns", remedy)
    try:
        raw = READERS[suffix](file, file)
        table = TableFile(hashes, raw, {}, lambda row, column: file, encodings={next(iter(hashes)): raw.encoding})
        _check_names(raw.names, kind, lambda name, *text: table.error(None, name, *text))
    except InputError as error:
        own, remedy = (
            _own_map(file, kind),
            f"{error.remedy}; or add {_proposal(file, kind, Layout())} to the experiment",
        )
        if isinstance(error, MissingCellsError) and own:
            missing = json.dumps(error.texts, ensure_ascii=False)
            remedy = (
                f"add two lines to the experiment, which drop all rows without a reading: {own} and missing = {missing}"
            )
        elif error.line != 1 or _A_TRIAL in error.remedy:
            raise
        elif own:
            remedy = f"add to the experiment {own}: other columns are then not read"
        raise InputError(error.rule, error.value, remedy, file, error.line, error.column) from None
    return table


def _own_map(file: Path, kind: KindRule) -> str:
    """The column map of the headers that the kind itself has; "" where they are not those that it needs."""
    own = [(found[1], found[0], found[2]) for found in HEADER_CELL.finditer(TextFile(file, file).line(0))]
    own = [(name, *rest) for name, *rest in own if name in kind.columns]
    names = [name for name, *_ in own]
    try:
        _check_names(names, kind, lambda name, *text: InputError(*text))
    except (InputError, IndexError):
        return ""
    texts = [f"{name} = {{ from = {json.dumps(header)}, unit = {json.dumps(unit)} }}" for name, header, unit in own]
    return f"columns = {{ {', '.join(texts)} }}" if len({*names}) == len(names) else ""


def _proposal(file: Path, kind: KindRule, layout: Layout) -> str:
    """The column map that reads a file as ``kind``."""
    found, first = None, ""
    with suppress(InputError):
        found = find_layout(file.read_bytes(), file, sorted({rule.si for rule in kind.columns.values()}))
        if found.layout.data_from_line != layout.data_from_line is None:
            first = f"data_from_line = {found.layout.data_from_line} and "
    return first + proposal(kind, found)


def _times(table: TableFile) -> np.ndarray:
    """The times of a record, (n,) s, increasing."""
    return _to_si(table, table.raw.names.index("time"), ColumnRule("s", increasing=True)).values


def _without_outliers(document: TomlDocument, path: KeyPath, table: TableFile, rejection: Rejection) -> TableFile:
    """The table without its outliers."""
    if "time" not in table.raw.names:
        value, remedy = " ".join(table.raw.names), "remove reject, and correct or delete the rows"
        raise document.error((*path, "reject"), "reject needs a record with times", value, remedy, of_key=True)
    keep = np.flatnonzero(~outlying_rows(document, path, table.raw, _times(table), rejection))
    raw = table.raw
    kept = RawTable(
        raw.names,
        raw.units,
        tuple(column[keep] for column in raw.columns),
        raw.rows[keep],
        lambda row, column: raw.place(None if row is None else int(keep[row]), column),
    )
    return replace(_with_rows(table, kept, keep), rejected=len(raw.rows) - len(keep))


def _with_rows(table: TableFile, raw: RawTable, origin: np.ndarray) -> TableFile:
    """The table with other rows; ``origin`` (k,) are their rows in the former one."""
    columns = len(table.raw.names) - 1
    return replace(
        table,
        raw=raw,
        file_of=lambda row, column: table.file_of(None if row is None else int(origin[row]), min(column, columns)),
    )


def _check_map_names(
    document: TomlDocument, path: KeyPath, column_map: ColumnMap, kind: KindRule, plateaus: Plateaus | None
) -> None:
    """Refuse a map without the columns that the kind needs; plateaus replace the time by the column of their levels."""
    place = (*path, "columns")

    def error(name: str, rule: str, value: str, remedy: str) -> InputError:
        del name
        return document.error(place, rule, value, remedy)

    names = tuple(column_map.sources)
    if plateaus is not None:
        names = (*(name for name in names if name != "time"), plateaus.name)
    _check_names(names, kind, error)


def _check_names(names: Sequence[str], kind: KindRule, error: Callable[[str, str, str, str], InputError]) -> None:
    """Refuse unknown columns, a wrong set of columns, and a table without a channel where the kind has channels.

    ``error`` makes the error about a column from rule, value and remedy.
    """
    for name in names:
        if name not in kind.columns:
            if name == "time":
                sets = ", or ".join(" and ".join(columns) for columns in kind.sets)
                remedy = (
                    f"read {sets} off the record, {_A_TRIAL}, and repeat the trial; plateaus reads steps of one record"
                )
                raise error(name, f"{kind.name} must be a table of trials", "a record against time", remedy)
            close = closest(name, kind.columns)
            remedy = f"rename it to {close}" if close else "remove it"
            known = " ".join(kind.columns)
            raise error(name, f"unknown column in {kind.name}", shown(name), f"{remedy}; known: {known}")
    stated = {name for name in names if name not in (*kind.channels, *kind.optional)}
    if stated not in [set(columns) for columns in kind.sets]:
        wanted = ", or ".join(" and ".join(columns) for columns in kind.sets)
        value = " and ".join(names)
        raise error(names[0], f"{kind.name} must have the columns {wanted}", value, "add or remove columns")
    if kind.channels and not set(kind.channels).intersection(names):
        wanted = " ".join(kind.channels)
        rule = f"{kind.name} must have a channel beside {' and '.join(sorted(stated))}"
        raise error(names[0], rule, " ".join(names), f"add one of {wanted}")


def _to_si(table: TableFile, index: int, rule: ColumnRule) -> Column:
    """Column ``index`` in SI; its values obey ``rule``."""
    name, unit = table.raw.names[index], table.raw.units[index]
    try:
        factor = factor_to_si(unit, rule.si)
    except UnitError as error:
        raise table.error(None, name, f"{name}: {error.rule}", shown(unit), error.remedy) from None
    written = table.raw.columns[index]
    with np.errstate(over="ignore"):
        values = written if factor == 1.0 else scale(written, factor)
    _check_values(table, index, rule, values)
    if rule.varies and len(values) > 1 and np.ptp(values) == 0.0:
        value = f"{written[0]:g} {unit} in every row"
        raise table.error(None, name, f"{name} must not be constant", value, "check the sensor and the export")
    if rule.varies and len(values) == 1:
        raise table.error(0, name, f"{name} must vary over the rows", "one row", "add rows")
    values.flags.writeable = False
    return Column(name, unit, 1.0 / factor, values)


def _check_values(table: TableFile, index: int, rule: ColumnRule, values: np.ndarray) -> None:
    """Refuse a value of column ``index`` outside its domain, (n,) SI."""
    name = table.raw.names[index]
    signed = [c for own, c in zip(table.raw.names, table.raw.columns, strict=True) if own != "normal_force"]
    # Sliding and pulls; a single sign may be a slip of the pen.
    directed = name in ("speed", "force") and np.sum(values < 0.0) > 1
    correct = (
        f"where the sign is the direction, move the rows with {name} < 0 to a file of their own without the minus signs, "
        'in an experiment of the same kind with direction = "backward"'
        if directed and all(np.array_equal(np.sign(c), np.sign(values)) for c in signed)
        else "correct the value or delete the row"
    )
    magnitude = f"{name} must be 0 or lie between {SMALLEST:g} and {LARGEST:g} in SI units"
    checks: list[tuple[Callable[[np.ndarray], np.ndarray], str, str]] = [
        (
            lambda part: np.isfinite(part) & rule.domain.holds(part),
            f"{name} must {rule.domain.text}",
            correct,
        ),
        (is_plausible, magnitude, "correct the value or the unit of the column"),
    ]
    for holds, text, remedy in checks:
        _raise_at_first_false(table, index, holds(values), (text, remedy), 0)
    if rule.increasing:
        rises = np.diff(values) > 0.0
        fall = int(np.argmin(rises)) if len(rises) else 0
        if rises.all():
            return
        remedy = "name the files in the order of time, or make an experiment of each"
        if table.file_of(fall + 1, index) == table.file_of(fall, index):
            remedy = remedy_of_order(table.raw, index)
        _raise_at_first_false(table, index, rises, (f"{name} must increase from row to row", remedy), 1)


def _raise_at_first_false(table: TableFile, index: int, good: np.ndarray, message: tuple[str, str], first: int) -> None:
    """Raise at the first row from ``first`` on that is not ``good``; ``message``: rule and remedy."""
    if not good.all():
        row, name, (rule, remedy) = first + int(np.argmin(good)), table.raw.names[index], message
        raise table.error(row, name, rule, f"{table.raw.columns[index][row]:g} {table.raw.units[index]}", remedy)


# entry: One ``[[experiment]]`` during its check: its table, and the places for error lines.


@dataclass(frozen=True)
class Entry(Generic[S]):
    """The argument of a kind's rules.

    Attributes
    ----------
    table : columns and settings, SI
    document, path : ``rig.toml``, and the key path of the entry
    file : the table as written
    """

    table: Table[S]
    document: TomlDocument
    path: KeyPath
    file: TableFile

    def error(self, key: str, rule: str, value: str, remedy: str, of_key: bool = False) -> InputError:
        """The error about a setting, at its value or key; ``key`` "" means the whole entry."""
        path = (*self.path, key) if key else self.path
        return self.document.error(path, rule, value, remedy, of_key)

    def refuse_ground(self, key: str, rule: str) -> None:
        """Refuse a slope or N0 that this experiment cannot have, its own or that of [rig].

        Raises
        ------
        InputError
            Where ``key``, "slope" or "N0", is stated.
        """
        settings: Any = self.table.settings
        if stated := settings.ground.get(key):
            unit = "deg" if key == "slope" else "N"
            remedy = f'state {key} = {{ value = 0, unit = "{unit}" }} in this experiment, if that is true of it'
            value = f"{stated.value:.3g}{f' ± {stated.sd:.3g}' if stated.sd else ''} in SI units"
            raise self.document.error(place_of(self.document, self.path, key), rule, value, remedy)

    def check_spring_with_gap(self) -> None:
        """Require a gap where a spring is within reach.

        Raises
        ------
        InputError
            At the one of spring and gap that stands alone.
        """
        settings: Any = self.table.settings
        if (settings.spring is None) != (settings.gap is None):
            one, other = ("spring", "gap") if settings.gap is None else ("gap", "spring")
            remedy = f"add {other}, or remove {one} where the support spring is out of reach"
            raise self.error(one, "spring and gap must stand together", f"{one} alone", remedy, of_key=True)

    def check_length(self) -> None:
        """Refuse a record that is too short to fit.

        Raises
        ------
        InputError
            At the last sample.
        """
        samples = len(self.table.rows)
        if samples < SHORTEST_RECORD:
            rule = f"a record must have at least {SHORTEST_RECORD} samples"
            remedy = f"record {self.table.kind} for longer or faster"
            raise self.file.error(samples - 1, "time", rule, counted(samples, "sample"), remedy)
