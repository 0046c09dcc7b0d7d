"""Bifurcation diagrams: Poincaré section, mean velocity, labels, and measured runs beside them.

Datasets come from ``motions.sweep`` in SI; an ``AxisUnit`` says in what unit a quantity is drawn. Direction has a
colour everywhere: blue forward, vermilion backward, grey standing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from capsule_id.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PURPLE,
    SMALL,
    VERMILION,
    new_figure,
    own_axes,
    set_legend,
    set_text,
)

_MM = 1e3
_DIRECTIONS = {"F": (BLUE, "^", "forward"), "B": (VERMILION, "v", "backward"), "S": (GREY, "o", "standing")}
# A label stands over its range of values where the range is at least this part of the axis.
_ROOM_FOR_LABEL = 0.055
# The second branch in rings, so that the first shows where both agree.
_BRANCH_LOOKS = (
    {"color": BLUE, "marker": ".", "ms": 3.2},
    {"color": VERMILION, "marker": "o", "mfc": "none", "mew": 0.4, "ms": 3.2},
)
# Periods of motions, first to last, of one colour.
_PERIODS = {
    (0, 0): (GREY, "aperiodic"),
    (1, 1): (BLUE, "period 1"),
    (2, 2): (VERMILION, "period 2"),
    (3, 99): (GREEN, "longer"),
}


@dataclass(frozen=True)
class AxisUnit:
    """How a quantity is drawn: value in ``unit`` = SI value / factor."""

    unit: str
    factor: float = 1.0


@dataclass(frozen=True)
class MeasuredPoint:
    """A measured forced run on a diagram: the swept value (SI), the label of its record, mean velocity in m/s."""

    value: float
    label: str
    mean_velocity: float


def bifurcation(
    data: xr.Dataset,
    units: Mapping[str, AxisUnit] | None = None,
    measured: Sequence[MeasuredPoint] = (),
    title: str = "",
) -> Figure:
    """A Dataset over (branch, <quantity>): Poincaré section above, mean velocity and the motions' labels below."""
    figure = new_figure(7.4, 6.6)
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.0, 1.15]})
    figure.subplots_adjust(left=0.115, right=0.975, bottom=0.095, top=0.93, hspace=0.2)
    poincare(data, units, upper)
    figure.text(0.01, 0.99, title, fontsize=SMALL, va="top", fontweight="bold", parse_math=False)
    upper.set_xlabel("")
    mean_velocity(data, units, measured, lower)
    return figure


def poincare(data: xr.Dataset, units: Mapping[str, AxisUnit] | None = None, ax: Axes | None = None) -> Axes:
    """x_rel at the drive's phase against the swept quantity, and the gap as the impact line.

    One or two branches have a colour each; of many branches the points are coloured by the period of their motion.
    Values at which branches have come to different attractors are marked at the bottom.
    """
    ax = own_axes(ax, 6.4, 4.4)
    over, x = axis_of(data, units)
    y = _MM * data["x_rel"].transpose("branch", over, "section").to_numpy()
    branches = [str(name) for name in data["branch"].to_numpy()]
    if len(branches) <= len(_BRANCH_LOOKS):
        for name, points, look in zip(branches, y, _BRANCH_LOOKS, strict=False):
            _dots(ax, x, points, label=name, **look)
    else:
        period = data["period"].transpose("branch", over).to_numpy()
        at = np.broadcast_to(x, period.shape)
        for (first, last), (colour, word) in _PERIODS.items():
            chosen = (period >= first) & (period <= last)
            if chosen.any():
                _dots(ax, at[chosen], y[chosen], color=colour, marker=".", ms=3.2, label=word)
    several = data["attractors"].to_numpy() > 1
    if several.any():
        low = np.zeros(int(several.sum()))
        look = {"ls": "none", "marker": "|", "ms": 8, "color": PURPLE, "transform": ax.get_xaxis_transform()}
        ax.plot(x[several], low, label="several attractors", clip_on=False, **look)
    if over != "G" and "G" in data.attrs:
        ax.axhline(_MM * float(data.attrs["G"]), color=BLACK, ls="--", lw=0.9, label="impact line")
    set_text(ax, axis_label(data, over, units), "X1 - X2 once a period, mm")
    handles, words = ax.get_legend_handles_labels()
    tight: dict[str, Any] = {"columnspacing": 1.1, "handletextpad": 0.2, "borderaxespad": 0.1, "handlelength": 1.4}
    place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": len(words)}
    ax.legend(handles, words, fontsize=SMALL - 0.5, frameon=False, **place, **tight)
    return ax


def mean_velocity(
    data: xr.Dataset,
    units: Mapping[str, AxisUnit] | None = None,
    measured: Sequence[MeasuredPoint] = (),
    ax: Axes | None = None,
) -> Axes:
    """Mean velocity against the swept quantity, marked by direction, with labels and measured runs."""
    ax = own_axes(ax, 6.4, 4.4)
    over, x = axis_of(data, units)
    velocity = _MM * data["mean_velocity"].transpose("branch", over).to_numpy()
    direction = data["direction"].transpose("branch", over).to_numpy()
    label = data["label"].transpose("branch", over).to_numpy()
    at = np.broadcast_to(x, velocity.shape)
    ax.axhline(0.0, color=GREY, lw=0.8)
    for name, (colour, marker, word) in _DIRECTIONS.items():
        chosen = direction == name
        if chosen.any():
            ax.plot(at[chosen], velocity[chosen], ls="none", marker=marker, ms=3.0, color=colour, label=word)
    failed = label == "failed"
    for value in np.unique(at[failed]):
        ax.axvline(value, color=GREY, lw=0.8, ls=":", label=None if value > at[failed].min() else "run given up")
    _draw_measured(ax, over, units, measured)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.36 * (high - low))
    _write_labels(ax, x, label[0])
    set_text(ax, axis_label(data, over, units), "mean velocity of the capsule, mm/s")
    set_legend(ax, place="above")
    return ax


def _draw_measured(
    ax: Axes, over: str, units: Mapping[str, AxisUnit] | None, measured: Sequence[MeasuredPoint]
) -> None:
    """Measured runs as the paper draws them, in red, each with the label of its own record."""
    factor = (units or {}).get(over, AxisUnit("")).factor
    for i, run in enumerate(measured):
        x, y = run.value / factor, _MM * run.mean_velocity
        name = "measured" if i == 0 else None
        ax.plot([x], [y], ls="none", marker="D", ms=6.0, mfc="none", mew=1.6, color="#B00020", label=name)
        text = ax.annotate(run.label, (x, y), xytext=(0, 8), textcoords="offset points", ha="center", color="#B00020")
        # white about the letters: they stand among the points of the model
        text.set(fontsize=SMALL - 1.0, path_effects=[withStroke(linewidth=2.5, foreground="white")], zorder=5)


def _write_labels(ax: Axes, x: np.ndarray, label: np.ndarray) -> None:
    """The first branch's labels over the ranges of values that have them, where the range is wide enough."""
    if len(x) < 2:
        return
    order = np.argsort(x)
    x, label = x[order], label[order]
    edges = np.concatenate([[x[0]], 0.5 * (x[1:] + x[:-1]), [x[-1]]])
    begin = 0
    for name, members in groupby(label):
        end = begin + len(list(members))
        left, right = edges[begin], edges[end]
        if begin > 0:
            ax.axvline(left, ymin=0.79, ymax=0.97, color=GREY, lw=0.7)
        if right - left >= _ROOM_FOR_LABEL * (x[-1] - x[0]):
            where = (0.5 * (left + right), 0.88)
            small = {"fontsize": SMALL - 1.5, "ha": "center", "va": "center", "rotation": 90}
            ax.text(*where, str(name), transform=ax.get_xaxis_transform(), parse_math=False, **small)
        begin = end


def _dots(ax: Axes, x: np.ndarray, y: np.ndarray, **look: object) -> None:
    """Points y (n, section) over x (n,) as one artist."""
    ax.plot(np.repeat(x, y.shape[1]), y.ravel(), ls="none", **look)  # pyright: ignore[reportArgumentType]


def axis_of(data: xr.Dataset, units: Mapping[str, AxisUnit] | None) -> tuple[str, np.ndarray]:
    """(symbol, values in the unit to be drawn) of the one swept quantity."""
    other = {"branch", "section", "label", "quantile", "draw"}
    over = str(next(name for name in data.dims if name not in other))
    return over, data[over].to_numpy() / (units or {}).get(over, AxisUnit("")).factor


def axis_label(data: xr.Dataset, over: str, units: Mapping[str, AxisUnit] | None) -> str:
    """``symbol, unit`` as it stands on the axis."""
    unit = units[over].unit if units and over in units else str(data[over].attrs["units"])
    return f"{over}, {unit}"
