"""``capsule-id check DATA``: read a rig folder, describe it, list findings before a fit; fits nothing."""

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from capsule_id.commands import PATH, rig_folders
from capsule_id.console import say
from capsule_id.errors import InputError, refusing
from capsule_id.experiments.kind import default_registry, rough_values
from capsule_id.experiments.lint import lint, lint_settings
from capsule_id.output import write_file
from capsule_id.report.messages import finding_text, messages_of, title_of
from capsule_id.rig.filters import sampling_step
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.read import read_rig
from capsule_id.views import Finding, Message, counted

OPTIONS = {
    "": (
        ("data", "DATA", "rig folder, with its rig.toml (default: this folder)", {"nargs": "?"}),
        ("--figures", "DIR", "draw every experiment with its findings into DIR", PATH),
        ("--json", "", "print rig, tables, findings and errors as JSON"),
    )
}


#: Name and version of the form of ``--json``; it may gain keys, and no key changes or goes without another version.
FORMAT = "capsule-id check 1"


def run(args: argparse.Namespace) -> int:
    """Print a line per experiment and per finding to standard output, or everything as JSON; 0.

    Raises
    ------
    InputError
        If the folder is not a valid rig, or DIR cannot be written.
    """
    try:
        say(_checked(args), coloured=not args.json)
    except InputError as error:
        if args.json:
            faults = [_problem(each, "input", "error") for each in getattr(error, "errors", (error,))]
            say(_as_json(errors=faults))
        raise
    return 0


def _checked(args: argparse.Namespace) -> str:
    """Read and judge the rig; the text to print. Errors as of ``run``."""
    kinds = default_registry()
    rig = read_rig(rig_folders([args.data] if args.data is not None else [])[0], kinds)
    findings = (*lint(rig, kinds, rig.tables), *lint_settings(rig, kinds, rough_values(rig, kinds)))
    messages = messages_of(kinds)
    drawn = _draw(rig, findings, args.figures) if args.figures is not None else []
    if args.json:
        tables, told = [_columns(table) for table in rig.tables], [_told(each, rig, messages) for each in findings]
        return _as_json(rig=rig.name, synthetic=rig.synthetic, tables=tables, findings=told)
    return "\n".join(
        [
            f"{rig.name}: {counted(len(rig.tables), 'experiment')}{', SYNTHETIC data' if rig.synthetic else ''}",
            *map(_summary, rig.tables),
            *(f"{table.label}: {line}" for table in rig.tables for line in kinds[table.kind].describe(table)),
            *(f"{finding.level}: {finding_text(finding, messages)}" for finding in findings),
            *drawn,
            counted(len(findings), "finding") if findings else "no findings",
        ]
    )


def _as_json(**content: Any) -> str:
    """The text of ``--json``; ``content`` holds some of its keys."""
    empty = {"format": FORMAT, "rig": None, "synthetic": None, "tables": [], "findings": [], "errors": []}
    return json.dumps(empty | content, indent=1, ensure_ascii=False, allow_nan=False)


def _columns(table: Table) -> dict[str, Any]:
    """A table for ``--json``."""
    return {
        **{key: getattr(table, key) for key in ("label", "kind", "file", "missing", "rejected")},
        "rows": len(table.rows),
        "columns": {column.name: column.unit for column in table.columns.values()},
    }


def _told(finding: Finding, rig: Rig, messages: Mapping[str, Message]) -> dict[str, Any]:
    """A finding for ``--json``: the first sentence of its text says what was found, the others what to do."""
    table = next((table for table in rig.tables if table.label == finding.experiment), None)
    line, text = finding.facts.get("line"), finding_text(finding, messages)
    value, *remedy = re.split(r"(?<=\.)\s+(?=[A-Z])", text, maxsplit=1)
    file = str(rig.folder / str(finding.facts.get("file", table.file if table else "rig.toml")))
    place = file, line if isinstance(line, int) else None
    told = InputError(title_of(finding.code, messages), value, " ".join(remedy), *place)
    return _problem(told, finding.code, finding.level) | {
        "experiment": finding.experiment,
        "parameters": list(finding.parameters),
        "text": text,
    }


def _problem(told: InputError, code: str, level: str) -> dict[str, Any]:
    """An error, or what is told of a finding in the form of one, for ``--json``."""
    parts = {key: getattr(told, key) for key in ("file", "line", "column", "rule", "value", "remedy")}
    return {"code": code, "level": level, "experiment": "", "parameters": [], **parts, "text": str(told)}


def _draw(rig: Rig, findings: Sequence[Finding], folder: Path) -> list[str]:
    """Write a PNG file per experiment into ``folder``; return a line that says so.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    from capsule_id.report.figures import fits, style

    with refusing("--figures DIR must be writable", "name another one", folder), style.own_style():
        folder.mkdir(parents=True, exist_ok=True)
        for table in rig.tables:
            figure = fits.readings_figure(table, [found for found in findings if found.experiment == table.label])
            if rig.synthetic:
                style.mark(figure, "SYNTHETIC")
            write_file(folder / f"{table.label}.png", style.png(figure))
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
