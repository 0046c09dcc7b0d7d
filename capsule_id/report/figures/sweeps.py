"""Figures of sweeps: diagrams, maps, basins, and bands over draws of the parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from capsule_id.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PALE_BLUE,
    PURPLE,
    SMALL,
    TEXT,
    VERMILION,
    new_figure,
    own_axes,
    set_legend,
    set_text,
)

# motion looks: How a motion's label looks on areas: blue forward, orange backward, grey standing, black aperiodic.


# Shades of a direction, dark to light; what does not fit goes into "other".
_SHADES = {
    "F": ("#08306B", "#0072B2", "#56B4E9", "#A6D3EE", "#DCEEF9"),
    "B": ("#7F2704", "#D55E00", "#F0944D", "#F8C496", "#FDE6D2"),
    "S": ("#6E6E6E", "#8F8F8F", "#ADADAD", "#C8C8C8"),
}
_OTHER, _APERIODIC, _FAILED = "#E8D9A0", BLACK, "#FFFFFF"


def shown(names: list[str], heights: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Labels that have a look of their own, by direction, and "other"; heights (labels, ...) go with them."""
    kept: dict[str, list[int]] = {}
    rest: list[int] = []
    for i in np.argsort(-heights.reshape(len(names), -1).sum(axis=1), kind="stable"):
        direction = _direction_of(names[i])
        family = kept.setdefault(direction, [])
        (family if len(family) < len(_SHADES.get(direction, " ")) else rest).append(int(i))
    order = [
        i
        for direction in ("F", "S", "B", "aperiodic", "not settled", "failed")
        for i in sorted(kept.get(direction, []), key=lambda i: names[i])
    ]
    own = heights[order]
    if rest:
        return [*(names[i] for i in order), "other"], np.concatenate([own, heights[rest].sum(axis=0)[None]])
    return [names[i] for i in order], own


def _direction_of(name: str) -> str:
    return name.split("-")[2] if name.startswith("P-") else name


def label_looks(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Colour and hatch of each label."""
    used: dict[str, int] = {}
    colours: list[str] = []
    hatches: list[str] = []
    for name in names:
        direction = _direction_of(name)
        if direction in _SHADES:
            shade = used.get(direction, 0)
            used[direction] = shade + 1
            colours.append(_SHADES[direction][shade])
        else:
            colours.append({"other": _OTHER, "aperiodic": _APERIODIC}.get(name, _FAILED))
        hatches.append({"failed": "xx", "not settled": "//"}.get(name, ""))
    return colours, hatches


def label_classes(label: np.ndarray) -> tuple[list[str], list[str], np.ndarray]:
    """(names, colours, classes) of an array of labels: classes has its shape and holds indices into names."""
    found = [str(name) for name in np.unique(label)]
    share = np.stack([label == name for name in found]).astype(float)
    names, _ = shown(found, share)
    index = {name: i for i, name in enumerate(names)}
    classes = np.vectorize(lambda name: index.get(str(name), index.get("other", 0)), otypes=[int])(label)
    return names, label_looks(names)[0], classes


# sweeps: Bifurcation diagrams: Poincaré section, mean velocity, labels, and measured runs beside them.
#
# Datasets come from ``motions.sweep`` in SI; an ``AxisUnit`` says in what unit a quantity is drawn. Direction has a
# colour everywhere: blue forward, vermilion backward, grey standing.


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


# bands: Motions over draws of the parameters: probabilities, bands, best operating point.


def bands(data: xr.Dataset, units: Mapping[str, AxisUnit] | None = None, title: str = "") -> Figure:
    """A Dataset of ``operating.bands``: probability of each motion above, objective with its band below."""
    figure = new_figure(7.4, 6.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    figure.subplots_adjust(left=0.115, right=0.775, bottom=0.095, top=0.94, hspace=0.14)
    probabilities(data, units, upper)
    figure.text(0.01, 0.99, title, fontsize=SMALL, va="top", fontweight="bold", parse_math=False)
    upper.set_xlabel("")
    objective_band(data, units, lower)
    return figure


def probabilities(data: xr.Dataset, units: Mapping[str, AxisUnit] | None = None, ax: Axes | None = None) -> Axes:
    """Probability of each motion label, stacked, against the swept quantity."""
    ax = own_axes(ax, 6.4, 4.4)
    over, x = axis_of(data, units)
    names, heights = shown([str(name) for name in data["label"].to_numpy()], data["probability"].to_numpy())
    colours, hatches = label_looks(names)
    areas = ax.stackplot(x, heights, colors=colours, labels=names, edgecolor="white", lw=0.3)
    for area, hatch in zip(areas, hatches, strict=True):
        area.set_hatch(hatch)
    ax.set(xlim=(x.min(), x.max()), ylim=(0.0, 1.0))
    set_text(ax, axis_label(data, over, units), "probability of the motion, 1")
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(handles[::-1], labels[::-1], fontsize=SMALL - 1.0, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return ax


def objective_band(data: xr.Dataset, units: Mapping[str, AxisUnit] | None = None, ax: Axes | None = None) -> Axes:
    """Median and 95 % band of the objective, the value chosen, and the interval of the best value over the draws."""
    ax = own_axes(ax, 6.4, 4.4)
    over, x = axis_of(data, units)
    objective = str(data.attrs["objective"])
    factor = (units or {}).get(over, AxisUnit("")).factor
    low, middle, high = _MM * data[f"{objective}_quantiles"].to_numpy()
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.fill_between(x, low, high, color=PALE_BLUE, lw=0, label="95 % band")
    ax.plot(x, middle, color=BLUE, lw=1.5, label="median")
    chosen = float(data["chosen"]) / factor
    span = _MM * data[f"chosen_{objective}_quantiles"].to_numpy()
    ax.errorbar(
        [chosen], [span[1]], yerr=[[span[1] - span[0]], [span[2] - span[1]]], color=BLACK, marker="o", ms=5, capsize=3,
        ls="none", clip_on=False,
        label="best in the mean"
    )  # fmt: skip
    best = data["best_quantiles"].to_numpy() / factor
    ax.axvspan(best[0], best[2], color=VERMILION, alpha=0.16, lw=0, label="best, 95 % of draws")
    words = {"mean_velocity": "mean velocity, mm/s", "efficiency": "advance per work, mm/J"}
    set_text(ax, axis_label(data, over, units), words[objective])
    ax.legend(fontsize=SMALL - 1.0, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return ax


# maps: Figures over two quantities: which motion, how fast, how efficient; and basins of attraction.


# The colour scale of a quantity reaches to this quantile of its size: a few extreme points do not bleach the map.
_REACH = 0.99
# Backward to forward, in the colours that directions have elsewhere.
_DIVERGING = LinearSegmentedColormap.from_list(
    "direction", ["#7F2704", "#D55E00", "#F8C496", "#FFFFFF", "#A6D3EE", "#0072B2", "#08306B"]
)
_WORDS = {"mean_velocity": "mean velocity, mm/s", "efficiency": "advance per work, mm/J"}


def motion_map(data: xr.Dataset, units: Mapping[str, AxisUnit] | None = None, title: str = "") -> Figure:
    """A Dataset over two quantities: label, mean velocity and efficiency beside each other."""
    figure = new_figure(12.6, 4.4)
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    figure.subplots_adjust(left=0.055, right=0.96, bottom=0.14, top=0.91, wspace=0.36)
    labels(data, units, axes[0])
    axes[0].set_title(" ".join(["settled motion", title]).strip(), fontsize=TEXT - 0.5, loc="left", parse_math=False)
    for name, ax in zip(_WORDS, axes[1:], strict=True):
        quantity(data, name, units, ax)
        ax.set_ylabel("")
    return figure


def labels(data: xr.Dataset, units: Mapping[str, AxisUnit] | None = None, ax: Axes | None = None) -> Axes:
    """Which motion where, as coloured areas: blue forward, orange backward, grey standing, black aperiodic."""
    ax = own_axes(ax, 6.4, 4.6)
    names, colours, classes = label_classes(data["label"].to_numpy())
    x, y = _mesh(data, units, ax)
    look = ListedColormap(colours)
    ax.pcolormesh(x, y, classes.T, cmap=look, vmin=-0.5, vmax=len(names) - 0.5, rasterized=True)
    handles = [Patch(facecolor=c, edgecolor="#6B6B6B", lw=0.4, label=n) for n, c in zip(names, colours, strict=True)]
    ax.legend(
        handles=handles, fontsize=SMALL - 2.0, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.02),
        handlelength=1.0, handletextpad=0.4, labelspacing=0.35, borderaxespad=0.3,
    )  # fmt: skip
    return ax


def quantity(data: xr.Dataset, name: str, units: Mapping[str, AxisUnit] | None = None, ax: Axes | None = None) -> Axes:
    """``mean_velocity`` or ``efficiency`` in colour: blue forward, orange backward, dark grey where a run failed."""
    ax = own_axes(ax, 6.4, 4.6)
    values = _MM * data[name].to_numpy()
    reach = float(np.nanquantile(np.abs(values), _REACH)) or 1.0
    x, y = _mesh(data, units, ax)
    ax.set_facecolor("#6B6B6B")
    mesh = ax.pcolormesh(x, y, values.T, cmap=_DIVERGING, vmin=-reach, vmax=reach, rasterized=True)
    ends = {(True, True): "both", (True, False): "min", (False, True): "max", (False, False): "neither"}
    beyond = (bool(np.nanmin(values) < -reach), bool(np.nanmax(values) > reach))
    figure = ax.get_figure(root=True)
    if figure is not None:
        bar = figure.colorbar(mesh, ax=ax, fraction=0.05, pad=0.03, extend=ends[beyond])
        bar.ax.tick_params(labelsize=SMALL - 1.0)
    ax.set_title(_WORDS[name], fontsize=TEXT - 0.5, loc="left", parse_math=False)
    return ax


def basins(data: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Which initial state leads to which attractor: a Dataset of ``sweep.basins``."""
    ax = own_axes(ax, 6.4, 4.6)
    number, label = data["attractor"].to_numpy(), data["label"].to_numpy()
    names = [f"{i + 1}: {label[number == i][0]}" if i >= 0 else "failed" for i in np.unique(number)]
    colours = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6B6B6B", "#000000"]
    shown = [colours[i % len(colours)] for i in range(len(names))]
    classes = number - number.min()
    x, y = (_edges(data[axis].to_numpy() * scale) for axis, scale in (("x_rel_0", _MM), ("rate_0", 1.0)))
    ax.pcolormesh(x, y, classes.T, cmap=ListedColormap(shown), vmin=-0.5, vmax=len(names) - 0.5, rasterized=True)
    set_text(ax, "X1 - X2 at the start, mm", "Y1 - Y2 at the start, m/s")
    handles = [Patch(facecolor=c, label=n) for n, c in zip(names, shown, strict=True)]
    ax.legend(handles=handles, fontsize=SMALL - 1.0, loc="upper right")
    return ax


def _mesh(data: xr.Dataset, units: Mapping[str, AxisUnit] | None, ax: Axes) -> tuple[np.ndarray, np.ndarray]:
    """Edges of the cells along both axes, in the units to be drawn; names the axes."""
    edges, words = [], []
    for name in map(str, data["label"].dims):
        unit = (units or {}).get(name, AxisUnit(str(data[name].attrs["units"])))
        edges.append(_edges(data[name].to_numpy() / unit.factor))
        words.append(f"{name}, {unit.unit}")
    set_text(ax, words[0], words[1])
    return edges[0], edges[1]


def _edges(x: np.ndarray) -> np.ndarray:
    if len(x) == 1:
        return np.array([x[0] - 0.5, x[0] + 0.5])
    middle = 0.5 * (x[1:] + x[:-1])
    return np.concatenate([[1.5 * x[0] - 0.5 * x[1]], middle, [1.5 * x[-1] - 0.5 * x[-2]]])
