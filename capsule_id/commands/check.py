"""``capsule-id check DATA``: read a rig folder, describe it, list findings before a fit; fits nothing."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from capsule_id.commands import PATH, rig_folders
from capsule_id.console import say
from capsule_id.errors import InputError, refusing
from capsule_id.experiments.kind import default_registry, rough_values
from capsule_id.experiments.lint import lint, lint_settings
from capsule_id.output import write_file
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.filters import sampling_step
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.read import read_rig
from capsule_id.views import Finding, counted

OPTIONS = {
    "": (
        ("data", "DATA", "rig folder, with its rig.toml (default: this folder)", {"nargs": "?"}),
        ("--figures", "DIR", "draw every experiment with its findings into DIR", PATH),
    )
}


def run(args: argparse.Namespace) -> int:
    """Print a line per experiment and per finding to standard output; 0.

    Raises
    ------
    InputError
        If the folder is not a valid rig, or DIR cannot be written.
    """
    kinds = default_registry()
    rig = read_rig(rig_folders([args.data] if args.data is not None else [])[0], kinds)
    lines = [f"{rig.name}: {counted(len(rig.tables), 'experiment')}{', SYNTHETIC data' if rig.synthetic else ''}"]
    lines += [_summary(table) for table in rig.tables]
    lines += [f"{table.label}: {line}" for table in rig.tables for line in kinds[table.kind].describe(table)]
    findings = (*lint(rig, kinds, rig.tables), *lint_settings(rig, kinds, rough_values(rig, kinds)))
    messages = messages_of(kinds)
    lines += [f"{finding.level}: {finding_text(finding, messages)}" for finding in findings]
    if args.figures is not None:
        lines += _draw(rig, findings, args.figures)
    say("\n".join([*lines, counted(len(findings), "finding") if findings else "no findings"]), coloured=True)
    return 0


def _draw(rig: Rig, findings: Sequence[Finding], folder: Path) -> list[str]:
    """Write a PNG file per experiment into ``folder``; return a line that says so.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    from capsule_id.report.figures.fits import readings_figure
    from capsule_id.report.figures.style import mark, own_style, png

    with refusing("--figures DIR must be writable", "name another one", folder), own_style():
        folder.mkdir(parents=True, exist_ok=True)
        for table in rig.tables:
            figure = readings_figure(table, [found for found in findings if found.experiment == table.label])
            if rig.synthetic:
                mark(figure, "SYNTHETIC")
            write_file(folder / f"{table.label}.png", png(figure))
    return [f"figures: {len(rig.tables)} in {folder}"]


def _summary(table: Table) -> str:
    """Kind, label, rows, columns and sampling of one experiment."""
    columns = ", ".join(f"{column.name} [{column.unit}]" for column in table.columns.values())
    text = f"{table.kind} {table.label}: {counted(len(table.rows), 'row')} of {columns}"
    dropped = [
        f"{counted(number, 'row')} {why}"
        for number, why in (
            (table.other, "outside where"),
            (table.missing, "with a missing reading"),
            (table.rejected, "with an outlier"),
        )
        if number
    ]
    text += f" ({' and '.join(dropped)} not used)" if dropped else ""
    if "time" not in table.columns:
        return text
    try:
        return f"{text}, {1.0 / sampling_step(table['time']):.6g} Hz"
    except InputError:
        return f"{text}, unevenly sampled"
