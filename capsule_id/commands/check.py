"""``capsule-id check DATA``: read a rig folder, say what stands in it and what to mind; fits nothing."""

import argparse

from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.records.run_description import describe_run, run_warning
from capsule_id.rig.filters import sampling_step
from capsule_id.rig.lint import lint
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.read import read_rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """DATA."""
    parser.add_argument("data", metavar="DATA", help="rig folder, with its rig.toml")


def run(args: argparse.Namespace) -> int:
    """Print a line per experiment and per finding to standard output; 0.

    Raises
    ------
    InputError
        If the folder is no valid rig.
    """
    rig = read_rig(args.data)
    lines = [f"{rig.name}: {len(rig.tables)} experiments{', SYNTHETIC data' if rig.synthetic else ''}"]
    lines += [_summary(table) for table in rig.tables]
    runs = [table for table in rig.tables if table.kind == "forced_run"]
    lines += [f"{table.label}: {line}" for table in runs for line in describe_run(table)]
    warnings = {table.label: run_warning(table) for table in runs}
    findings = [*lint(rig), *_feasibility(rig)]
    findings += [f"{label}: {text}" for label, text in warnings.items() if text]
    lines += [f"lint: {finding}" for finding in findings]
    say("\n".join([*lines, f"{len(findings)} findings" if findings else "no findings"]))
    return 0


def _feasibility(rig: Rig) -> list[str]:
    """What the settings of forced runs cannot do, a line each; the physics is loaded where there are such runs only."""
    if not any(table.kind == "forced_run" for table in rig.tables):
        return []
    from capsule_id.experiments.rough_values import lint_runs

    return [finding.text for finding in lint_runs(rig)]


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
