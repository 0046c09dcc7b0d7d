"""``capsule-id check DATA``: read a rig folder, describe it, list findings before a fit; fits nothing."""

import argparse

from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.experiments.lint import lint, lint_settings
from capsule_id.experiments.registry import default_registry
from capsule_id.experiments.rough_values import rough_values
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.filters import sampling_step
from capsule_id.rig.model import Table
from capsule_id.rig.read import read_rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add DATA."""
    parser.add_argument("data", metavar="DATA", help="rig folder, with its rig.toml")


def run(args: argparse.Namespace) -> int:
    """Print a line per experiment and per finding to standard output; 0.

    Raises
    ------
    InputError
        If the folder is not a valid rig.
    """
    kinds = default_registry()
    rig = read_rig(args.data, kinds)
    lines = [f"{rig.name}: {len(rig.tables)} experiments{', SYNTHETIC data' if rig.synthetic else ''}"]
    lines += [_summary(table) for table in rig.tables]
    lines += [f"{table.label}: {line}" for table in rig.tables for line in kinds[table.kind].describe(table)]
    findings = (*lint(rig, kinds, rig.tables), *lint_settings(rig, kinds, rough_values(rig, kinds)))
    messages = messages_of(kinds)
    lines += [f"{finding.level}: {finding_text(finding, messages)}" for finding in findings]
    say("\n".join([*lines, _number(len(findings))]))
    return 0


def _number(findings: int) -> str:
    """Number of findings in words."""
    return {0: "no findings", 1: "1 finding"}.get(findings, f"{findings} findings")


def _summary(table: Table) -> str:
    """Kind, label, rows, columns and sampling of one experiment."""
    columns = ", ".join(f"{column.name} [{column.unit}]" for column in table.columns.values())
    text = f"{table.kind} {table.label}: {len(table.rows)} rows of {columns}"
    if "time" not in table.columns:
        return text
    try:
        return f"{text}, {1.0 / sampling_step(table['time']):.6g} Hz"
    except InputError:
        return f"{text}, unevenly sampled"
