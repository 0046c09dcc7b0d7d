"""All pictures of a result, drawn once: the page embeds the same bytes as in ``figures/``."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from matplotlib.figure import Figure

from capsule_id.inference.result import Result, RunRecord
from capsule_id.interruption import stop_if_interrupted
from capsule_id.records.label import UNDECIDED
from capsule_id.report.figures import comparisons as figures
from capsule_id.report.figures.corner import corner
from capsule_id.report.figures.runs import force_on_rod, run_overview
from capsule_id.report.figures.style import figure_of, mark, png
from capsule_id.report.figures.traces import traces
from capsule_id.views import Comparison

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
# Wider than this (CSS pixels) does not go in pairs.
_HALF_PAGE = 650


@dataclass(frozen=True)
class Picture:
    """A drawn figure.

    Attributes
    ----------
    name : file name without suffix, safe and unique within the result
    section : "measured", "sample" or "point_fit"
    title, caption : plain text
    width, height : of the page's picture, CSS pixels
    png : the file
    """

    name: str
    section: Literal["measured", "sample", "point_fit"]
    title: str
    caption: str
    width: int
    height: int
    png: bytes

    @property
    def wide(self) -> bool:
        """Whether the picture takes the whole width of the page."""
        return self.width > _HALF_PAGE


def pictures(result: Result) -> tuple[Picture, ...]:
    """Draw every figure of the result; synthetic data are marked on each of them."""
    names = _unique(_comparison_name(item) for item in result.comparisons)
    drawn = [
        _picture(
            result,
            name,
            "measured",
            item.title,
            comparison_caption(item, result.registry.captions),
            figures.comparison_figure(item),
        )
        for name, item in zip(names, result.comparisons, strict=True)
    ]
    labels = _unique(_UNSAFE.sub("_", record.name) for record in result.records)
    for label, record in zip(labels, result.records, strict=True):
        drawn += _record_pictures(result, label, record)
    if result.posterior is not None:
        corner_caption = "Posterior of the physical parameters: histograms, and contours of every pair."
        trace_caption = (
            f"A few walkers of each ensemble, one colour per ensemble ({len(result.posterior.draws)} ensembles)."
        )
        drawn.append(_picture(result, "corner", "sample", "Corner plot", corner_caption, figure_of(corner(result))))
        drawn.append(_picture(result, "traces", "sample", "Traces", trace_caption, figure_of(traces(result))))
    starts = figure_of(figures.point_fit_starts(result.point_fit))
    starts_caption = "Where each start began and where it ended, in standard deviations of the Laplace approximation."
    drawn.append(_picture(result, "point_fit_starts", "point_fit", "Starts of the point fit", starts_caption, starts))
    return tuple(drawn)


def _record_pictures(result: Result, label: str, record: RunRecord) -> list[Picture]:
    """The record as the paper draws it (its Figs. 4 and 9); ``label`` is safe and unique."""
    view, contact = record.view, record.view.at_contact
    left = f"{view.at_drive.rate:.0%} of a rate at the drive's frequency" + (
        f" and {contact.rate:.0%} at that of the contacts ({contact.f:.3g} Hz)" if contact else ""
    )
    caption = (
        "The record itself: raw channels, and the phase plane through Savitzky–Golay with the impact line and a point a "
        f"period. The filter ({view.samples} samples) leaves {left}."
    )
    word = view.label if view.label == UNDECIDED else f"{view.label} (probability {view.probability:.2g})"
    title = f"{record.name}: the record, {word}"
    drawn = [_picture(result, f"record_{label}", "measured", title, caption, figure_of(run_overview(view)))]
    if view.force is not None:
        figure = figure_of(force_on_rod(view, model=(view.time, record.force)))
        text = (
            "Force on the rod (the paper's Fig. 4d): K times the recorded current, and the drive of the fitted model."
        )
        drawn.append(_picture(result, f"force_{label}", "measured", f"{record.name}: force on the rod", text, figure))
    return drawn


def comparison_caption(item: Comparison, captions: Mapping[str, str]) -> str:
    """What the panel shows, and its posterior predictive p-value where there is one."""
    parts = [captions.get(item.kind, "Measured beside predicted.")]
    if item.residuals is not None:
        parts.append("Shaded: the range that holds 95 % of a good fit's residuals.")
    if any(points.flagged is not None and points.flagged.any() for points in item.points):
        parts.append("Framed rows are flagged by a check; they stay in the fit.")
    if item.predictive_p is not None:
        parts.append(f"Posterior predictive p = {item.predictive_p:.2g} (chi-square discrepancy).")
    return " ".join(parts)


def _picture(
    result: Result,
    name: str,
    section: Literal["measured", "sample", "point_fit"],
    title: str,
    caption: str,
    figure: Figure,
) -> Picture:
    stop_if_interrupted()
    if result.rig.synthetic:
        mark(figure, "synthetic data")
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    return Picture(name, section, title, caption, width, height, png(figure))


def _comparison_name(item: Comparison) -> str:
    name = item.label if item.label.startswith(item.kind) else f"{item.kind}_{item.label}"
    return _UNSAFE.sub("_", name)


def _unique(names: Iterable[str]) -> list[str]:
    """Number names that would overwrite another picture (also on file systems that ignore case)."""
    taken = {"corner", "traces", "point_fit_starts"}
    unique = []
    for name in names:
        candidate, number = name, 2
        while candidate.lower() in taken:
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate.lower())
        unique.append(candidate)
    return unique
