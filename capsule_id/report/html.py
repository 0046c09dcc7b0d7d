"""The page: one self-contained HTML file, figures embedded, one small script, nothing loaded from elsewhere."""

import base64
import math
import numbers
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from capsule_id.inference.result import Result
from capsule_id.parameters import is_stated
from capsule_id.report.columns import Output, columns_of, skewed_names, table_rows
from capsule_id.report.console_table import verdict_text
from capsule_id.report.gallery import Picture
from capsule_id.report.texts.advice import next_steps
from capsule_id.report.texts.citation import AUTHORS, PUBLISHED, TITLE, bibtex, latex_table, methods_paragraph
from capsule_id.report.texts.messages import caption_of, finding_text, messages_of, title_of
from capsule_id.report.texts.terms import OF_A_SAMPLE, TERMS
from capsule_id.report.typography import MISSING, fixed, symbol_parts
from capsule_id.views import Finding, Level, Message, ResultTable, counted

_TEMPLATES = Path(__file__).with_name("templates")
_WORST_FIRST: tuple[Level, ...] = ("fail", "warn", "ok")
#: Largest number of figures of experiments that are open at first; those of the sample and the point fit add 3.
MOST_OPEN = 9
_WORDS: Mapping[Level, str] = {"ok": "✓ ok", "warn": "! warning", "fail": "✗ failed"}


def render(result: Result, pictures: Sequence[Picture]) -> str:
    """The page for ``result``; ``pictures`` as ``gallery.pictures`` draws them. The same input gives the same text."""
    messages = messages_of(result.registry)
    worst_first = sorted(result.findings, key=lambda finding: _WORST_FIRST.index(finding.level))
    titles = {finding.code: title_of(finding.code, messages) for finding in result.findings}
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            result=result,
            answers=_answers(result),
            steps=next_steps(result),
            skewed=skewed_names(result.summary),
            experiments=_experiments(result, pictures),
            sections={name: _section(pictures, name) for name in ("sample", "point_fit")},
            parameters=_parameters(result.summary),
            nuisances=_parameters(result.nuisances),
            checks=_checks(result.findings, titles),
            findings=[(finding, titles[finding.code], finding_text(finding, messages)) for finding in worst_first],
            words=_WORDS,
            verdict=verdict_text(
                result.trust,
                sorted({titles[finding.code] for finding in result.findings if finding.level == "fail"}),
                sum(finding.level == "warn" for finding in result.findings),
            ),
            starts=_starts(result),
            notes=[_note(note, messages) for note in result.notes],
            terms={term: TERMS[term] for term in TERMS if result.posterior or term not in OF_A_SAMPLE},
            missing=MISSING,
            authors=AUTHORS,
            title=TITLE,
            published=PUBLISHED,
            copies=(
                ("methods", "Methods paragraph", methods_paragraph(result)),
                ("bibtex", "BibTeX", bibtex(result)),
                ("latex", "LaTeX table", latex_table(result)),
            ),
        )
    )


def _answers(result: Result) -> list[dict[str, str]]:
    """The rows of the first screen: name, value ± sd with its unit, interval, trust, truth; stated quantities last."""
    rows = sorted(table_rows(result.summary), key=lambda row: is_stated(row.name))
    columns = {column.key: column for column in columns_of("html", result.summary)}
    answers = []
    for row in rows:
        unit = "" if row.unit == "1" else f" {row.unit}"
        truth, sd = result.truth.get(row.name), float(row.values["sd"])
        known = MISSING if truth is None else fixed(truth * row.scale, row.decimals)
        if truth is not None and sd > 0.0:
            known += f" ({(float(row.values['value']) - truth) / sd:+.1f} sd)".replace("-", "−")
        answers.append(
            {
                "name": row.name,
                "meaning": str(row.values["meaning"]),
                "value": row.quoted + unit,
                "interval": columns["ci95"].text(row) if "ci95" in columns else MISSING,
                "trust": str(row.values["trust"]),
                "truth": known,
            }
        )
    return answers


def _experiments(result: Result, pictures: Sequence[Picture]) -> list[dict[str, object]]:
    """One entry per experiment: label, worst level of its findings, pictures, whether it is open at first.

    Experiments with a failure or a warning are open, as long as fewer than ``MOST_OPEN`` figures are.
    """
    measured = [picture for picture in pictures if picture.section == "measured"]
    shared = {picture.group for picture in measured}.difference(table.label for table in result.rig.tables)
    named: dict[str, Level] = {}
    for level in reversed(_WORST_FIRST):
        found = [finding for finding in result.findings if finding.level == level]
        named |= {label: level for label in (finding.code.partition(".")[0] for finding in found) if label in shared}
        named |= {finding.experiment: level for finding in found}
    entries, shown = [], 0
    for group in dict.fromkeys(picture.group for picture in measured):
        own = sorted((picture for picture in measured if picture.group == group), key=lambda picture: picture.wide)
        level = named.get(group, "ok")
        is_open = level != "ok" and shown + len(own) <= MOST_OPEN
        shown += len(own) if is_open else 0
        entries.append({"label": group, "level": level, "pictures": own, "open": is_open})
    return entries


def summary_html(result: Result, verdict: str, changes: Sequence[str]) -> str:
    """Verdict, changes of the model (texts of the findings that make them) and parameter table, for a notebook."""
    table = _parameters(result.summary, "console")
    return (
        _environment()
        .get_template("summary.html.j2")
        .render(result=result, changes=changes, verdict=verdict, table=table, missing=MISSING)
    )


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "symbol_parts": symbol_parts,
        "number": _number,
        "embed": lambda picture: "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii"),
        "counted": counted,
    }
    return environment


def _section(pictures: Sequence[Picture], name: str) -> list[Picture]:
    """Narrow pictures first: they go in pairs, and a wide one between them leaves a gap."""
    return sorted((picture for picture in pictures if picture.section == name), key=lambda picture: picture.wide)


def _parameters(frame: pd.DataFrame, output: Output = "html") -> dict[str, object]:
    """Columns, and rows of name and printed cells."""
    columns = columns_of(output, frame)
    rows = [(row.name, [(column, column.text(row)) for column in columns]) for row in table_rows(frame)]
    return {"columns": columns, "rows": rows}


def _checks(findings: Sequence[Finding], titles: Mapping[str, str]) -> list[tuple[str, Level, int]]:
    """A cell per check: its title, its worst level, and how many findings have that level."""
    cells = []
    for check in dict.fromkeys(titles[finding.code] for finding in findings):
        levels = [finding.level for finding in findings if titles[finding.code] == check]
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


def _note(note: ResultTable, messages: Mapping[str, Message]) -> dict[str, object]:
    frame = note.frame
    named = not isinstance(frame.index, pd.RangeIndex)
    header = [(str(frame.index.name or ""), False)] if named else []
    numeric = [pd.api.types.is_numeric_dtype(kind) for kind in frame.dtypes]
    header += [(str(column), number) for column, number in zip(frame.columns, numeric, strict=True)]
    rows = [
        ([index] if named else []) + list(row)
        for index, row in zip(frame.index, frame.itertuples(index=False), strict=True)
    ]
    title, caption = title_of(note.code, messages), caption_of(note, messages)
    return {"title": title, "caption": caption, "header": header, "rows": rows}


def _number(value: object, form: str = ".5g") -> str:
    """A cell: numbers with a true minus sign, a dash for what is missing, everything else as it is."""
    if value is None or value is pd.NA:
        return MISSING
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return MISSING if math.isnan(value) else format(float(value), form).replace("-", "−")
    return str(value)
