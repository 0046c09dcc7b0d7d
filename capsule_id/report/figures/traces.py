"""Traces of the sample: they show drift, and ensembles that disagree."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from capsule_id.inference.result import Result
from capsule_id.report.figures.style import CYCLE, SMALL, TEXT, new_figure, subfigure_at
from capsule_id.report.sampled_parameters import sampled_parameters

# Enough to see drift, few enough to see lines.
_POINTS, _WALKERS = 120, 2


def traces_size(n: int) -> tuple[float, float]:
    """Width and height of the figure of ``n`` parameters, inches."""
    return 9.0, 0.8 + 1.15 * ((n + 1) // 2)


def traces(result: Result, ax: Axes | None = None) -> Axes:
    """A panel per physical parameter: a few walkers of each ensemble against the step, one colour per ensemble.

    Returns the first panel.

    Raises
    ------
    ValueError
        If nothing was sampled.
    """
    columns = sampled_parameters(result)
    n = len(columns.names)
    rows = (n + 1) // 2
    width, height = traces_size(n)
    figure = new_figure(width, height) if ax is None else subfigure_at(ax)
    axes: Any = figure.subplots(rows, 2, sharex=True, squeeze=False)
    every = max(1, columns.draws.shape[1] // _POINTS)
    shown = columns.draws[:, ::every, :_WALKERS]
    step = np.arange(shown.shape[1]) * every * columns.posterior.thin
    for i, panel in enumerate(axes.flat):
        if i >= n:
            panel.remove()
            continue
        for e, ensemble in enumerate(shown[..., i]):
            panel.plot(step, ensemble, color=CYCLE[e % len(CYCLE)], lw=0.6, alpha=0.8)
        panel.set_ylabel(f"{columns.symbols[i]} [{columns.units[i]}]", fontsize=SMALL, parse_math=False)
        panel.tick_params(labelsize=SMALL, length=3)
        panel.yaxis.set_major_locator(MaxNLocator(3))
        panel.ticklabel_format(axis="y", useOffset=False, style="plain")
        panel.spines[["top", "right"]].set_visible(False)
        panel.margins(x=0.01)
    for panel in axes[-1]:
        panel.set_xlabel("step after burn-in [1]", fontsize=TEXT)
    if n % 2 and n > 1:
        # The last panel on the right is empty: the axis above it takes its place at the foot of the column.
        axes[-2, -1].tick_params(labelbottom=True)
        axes[-2, -1].set_xlabel("step after burn-in [1]", fontsize=TEXT)
    figure.subplots_adjust(left=0.1, right=0.975, bottom=0.6 / height, top=1 - 0.25 / height, wspace=0.28, hspace=0.18)
    figure.align_ylabels()
    return axes[0, 0]
