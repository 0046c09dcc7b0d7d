"""Warnings on a valid rig folder before a fit."""

from collections.abc import Iterable, Mapping

from capsule_id.experiments.kind import Estimate, Kind
from capsule_id.rig.model import Rig, Table


def lint(rig: Rig, kinds: Mapping[str, Kind], estimate: Estimate) -> list[str]:
    """Return warnings on a valid rig, one line each: experiment, problem, remedy.

    Parameters
    ----------
    rig : rig as ``read_rig`` returns it
    kinds : kinds of experiments of the rig
    estimate : rough values, computed only where a kind needs them
    """
    findings = [
        f"{name}: no sd stated, so its value counts as exact; state the weighing error"
        for name, mass in (("m1", rig.m1), ("m2", rig.m2))
        if mass is not None and mass.sd == 0.0
    ]
    for table in rig.tables:
        kind = kinds[table.kind]
        texts = [
            *(text for lint_table in kind.lint for text in lint_table(table)),
            *kind.lint_rig(table, rig, estimate),
        ]
        findings += [f"{table.label}: {text}" for text in texts]
    by_content: dict[str, list[str]] = {}
    for table in rig.tables:
        by_content.setdefault(rig.files[table.file], []).append(table.label)
    for labels in by_content.values():
        if len(labels) > 1:
            findings.append(f"{' and '.join(labels)}: the same data; use each reading in one experiment only")
    return findings


def lint_rows(table: Table, fewest: int) -> Iterable[str]:
    """Warn where a table has fewer than ``fewest`` rows: the number of unknowns of its law plus three."""
    if len(table.rows) < fewest:
        yield f"{len(table.rows)} rows, too few to estimate the scatter; measure {fewest} or more"


def lint_reading_errors(table: Table) -> Iterable[str]:
    """Warn where columns have no reading error."""
    unstated = [name for name, column in table.columns.items() if column.reading_sd == 0.0]
    if unstated:
        yield f"no reading error stated for {' and '.join(unstated)}; add {unstated[0]}_sd"
