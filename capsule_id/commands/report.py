"""``capsule-id report DIR``: prints table and findings of a result from its parameters.json, or compares several."""

import argparse
import json
import math
import string
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from capsule_id.commands import PATH
from capsule_id.console import refusing_damage, say
from capsule_id.errors import InputError
from capsule_id.views import counted

if TYPE_CHECKING:
    import pandas as pd

#: Most results of one table: each has a letter.
MOST = len(string.ascii_uppercase)

OPTIONS = {
    "": (
        (
            "directory",
            "DIR",
            "result directory of fit-params; several: one table, with the differences",
            {**PATH, "nargs": "+"},
        ),
        ("--json", "", "print parameters.json instead of the table"),
    )
}


def run(args: argparse.Namespace) -> int:
    """Print the parameter table and the findings, or a table of several results; return 0 for clean verdicts, else 3.

    Raises
    ------
    InputError
        If DIR holds no result, or several are to be printed as JSON.
    """
    if args.json and len(args.directory) > 1:
        raise InputError("--json is for one result", counted(len(args.directory), "result"), "name one of them")
    if len(args.directory) > MOST:
        raise InputError(f"at most {MOST} results fit side by side", str(len(args.directory)), "name fewer")
    results = []
    for directory in args.directory:
        path = directory / "parameters.json"
        remedy = "run fit-params again" if path.is_file() else "run fit-params first"
        with refusing_damage("DIR must be a result of fit-params", remedy, path):
            text = path.read_text(encoding="utf-8")
            results.append(_read(json.loads(text)))
            shown = text.rstrip() if args.json else results[0].text
    if len(results) > 1:
        shown = _side_by_side([str(directory) for directory in args.directory], results)
    say(shown, coloured=not args.json)
    return 0 if all(result.clean for result in results) else 3


class _Saved(NamedTuple):
    """What a parameters.json says: its table and findings as text, the SHA-256 of its files by name."""

    summary: "pd.DataFrame"
    text: str
    verdict: str
    clean: bool
    files: Mapping[str, str]


def _read(saved: dict[str, Any]) -> _Saved:
    """The parts of a parameters.json.

    Raises
    ------
    Exception
        Of any kind, if a part is missing or of another type.
    """
    import pandas as pd

    from capsule_id.report.columns import SYNTHETIC, table_text, verdict_text

    findings, clean, synthetic = saved["verdict"]["findings"], saved["verdict"]["clean"], saved["synthetic"]
    if not (isinstance(clean, bool) and isinstance(synthetic, bool)):
        raise TypeError("verdict.clean and synthetic must be true or false")
    rows = {name: _row(entry) for name, entry in saved["parameters"].items()}
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("name")
    texts = (f"{finding['level']:4} {finding['check']}: {finding['text']}" for finding in findings)
    verdict = verdict_text(saved["trust"], [(finding["level"], finding["check"]) for finding in findings])
    text = "\n".join([table_text(frame, synthetic=synthetic), *texts, *saved.get("not_in_sd", ()), verdict])
    marked = f"{verdict}; {SYNTHETIC.strip('* ')}" if synthetic else verdict
    return _Saved(frame, text, marked, clean, saved["provenance"]["files"])


def _side_by_side(names: Sequence[str], results: Sequence[_Saved]) -> str:
    """One table of all results, then the name and the verdict of each, and how many files it shares with the first."""
    from capsule_id.report.columns import table_side_by_side, wrapped

    first, lines = {*results[0].files.values()}, []
    for letter, name, result in zip(string.ascii_uppercase, names, results, strict=False):
        same = [file for file, own in result.files.items() if own in first and letter != "A"]
        shared = f"; it shares {counted(len(same), 'file')} with A, so that its differences in sd are too small"
        lines.append(f"{letter}: {name}: {result.verdict}{shared if same else ''}")
    return "\n".join([table_side_by_side([result.summary for result in results]), *wrapped(lines)])


def _row(entry: dict[str, Any]) -> dict[str, Any]:
    """One row of the parameter table. The file has no standard error of the point fit."""
    lower, upper = entry["ci95"] or (None, None)
    row = {"quote": "sd", "meaning": "", "standard_error": None, **entry, "lower": lower, "upper": upper}
    return {key: math.nan if value is None else value for key, value in row.items()}
