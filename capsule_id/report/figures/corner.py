"""Corner plot: a histogram of every parameter, contours of every pair.

All panels lie in one ``Axes`` and all contours are those of one field: with an ``Axes`` a panel, ten parameters would
cost more time than all other figures of the report together.
"""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from capsule_id.inference.result import Result
from capsule_id.report.figures.style import BLACK, BLUE, GREY, PALE_BLUE, SMALL, TEXT, VERMILION, figure_of, new_figure
from capsule_id.report.sampled_parameters import SampledParameters, sampled_parameters
from capsule_id.report.typography import fixed

_BINS = 40
# Shares of the draws inside the contours, from outside in.
_SHARES = (0.95, 0.68)
# A panel shows the central 99.8 %: one stray walker must not shrink everything else to a dot.
_TAILS = (0.1, 99.9)
# Panels are squares of this side on a grid of unit cells.
_SIDE = 0.94
# No tick in the outer tenths of a side: its label would run into the neighbour's.
_TICK_MARGIN = 0.1


def corner_size(n: int) -> tuple[float, float, float]:
    """Width of a panel, width and height of the figure of ``n`` parameters, inches."""
    panel = 2.6 if n <= 2 else 1.9 if n <= 4 else min(1.25, max(0.9, 15 / n))
    # The key stands in the empty upper triangle, or above the panels where that is too small.
    return panel, 1.25 + panel * n, 1.25 + panel * n + (0.8 if n <= 2 else 0.0)


def corner(result: Result, ax: Axes | None = None) -> Axes:
    """Histogram of every sampled physical parameter and contours (68 %, 95 %) of every pair.

    The point fit is marked in black, the paper's estimate, where it lies in the picture, in vermilion.

    Raises
    ------
    ValueError
        If nothing was sampled.
    """
    columns = sampled_parameters(result)
    n = len(columns.names)
    panel, width, height = corner_size(n)
    if ax is None:
        ax = new_figure(width, height).add_axes(
            (1.1 / width, 1.0 / height, panel * n / width, panel * n / height), frameon=False
        )
    else:
        ax.set_frame_on(False)
        panel = ax.get_window_extent().width / figure_of(ax).dpi / n
    ax.set(xlim=(0, n), ylim=(0, n), xticks=[], yticks=[])
    low, high = _limits(columns)
    flat = columns.draws.reshape(-1, n)
    place = (flat - low) / (high - low) * _BINS
    inside = (place >= 0) & (place < _BINS)
    bins = np.clip(place, 0, _BINS - 1).astype(np.int64)
    _contours(ax, bins, inside)
    _histograms(ax, bins, inside)
    _frames(ax, n)
    _marks(ax, (columns.map - low) / (high - low), BLACK, "+", "-")
    _marks(ax, (columns.paper - low) / (high - low), VERMILION, "x", "--")
    _axes(ax, columns, low, high, panel)
    above: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)} if n <= 2 else {"loc": "upper right"}
    ax.legend(handles=_key(), fontsize=TEXT, frameon=False, borderaxespad=0.2, **above)
    return ax


def _limits(columns: SampledParameters) -> tuple[np.ndarray, np.ndarray]:
    """Ends of every panel's axis, (n,) each."""
    low, high = np.percentile(columns.draws.reshape(-1, len(columns.names)), _TAILS, axis=0)
    # A parameter that never moved (a frozen chain) still gets a panel of some width.
    width = np.where(high > low, high - low, np.where(high == 0, 1.0, np.abs(high)))
    return low - 0.02 * width, low + 1.02 * width


def _contours(ax: Axes, bins: np.ndarray, inside: np.ndarray) -> None:
    """Filled contours of every pair at once: a field over the whole picture, zero between the panels.

    The field is the share of the draws at lower density, so that the same two levels hold in every panel.
    """
    n = bins.shape[1]
    field = np.zeros((n, _BINS + 2, n, _BINS + 2))
    for i in range(1, n):
        for j in range(i):
            both = inside[:, i] & inside[:, j]
            counts = np.bincount(bins[both, i] * _BINS + bins[both, j], minlength=_BINS * _BINS)
            density = _smoothed(counts.reshape(_BINS, _BINS).astype(float))
            order = np.argsort(density, axis=None, kind="stable")
            share = np.empty(order.size)
            share[order] = np.cumsum(density.flat[order]) / max(density.sum(), 1.0)
            field[n - 1 - i, 1:-1, j, 1:-1] = share.reshape(_BINS, _BINS)
    edge = np.concatenate([[0.0], (np.arange(_BINS) + 0.5) / _BINS, [1.0]]) * _SIDE
    centres = (np.arange(n)[:, np.newaxis] + edge).ravel()
    levels = [1 - share for share in _SHARES] + [1.0]
    size = n * (_BINS + 2)
    ax.contourf(centres, centres, field.reshape(size, size), levels=levels, colors=[PALE_BLUE, BLUE])


def _smoothed(counts: np.ndarray) -> np.ndarray:
    """Binomial smoothing over five bins each way, so that contours follow the density and not the counting noise."""
    kernel = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    padded = np.pad(counts, 2)
    rows = np.sum([weight * padded[k : k + _BINS] for k, weight in enumerate(kernel)], axis=0)
    return np.sum([weight * rows[:, k : k + _BINS] for k, weight in enumerate(kernel)], axis=0)


def _histograms(ax: Axes, bins: np.ndarray, inside: np.ndarray) -> None:
    n = bins.shape[1]
    for i in range(n):
        counts = np.bincount(bins[inside[:, i], i], minlength=_BINS)
        base = n - 1 - i
        heights = base + 0.92 * _SIDE * counts / max(counts.max(), 1)
        edges = i + np.linspace(0.0, _SIDE, _BINS + 1)
        ax.stairs(heights, edges, baseline=base, color=PALE_BLUE, fill=True)
        ax.stairs(heights, edges, baseline=base, color=BLUE, lw=1.2)


def _frames(ax: Axes, n: int) -> None:
    square = np.array([(0.0, 0.0), (_SIDE, 0.0), (_SIDE, _SIDE), (0.0, _SIDE), (0.0, 0.0)])
    corners = [np.array([j, n - 1 - i]) for i in range(n) for j in range(i + 1)]
    ax.add_collection(LineCollection([square + corner for corner in corners], colors=BLACK, lw=0.9, clip_on=False))


def _marks(ax: Axes, place: np.ndarray, color: str, marker: str, line: str) -> None:
    """A point in every pair and a line in every histogram; ``place`` (n,) counts from 0 to 1 along a panel's side."""
    n = place.size
    shown = np.flatnonzero((place > 0) & (place < 1))
    pairs = [(j + _SIDE * place[j], n - 1 - i + _SIDE * place[i]) for i in shown for j in shown if j < i]
    if pairs:
        ax.plot(*np.transpose(pairs), ls="", marker=marker, color=color, ms=7, mew=1.4, zorder=4)
    x = shown + _SIDE * place[shown]
    ax.vlines(x, n - 1.0 - shown, n - 1.0 - shown + _SIDE, color=color, ls=line, lw=1.3, zorder=4)


def _axes(ax: Axes, columns: SampledParameters, low: np.ndarray, high: np.ndarray, panel: float) -> None:
    """Ticks and labels along the bottom, and on the left from the second row on (a histogram has no y-axis).

    ``panel`` is the width of a cell in inches: text keeps its distance in inches whatever the size of the cells.
    """
    n = len(columns.names)
    length, gap, away = 0.035 / panel, 0.06 / panel, 0.6 / panel
    ticks: list[tuple[tuple[float, float], tuple[float, float]]] = []
    small: dict[str, Any] = {"fontsize": SMALL - 0.5}
    label: dict[str, Any] = {"fontsize": TEXT * min(1.0, panel), "parse_math": False}
    for i in range(n):
        for value, text in _ticks(low[i], high[i]):
            place = _SIDE * (value - low[i]) / (high[i] - low[i])
            ticks.append(((i + place, 0.0), (i + place, -length)))
            ax.text(i + place + gap, -gap, text, rotation=40, ha="right", va="top", rotation_mode="anchor", **small)
            if i > 0:
                y = n - 1 - i + place
                ticks.append(((0.0, y), (-length, y)))
                ax.text(-gap, y, text, ha="right", va="center", **small)
        name = f"{columns.symbols[i]}\n[{columns.units[i]}]"
        ax.text(i + _SIDE / 2, -away, name, ha="center", va="top", **label)
        if i > 0:
            y = n - 1 - i + _SIDE / 2
            ax.text(-away, y, name, ha="right", va="center", rotation=90, multialignment="center", **label)
    ax.add_collection(LineCollection(ticks, colors=GREY, lw=0.8, clip_on=False))


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Two to four round values inside the panel, with the decimals that tell them apart."""
    start, stop = low + _TICK_MARGIN * (high - low), high - _TICK_MARGIN * (high - low)
    power = math.floor(math.log10(high - low))
    steps = ((exponent, digit * 10.0**exponent) for exponent in (power, power - 1) for digit in (5, 2, 1))
    exponent, step = next((e, step) for e, step in steps if math.floor(stop / step) > math.ceil(start / step))
    multiples = range(math.ceil(start / step), math.floor(stop / step) + 1)
    return [(k * step, fixed(k * step, max(-exponent, 0))) for k in multiples]


def _key() -> tuple[Patch | Line2D, ...]:
    return (
        Patch(color=BLUE, label="68 % of the draws"),
        Patch(color=PALE_BLUE, label="95 % of the draws"),
        Line2D([], [], color=BLACK, marker="+", ms=9, mew=1.4, label="point fit (MAP)"),
        Line2D([], [], color=VERMILION, ls="--", marker="x", label="the paper's estimate, where in range"),
    )
