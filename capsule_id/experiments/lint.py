"""Findings on the readings of a rig before a fit."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from capsule_id.experiments.kind import Estimate, Kind
from capsule_id.experiments.lint_magnitudes import (
    lint_magnitudes,
    lint_rig_quantities,
    lint_stated_sd,
    with_line,
)
from capsule_id.records.faults.duplicates import Readings, repeated_blocks
from capsule_id.rig.formats.text.blocks import WINDOWS
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Finding


def lint(rig: Rig, kinds: Mapping[str, Kind], tables: Sequence[Table[Any]]) -> tuple[Finding, ...]:
    """Return findings on masses and readings; they enter the verdict of a fit.

    Parameters
    ----------
    rig : rig as ``read_rig`` returns it
    kinds : kinds of experiments of the rig
    tables : tables of ``rig`` that are fitted together
    """
    masses = (("m1", rig.m1), ("m2", rig.m2))
    exact = [name for name, mass in masses if mass is not None and mass.sd == 0.0]
    findings = [Finding("masses.exact", "warn", {"name": name}) for name in exact]
    findings += (*lint_rig_quantities(rig), *lint_magnitudes(tables, kinds, rig))
    for table in tables:
        findings += lint_stated_sd(table, kinds[table.kind])
        windows = {file: encoding for file, encoding in table.encodings.items() if encoding == WINDOWS}
        findings += [
            Finding("readings.encoding", "ok", {"file": file, "encoding": encoding}, table.label)
            for file, encoding in windows.items()
        ]
        if table.missing:
            facts = {"file": table.file, "rows": table.missing, "used": len(table.rows)}
            findings.append(Finding("readings.missing", "warn", facts, table.label))
        if table.rejected:
            facts = {"file": table.file, "rows": table.rejected, "used": len(table.rows)}
            findings.append(Finding("readings.rejected", "warn", facts, table.label))
        for lint_table in kinds[table.kind].lint:
            findings += lint_table(table, rig)
    return (*with_line(findings, rig), *_same_files(rig, tables), *_repeated_blocks(rig, tables))


def lint_settings(rig: Rig, kinds: Mapping[str, Kind], estimate: Estimate) -> tuple[Finding, ...]:
    """Return findings on settings at rough values, before anything is fitted."""
    return tuple(found for table in rig.tables for found in kinds[table.kind].lint_rig(table, rig, estimate))


def _same_files(rig: Rig, tables: Sequence[Table[Any]]) -> Iterable[Finding]:
    """Report tables whose files have the same bytes."""
    by_content: dict[tuple[object, ...], list[Table[Any]]] = {}
    for table in tables:
        if table.file in rig.files:
            by_content.setdefault(_content(rig, table), []).append(table)
    for first, *others in by_content.values():
        for other in others:
            facts = {"file": other.file, "first": first.label, "rows": list(range(len(other.rows)))}
            yield Finding("readings.repeated_file", "fail", facts, other.label)


def _content(rig: Rig, table: Table[Any]) -> tuple[object, ...]:
    """Equal for two tables with the same readings of the same file; column maps may read different ones."""
    readings = []
    for name, column in table.columns.items():
        readings.append((name, hashlib.sha256(np.ascontiguousarray(column.values).data).digest()))
    return rig.files.get(table.file, table.label), *readings


def _repeated_blocks(rig: Rig, tables: Sequence[Table[Any]]) -> Iterable[Finding]:
    """Report rows that occur twice, within a table or across tables with the same columns; equal files are left out."""
    groups: dict[tuple[str, ...], list[Table[Any]]] = {}
    for table in {_content(rig, table): table for table in reversed(tables)}.values():
        groups.setdefault(tuple(sorted(set(table.columns) - {"time"})), []).insert(0, table)
    for names, members in groups.items():
        by_label = {table.label: table for table in members}
        readings = [
            Readings(
                table.label,
                np.stack([table[name] for name in names], axis=1),
                "time" in table.columns,
                tuple(table.columns[name].to_display for name in names),
            )
            for table in members
        ]
        for block in repeated_blocks(readings):
            later, first = by_label[block.label], by_label[block.first]
            facts = {
                "file": later.file,
                "line": int(later.rows[block.row]),
                "last": int(later.rows[block.row + block.count - 1]),
                "first": first.file,
                "first_line": int(first.rows[block.first_row]),
                "first_last": int(first.rows[block.first_row + block.count - 1]),
                "rows": list(range(block.row, block.row + block.count)),
            }
            yield Finding("readings.repeated", "fail", facts, block.label)


def lint_rows(table: Table[Any], rig: Rig, fewest: int) -> Iterable[Finding]:
    """Warn where a table has fewer than ``fewest`` rows: three for one unknown, five for two."""
    del rig
    if len(table.rows) < fewest:
        yield Finding("readings.few", "warn", {"rows": len(table.rows), "wanted": fewest}, table.label)


def lint_reading_errors(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Warn where columns have no reading error."""
    del rig
    unstated = [name for name, column in table.columns.items() if column.reading_sd == 0.0]
    if unstated:
        facts = {"names": " and ".join(unstated), "first": unstated[0]}
        yield Finding("readings.errors", "warn", facts, table.label)
