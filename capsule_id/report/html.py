"""The page: one self-contained HTML file with all pictures of a result, nothing loaded from elsewhere."""

import base64
import math
import numbers
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from capsule_id.console import stop_if_interrupted
from capsule_id.experiments.kind import select_tables
from capsule_id.inference.result import STATED, Result
from capsule_id.parameters import QUANTILE_975, Name, is_stated, symbol_of
from capsule_id.records.motion import UNDECIDED
from capsule_id.records.view import RunRecord
from capsule_id.report.columns import (
    MISSING,
    SampledParameters,
    errors_left_out,
    fixed,
    printed_table,
    sampled_parameters,
    skewed_names,
    symbol_parts,
    table_rows,
    verdict_text,
)
from capsule_id.report.figures import fits as figures
from capsule_id.report.figures.style import figure_of, new_axes, new_figure, png, svg
from capsule_id.report.messages import (
    OF_A_SAMPLE,
    TERMS,
    TRUST,
    caption_of,
    finding_text,
    messages_of,
    question_of,
    title_of,
)
from capsule_id.views import Comparison, Finding, Level, Message, ResultTable, after_number, counted

# gallery: All pictures of a result, drawn once: the page embeds the same bytes as in ``figures/``.


_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
# Characters of a file's name from a label, which may be longer than a name.
_LONGEST = 80
# Wider than this (CSS pixels) does not go in pairs.
_HALF_PAGE = 650
#: Tables of one kind of panel that are drawn; of more, those with findings or the largest residuals.
MOST_TABLES = 24
#: Symbols of the sketch of the rig.
SKETCHED = ("m1", "m2", "k1", "c", "k2", "G", "mu")


Part = Literal["measured", "sample", "point_fit"]


@dataclass(frozen=True)
class Picture:
    """A drawn figure.

    Attributes
    ----------
    name : file name without suffix, safe and unique within the result
    section : "measured", "sample" or "point_fit"
    title, caption : plain text
    width, height : of the page's picture, CSS pixels
    png, svg : the file, and the picture of the page where it is none of many points
    alt : what is seen, for readers who do not see it
    group : label of the experiment, "" for figures of the whole fit
    """

    name: str
    section: Part
    title: str
    caption: str
    width: int
    height: int
    png: bytes
    alt: str = ""
    group: str = ""
    svg: bytes = b""

    @property
    def wide(self) -> bool:
        """Whether the picture takes the whole width of the page."""
        return self.width > _HALF_PAGE


#: Name, section, title, caption, figure, alternative text and group of a picture.
Drawing = tuple[str, Part, str, str, Figure, str, str]


def pictures(result: Result) -> tuple[Picture, ...]:
    """Draw every figure of the result; synthetic data are marked on each of them."""
    drawn = []
    for name, section, title, caption, figure, alt, group in drawings(result):
        stop_if_interrupted()
        width, height = (round(96 * inches) for inches in figure.get_size_inches())
        file = png(figure, result.rig.synthetic)
        drawn.append(Picture(name, section, title, caption, width, height, file, alt, group, svg(figure, len(file))))
    return tuple(drawn)


def drawings(result: Result) -> Iterator[Drawing]:
    """The table of the figures: those of the comparisons, of the records, of the sample, of the point fit."""
    labels = [
        item.label if item.label.startswith(item.kind) else f"{item.kind}_{item.label}" for item in result.comparisons
    ]
    groups = [(item.kind, _group(result, item.label)) for item in result.comparisons]
    numbers, worst = Counter(kind for kind, _ in {*groups}), worst_tables(result)
    for name, item, (_, group) in zip(_unique(labels), result.comparisons, groups, strict=True):
        if group not in worst[item.kind]:
            continue
        caption, figure = comparison_caption(item, result.registry.captions), figures.comparison_figure(item)
        if (number := numbers[item.kind]) > MOST_TABLES:
            caption += (
                f" Drawn are the {MOST_TABLES} of {number} such tables with findings or the largest residuals; "
                "plot_comparison draws any."
            )
        yield name, "measured", item.title, caption, figure, comparison_alt(item), group
    labels = _unique(record.name for record in result.records)
    for label, record in zip(labels, result.records, strict=True):
        yield from _drawings_of_record(record, label, _group(result, record.name))
    if result.posterior is not None:
        columns = sampled_parameters(result)
        caption = "Posterior of the physical parameters: histograms, and contours of every pair."
        figures.corner(columns, figure := new_figure(*figures.corner_size(columns)))
        yield "corner", "sample", "Corner plot", caption, figure, _corner_alt(columns), ""
        ensembles = counted(len(result.posterior.draws), "ensemble")
        caption = f"A few walkers of each ensemble, one colour per ensemble ({ensembles})."
        alt = f"Traces of every physical parameter, {ensembles}; the largest split R-hat is {max(result.posterior.rhat):.4f}."
        figures.traces(columns, figure := new_figure(*figures.traces_size(columns)))
        yield "traces", "sample", "Traces", caption, figure, alt, ""
    profiles = [note for note in result.notes if note.code == "parameters.profile"]
    for name, note in zip(_unique(f"profile_{n.facts['name']}" for n in profiles), profiles, strict=True):
        caption = caption_of(note, messages_of(result.registry))
        alt = (
            f"Profile likelihood of {note.facts['name']}: 95 % interval {note.facts['lower']} to {note.facts['upper']}."
        )
        figures.profile(note, ax := new_axes(4.6, 3.4))
        yield name, "point_fit", f"Profile likelihood of {note.facts['name']}", caption, figure_of(ax), alt, ""
    fit = result.point_fit
    caption = "Where each start began and where it ended, in posterior standard deviations from its curvature."
    alt = f"{counted(len(fit.starts), 'start')}; {int(fit.at_other_maximum.sum())} ended at another maximum than the best."
    ax = new_axes(*figures.starts_size(fit), left=2.6, bottom=0.7, top=0.6)
    figures.point_fit_starts(fit, ax)
    yield "point_fit_starts", "point_fit", "Starts of the point fit", caption, figure_of(ax), alt, ""


def worst_tables(result: Result) -> dict[str, set[str]]:
    """Labels of the tables whose panels are drawn, by kind of panel: those with findings, then the largest residuals."""
    places = sorted(((_WORST_FIRST.index(one.level), one.experiment) for one in result.findings), reverse=True)
    found, largest_of = {label: place for place, label in places}, defaultdict[str, dict[str, float]](dict)
    for item in result.comparisons:
        label, own = _group(result, item.label), largest_of[item.kind]
        largest = 0.0 if item.residuals is None else float(np.max(np.abs(item.residuals), initial=0.0))
        own[label] = max(own.get(label, 0.0), largest)
    return {
        kind: {*sorted(own, key=lambda label: (found.get(label, len(_WORST_FIRST)), -own[label]))[:MOST_TABLES]}
        for kind, own in largest_of.items()
    }


def _group(result: Result, label: str) -> str:
    """The table that a panel belongs to, by the longest label that begins it; the panel's own label for shared ones."""
    own = [table.label for table in result.rig.tables if label == table.label or label.startswith(f"{table.label}_")]
    return max(own, key=len, default=label)


def _drawings_of_record(record: RunRecord, label: str, group: str) -> Iterator[Drawing]:
    """The record as the paper draws it (its Figs. 4 and 9); ``label`` is safe and unique."""
    view, contact = record.view, record.view.at_contact
    left = f"{100.0 * view.at_drive.rate:.0f} % of a rate at the drive's frequency" + (
        f" and {100.0 * contact.rate:.0f} % at that of the contacts ({contact.f:.3g} Hz)" if contact else ""
    )
    caption = (
        "The record itself: raw channels, and the phase plane through Savitzky–Golay with the impact line and a point a "
        f"period. The filter ({view.samples} samples) leaves {left}."
    )
    word = view.label if view.label == UNDECIDED else f"{view.label} (probability {view.probability:.2g})"
    alt = (
        f"{len(view.time)} samples of {', '.join(view.channels)} over {view.time[-1] - view.time[0]:.3g} s; x_rel from "
        f"{1e3 * view.x_rel.min():.3g} to {1e3 * view.x_rel.max():.3g} mm; {len(view.section_x_rel)} points, one a period."
    )
    figures.overview(view, figure := new_figure(*figures.overview_size(view)))
    yield f"record_{label}", "measured", f"{record.name}: the record, {word}", caption, figure, alt, group
    if view.force is not None:
        figures.force_on_rod(record, ax := new_axes())
        caption = (
            "Force on the rod (the paper's Fig. 4d): K times the recorded current, and the drive of the fitted model."
        )
        misses = float(np.std(view.force - record.force))
        alt = f"Force between {view.force.min():.3g} and {view.force.max():.3g} N; the model differs by {misses:.2g} N (rms)."
        yield f"force_{label}", "measured", f"{record.name}: force on the rod", caption, figure_of(ax), alt, group


def comparison_alt(item: Comparison) -> str:
    """What the panel shows, in numbers: how many readings over which range, and how far the model misses them."""
    readings = [points for points in item.points if points.x.size]
    parts = [f"{item.y_label} against {item.x_label}"]
    if readings:
        x = np.concatenate([points.x for points in readings])
        parts.append(f"{counted(x.size, 'reading')} from {np.nanmin(x):.3g} to {np.nanmax(x):.3g}")
    parts.append(f"curves: {', '.join(curve.label for curve in item.curves)}" if item.curves else "no curve")
    if item.residuals is not None and item.residuals.size:
        size = np.abs(item.residuals)
        inside = np.mean(size <= QUANTILE_975)
        parts.append(f"{100.0 * inside:.0f} % of the residuals within ±1.96 sd, the largest {np.max(size):.2g} sd")
    flagged = sum(int(points.flagged.sum()) for points in item.points if points.flagged is not None)
    parts += [f"{flagged} rows flagged by a check"] if flagged else []
    return "; ".join(parts) + "."


def _corner_alt(columns: SampledParameters) -> str:
    """Number of parameters and the strongest correlation."""
    names, flat = columns.names, columns.draws.reshape(-1, len(columns.names))
    if len(names) < 2 or not np.all(np.std(flat, axis=0) > 0.0):
        return f"Histograms of {counted(len(names), 'parameter')}."
    correlation = np.triu(np.corrcoef(flat.T), 1)
    i, j = np.unravel_index(np.argmax(np.abs(correlation)), correlation.shape)
    strongest = f"strongest correlation {correlation[i, j]:.2f}, of {names[i]} with {names[j]}"
    return f"Histograms of {len(names)} parameters and contours of their pairs; {strongest}."


def comparison_caption(item: Comparison, captions: Mapping[str, str]) -> str:
    """What the panel shows, and its posterior predictive p-value where there is one."""
    flagged = any(points.flagged is not None and points.flagged.any() for points in item.points)
    p = item.predictive_p
    parts = (
        (True, captions.get(item.kind, "Measured beside predicted.")),
        (figures.period_of(item), "Above: the range in each period, and the periods with the largest residuals."),
        (item.residuals is not None, "Shaded: the range that holds 95 % of a good fit's residuals."),
        (flagged, "Framed rows are flagged by a check; they stay in the fit."),
        (p is not None, f"Posterior predictive p = {p or 0.0:.2g} (chi-square discrepancy)."),
    )
    return " ".join(words for holds, words in parts if holds)


def _unique(labels: Iterable[str]) -> list[str]:
    """Names of files: safe, numbered where they would overwrite another picture (also where case is ignored)."""
    taken, unique = {"corner", "traces", "point_fit_starts"}, list[str]()
    for name in (_UNSAFE.sub("_", label)[:_LONGEST] for label in labels):
        candidates = chain([name], (f"{name}_{number}" for number in count(2)))
        unique.append(next(candidate for candidate in candidates if candidate.lower() not in taken))
        taken.add(unique[-1].lower())
    return unique


# html: The page: one self-contained HTML file, figures embedded, one small script, nothing loaded from elsewhere.


_WORST_FIRST: tuple[Level, ...] = ("fail", "warn", "ok")


@dataclass(frozen=True)
class Shown:
    """A finding with its texts; ``asked``: question, number and limit of its check, "" where there is none."""

    finding: Finding
    title: str
    asked: str
    text: str


@dataclass(frozen=True)
class Section:
    """What the page shows of one experiment, or, with the label "", of the whole fit.

    Attributes
    ----------
    level : the worst one of its findings
    shown : findings that are not ok, the worst first
    picture, others : the picture of its worst failed check, else the first one; those of the appendix
    labels : of the tables that the picture shows
    """

    label: str
    level: Level
    shown: tuple[Shown, ...]
    picture: Picture | None
    others: tuple[Picture, ...]
    labels: frozenset[str]


def render(result: Result, pictures: Sequence[Picture]) -> str:
    """The page for ``result``; ``pictures`` as ``pictures`` draws them. The same input gives the same text."""
    messages = messages_of(result.registry)
    stated_last = sorted(table_rows(result.summary), key=lambda row: is_stated(row.name))
    shown = [
        Shown(found, title_of(found.code, messages), question_of(found), finding_text(found, messages))
        for found in sorted(result.findings, key=lambda finding: _WORST_FIRST.index(finding.level))
    ]
    sections = sections_of(result, [picture for picture in pictures if picture.section == "measured"], shown)
    lead, reason = leading_section(result, sections)
    tables = select_tables(result.rig, result.provenance.experiments)
    return _ENVIRONMENT.get_template("report.html.j2").render(
        result=result,
        answers=stated_last,
        parts={symbol: [row for row in stated_last if symbol_of(row.name) == symbol] for symbol in SKETCHED},
        steps=next_steps(result),
        skewed=skewed_names(result.summary),
        left_out=errors_left_out(result.summary),
        sections=sections,
        lead=lead,
        reason=reason,
        pictures=pictures,
        parameters=printed_table(result.summary, "html"),
        nuisances=printed_table(result.nuisances, "html"),
        passed=[one for one in shown if one.finding.level == "ok"],
        verdict=verdict_text(result.trust, [(one.finding.level, one.title) for one in shown]),
        best=np.nanmax(result.point_fit.log_posterior),
        notes=[_note(note, messages) for note in result.notes],
        trust=TRUST,
        terms={term: TERMS[term] for term in TERMS if result.posterior or term not in OF_A_SAMPLE},
        missing=MISSING,
        names=NAMES,
        title=TITLE,
        published=PUBLISHED,
        paper=PAPER,
        fitted=Counter(table.kind.replace("_", " ") for table in tables),
        latex=latex_table(result),
    )


def sections_of(result: Result, measured: Sequence[Picture], shown: Sequence[Shown]) -> list[Section]:
    """The whole fit and every experiment with a picture or a finding that is not ok, the worst first."""
    tables = result.rig.tables
    labels = {table.label: {table.label} for table in tables}
    for item in result.comparisons:
        if (group := _group(result, item.label)) not in labels:  # a panel of several tables
            drawn = {
                table.label for table in tables if item.kind in getattr(result.registry.get(table.kind), "captions", ())
            }
            labels[group] = {group, *drawn}
    groups, known = dict.fromkeys(picture.group for picture in measured), {table.label for table in tables}
    home = {label: group for group in groups for label in labels.get(group, {group})}
    own: dict[str, list[Shown]] = {"": []} | {group: [] for group in groups}
    for one in shown:
        if one.finding.level != "ok":
            label, topic = one.finding.experiment, one.finding.code.partition(".")[0]
            # A shared panel has the name of its checks; a table may have any name.
            topic = topic if topic in groups and topic not in known else ""
            own.setdefault(home.get(label, label) or topic, []).append(one)
    sections = []
    for label, found in own.items():
        drawn = [picture for picture in measured if picture.group == label]
        worst = _UNSAFE.sub("_", str(found[0].finding.facts.get("record", "")) if found else "") or "none"
        drawn.sort(key=lambda picture: not picture.name.endswith(worst))
        level = found[0].finding.level if found else "ok"
        # Narrow pictures go in pairs, and a wide one between them leaves a gap.
        others = tuple(sorted(drawn[1:], key=lambda picture: picture.wide))
        names = frozenset(labels.get(label, {label}))
        sections.append(Section(label, level, tuple(found), drawn[0] if drawn else None, others, names))
    return sorted(
        sections, key=lambda one: (_WORST_FIRST.index(one.level), one.picture is not None and one.picture.wide)
    )


def leading_section(result: Result, sections: Sequence[Section]) -> tuple[Section | None, str]:
    """The section whose picture convinces or warns, and why; None without a picture.

    It is that of the worst failed check, else of a warning that leaves a parameter unjudged, else of the experiment that
    informs most of the parameters. A fault that is no
    matter of chance has no probability; it is worse than one that has.
    """
    drawn = [section for section in sections if section.picture]
    if not drawn:
        return None, ""
    if failed := [section for section in drawn if section.level == "fail"]:
        faults = [(one.finding.facts.get("p", -1.0), i, one) for i, part in enumerate(failed) for one in part.shown[:1]]
        _, i, worst = min(faults, key=lambda fault: fault[:2])
        return failed[i], f"The worst failed check: {worst.title}."
    whole = (one for section in sections if not section.label for one in section.shown)
    doubted = [one for one in whole if one.finding.level == "fail"]
    names = [name for one in doubted for name in one.finding.parameters] or [str(name) for name in result.summary.index]
    shares = [result.point_fit.shares.get(name, {}) for name in names]
    informs = [sum(own.get(label, 0.0) for own in shares for label in section.labels) for section in drawn]
    best = drawn[int(np.argmax(informs))]
    if doubted:
        return best, f"Failed: {doubted[0].title}. This experiment informs the parameters concerned most."
    if warned := [(section, one) for section in drawn for one in section.shown if one.finding.parameters]:
        section, one = warned[0]
        return section, f"A warning concerns {', '.join(one.finding.parameters)}: {one.title}."
    return best, "No check failed. The readings of this experiment decide more than those of any other."


def summary_html(result: Result, verdict: str, changes: Sequence[str]) -> str:
    """Verdict, changes of the model (texts of the findings that make them) and parameter table, for a notebook."""
    columns, rows = printed_table(result.summary, "console")
    template = _ENVIRONMENT.get_template("summary.html.j2")
    return template.render(result=result, changes=changes, verdict=verdict, columns=columns, rows=rows, missing=MISSING)


def _note(note: ResultTable, messages: Mapping[str, Message]) -> dict[str, object]:
    frame = note.frame
    if not isinstance(frame.index, pd.RangeIndex):
        frame = frame.rename_axis(frame.index.name or "").reset_index(allow_duplicates=True)
    header = [(str(name), pd.api.types.is_numeric_dtype(kind)) for name, kind in frame.dtypes.items()]
    return {
        "title": title_of(note.code, messages),
        "caption": caption_of(note, messages),
        "header": header,
        "rows": frame.itertuples(index=False, name=None),
    }


def _number(value: object, form: str = ".5g") -> str:
    """A cell: numbers with a true minus sign, a dash for what is missing, everything else as it is."""
    if value is None or value is pd.NA:
        return MISSING
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return MISSING if math.isnan(value) else format(float(value), form).replace("-", "−")
    return str(value)


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).with_name("templates")),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {
    "symbol_parts": symbol_parts,
    "fixed": fixed,
    "number": _number,
    "embed": lambda picture: (
        f"data:image/{'svg+xml' if picture.svg else 'png'};base64,{base64.b64encode(picture.svg or picture.png).decode()}"
    ),
    "after_number": after_number,
}


# advice: What would improve a result: the steps that the first screen of the report lists.


#: Share of a variance above which one input decides the sd.
DECISIVE = 0.5
#: Share below which an input is not named.
SMALL = 0.05


def next_steps(result: Result) -> list[tuple[str, str]]:
    """Pairs of a heading and a sentence, the most urgent first."""
    return [*_faults(result), *_missing(result), *_inputs(result), *_widest(result)]


def _faults(result: Result) -> Iterator[tuple[str, str]]:
    """Failed checks, then warnings that leave a parameter unjudged; the finding says what to do.

    What fails beside a cause of the same experiment is named with the cause: its own remedy may harm.
    """
    messages, shares = messages_of(result.registry), result.point_fit.shares
    causes = [finding for finding in result.findings if finding.cause and finding.experiment]
    followers = defaultdict[str, list[str]](list)
    others = list[Finding]()
    known = {cause.experiment for cause in causes}
    for one in result.findings:
        shared = ((label, share) for name in one.parameters for label, share in shares.get(name, {}).items())
        informing = {table.label for table in result.rig.tables} & {label for label, share in shared if share > SMALL}
        places = {one.experiment} if one.experiment else informing
        if one.level == "fail" and not one.cause and places and places <= known:
            followers[next(cause.experiment for cause in causes if cause.experiment in places)].append(
                title_of(one.code, messages)
            )
        else:
            others.append(one)
    for level, heading in (("fail", "Correct"), ("warn", "Look at")):
        for one in (one for one in others if one.level == level):
            own = ", ".join(dict.fromkeys(followers.pop(one.experiment, []) if one.cause else []))
            if not (own or level == "fail" or one.parameters):
                continue
            first = f"Probably the cause of further failed checks ({own}). " if own else ""
            place = f"experiment {one.experiment}" if one.experiment else ", ".join(one.parameters) or "the whole fit"
            yield f"{heading} {place}", first + finding_text(one, messages)


def _missing(result: Result) -> Iterator[tuple[str, str]]:
    if result.posterior is None:
        # A fit that goes on shows its point fit first.
        unfinished = any(finding.code == "sample.unfinished" for finding in result.findings)
        how = "Wait for the end of fit-params" if unfinished else "Run fit-params without --no-sample"
        yield "Sample", f"{how}: only a sample gives intervals and lets checks judge the numbers."
        return
    names = [str(name) for name in result.summary.index if not is_stated(name)]
    for name in names:
        # NaN for an exact constant: nothing is to be measured.
        if f"{result.summary.at[name, 'informed']}" == "False":
            # Kinds of bench tests that inform it, by the symbols that they list.
            symbol = re.compile(rf"\b{re.escape(symbol_of(name))}\b")
            kinds = [kind.name for kind in result.registry.kinds if symbol.search(kind.informs)] or ["another test"]
            yield f"Measure {name}", f"The data hardly narrow the prior of {name}. Add a table of {' or '.join(kinds)}."


def _inputs(result: Result) -> Iterator[tuple[str, str]]:
    """Stated values whose sd decides that of other parameters: more readings do not narrow these."""
    gains: dict[str, dict[str, str]] = {}
    for name in _quotable(result):
        source, share = _largest_input(result, name)
        if source.startswith(STATED) and source != f"{STATED}{name}" and share > DECISIVE:
            gains.setdefault(source.removeprefix(STATED), {})[name] = _factor(1.0 - share)
    for stated, factors in gains.items():
        verb = "Weigh" if stated in ("m1", "m2") else "Measure"
        yield (
            f"{verb} {stated} more precisely",
            f"The sd of {', '.join(factors)} comes mainly from the stated sd of {stated}. With an exact {stated} that of "
            f"{', that of '.join(f'{name} would be at least {factor} times' for name, factor in factors.items())} smaller; "
            "more readings of the tests help little.",
        )


def _widest(result: Result) -> Iterator[tuple[str, str]]:
    """The parameter with the largest relative sd among those that readings decide, and the tables that decide it."""
    rows = result.summary.loc[_quotable(result)]
    relative = (rows["sd"].astype(float) / rows["value"].astype(float).abs()).replace([np.inf], np.nan).dropna()
    tables = {table.label: table for table in result.rig.tables}
    decided = [str(name) for name in relative.index if _largest_input(result, str(name))[0] in tables]
    if not decided:
        return
    name = str(relative[decided].idxmax())
    first = tables[_largest_input(result, name)[0]]
    shares = result.point_fit.shares[name]
    alike = [table for table in tables.values() if table.kind == first.kind and shares.get(table.label, 0.0) > SMALL]
    factor = _factor(1.0 - 0.75 * sum(shares[table.label] for table in alike))
    labels = ", ".join(table.label for table in alike)
    number = sum(len(table.rows) for table in alike)
    more = "such records" if "time" in first.columns else f"such rows (now {number})"
    sentence = f"{name} has the largest relative sd, {100.0 * relative[name]:.2g} %, mainly from {labels}."
    yield f"Narrow {name}", f"{sentence} With four times as many {more} it would be at least {factor} times smaller."


def _quotable(result: Result) -> list[str]:
    """Names of the parameters that a better measurement can narrow: not stated, and not contradicted by a check."""
    words = result.summary["trust"].to_dict()
    return [str(name) for name, word in words.items() if not is_stated(name) and word != "not trusted"]


def _largest_input(result: Result, name: str) -> tuple[str, float]:
    """The input with the largest share in the variance of a parameter, and its share; ("", 0.0) where it is unknown."""
    shares = result.point_fit.shares.get(name, {})
    return max(shares.items(), key=lambda item: item[1], default=("", 0.0))


def _factor(remaining: float) -> str:
    """By how much the sd falls where this part of the variance remains: a lower bound, since weights would adapt."""
    return f"{float(f'{max(remaining, 1e-4) ** -0.5:.2g}'):g}"


# citation: What a paper or a thesis takes over from a result: the paper's reference and a LaTeX table. The template has
# the methods paragraph.


#: The paper whose model and rig this package fits.
NAMES = "Yang Liu, Ekaterina Pavlovskaia and Marian Wiercigroch"
TITLE = "Experimental verification of the vibro-impact capsule model"
PAPER = {
    "author": "Liu, Yang and Pavlovskaia, Ekaterina and Wiercigroch, Marian",
    "title": TITLE,
    "journal": "Nonlinear Dynamics",
    "volume": "83",
    "year": "2016",
    "pages": "1029--1041",
}
PUBLISHED = "{journal} {volume} ({year}) {pages}".format(**PAPER).replace("--", "–")
_ESCAPES = str.maketrans({"_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}"})


def latex_table(result: Result) -> str:
    """A tabular of symbol, unit, value and sd, and trust; needs no package."""
    lines = [r"\begin{tabular}{llll}", r"parameter & unit & value $\pm$ sd & trust \\", r"\hline"]
    for row in table_rows(result.summary):
        base, of = Name.parse(row.name)
        known, label = result.registry.parameters.get(base), of.translate(_ESCAPES)
        symbol = f"${known.latex}$" if known else base.translate(_ESCAPES)
        number = row.quoted.replace(MISSING, "-")
        number = re.sub(r"[-+.e\d]*\d", r"$\g<0>$", number) if row.skewed else f"${number}$".replace("±", r"\pm")
        unit = row.unit.replace("µ", r"\textmu ").replace("²", "$^2$").replace("^2", "$^2$")
        lines.append(rf"{symbol}{f' ({label})' if label else ''} & {unit} & {number} & {row.values['trust']} \\")
    texts = (text.translate(_ESCAPES) for text in errors_left_out(result.summary))
    notes = [rf"\multicolumn{{4}}{{p{{0.9\linewidth}}}}{{{text}}} \\" for text in texts]
    return "\n".join([*lines, *notes, r"\end{tabular}"])
