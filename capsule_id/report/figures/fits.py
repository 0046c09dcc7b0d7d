"""Figures of a rig and its fit: readings, motions, comparisons, corner plot, traces.

A panel is ``(data, ax)`` and draws into ``ax``; labels are plain text.
"""

import textwrap
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy import ndimage, signal

from capsule_id.inference.result import PointFit
from capsule_id.parameters import QUANTILE_975
from capsule_id.records.view import MotionView, RunRecord
from capsule_id.report.columns import SampledParameters, plain_symbol
from capsule_id.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    GREEN,
    GREY,
    MM,
    ORANGE,
    PALE_BLUE,
    PURPLE,
    SKY,
    SMALL,
    TEXT,
    VERMILION,
    new_figure,
    set_legend,
    set_margins,
    set_text,
)
from capsule_id.rig.model import Table
from capsule_id.views import Comparison, Curve, Finding, Points, ResultTable, counted, with_unit

# comparisons: Measured beside predicted: the panels of a ``Comparison``, and where the point fit's starts ended.


# Beyond this many points a record is a cloud of dots or a line, not single readings with bars or markers.
_MANY = 100

_POINT_STYLES: dict[str, dict[str, Any]] = {
    "static": {"marker": "o", "mfc": "none", "color": BLACK},
    "dynamic": {"marker": "s", "mfc": "none", "color": BLUE},
    "mean": {"marker": "x", "color": PURPLE, "alpha": 0.6},
    "sliding": {"marker": "^", "mfc": "none", "color": GREEN},
    "data": {"marker": "o", "mfc": "none", "color": BLACK},
}
_CURVE_STYLES: dict[str, dict[str, Any]] = {
    "ours": {"color": BLUE, "ls": "-", "lw": 1.8},
    "paper": {"color": VERMILION, "ls": "--", "lw": 1.6},
    "alternative": {"color": PURPLE, "ls": ":", "lw": 2.0},
}


def comparison(item: Comparison, ax: Axes) -> None:
    """Measured points with the predicted curves and their 95 % bands."""
    banded = next((curve for curve in item.curves if curve.lower is not None and curve.upper is not None), None)
    long = any(points.x.size > _MANY for points in item.points)
    for curve in item.curves:
        _draw_curve(ax, curve, "95 % band" if curve is banded else None, over_cloud=long)
    for points in item.points:
        _draw_points(ax, points)
    set_text(ax, item.x_label, item.y_label, item.title)
    set_legend(ax)


def residuals(item: Comparison, ax: Axes) -> None:
    """Residuals at the point fit in units of the noise sd, with the band that holds 95 % of a good fit's.

    Raises
    ------
    ValueError
        If the comparison has no residuals.
    """
    if item.residuals is None:
        raise ValueError(f"{item.label} has no residuals")
    many = item.residuals.size > _MANY
    _about_zero(ax, QUANTILE_975, 1.1 * max(3.0, _largest(item.residuals)))
    ax.plot(item.points[0].x, item.residuals, ls="", marker="." if many else "o", ms=2 if many else 4.5, color=BLACK)
    set_text(ax, item.x_label, "residual / sd")


def autocorrelation(item: Comparison, ax: Axes) -> None:
    """Autocorrelation of the residuals from lag 1, with the 95 % band of a white record.

    Raises
    ------
    ValueError
        If the comparison has no autocorrelation.
    """
    if item.autocorrelation is None or item.residuals is None:
        raise ValueError(f"{item.label} has no autocorrelation")
    bound = QUANTILE_975 / float(np.sqrt(item.residuals.size))
    limit = 1.25 * max(_largest(item.autocorrelation), 2.0 * bound, 0.05)
    _about_zero(ax, bound, limit, "95 % of white records")
    ax.vlines(np.arange(1, item.autocorrelation.size + 1), 0.0, item.autocorrelation, color=BLACK, lw=1.3)
    set_text(ax, "lag, samples", "autocorrelation")
    set_legend(ax, "above")  # bars of a coloured record reach everywhere


def _about_zero(ax: Axes, bound: float, limit: float, label: str | None = None) -> None:
    """An axis from -limit to limit, with its zero and a band from -bound to bound."""
    ax.axhspan(-bound, bound, color=BLUE, alpha=0.13, lw=0, label=label)
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.set_ylim(-limit, limit)


def _largest(values: np.ndarray) -> float:
    return float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values)))


def comparison_figure(item: Comparison) -> Figure:
    """The panel of a comparison over the residual and autocorrelation panels that it has.

    A record of many periods covers its curve: it has its range in each period, and beside it three periods in full.
    """
    below = [residuals] * (item.residuals is not None) + [autocorrelation] * (item.autocorrelation is not None)
    figure = new_figure(9.0 if item.autocorrelation is not None else 6.4, 5.6)
    period, end = period_of(item), None
    look: dict[str, Any] = {"height_ratios": (1.7, 1.0), "width_ratios": (1.0, 1.4) if period else None}
    grid = figure.add_gridspec(2, max(len(below), 1), hspace=0.38, wspace=0.25, **look)
    top = figure.add_subplot(grid[0, 0] if period else grid[0, :] if below else grid[:, :])
    if period:
        ranges(item, period, top)
        comparison(worst_periods(item, period), figure.add_subplot(grid[0, 1]))
    elif (end := end_of_motion(item)) is not None:
        comparison(replace(item, title=f"{item.title}, until it dies away in the noise"), top)
        top.set_xlim(right=end)
    else:
        comparison(item, top)
    for column, panel in enumerate(below):
        panel(item, figure.add_subplot(grid[1, column], sharex=top if panel is residuals and end is None else None))
    return figure


#: Periods drawn in full, fewest periods of a record that has them, and smallest correlation of neighbouring periods.
PERIODS_IN_FULL, FEWEST_PERIODS, ALIKE = 3, 6, 0.8


def period_of(item: Comparison) -> int:
    """Samples in a period of a long record whose fitted motion repeats; 0 for any other comparison."""
    curve, n = item.curves[0].y if item.curves else np.zeros(0), item.points[0].y.size
    if (
        item.autocorrelation is None
        or item.residuals is None
        or n <= _MANY
        or not curve.size == item.residuals.size == n
    ):
        return 0
    lags = np.arange(n // FEWEST_PERIODS)
    power = np.abs(np.fft.rfft(signal.detrend(curve), 2 * n)) ** 2
    similar = np.fft.irfft(power)[lags] / (n - lags)
    # Beyond the first sign change; the first of the lags that are nearly as good, since multiples of the period are too.
    later = similar[np.argmax(similar < 0.0) :] if np.any(similar < 0.0) else np.zeros(1)
    if not np.max(later) >= ALIKE * similar[0] > 0.0:
        return 0
    good = np.flatnonzero(similar >= 0.95 * np.max(later))
    good = good[good >= lags.size - later.size]
    first = good[: np.argmax(np.diff(good, append=n) > 1) + 1]
    return int(first[np.argmax(similar[first])])


def worst_periods(item: Comparison, period: int) -> Comparison:
    """The part of a record with the largest residuals, ``PERIODS_IN_FULL`` periods long."""
    assert item.residuals is not None
    length = PERIODS_IN_FULL * period
    sums = np.cumsum(np.append(0.0, item.residuals**2))
    start = int(np.argmax(sums[length:] - sums[:-length]))

    def cut(part: Any) -> Any:
        arrays = {key: x[start : start + length] for key, x in vars(part).items() if isinstance(x, np.ndarray)}
        return replace(part, **arrays)

    points, curves = tuple(map(cut, item.points)), tuple(map(cut, item.curves))
    title = f"{counted(PERIODS_IN_FULL, 'period')} with the largest residuals"
    return replace(item, title=title, y_label="", points=points, curves=curves, residuals=None, autocorrelation=None)


def ranges(item: Comparison, period: int, ax: Axes) -> None:
    """Smallest and largest value in each period, of record and curve, against the first coordinate."""
    points, curve = item.points[0], item.curves[0]
    starts = np.arange(0, points.x.size - period + 1, period)
    (low, high), fitted = (
        [np.array([edge(y[i : i + period]) for i in starts]) for edge in (np.min, np.max)] for y in (points.y, curve.y)
    )
    x = points.x[starts + period // 2]
    ax.fill_between(x, low, high, color=GREY, alpha=0.35, lw=0, label="range of the record")
    for edge, label in zip(fitted, (f"range of {curve.label}", ""), strict=True):
        ax.plot(x, edge, label=label, **_CURVE_STYLES[curve.role])
    set_text(ax, item.x_label, item.y_label, item.title)
    set_legend(ax, "upper right")


def end_of_motion(item: Comparison) -> float | None:
    """First coordinate at which the fitted motion of a record has died away in its noise; None where that is near the end."""
    curve, points = item.curves[0] if item.curves else None, item.points[0]
    if item.autocorrelation is None or curve is None or not _MANY < points.x.size == curve.y.size:
        return None
    noise = 1.4826 * float(np.median(np.abs(points.y - curve.y)))
    moves = np.flatnonzero(np.abs(curve.y - curve.y[-1]) > noise)
    last = points.x[min(int(1.2 * moves[-1]), points.x.size - 1)] if moves.size else points.x[-1]
    return float(last) if last - points.x[0] < 0.75 * np.ptp(points.x) else None


def side_by_side(items: Sequence[Comparison]) -> Figure:
    """All panels in one figure, two in a row."""
    columns = min(len(items), 2)
    rows = -(-len(items) // columns)
    figure = new_figure(6.4 * columns, 4.4 * rows, wspace=0.2, hspace=0.3)
    for number, item in enumerate(items, start=1):
        comparison(item, figure.add_subplot(rows, columns, number))
    return figure


def starts_size(fit: PointFit) -> tuple[float, float]:
    """Width and height of ``point_fit_starts``, inches."""
    return 7.2, 1.5 + 0.25 * len(fit.names)


def point_fit_starts(fit: PointFit, ax: Axes) -> None:
    """Where each start of the point fit began and ended, per parameter, in standard deviations from the best maximum.

    The standard deviation is that of the Laplace approximation in the unconstrained space; a parameter for which it is
    not a positive number is shown in the bare unconstrained unit. Starts that stalled end in a cross.
    """
    variance = np.diag(fit.covariance)
    sd = np.sqrt(np.where(np.isfinite(variance) & (variance > 0), variance, 1.0))
    rows = np.arange(len(fit.names))[::-1]
    stalled = np.asarray(fit.stalled, dtype=bool)
    ax.set_xscale("symlog", linthresh=1.0)
    ax.xaxis.set_major_formatter("{x:g}")
    for i, shift in enumerate(np.linspace(0.25, -0.25, len(fit.starts))):
        marker, size, text = ("x", 7, "end, stalled") if stalled[i] else ("o", 4, "end")
        first = not np.any(stalled[:i] == stalled[i])
        start, end = (fit.starts[i] - fit.u) / sd, (fit.ends[i] - fit.u) / sd
        style: dict[str, Any] = {"ls": "", "color": CYCLE[i % len(CYCLE)]}
        ax.plot(start, rows + shift, marker="o", mfc="none", ms=5, label="" if i else "start", **style)
        ax.plot(end, rows + shift, marker=marker, ms=size, label=text if first else "", **style)
    ax.axvline(0.0, color=GREY, lw=0.8, zorder=0)
    ax.set_yticks(rows, [plain_symbol(name) for name in fit.names], parse_math=False)
    ax.set_ylim(-0.8, len(rows) - 0.2)
    set_text(ax, "distance from the best maximum, posterior sd", "", "Starts of the point fit")
    set_legend(ax, "above")


def profile(note: ResultTable, ax: Axes) -> None:
    """A table of a profile likelihood: the profile, the parabola of the curvature, and the drop of the 95 % interval."""
    value, drop = note.frame.index.to_numpy(float), note.facts["drop"]
    ax.plot(value, note.frame["profile"], color=BLUE, marker="o", ms=3.5, lw=1.4, label="profile")
    ax.plot(value, note.frame["curvature"], color=GREY, ls="--", lw=1.0, label="curvature")
    ax.axhline(-drop, color=BLACK, ls=":", lw=0.9, label="95 %")
    ax.set_ylim(max(-4.0 * drop, 1.1 * min(note.frame["profile"].min(), -drop)), 0.4 * drop)
    set_text(ax, with_unit(plain_symbol(note.facts["name"]), note.facts["unit"]), "log-likelihood less its maximum")
    set_legend(ax, "above")


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
    if points.x.size > _MANY:
        ax.plot(points.x, points.y, ls="", marker=".", ms=2.5, color=GREY, label=points.label, zorder=2)
    else:
        style = {"ms": 6.5, "mew": 1.4, "elinewidth": 1.1, "zorder": 4, **_POINT_STYLES[points.role]}
        ax.errorbar(points.x, points.y, points.y_error, ls="", label=points.label, **style)
    if points.flagged is not None and np.any(points.flagged):
        ax.plot(
            points.x[points.flagged], points.y[points.flagged], ls="", marker="s", ms=13, mfc="none", mew=1.6,
            color=VERMILION, label="flagged by a check, kept", zorder=5,
        )  # fmt: skip


# readings: Figures of the readings of one experiment with what ``capsule-id check`` found in them.


#: Marks of rows that findings name: code, words of the legend, marker, colour.
_MARKS = (
    ("readings.clipped", "clipped", "v", VERMILION),
    ("readings.dropouts", "drop-out", "X", PURPLE),
    ("readings.frozen", "frozen", "s", ORANGE),
    ("readings.repeated", "repeated", "D", ORANGE),
    ("readings.repeated_file", "repeated", "D", ORANGE),
    ("readings.jump", "jump", "P", PURPLE),
    ("readings.burst", "burst of noise", "P", PURPLE),
    ("readings.spike", "spike", "P", PURPLE),
)
#: Times that findings propose: fact, words of the legend, line style.
_TIMES = (("start", "release found", "--"), ("stop", "end found", ":"))


def readings_figure(table: Table[Any], findings: Sequence[Finding]) -> Figure:
    """Draw the channels of a record against time, or the columns of a table against the first one.

    Parameters
    ----------
    findings : on this table; their facts name rows and times
    """
    names = list(table.columns)
    across, channels = (names[0], names[1:]) if len(names) > 1 else ("", names)
    figure = new_figure(8.0, 0.9 + 2.1 * len(channels))
    axes = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    for ax, name in zip(axes, channels, strict=True):
        channel_with_findings(table, name, findings, ax, across)
        ax.label_outer()
    axes[0].set_title(f"{table.kind} {table.label}", loc="left", parse_math=False)
    return figure


def channel_with_findings(table: Table[Any], name: str, findings: Sequence[Finding], ax: Axes, across: str) -> None:
    """Draw one column against the column ``across`` ("": row numbers), in the units of the file, with marked findings."""
    y = _displayed(table, name)
    x = _displayed(table, across) if across else np.arange(1.0, len(y) + 1.0)
    record = "time" in table.columns
    marker = "" if record and len(y) > _MANY else "o"
    ax.plot(x, y, color=BLUE, lw=0.8 if record else 0.0, marker=marker, ms=3.5, label="readings")
    if record:
        _mark_times(table, findings, ax)
    for code, words, marker, color in _MARKS:
        named = [found.facts for found in findings if found.code == code and found.facts.get("column", name) == name]
        if rows := [row for facts in named for row in facts["rows"]]:
            ax.plot(x[rows], y[rows], ls="none", marker=marker, ms=5.0, color=color, label=words, zorder=3)
    set_text(ax, *(with_unit(key, table.columns[key].unit) if key else "row" for key in (across, name)))
    set_legend(ax, "above")


def _mark_times(table: Table[Any], findings: Sequence[Finding], ax: Axes) -> None:
    """Shade gaps and the part outside the stated window; draw lines at the times that findings propose."""
    time = [float(value) for value in _displayed(table, "time")]
    scale = table.columns["time"].to_display
    for found in findings:
        if found.code == "readings.gaps":
            for index, row in enumerate(found.facts["rows"]):
                label = "gap" if index == 0 else None
                ax.axvspan(time[row], time[row + 1], color=ORANGE, alpha=0.6, lw=1.5, label=label)
        for fact, words, line in _TIMES:
            if isinstance(found.facts.get(fact), float) and found.code.startswith("decays."):
                ax.axvline(scale * found.facts[fact], color=VERMILION, ls=line, lw=1.4, label=words)
    stated = [getattr(table.settings, key, None) for key in ("start", "stop")]
    for edge, outside in zip(stated, (time[0], time[-1]), strict=True):
        if isinstance(edge, float):
            ax.axvspan(min(scale * edge, outside), max(scale * edge, outside), color=GREY, alpha=0.2, lw=0.0)
            ax.axvline(scale * edge, color=SKY, lw=1.2)


def _displayed(table: Table[Any], name: str) -> np.ndarray:
    """Values of a column in the unit of the file, (n,)."""
    return table[name] * table.columns[name].to_display


# motions: Recorded and simulated motions as the paper draws them: time histories (Fig. 4), phase plane (Figs. 9, 12),
# force (4d).


# Channels in the order of the panels: axis label, display per SI, colour.
_CHANNELS = {
    "x_capsule": ("X2, mm", MM, BLACK),
    "x_rel": ("X1 - X2, mm", MM, BLUE),
    "acceleration_rod": ("acceleration\nof the rod, m/s²", 1.0, GREY),
    "current": ("current, A", 1.0, PURPLE),
}


def phase_plane(view: MotionView, ax: Axes) -> None:
    """Rate against x_rel, with the impact line and the Poincaré points at the drive's phase."""
    # At the ends of a filtered record the derivative is that of a polynomial's edge, and mostly noise.
    inside = slice(view.samples // 2, len(view.time) - view.samples // 2)
    ax.plot(MM * view.x_rel[inside], view.rate[inside], color=BLUE, lw=0.6)
    recorded = view.label != ""
    lines = []
    if np.isfinite(view.gap):
        words = "gap as stated" if recorded else "impact line"
        lines.append(ax.axvline(MM * view.gap, color=VERMILION, ls="--", lw=1.2, label=words))
    if view.gap_seen is not None:
        lines.append(ax.axvline(MM * view.gap_seen, color=VERMILION, ls=":", lw=1.6, label="contacts begin"))
    look: dict[str, Any] = {"marker": "o", "ms": 4.5, "color": GREEN, "zorder": 3, "label": "once a period"}
    ax.plot(MM * view.section_x_rel, view.section_rate, ls="none", **look)
    words = ("rate of X1 - X2, m/s", f"motion: {view.label}") if recorded else ("Y1 - Y2, m/s", "")
    set_text(ax, "X1 - X2, mm", *words)
    below_legend = set_legend(ax, "upper right")
    for line in lines:
        line.set_ydata([0.0, below_legend])


def force_on_rod(record: RunRecord, ax: Axes) -> None:
    """K times the recorded current against time, and beside it the fitted drive.

    Raises
    ------
    ValueError
        If the view has no force: it was made without K, or from a table without current.
    """
    view = record.view
    if view.force is None:
        raise ValueError("this view has no force: give view_record a K and a table with current")
    ax.plot(view.time, view.force, color=PURPLE, lw=1.0, label="K times current")
    ax.plot(view.time, record.force, color=BLACK, ls="--", lw=1.2, label="model")
    set_text(ax, "time, s", "force on the rod, N")
    set_legend(ax, "upper right")


def channel_history(view: MotionView, name: str, ax: Axes) -> None:
    """One raw channel against time; x_rel with the gap."""
    label, scale, color = _CHANNELS[name]
    ax.plot(view.time, scale * view.channels[name], color=color, lw=0.7)
    if name == "x_rel" and np.isfinite(view.gap):
        ax.axhline(scale * view.gap, color=VERMILION, ls="--", lw=1.2)
    set_text(ax, "time, s", label)


def overview_size(view: MotionView) -> tuple[float, float]:
    """Width and height of ``overview``, inches."""
    return 10.0, 1.2 + 1.25 * max(sum(name in view.channels for name in _CHANNELS), 3)


def overview(view: MotionView, figure: Figure | SubFigure) -> None:
    """Every channel above each other, the phase plane beside them."""
    set_margins(figure, left=1.0)
    names = [name for name in _CHANNELS if name in view.channels]
    grid = figure.add_gridspec(len(names), 2, wspace=0.24, hspace=0.3)
    for row, name in enumerate(names):
        ax = figure.add_subplot(grid[row, 0])
        channel_history(view, name, ax)
        ax.label_outer()
    phase_plane(view, figure.add_subplot(grid[:, 1]))


# corner: Corner plot: a histogram of every parameter, contours of every pair.


_BINS = 40
# Largest number of parameters whose panels are large; the tick labels of small ones stand upright.
_ROOMY = 4
# Levels of the share of the draws at lower density: the contours hold 95 % and 68 %.
_LEVELS = (0.05, 0.32, 1.0)
# A panel shows the central 99.8 %: one stray walker must not shrink everything else to a dot.
_TAILS = (0.1, 99.9)


def corner_size(columns: SampledParameters) -> tuple[float, float]:
    """Width and height of ``corner``, inches."""
    n = len(columns.names)
    panels = n * (2.6 if n <= 2 else 1.9 if n <= _ROOMY else min(1.25, max(0.9, 15 / n)))
    # The key stands in the empty upper triangle, or above the panels where that is too small.
    return 1.6 + panels, 1.25 + panels + (0.9 if n <= 2 else 0.0) + (0.25 if n > _ROOMY else 0.0)


def corner(columns: SampledParameters, figure: Figure | SubFigure) -> None:
    """Histogram of every sampled physical parameter and contours (68 %, 95 %) of every pair.

    The point fit is marked in black, the paper's estimate, where it lies in the picture, in vermilion.
    """
    n, flat = len(columns.names), columns.draws.reshape(-1, len(columns.names))
    set_margins(figure, left=1.25, right=0.35, bottom=1.25 if n > _ROOMY else 1.0, top=1.15 if n <= 2 else 0.25)
    grid, ends = figure.add_gridspec(n, n, wspace=0.06, hspace=0.06), _ends(columns)
    for i, j in ((row, column) for row in range(n) for column in range(row + 1)):
        ax = figure.add_subplot(grid[i, j], xticks=[], yticks=[])
        for mark, color, marker, line in ((columns.map, BLACK, "+", "-"), (columns.paper, VERMILION, "x", "--")):
            if i == j:
                ax.axvline(mark[j], color=color, ls=line, lw=1.3, zorder=4)
            else:
                ax.plot(mark[j], mark[i], ls="", marker=marker, color=color, ms=7, mew=1.4, zorder=4)
        if i == j:
            counts, edges = np.histogram(flat[:, j], _BINS, ends[j])
            ax.stairs(counts, edges, color=PALE_BLUE, fill=True)
            ax.stairs(counts, edges, color=BLUE, lw=1.2)
            ax.set_ylim(0.0, 1.08 * max(counts.max(), 1))
        else:
            _contours(ax, flat[:, [j, i]], ends[[j, i]])
            ax.set_ylim(*ends[i])
        ax.set_xlim(*ends[j])
        for axis, k, shown in ((ax.xaxis, j, i == n - 1), (ax.yaxis, i, j == 0 < i)):
            if shown:
                ticks, middle = MaxNLocator(5).tick_values(*ends[k]), np.mean(ends[k])
                # Those at the edges would touch the next panel's.
                axis.set_ticks(ticks[np.abs(ticks - middle) < 0.42 * np.ptp(ends[k])])
                axis.set_label_text(
                    with_unit(columns.symbols[k], columns.units[k]).replace(", ", ",\n"),
                    fontsize=TEXT,
                    parse_math=False,
                )
        ax.tick_params(labelsize=SMALL - 0.5, length=3)
        ax.tick_params("x", labelrotation=40 if n <= _ROOMY else 90)
        ax.ticklabel_format(useOffset=False, style="plain")
    figure.align_labels()
    key = (
        Patch(color=BLUE, label="68 % of the draws"),
        Patch(color=PALE_BLUE, label="95 % of the draws"),
        Line2D([], [], color=BLACK, marker="+", ms=9, mew=1.4, label="point fit (MAP)"),
        Line2D([], [], color=VERMILION, ls="--", marker="x", label="the paper's estimate, where in range"),
    )
    place: dict[str, Any] = {"bbox_to_anchor": (0.99, 0.98), "bbox_transform": figure.transSubfigure}
    set_legend(figure.axes[0], "beside", key, fontsize=TEXT, handlelength=2.0, **place | {"loc": "upper right"})


def _ends(columns: SampledParameters) -> np.ndarray:
    """Ends of every panel's axis, (n, 2)."""
    low, high = np.percentile(columns.draws.reshape(-1, len(columns.names)), _TAILS, axis=0)
    # A parameter that never moved (a frozen chain) still gets a panel of some width.
    width = np.where(high > low, high - low, np.where(high == 0, 1.0, np.abs(high)))
    return np.column_stack([low - 0.02 * width, low + 1.02 * width])


def _contours(ax: Axes, pair: np.ndarray, ends: np.ndarray) -> None:
    """Filled contours of the density of a pair, (draws, 2).

    Smoothing over five bins each way lets them follow the density and not the counting noise.
    """
    counts, *edges = np.histogram2d(pair[:, 0], pair[:, 1], _BINS, ends.tolist())
    for axis in (0, 1):
        counts = ndimage.convolve1d(counts, np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0, axis=axis, mode="constant")
    order, share = np.argsort(counts, axis=None, kind="stable"), np.empty(counts.size)
    share[order] = np.cumsum(counts.flat[order]) / max(counts.sum(), 1.0)
    x, y = (0.5 * (edge[1:] + edge[:-1]) for edge in edges)
    ax.contourf(x, y, share.reshape(counts.shape).T, levels=_LEVELS, colors=[PALE_BLUE, BLUE])


# traces: Traces of the sample: they show drift, and ensembles that disagree.


# Enough to see drift, few enough to see lines.
_POINTS, _WALKERS = 120, 2


def traces_size(columns: SampledParameters) -> tuple[float, float]:
    """Width and height of ``traces``, inches."""
    return 9.0, 0.8 + 1.15 * ((len(columns.names) + 1) // 2)


def traces(columns: SampledParameters, figure: Figure | SubFigure) -> None:
    """A panel per physical parameter: a few walkers of each ensemble against the step, one colour per ensemble."""
    n = len(columns.names)
    set_margins(figure, right=0.22, bottom=0.6, top=0.25, wspace=0.28, hspace=0.18)
    axes: Any = figure.subplots((n + 1) // 2, 2, sharex=True, squeeze=False)
    every = max(1, columns.draws.shape[1] // _POINTS)
    shown = columns.draws[:, ::every, :_WALKERS]
    step = np.arange(shown.shape[1]) * every * columns.posterior.thin
    for panel in axes.flat[n:]:
        panel.remove()
    for i, panel in enumerate(axes.flat[:n]):
        for e, ensemble in enumerate(shown[..., i]):
            panel.plot(step, ensemble, color=CYCLE[e % len(CYCLE)], lw=0.6, alpha=0.8)
        lowest = i + 2 >= n  # of its column; over an empty place too
        words = "step after burn-in" if lowest else "", with_unit(columns.symbols[i], columns.units[i])
        set_text(panel, *words, size=SMALL)
        panel.tick_params(labelbottom=lowest)
        panel.yaxis.set_major_locator(MaxNLocator(3))
        panel.ticklabel_format(axis="y", useOffset=False, style="plain")
        panel.margins(x=0.01)
    figure.align_ylabels()


#: Most rows of the ranking, and most letters of a line of their labels.
_ROWS, _LETTERS = 10, 44


def expected_sds(table: pd.DataFrame, targets: Sequence[str], title: str = "") -> Figure:
    """Ratio of the expected to the present sd of every target after each of the best tests; see ``planning.Plan``."""
    best, height = table.head(_ROWS)[::-1], 0.8 / len(targets)
    figure = new_figure(8.6, 1.3 + 0.42 * len(best), left=4.2, top=0.62)
    ax, rows = figure.subplots(), np.arange(len(best))
    for i, name in enumerate(targets):
        place = rows + 0.4 - (i + 0.5) * height
        ax.barh(place, best[f"{name}, ratio"], height, color=CYCLE[i % len(CYCLE)], label=name)
    ax.axvline(1.0, color=BLACK, lw=1.0, ls="--")
    words = [textwrap.fill(f"{n}: {what}", _LETTERS) for n, what in zip(best["tests"], best["what"], strict=True)]
    ax.set_yticks(rows, words, fontsize=SMALL, parse_math=False)
    set_text(ax, "expected sd, parts of the present one", "")
    figure.text(0.01, 0.99, title, fontsize=SMALL, va="top", fontweight="bold", parse_math=False)
    set_legend(ax, "above")
    return figure
