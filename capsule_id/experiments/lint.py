"""Findings on the readings of a rig before a fit."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from capsule_id.experiments.kind import Estimate, Kind
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
    for table in tables:
        findings += [found for lint_table in kinds[table.kind].lint for found in lint_table(table)]
    return (*findings, *_same_files(rig, tables))


def lint_settings(rig: Rig, kinds: Mapping[str, Kind], estimate: Estimate) -> tuple[Finding, ...]:
    """Return findings on settings at rough values, before anything is fitted."""
    return tuple(found for table in rig.tables for found in kinds[table.kind].lint_rig(table, rig, estimate))


def _same_files(rig: Rig, tables: Sequence[Table[Any]]) -> Iterable[Finding]:
    """Report tables whose files have the same bytes."""
    by_content: dict[str, list[str]] = {}
    for table in tables:
        if table.file in rig.files:
            by_content.setdefault(rig.files[table.file], []).append(table.label)
    for first, *others in by_content.values():
        for other in others:
            yield Finding("readings.repeated", "fail", {"first": first}, other)


def lint_rows(table: Table, fewest: int) -> Iterable[Finding]:
    """Warn where a table has fewer than ``fewest`` rows: the number of unknowns of its law plus three."""
    if len(table.rows) < fewest:
        yield Finding("readings.few", "warn", {"rows": len(table.rows), "wanted": fewest}, table.label)


def lint_reading_errors(table: Table) -> Iterable[Finding]:
    """Warn where columns have no reading error."""
    unstated = [name for name, column in table.columns.items() if column.reading_sd == 0.0]
    if unstated:
        facts = {"names": " and ".join(unstated), "first": unstated[0]}
        yield Finding("readings.errors", "warn", facts, table.label)
