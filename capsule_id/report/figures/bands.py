"""Motions over draws of the parameters: probabilities, bands, best operating point."""

from collections.abc import Mapping

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsule_id.report.figures.motion_looks import label_looks, shown
from capsule_id.report.figures.style import (
    BLACK,
    BLUE,
    GREY,
    PALE_BLUE,
    SMALL,
    VERMILION,
    new_figure,
    own_axes,
    set_text,
)
from capsule_id.report.figures.sweeps import AxisUnit, axis_label, axis_of

_MM = 1e3


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
