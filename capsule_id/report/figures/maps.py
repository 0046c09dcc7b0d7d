"""Figures over two quantities: which motion, how fast, how efficient; and basins of attraction."""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from capsule_id.report.figures.motion_looks import label_classes
from capsule_id.report.figures.style import SMALL, TEXT, new_figure, own_axes, set_text
from capsule_id.report.figures.sweeps import AxisUnit

_MM = 1e3
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
