"""``capsule-id report DIR``: prints table and findings of a result from its parameters.json."""

import argparse
import json
import math
from typing import Any

from capsule_id.commands import PATH
from capsule_id.console import refusing_damage, say

OPTIONS = {
    "": (
        ("directory", "DIR", "result directory of fit-params", PATH),
        ("--json", "", "print parameters.json instead of the table"),
    )
}


def run(args: argparse.Namespace) -> int:
    """Print the parameter table and the findings; return 0 for a clean verdict, else 3.

    Raises
    ------
    InputError
        If DIR holds no result.
    """
    path = args.directory / "parameters.json"
    remedy = "run fit-params again" if path.is_file() else "run fit-params first"
    with refusing_damage("DIR must be a result of fit-params", remedy, path):
        text = path.read_text(encoding="utf-8")
        shown, clean = _shown(json.loads(text))
    say(text.rstrip() if args.json else shown)
    return 0 if clean else 3


def _shown(saved: dict[str, Any]) -> tuple[str, bool]:
    """Table and findings, and whether the verdict is clean.

    Raises
    ------
    Exception
        Of any kind, if a part is missing or of another type.
    """
    import pandas as pd

    from capsule_id.report.columns import table_text, verdict_text

    findings, clean, synthetic = saved["verdict"]["findings"], saved["verdict"]["clean"], saved["synthetic"]
    if not (isinstance(clean, bool) and isinstance(synthetic, bool)):
        raise TypeError("verdict.clean and synthetic must be true or false")
    rows = {name: _row(entry) for name, entry in saved["parameters"].items()}
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("name")
    texts = (f"{finding['level']:4} {finding['check']}: {finding['text']}" for finding in findings)
    verdict = verdict_text(saved["trust"], [(finding["level"], finding["check"]) for finding in findings])
    return "\n".join([table_text(frame, synthetic=synthetic), *texts, verdict]), clean


def _row(entry: dict[str, Any]) -> dict[str, Any]:
    """One row of the parameter table. The file has no standard error of the point fit."""
    lower, upper = entry["ci95"] or (None, None)
    row = {"quote": "sd", "meaning": "", "standard_error": None, **entry, "lower": lower, "upper": upper}
    return {key: math.nan if value is None else value for key, value in row.items()}
