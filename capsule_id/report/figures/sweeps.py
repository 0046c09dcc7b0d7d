"""Figures of sweeps: diagrams, maps, and bands over draws of the parameters.

Datasets come from ``motions.sweep`` in SI; ``in_units`` says in what units the swept quantities are drawn. A panel is
``(data, ax)``. Direction has a colour everywhere: blue forward, vermilion backward, grey standing.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
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
    MM,
    PALE_BLUE,
    PURPLE,
    SMALL,
    VERMILION,
    figure_of,
    new_figure,
    set_legend,
    set_text,
)

# How a motion's label looks on areas, by direction in the order of the legend: shades, dark to light, and hatch. What
# does not fit goes into "other".
_LOOKS = {
    "F": (("#08306B", "#0072B2", "#56B4E9", "#A6D3EE", "#DCEEF9"), ""),
    "S": (("#6E6E6E", "#8F8F8F", "#ADADAD", "#C8C8C8"), ""),
    "B": (("#7F2704", "#D55E00", "#F0944D", "#F8C496", "#FDE6D2"), ""),
    "aperiodic": ((BLACK,), ""),
    "not settled": (("#FFFFFF",), "//"),
    "failed": (("#FFFFFF",), "xx"),
}
_OTHER = ("#E8D9A0", "")
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
_MEASURED = "#B00020"
# The colour scale of a quantity reaches to this quantile of its size: a few extreme points do not bleach the map.
_REACH = 0.99
# Backward to forward, in the colours that directions have elsewhere.
_DIVERGING = LinearSegmentedColormap.from_list(
    "direction", ["#7F2704", "#D55E00", "#F8C496", "#FFFFFF", "#A6D3EE", "#0072B2", "#08306B"]
)
_WORDS = {"mean_velocity": "mean velocity, mm/s", "efficiency": "advance per work, mm/J"}


@dataclass(frozen=True)
class MeasuredPoint:
    """A measured forced run on a diagram: the swept value (SI), the label of its record, mean velocity in m/s."""

    value: float
    label: str
    mean_velocity: float


def in_units(data: xr.Dataset, units: Mapping[str, tuple[str, float]]) -> xr.Dataset:
    """``data`` with the swept quantities in other units: name -> unit and its factor to SI, an attribute from here on."""
    drawn = {
        name: (name, data[name].to_numpy() / factor, {"units": unit, "factor": factor})
        for name, (unit, factor) in units.items()
    }
    return data.assign_coords(drawn)


def label_looks(weights: Mapping[str, float]) -> tuple[dict[str, tuple[str, str]], dict[str, int]]:
    """Colour and hatch by the names of the legend, and the place of every label among them: rare labels are "other"."""
    kept: defaultdict[str, list[str]] = defaultdict(list)
    for name in sorted(weights, key=lambda name: -weights[name]):
        direction = name.split("-")[2] if name.startswith("P-") else name
        if len(kept[direction]) < len(_LOOKS[direction][0]):
            kept[direction].append(name)
    looks = {
        name: (shade, hatch)
        for direction, (shades, hatch) in _LOOKS.items()
        for name, shade in zip(sorted(kept[direction]), shades, strict=False)
    }
    looks |= {"other": _OTHER} if len(looks) < len(weights) else {}
    return looks, {name: list(looks).index(name if name in looks else "other") for name in weights}


def _swept(data: xr.Dataset) -> tuple[str, np.ndarray, float]:
    """Symbol of the one swept quantity, its values as drawn, and the factor of their unit to SI."""
    over = str(next(name for name in data.dims if name not in ("branch", "section", "label", "quantile", "draw")))
    return over, data[over].to_numpy(), data[over].attrs.get("factor", 1.0)


def _axis_label(data: xr.Dataset, over: str) -> str:
    """``symbol, unit``."""
    return f"{over}, {data[over].attrs['units']}"


def _above_each_other(title: str, *panels: Callable[[Axes], None], **margins: float) -> Figure:
    """Two panels over the same values."""
    figure = new_figure(7.4, 6.6, **margins)
    figure.text(0.01, 0.99, title, fontsize=SMALL, va="top", fontweight="bold", parse_math=False)
    axes = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.0, 1.15]})
    for ax, panel in zip(axes, panels, strict=True):
        panel(ax)
    axes[0].set_xlabel("")
    return figure


# sweeps: Bifurcation diagrams: Poincaré section, mean velocity, labels, and measured runs beside them.


def bifurcation(data: xr.Dataset, measured: Sequence[MeasuredPoint] = (), title: str = "") -> Figure:
    """A Dataset over (branch, <quantity>): Poincaré section above, mean velocity and the motions' labels below."""
    panels = partial(poincare, data), partial(mean_velocity, data, measured)
    return _above_each_other(title, *panels, top=0.46, hspace=0.2)


def poincare(data: xr.Dataset, ax: Axes) -> None:
    """x_rel at the drive's phase against the swept quantity, and the gap as the impact line.

    One or two branches have a colour each; of many branches the points are coloured by the period of their motion.
    Values at which branches have come to different attractors are marked at the bottom.
    """
    over, x, _ = _swept(data)
    y = MM * data["x_rel"].transpose("branch", over, "section").to_numpy()
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
    several = x[data["attractors"].to_numpy() > 1]
    if several.size:
        look = {"ls": "none", "marker": "|", "ms": 8, "color": PURPLE, "transform": ax.get_xaxis_transform()}
        ax.plot(several, np.zeros(several.size), label="several attractors", clip_on=False, **look)
    if over != "G" and "G" in data.attrs:
        ax.axhline(MM * float(data.attrs["G"]), color=BLACK, ls="--", lw=0.9, label="impact line")
    set_text(ax, _axis_label(data, over), "X1 - X2 once a period, mm")
    set_legend(ax, "above", fontsize=SMALL - 0.5, columnspacing=1.1, handletextpad=0.2, handlelength=1.4)


def mean_velocity(data: xr.Dataset, measured: Sequence[MeasuredPoint], ax: Axes) -> None:
    """Mean velocity against the swept quantity, marked by direction, with labels and measured runs."""
    over, x, factor = _swept(data)
    names = ("mean_velocity", "direction", "label")
    velocity, direction, label = (data[name].transpose("branch", over).to_numpy() for name in names)
    at = np.broadcast_to(x, velocity.shape)
    ax.axhline(0.0, color=GREY, lw=0.8)
    for name, (colour, marker, word) in _DIRECTIONS.items():
        chosen = direction == name
        if chosen.any():
            ax.plot(at[chosen], MM * velocity[chosen], ls="none", marker=marker, ms=3.0, color=colour, label=word)
    for i, value in enumerate(np.unique(at[label == "failed"])):
        ax.axvline(value, color=GREY, lw=0.8, ls=":", label=None if i else "run given up")
    for i, run in enumerate(measured):
        place = run.value / factor, MM * run.mean_velocity
        _draw_measured(ax, place, run.label, None if i else "measured")
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.36 * (high - low))
    _write_labels(ax, x, label[0])
    set_text(ax, _axis_label(data, over), "mean velocity of the capsule, mm/s")
    set_legend(ax, "above")


def _write_labels(ax: Axes, x: np.ndarray, label: np.ndarray) -> None:
    """The first branch's labels over the ranges of values that have them, where the range is wide enough."""
    if len(x) < 2:
        return
    order = np.argsort(x)
    x, label = x[order], label[order]
    edges = np.concatenate([[x[0]], 0.5 * (x[1:] + x[:-1]), [x[-1]]])
    small: dict[str, Any] = {"fontsize": SMALL - 1.5, "ha": "center", "va": "center", "rotation": 90}
    begins = [0, *(1 + np.flatnonzero(label[1:] != label[:-1])), len(label)]
    for begin, end in pairwise(begins):
        left, right = float(edges[begin]), float(edges[end])
        if begin > 0:
            ax.axvline(left, ymin=0.79, ymax=0.97, color=GREY, lw=0.7)
        if right - left >= _ROOM_FOR_LABEL * (x[-1] - x[0]):
            place = 0.5 * (left + right), 0.88
            ax.text(*place, str(label[begin]), transform=ax.get_xaxis_transform(), parse_math=False, **small)


def _draw_measured(ax: Axes, place: tuple[float, float], text: str, label: str | None) -> None:
    """A measured run as the paper draws it, in red, with a text of its own."""
    ax.plot(*place, ls="none", marker="D", ms=6.0, mfc="none", mew=1.6, color=_MEASURED, label=label)
    words = ax.annotate(text, place, xytext=(0, 8), textcoords="offset points", ha="center", parse_math=False)
    # white about the letters: they stand among the points of the model
    words.set(
        fontsize=SMALL - 1.0, path_effects=[withStroke(linewidth=2.5, foreground="white")], color=_MEASURED, zorder=5
    )


def _dots(ax: Axes, x: np.ndarray, y: np.ndarray, **look: object) -> None:
    """Points y (n, section) over x (n,) as one artist."""
    ax.plot(np.repeat(x, y.shape[1]), y.ravel(), ls="none", **look)  # pyright: ignore[reportArgumentType]


# bands: Motions over draws of the parameters: probabilities, bands, best operating point.


def bands(data: xr.Dataset, title: str = "") -> Figure:
    """A Dataset of ``operating.bands``: probability of each motion above, objective with its band below."""
    return _above_each_other(
        title, partial(probabilities, data), partial(objective_band, data), right=1.66, hspace=0.14
    )


def probabilities(data: xr.Dataset, ax: Axes) -> None:
    """Probability of each motion label, stacked, against the swept quantity."""
    over, x, _ = _swept(data)
    shares = dict(zip(map(str, data["label"].to_numpy()), data["probability"].to_numpy(), strict=True))
    looks, places = label_looks({name: share.sum() for name, share in shares.items()})
    heights = np.zeros((len(looks), len(x)))
    for name, share in shares.items():
        heights[places[name]] += share
    areas = ax.stackplot(
        x, heights, colors=[look[0] for look in looks.values()], labels=looks, edgecolor="white", lw=0.3
    )
    for area, (_, hatch) in zip(areas, looks.values(), strict=True):
        area.set_hatch(hatch)
    ax.set(xlim=(x.min(), x.max()), ylim=(0.0, 1.0))
    set_text(ax, _axis_label(data, over), "probability of the motion")
    set_legend(ax, "beside", areas[::-1], fontsize=SMALL - 1.0)


def objective_band(data: xr.Dataset, ax: Axes) -> None:
    """Median and 95 % band of the objective, the value chosen, and the interval of the best value over the draws."""
    over, x, factor = _swept(data)
    objective = str(data.attrs["objective"])
    low, middle, high = MM * data[f"{objective}_quantiles"].to_numpy()
    least, span, most = MM * data[f"chosen_{objective}_quantiles"].to_numpy()
    best = data["best_quantiles"].to_numpy() / factor
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.fill_between(x, low, high, color=PALE_BLUE, lw=0, label="95 % band")
    ax.plot(x, middle, color=BLUE, lw=1.5, label="median")
    look: dict[str, Any] = {"color": BLACK, "marker": "o", "ms": 5, "capsize": 3, "ls": "none", "clip_on": False}
    reach = [[span - least], [most - span]]
    ax.errorbar([float(data["chosen"]) / factor], [span], yerr=reach, label="best in the mean", **look)
    ax.axvspan(best[0], best[2], color=VERMILION, alpha=0.16, lw=0, label="best, 95 % of draws")
    set_text(ax, _axis_label(data, over), _WORDS[objective])
    set_legend(ax, "beside", fontsize=SMALL - 1.0)


# maps: Figures over two quantities: which motion, how fast, how efficient.


def motion_map(data: xr.Dataset, title: str = "") -> Figure:
    """A Dataset over two quantities: label, mean velocity and efficiency beside each other."""
    figure = new_figure(12.6, 4.4, left=0.7, right=0.5, wspace=0.36)
    first, *others = figure.subplots(1, 3, sharex=True, sharey=True)
    labels(data, title, first)
    for name, ax in zip(_WORDS, others, strict=True):
        quantity(data, name, ax)
        ax.set_ylabel("")
    return figure


def labels(data: xr.Dataset, title: str, ax: Axes) -> None:
    """Which motion where, as coloured areas: blue forward, orange backward, grey standing, black aperiodic."""
    found, number, count = np.unique(data["label"].to_numpy(), return_inverse=True, return_counts=True)
    looks, places = label_looks(dict(zip(map(str, found), count.tolist(), strict=True)))
    classes = np.array(list(places.values()))[number].reshape(data["label"].shape)
    look = ListedColormap([colour for colour, _ in looks.values()])
    _mesh(data, classes, f"settled motion {title}".strip(), ax, cmap=look, vmin=-0.5, vmax=len(looks) - 0.5)
    handles = [Patch(facecolor=look[0], edgecolor=GREY, lw=0.4, label=name) for name, look in looks.items()]
    set_legend(ax, "beside", handles, fontsize=SMALL - 2.0, handlelength=1.0, handletextpad=0.4, labelspacing=0.35)


def quantity(data: xr.Dataset, name: str, ax: Axes) -> None:
    """``mean_velocity`` or ``efficiency`` in colour: blue forward, orange backward, dark grey where a run failed."""
    values = MM * data[name].to_numpy()
    reach = float(np.nanquantile(np.abs(values), _REACH)) or 1.0
    ax.set_facecolor(GREY)
    mesh = _mesh(data, values, _WORDS[name], ax, cmap=_DIVERGING, vmin=-reach, vmax=reach)
    ends = {(True, True): "both", (True, False): "min", (False, True): "max", (False, False): "neither"}
    beyond = (bool(np.nanmin(values) < -reach), bool(np.nanmax(values) > reach))
    bar = figure_of(ax).colorbar(mesh, ax=ax, fraction=0.05, pad=0.03, extend=ends[beyond])
    bar.ax.tick_params(labelsize=SMALL - 1.0)


def _mesh(data: xr.Dataset, values: np.ndarray, title: str, ax: Axes, **look: Any) -> Any:
    """``values`` (first quantity, second) as cells at their places in the units to be drawn."""
    first, second = map(str, data["mean_velocity"].dims)
    x, y = data[first].to_numpy(), data[second].to_numpy()
    mesh = ax.pcolormesh(x, y, values.T, shading="nearest", rasterized=True, **look)
    set_text(ax, _axis_label(data, first), _axis_label(data, second), title)
    return mesh


# tuning: Mean velocity over searched settings, the chosen one, and the measured operating points.


def tuned(
    data: xr.Dataset,
    best: Mapping[str, float],
    measured: Sequence[tuple[str, Mapping[str, float], float]],
    title: str = "",
) -> Figure:
    """The ``surface`` of a search over one or two settings, others at their best.

    Parameters
    ----------
    best : the chosen settings by symbol, SI
    measured : label, settings by symbol (SI) and mean velocity (mm/s) of measured operating points
    """
    figure = new_figure(7.4, 5.0, right=0.5, top=0.62)
    ax, shown = figure.subplots(), list(map(str, data["mean_velocity"].dims))
    if len(shown) == 2:
        quantity(data, "mean_velocity", ax)
    else:
        low, _, high = MM * data["mean_velocity_quantiles"].to_numpy()
        ax.fill_between(data[shown[0]], low, high, color=PALE_BLUE, lw=0, label="95 % of the draws")
        ax.plot(data[shown[0]], MM * data["mean_velocity"], color=BLUE, lw=1.5, label="mean of the draws")
        ax.axvline(best[shown[0]], color=BLACK, lw=1.0, ls="--", label="chosen")
    words = f"{title} {_WORDS['mean_velocity']}".strip()
    figure.text(0.01, 0.99, words, fontsize=SMALL, va="top", fontweight="bold", parse_math=False)
    set_text(ax, _axis_label(data, shown[0]), _axis_label(data, shown[1]) if shown[1:] else _WORDS["mean_velocity"])
    ends = [(float(data[name].min()), float(data[name].max())) for name in shown]
    if len(shown) == 2:
        ax.plot(*(best[name] for name in shown), ls="none", marker="*", ms=15, mfc="white", mec=BLACK, label="chosen")
    first = True
    for _, settings, speed in measured:
        place = [settings[name] for name in shown if name in settings]
        if len(place) < len(shown) or not all(low <= x <= high for x, (low, high) in zip(place, ends, strict=True)):
            continue
        at = (place[0], place[1] if shown[1:] else speed)
        _draw_measured(ax, at, f"{speed:.3g}", "measured, mm/s" if first else None)
        first = False
    set_legend(ax, "above")
    return figure
