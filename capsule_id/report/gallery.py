"""All pictures of a result, drawn once: the page embeds the same bytes that stand in ``figures/``."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from matplotlib.figure import Figure

from capsule_id.inference.result import Result
from capsule_id.report import figures
from capsule_id.report.corner import corner
from capsule_id.report.style import figure_of, mark, png
from capsule_id.report.traces import traces
from capsule_id.views import Comparison

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
# Wider than this (CSS pixels) does not go in pairs.
_HALF_PAGE = 650
_KINDS = {
    "friction": "Counterpart of the paper's Fig. 2: coefficients as the paper reads them off, its curve, and ours.",
    "motor_current": "Counterpart of the paper's Fig. 3: the slope of the line is K.",
    "support_spring": "The slope of the line is the stiffness of the support spring.",
    "forced_run": "Forced run: one recorded channel, its residuals at the point fit, and their autocorrelation.",
    "phase_portrait": "Phase plane as the paper draws it: the record through Savitzky–Golay, the model, the impact line.",
    "free_vibration": "Free decay: the record, its residuals at the point fit, and their autocorrelation.",
}


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
        """Takes the whole width of the page."""
        return self.width > _HALF_PAGE


def pictures(result: Result) -> tuple[Picture, ...]:
    """Draw every figure of the result; synthetic data are marked on each of them."""
    names = _unique(_comparison_name(item) for item in result.comparisons)
    drawn = [
        _picture(result, name, "measured", item.title, comparison_caption(item), figures.comparison_figure(item))
        for name, item in zip(names, result.comparisons, strict=True)
    ]
    if result.posterior is not None:
        corner_caption = "Posterior of the physical parameters: histograms, and contours of every pair."
        trace_caption = (
            f"A few walkers of each ensemble, one colour per ensemble ({len(result.posterior.draws)} ensembles)."
        )
        drawn.append(_picture(result, "corner", "sample", "Corner plot", corner_caption, corner(result)))
        drawn.append(_picture(result, "traces", "sample", "Traces", trace_caption, traces(result)))
    starts = figure_of(figures.point_fit_starts(result.point_fit))
    starts_caption = "Where each start began and where it ended, in standard deviations of the Laplace approximation."
    drawn.append(_picture(result, "point_fit_starts", "point_fit", "Starts of the point fit", starts_caption, starts))
    return tuple(drawn)


def comparison_caption(item: Comparison) -> str:
    """What the panel shows, and its posterior predictive p-value where there is one."""
    parts = [_KINDS.get(item.kind, "Measured beside predicted.")]
    if item.residuals is not None:
        parts.append("Shaded: the range that holds 95 % of a good fit's residuals.")
    if any(points.flagged is not None and points.flagged.any() for points in item.points):
        parts.append("Framed rows are named by a check; they take part in the fit like all others.")
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
    if result.rig.synthetic:
        mark(figure, "synthetic data")
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    return Picture(name, section, title, caption, width, height, png(figure))


def _comparison_name(item: Comparison) -> str:
    name = item.label if item.label.startswith(item.kind) else f"{item.kind}_{item.label}"
    return _UNSAFE.sub("_", name)


def _unique(names: Iterable[str]) -> list[str]:
    """Number what would otherwise overwrite another picture (also on file systems that ignore case)."""
    taken = {"corner", "traces", "point_fit_starts"}
    unique = []
    for name in names:
        candidate, number = name, 2
        while candidate.lower() in taken:
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate.lower())
        unique.append(candidate)
    return unique
