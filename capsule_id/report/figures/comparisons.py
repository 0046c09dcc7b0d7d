"""Measured beside predicted: the panels of a ``Comparison``, and where the point fit's starts ended.

Every panel is ``(thing, ax=None) -> ax`` and draws into ``ax`` or into a figure of its own; labels are plain text.
"""

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsule_id.inference.result import PointFit
from capsule_id.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    GREEN,
    GREY,
    PURPLE,
    VERMILION,
    figure_of,
    make_room,
    new_figure,
    own_axes,
    set_legend,
    set_text,
)
from capsule_id.report.typography import plain_symbol
from capsule_id.views import Comparison, Curve, Points

# Beyond this many points a record is a cloud of dots, not single readings with bars.
_MANY = 100
TWO_SIDED_95 = 1.96

_POINT_STYLES: dict[str, dict[str, Any]] = {
    "static": {"marker": "o", "mfc": "none", "color": BLACK},
    "dynamic": {"marker": "x", "color": VERMILION},
    "sliding": {"marker": "^", "mfc": "none", "color": GREEN},
    "data": {"marker": "o", "mfc": "none", "color": BLACK},
}
_CURVE_STYLES: dict[str, dict[str, Any]] = {
    "ours": {"color": BLUE, "ls": "-", "lw": 1.8},
    "paper": {"color": VERMILION, "ls": "--", "lw": 1.6},
    "predictive": {"color": GREEN, "ls": "-.", "lw": 1.6},
    "alternative": {"color": PURPLE, "ls": ":", "lw": 2.0},
}


def comparison(item: Comparison, ax: Axes | None = None) -> Axes:
    """Measured points with the predicted curves and their 95 % bands."""
    ax = own_axes(ax)
    banded = [curve for curve in item.curves if curve.lower is not None and curve.upper is not None]
    long = any(points.x.size > _MANY for points in item.points)
    for curve in item.curves:
        _draw_curve(ax, curve, "95 % band" if banded and curve is banded[0] else None, over_cloud=long)
    for points in item.points:
        _draw_points(ax, points)
    set_text(ax, item.x_label, item.y_label, item.title)
    # Finding the best place means testing every point: for a record that takes longer than drawing it.
    if long:
        make_room(ax)
    set_legend(ax, place="upper right" if long else "best")
    return ax


def residuals(item: Comparison, ax: Axes | None = None) -> Axes:
    """Residuals at the point fit in units of the noise sd, with the band that holds 95 % of a good fit's.

    Raises
    ------
    ValueError
        If the comparison has no residuals.
    """
    if item.residuals is None or item.residual_x is None:
        raise ValueError(f"{item.label} has no residuals")
    ax = own_axes(ax, height=2.2)
    ax.axhspan(-TWO_SIDED_95, TWO_SIDED_95, color=BLUE, alpha=0.13, lw=0)
    ax.axhline(0.0, color=GREY, lw=0.8)
    many = item.residuals.size > _MANY
    ax.plot(item.residual_x, item.residuals, ls="", marker="." if many else "o", ms=2 if many else 4.5, color=BLACK)
    limit = 1.1 * max(3.0, float(np.max(np.abs(item.residuals), initial=0.0, where=np.isfinite(item.residuals))))
    ax.set_ylim(-limit, limit)
    set_text(ax, item.x_label, "residual / sd [1]")
    return ax


def autocorrelation(item: Comparison, ax: Axes | None = None) -> Axes:
    """Autocorrelation of the residuals from lag 1, with the 95 % band of a white record.

    Raises
    ------
    ValueError
        If the comparison has no autocorrelation.
    """
    if item.autocorrelation is None:
        raise ValueError(f"{item.label} has no autocorrelation")
    ax = own_axes(ax, height=2.2)
    lags = np.arange(1, item.autocorrelation.size + 1)
    bound = item.autocorrelation_bound
    if bound is not None:
        ax.axhspan(-bound, bound, color=BLUE, alpha=0.13, lw=0, label="95 % of white records")
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.vlines(lags, 0.0, item.autocorrelation, color=BLACK, lw=1.3)
    largest = float(np.max(np.abs(item.autocorrelation), initial=0.0, where=np.isfinite(item.autocorrelation)))
    limit = 1.25 * max(largest, 2.0 * (bound or 0.0), 0.05)
    ax.set_ylim(-limit, limit)
    set_text(ax, "lag [samples]", "autocorrelation [1]")
    set_legend(ax, place="above")  # bars of a coloured record reach everywhere
    return ax


def comparison_figure(item: Comparison) -> Figure:
    """The panel of a comparison with the residual and autocorrelation panels that it has."""
    if item.autocorrelation is not None and item.residuals is not None:
        figure = new_figure(9.0, 5.6)
        grid = figure.add_gridspec(2, 2, height_ratios=(1.7, 1.0), hspace=0.38, wspace=0.25)
        comparison(item, figure.add_subplot(grid[0, :]))
        residuals(item, figure.add_subplot(grid[1, 0]))
        autocorrelation(item, figure.add_subplot(grid[1, 1]))
        figure.subplots_adjust(left=0.09, right=0.98, bottom=0.1, top=0.93)
        return figure
    if item.residuals is None:
        return figure_of(comparison(item, own_axes(None, height=5.6)))
    figure = new_figure(6.4, 5.6)
    top, bottom = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (2.4, 1.0), "hspace": 0.12})
    comparison(item, top)
    residuals(item, bottom)
    top.set_xlabel("")
    top.tick_params(labelbottom=False)
    figure.subplots_adjust(left=0.14, right=0.97, bottom=0.11, top=0.93)
    figure.align_ylabels([top, bottom])
    return figure


def side_by_side(items: Sequence[Comparison]) -> Figure:
    """All panels in one figure, two in a row."""
    columns = min(len(items), 2)
    rows = -(-len(items) // columns)
    figure = new_figure(6.4 * columns, 4.4 * rows)
    grid = figure.subplots(rows, columns, squeeze=False)
    for ax, item in zip_longest(grid.flat, items):
        if item is None:
            ax.set_axis_off()
        else:
            comparison(item, ax)
    figure.subplots_adjust(
        left=0.9 / (6.4 * columns),
        right=1 - 0.2 / (6.4 * columns),
        bottom=0.62 / (4.4 * rows),
        top=1 - 0.39 / (4.4 * rows),
        wspace=0.2,
        hspace=0.3,
    )
    return figure


def point_fit_starts(fit: PointFit, ax: Axes | None = None) -> Axes:
    """Where each start of the point fit began and ended, per parameter, in standard deviations from the best maximum.

    The standard deviation is that of the Laplace approximation in the unconstrained space; a parameter for which it is
    not a positive number is shown in the bare unconstrained unit. Starts that stalled end in a cross.
    """
    d, height = len(fit.names), 1.5 + 0.25 * len(fit.names)
    if ax is None:
        ax = own_axes(None, 7.2, height)
        figure_of(ax).subplots_adjust(left=0.36, right=0.97, bottom=0.7 / height, top=1 - 0.6 / height)
    variance = np.diag(fit.covariance)
    sd = np.sqrt(np.where(np.isfinite(variance) & (variance > 0), variance, 1.0))
    rows = np.arange(d)[::-1]
    shifts = np.linspace(0.25, -0.25, len(fit.starts))
    stalled = np.asarray(fit.stalled, dtype=bool)
    ax.set_xscale("symlog", linthresh=1.0)
    ax.xaxis.set_major_formatter("{x:g}")
    for i, (start, end, shift) in enumerate(zip(fit.starts, fit.ends, shifts, strict=True)):
        marker, size, text = ("x", 7, "end, stalled") if stalled[i] else ("o", 4, "end")
        first = not np.any(stalled[:i] == stalled[i])
        style: dict[str, Any] = {"ls": "", "color": CYCLE[i % len(CYCLE)]}
        ax.plot((start - fit.u) / sd, rows + shift, marker="o", mfc="none", ms=5, label="" if i else "start", **style)
        ax.plot((end - fit.u) / sd, rows + shift, marker=marker, ms=size, label=text if first else "", **style)
    ax.axvline(0.0, color=GREY, lw=0.8, zorder=0)
    ax.set_yticks(rows, [plain_symbol(name) for name in fit.names], parse_math=False)
    ax.set_ylim(-0.8, d - 0.2)
    set_text(ax, "distance from the best maximum [posterior sd]", "", "Starts of the point fit")
    set_legend(ax, place="above")
    return ax


def _draw_curve(ax: Axes, curve: Curve, band_label: str | None, over_cloud: bool) -> None:
    style = dict(_CURVE_STYLES[curve.role])
    if over_cloud:  # a line as wide as the dots would hide a record that leaves it by less than that
        style["lw"] *= 0.5
    if curve.lower is not None and curve.upper is not None:
        if curve.x.size == 1:
            reach = [curve.y - curve.lower, curve.upper - curve.y]
            ax.errorbar(curve.x, curve.y, reach, capsize=4.0, marker="D", label=curve.label, zorder=3, **style)
            return
        ax.fill_between(
            curve.x, curve.lower, curve.upper, color=style["color"], alpha=0.22, lw=0, zorder=1, label=band_label
        )
    ax.plot(curve.x, curve.y, label=curve.label, zorder=3, **style)


def _draw_points(ax: Axes, points: Points) -> None:
    style = _POINT_STYLES[points.role]
    if points.x.size > _MANY:
        ax.plot(points.x, points.y, ls="", marker=".", ms=3.5, color=GREY, label=points.label, zorder=2)
    else:
        ax.errorbar(
            points.x,
            points.y,
            points.y_error,
            ls="",
            ms=6.5,
            mew=1.4,
            elinewidth=1.1,
            label=points.label,
            zorder=4,
            **style,
        )
    if points.flagged is not None and np.any(points.flagged):
        ax.plot(
            points.x[points.flagged], points.y[points.flagged], ls="", marker="s", ms=13, mfc="none", mew=1.6,
            color=VERMILION, label="flagged by a check, kept", zorder=5,
        )  # fmt: skip
