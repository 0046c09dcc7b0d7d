"""One table file of a rig folder: found inside the folder, read, hashed, its columns checked and turned into SI."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats import READERS
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.model import Column
from capsule_id.rig.schema import ColumnRule, KindRule
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import closest, shown
from capsule_id.rig.units import UnitError, factor_to_si, scale


@dataclass(frozen=True)
class TableFile:
    """A table in SI, with the raw table for places.

    Attributes
    ----------
    path : the file, as error lines name it
    sha256 : of the bytes read
    raw : the numbers as written
    columns : by name, without reading errors yet
    """

    path: Path
    sha256: str
    raw: RawTable
    columns: Mapping[str, Column]

    def error(self, row: int | None, name: str, rule: str, value: str, remedy: str) -> InputError:
        """The error to raise about a cell, or about the header of a column where ``row`` is None."""
        line, column = self.raw.place(row, self.raw.names.index(name))
        return InputError(rule, value, remedy, self.path, line, column)


def locate(document: TomlDocument, path: KeyPath, name: str) -> Path:
    """The file ``name`` of the folder, refused where it is not a regular file inside the folder.

    Raises
    ------
    InputError
        At the ``file`` key of ``rig.toml``.
    """
    folder = document.path.parent
    remedy = "put the file into the rig folder and name it relative to that"
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
    file = locate(document, path, name)
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
    """Only known columns, exactly one of the kind's sets of them, and a channel where it has channels."""
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
    """Column ``index`` in SI, inside its domain, increasing or varying where it has to."""
    name, unit = table.raw.names[index], table.raw.units[index]
    try:
        factor = factor_to_si(unit, rule.si)
    except UnitError as error:
        raise table.error(None, name, f"{name}: {error.rule}", shown(unit), error.remedy) from None
    written = table.raw.values[:, index]
    with np.errstate(over="ignore"):
        values = scale(written, factor)
    _refuse_first(
        table, name, np.isfinite(values) & rule.domain.holds(values), f"{name} must {rule.domain.text}", "correct it"
    )
    if rule.increasing:
        rises = np.concatenate([[True], np.diff(values) > 0.0])
        _refuse_first(
            table, name, rises, f"{name} must increase from row to row", "sort the rows, remove repeated ones"
        )
    if rule.varies and len(values) > 1 and np.ptp(values) == 0.0:
        value = f"{written[0]:g} {unit} in every row"
        raise table.error(None, name, f"{name} must not be constant", value, "check the sensor and the export")
    if rule.varies and len(values) == 1:
        raise table.error(0, name, f"{name} must vary over the rows", "one row", "add rows")
    values.flags.writeable = False
    return Column(name, unit, 1.0 / factor, values)


def _refuse_first(table: TableFile, name: str, good: np.ndarray, rule: str, remedy: str) -> None:
    """Raise at the first row that is not ``good``."""
    if not good.all():
        row = int(np.argmin(good))
        index = table.raw.names.index(name)
        raise table.error(row, name, rule, f"{table.raw.values[row, index]:g} {table.raw.units[index]}", remedy)
