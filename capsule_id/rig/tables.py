"""Reads one table file of a rig folder: path check, bytes, hash, columns in SI."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.domains import LARGEST, SMALLEST, is_plausible
from capsule_id.rig.formats import READERS
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.model import Column
from capsule_id.rig.schema import ColumnRule, KindRule
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import closest, shown
from capsule_id.rig.units import UnitError, factor_to_si, scale


@dataclass(frozen=True)
class TableFile:
    """A table in SI, with the raw table for the places of cells.

    Attributes
    ----------
    path : the file, for error lines
    sha256 : of the bytes read
    raw : the numbers as written
    columns : by name, still without reading errors
    """

    path: Path
    sha256: str
    raw: RawTable
    columns: Mapping[str, Column]

    def error(self, row: int | None, name: str, rule: str, value: str, remedy: str) -> InputError:
        """The error about a cell, or about the header of a column if ``row`` is None."""
        line, column = self.raw.place(row, self.raw.names.index(name))
        return InputError(rule, value, remedy, self.path, line, column)


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
        raise document.error(path, "file must exist", shown(name), "correct the name or add the file")
    if not regular:
        raise document.error(path, "file must be a regular file", shown(name), "name a table, not a folder or device")
    if file.suffix.lower() not in READERS:
        known = " ".join(READERS)
        raise document.error(path, f"file must be a table of a known kind ({known})", shown(name), "export it as CSV")
    return file


def read_table_file(document: TomlDocument, path: KeyPath, name: str, kind: KindRule) -> TableFile:
    """Read the table ``name`` and check its columns against ``kind``.

    Raises
    ------
    InputError
        At the ``file`` key of ``rig.toml`` (at ``path``) or at a place in the table.
    """
    file = table_path(document, path, name)
    try:
        content = file.read_bytes()
    except OSError as error:
        remedy = "check its permissions"
        raise document.error(path, "file must be readable", f"{shown(name)} ({error.strerror})", remedy) from None
    raw = READERS[file.suffix.lower()](content, file)
    raw.rows.flags.writeable = False
    table = TableFile(file, hashlib.sha256(content).hexdigest(), raw, {})
    _check_names(table, kind)
    columns = {column: _to_si(table, index, kind.columns[column]) for index, column in enumerate(raw.names)}
    return TableFile(file, table.sha256, raw, columns)


def _check_names(table: TableFile, kind: KindRule) -> None:
    """Refuse unknown columns, a wrong set of columns, and a table without a channel where the kind has channels."""
    names = table.raw.names
    for name in names:
        if name not in kind.columns:
            close = closest(name, kind.columns)
            remedy = f"rename it to {close}" if close else "remove it"
            known = " ".join(kind.columns)
            raise table.error(None, name, f"unknown column in {kind.name}", shown(name), f"{remedy}; known: {known}")
    stated = {name for name in names if name not in (*kind.channels, *kind.optional)}
    if stated not in [set(columns) for columns in kind.sets]:
        wanted = ", or ".join(" and ".join(columns) for columns in kind.sets)
        value = " and ".join(names)
        raise table.error(None, names[0], f"{kind.name} must have the columns {wanted}", value, "add or remove columns")
    if kind.channels and not set(kind.channels).intersection(names):
        wanted = " ".join(kind.channels)
        rule = f"{kind.name} must have a channel beside {' and '.join(sorted(stated))}"
        raise table.error(None, names[0], rule, " ".join(names), f"add one of {wanted}")


def _to_si(table: TableFile, index: int, rule: ColumnRule) -> Column:
    """Column ``index`` in SI; its values obey ``rule``."""
    name, unit = table.raw.names[index], table.raw.units[index]
    try:
        factor = factor_to_si(unit, rule.si)
    except UnitError as error:
        raise table.error(None, name, f"{name}: {error.rule}", shown(unit), error.remedy) from None
    written = table.raw.values[:, index]
    with np.errstate(over="ignore"):
        values = scale(written, factor)
    valid = np.isfinite(values) & rule.domain.holds(values)
    _raise_at_first_false(table, name, valid, f"{name} must {rule.domain.text}", "correct the value or delete the row")
    magnitude = f"{name} must be 0 or lie between {SMALLEST:g} and {LARGEST:g} in SI units"
    _raise_at_first_false(table, name, is_plausible(values), magnitude, "correct the value or the unit of the column")
    if rule.increasing:
        rises = np.concatenate([[True], np.diff(values) > 0.0])
        _raise_at_first_false(
            table, name, rises, f"{name} must increase from row to row", "sort the rows and delete repeated ones"
        )
    if rule.varies and len(values) > 1 and np.ptp(values) == 0.0:
        value = f"{written[0]:g} {unit} in every row"
        raise table.error(None, name, f"{name} must not be constant", value, "check the sensor and the export")
    if rule.varies and len(values) == 1:
        raise table.error(0, name, f"{name} must vary over the rows", "one row", "add rows")
    values.flags.writeable = False
    return Column(name, unit, 1.0 / factor, values)


def _raise_at_first_false(table: TableFile, name: str, good: np.ndarray, rule: str, remedy: str) -> None:
    """Raise at the first row that is not ``good``."""
    if not good.all():
        row = int(np.argmin(good))
        index = table.raw.names.index(name)
        raise table.error(row, name, rule, f"{table.raw.values[row, index]:g} {table.raw.units[index]}", remedy)
