"""Pictures of the sample: corner plot and traces of the physical parameters."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from capsule_id.inference.result import Posterior, Result
from capsule_id.report.style import BLACK, BLUE, CYCLE, PALE_BLUE, SMALL, TEXT, VERMILION, new_figure
from capsule_id.report.typography import plain_symbol, prefix_for, unit_suffix

_BINS = 40
# Shares of the draws inside the contours, from outside in.
_SHARES = (0.95, 0.68)
# A panel shows the central 99.8 %: one stray walker must not shrink everything else to a dot.
_TAILS = (0.1, 99.9)
_TRACE_POINTS, _TRACE_WALKERS = 120, 2


def corner(result: Result) -> Figure:
    """Histogram of every sampled physical parameter and contours (68 %, 95 %) of every pair.

    The point fit is marked in black, the paper's estimate, where it lies in the picture, in vermilion.

    Raises
    ------
    ValueError
        If nothing was sampled.
    """
    columns = _Columns(result)
    n = len(columns.names)
    panel = 1.25 if n > 4 else 1.9
    size = 1.3 + panel * n
    figure = new_figure(size, size)
    grid = figure.add_gridspec(
        n, n, left=1.0 / size, right=1 - 0.2 / size, bottom=0.9 / size, top=1 - 0.2 / size, wspace=0.06, hspace=0.06
    )
    for i in range(n):
        for j in range(i + 1):
            ax = figure.add_subplot(grid[i, j])
            if i == j:
                _histogram(ax, columns, i)
            else:
                _contours(ax, columns, j, i)
            _corner_ticks(ax, columns, j, i, n)
    key = (
        Patch(color=BLUE, label="68 % of the draws"),
        Patch(color=PALE_BLUE, label="95 % of the draws"),
        Line2D([], [], color=BLACK, marker="+", ms=9, mew=1.4, label="point fit (MAP)"),
        Line2D([], [], color=VERMILION, ls="--", marker="x", label="the paper's estimate, where in range"),
    )
    figure.legend(
        handles=key, fontsize=TEXT, frameon=False, bbox_to_anchor=(1 - 0.2 / size, 1 - 0.3 / size), loc="upper right"
    )
    return figure


def traces(result: Result) -> Figure:
    """A panel per physical parameter: a few walkers of each ensemble against the step, one colour per ensemble.

    Raises
    ------
    ValueError
        If nothing was sampled.
    """
    columns = _Columns(result)
    posterior = columns.posterior
    n = len(columns.names)
    rows = (n + 1) // 2
    height = 0.8 + 1.15 * rows
    figure = new_figure(9.0, height)
    axes = figure.subplots(rows, 2, sharex=True, squeeze=False)
    every = max(1, posterior.draws.shape[1] // _TRACE_POINTS)
    step = np.arange(0, posterior.draws.shape[1], every) * posterior.thin
    for i, ax in enumerate(axes.flat):
        if i >= n:
            ax.set_axis_off()
            continue
        for e, ensemble in enumerate(posterior.draws[:, ::every, :_TRACE_WALKERS, columns.index[i]]):
            ax.plot(step, ensemble * columns.scale[i], color=CYCLE[e % len(CYCLE)], lw=0.5, alpha=0.8)
        ax.set_ylabel(columns.labels[i], fontsize=SMALL, parse_math=False)
        ax.tick_params(labelsize=SMALL, length=3)
        ax.yaxis.set_major_locator(MaxNLocator(3))
        ax.ticklabel_format(axis="y", useOffset=False, style="plain")
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0.01)
    for ax in axes[-1]:
        ax.set_xlabel("step after burn-in [1]", fontsize=TEXT)
    figure.subplots_adjust(left=0.1, right=0.975, bottom=0.6 / height, top=1 - 0.2 / height, wspace=0.28, hspace=0.18)
    figure.align_ylabels()
    return figure


class _Columns:
    """The sampled physical parameters, flattened and scaled for display."""

    def __init__(self, result: Result) -> None:
        if result.posterior is None:
            raise ValueError("nothing was sampled (point fit only): there is no sample to show")
        self.posterior: Posterior = result.posterior
        sampled = {name: i for i, name in enumerate(self.posterior.names)}
        self.names = [str(name) for name in result.summary.index if name in sampled]
        self.index = [sampled[name] for name in self.names]
        scaled = [prefix_for(str(result.summary.at[n, "unit"]), float(result.summary.at[n, "map"])) for n in self.names]
        self.scale = np.array([scale for scale, _ in scaled])
        self.labels = [plain_symbol(n) + unit_suffix(unit) for n, (_, unit) in zip(self.names, scaled, strict=True)]
        draws = self.posterior.draws.reshape(-1, len(self.posterior.names))[:, self.index] * self.scale
        self.map = result.summary.loc[self.names, "map"].to_numpy(float) * self.scale
        self.paper = result.summary.loc[self.names, "paper"].to_numpy(float) * self.scale
        low, high = np.percentile(draws, _TAILS, axis=0)
        # A parameter that never moved (a frozen chain) still gets a panel of some width.
        width = np.where(high > low, high - low, np.maximum(np.abs(high), 1.0) * np.finfo(float).eps * 1e4)
        self.low, self.high = low - 0.02 * width, low + 1.02 * width
        place = (draws - self.low) / (self.high - self.low) * _BINS
        self.inside = (place >= 0) & (place < _BINS)
        self.bins = np.clip(place, 0, _BINS - 1).astype(np.int64)


def _histogram(ax: Axes, columns: _Columns, i: int) -> None:
    counts = np.bincount(columns.bins[columns.inside[:, i], i], minlength=_BINS)
    edges = np.linspace(columns.low[i], columns.high[i], _BINS + 1)
    ax.stairs(counts, edges, color=BLUE, fill=True, alpha=0.25)
    ax.stairs(counts, edges, color=BLUE, lw=1.2)
    ax.axvline(columns.map[i], color=BLACK, lw=1.2)
    if columns.low[i] < columns.paper[i] < columns.high[i]:
        ax.axvline(columns.paper[i], color=VERMILION, lw=1.4, ls="--")
    ax.set_ylim(0, 1.1 * max(counts.max(), 1))


def _contours(ax: Axes, columns: _Columns, x: int, y: int) -> None:
    both = columns.inside[:, x] & columns.inside[:, y]
    flat = columns.bins[both, y] * _BINS + columns.bins[both, x]
    density = _smoothed(np.bincount(flat, minlength=_BINS * _BINS).reshape(_BINS, _BINS).astype(float))
    ordered = np.sort(density, axis=None)[::-1]
    share = np.cumsum(ordered)
    levels = [float(ordered[min(np.searchsorted(share, part * share[-1]), ordered.size - 1)]) for part in _SHARES]
    centres = (np.arange(_BINS) + 0.5) / _BINS
    grid_x = columns.low[x] + centres * (columns.high[x] - columns.low[x])
    grid_y = columns.low[y] + centres * (columns.high[y] - columns.low[y])
    if 0 < levels[0] < levels[1] < ordered[0]:
        ax.contourf(grid_x, grid_y, density, levels=[*levels, ordered[0]], colors=[PALE_BLUE, BLUE])
    ax.plot(columns.map[x], columns.map[y], "+", color=BLACK, ms=8, mew=1.4)
    ax.plot(columns.paper[x], columns.paper[y], "x", color=VERMILION, ms=6, mew=1.4)
    ax.set_ylim(columns.low[y], columns.high[y])


def _smoothed(counts: np.ndarray) -> np.ndarray:
    """Binomial smoothing over five bins each way, so that contours follow the density and not the counting noise."""
    for axis in (0, 1):
        for _ in range(2):
            padded = np.pad(counts, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
            left, middle, right = (np.take(padded, np.arange(_BINS) + k, axis=axis) for k in (0, 1, 2))
            counts = (left + 2 * middle + right) / 4
    return counts


def _corner_ticks(ax: Axes, columns: _Columns, x: int, y: int, n: int) -> None:
    ax.set_xlim(columns.low[x], columns.high[x])
    ax.tick_params(labelsize=SMALL - 1.5, length=2.5, pad=2)
    bottom, left = y == n - 1, x == 0 and y > 0
    if bottom:
        ax.xaxis.set_major_locator(MaxNLocator(2, prune="both"))
        ax.ticklabel_format(axis="x", useOffset=False, style="plain")
        ax.tick_params(axis="x", rotation=40)
        ax.set_xlabel(columns.labels[x], fontsize=SMALL, parse_math=False)
        ax.xaxis.set_label_coords(0.5, -0.55)
    else:
        ax.set_xticks([])
    if left:
        ax.yaxis.set_major_locator(MaxNLocator(2, prune="both"))
        ax.ticklabel_format(axis="y", useOffset=False, style="plain")
        ax.set_ylabel(columns.labels[y], fontsize=SMALL, parse_math=False)
        ax.yaxis.set_label_coords(-0.52, 0.5)
    else:
        ax.set_yticks([])
