"""The page: one self-contained HTML file, figures embedded, no script, nothing loaded from elsewhere."""

import base64
import math
import numbers
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from capsule_id.inference.result import Result
from capsule_id.report.gallery import Picture
from capsule_id.report.rows import table_rows
from capsule_id.report.typography import MISSING, symbol_parts
from capsule_id.views import Finding, Level, NoteTable

_TEMPLATES = Path(__file__).with_name("templates")
_WORST_FIRST: tuple[Level, ...] = ("fail", "warn", "ok")
_WORDS: Mapping[Level, str] = {"ok": "✓ ok", "warn": "! warning", "fail": "✗ failed"}


def render(result: Result, pictures: Sequence[Picture]) -> str:
    """The page for ``result``; ``pictures`` as ``gallery.pictures`` draws them. The same input gives the same text."""
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"symbol_parts": symbol_parts, "number": _number, "embed": _embed}
    return environment.get_template("report.html.j2").render(
        result=result,
        sections={name: _section(pictures, name) for name in ("measured", "sample", "point_fit")},
        parameters=table_rows(result.summary),
        nuisances=table_rows(result.nuisances),
        checks=_checks(result.findings),
        findings=sorted(result.findings, key=lambda finding: _WORST_FIRST.index(finding.level)),
        words=_WORDS,
        failed=list(dict.fromkeys(finding.check for finding in result.findings if finding.level == "fail")),
        starts=_starts(result),
        notes=[_note(note) for note in result.notes],
        facts={key: value for key, value in result.provenance.items() if not isinstance(value, Mapping)},
        tables={key: value for key, value in result.provenance.items() if isinstance(value, Mapping)},
        missing=MISSING,
    )


def _section(pictures: Sequence[Picture], name: str) -> list[Picture]:
    """Narrow pictures first: they go in pairs, and a wide one between them leaves a gap."""
    return sorted((picture for picture in pictures if picture.section == name), key=lambda picture: picture.wide)


def _checks(findings: Sequence[Finding]) -> list[tuple[str, Level, int]]:
    """A cell per check: its name, its worst level, and how many findings have that level."""
    cells = []
    for check in dict.fromkeys(finding.check for finding in findings):
        levels = [finding.level for finding in findings if finding.check == check]
        worst = min(levels, key=_WORST_FIRST.index)
        cells.append((check, worst, levels.count(worst)))
    return cells


def _starts(result: Result) -> list[tuple[int, str, str, bool]]:
    """Number, log-posterior at the end, how far that is below the best, and whether the solver stalled."""
    fit = result.point_fit
    best = max((float(value) for value in fit.log_posterior if not math.isnan(value)), default=math.nan)
    return [
        (i, _number(float(value), ".8g"), _number(best - float(value), ".2g"), bool(stalled))
        for i, (value, stalled) in enumerate(zip(fit.log_posterior, fit.stalled, strict=True), start=1)
    ]


def _note(note: NoteTable) -> dict[str, object]:
    frame = note.frame
    named = not isinstance(frame.index, pd.RangeIndex)
    header = [(str(frame.index.name or ""), False)] if named else []
    numeric = [pd.api.types.is_numeric_dtype(kind) for kind in frame.dtypes]
    header += [(str(column), number) for column, number in zip(frame.columns, numeric, strict=True)]
    rows = [
        ([index] if named else []) + list(row)
        for index, row in zip(frame.index, frame.itertuples(index=False), strict=True)
    ]
    return {"title": note.title, "caption": note.caption, "header": header, "rows": rows}


def _number(value: object, form: str = ".5g") -> str:
    """A cell: numbers with a true minus sign, a dash for what is missing, everything else as it is."""
    if value is None or value is pd.NA:
        return MISSING
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return MISSING if math.isnan(value) else format(float(value), form).replace("-", "−")
    return str(value)


def _embed(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii")
