"""Figures of recorded runs, as the paper draws them: time histories (Fig. 4), phase plane (Figs. 9, 12), force (4d).

Every figure is ``(view, ax=None) -> ax`` and draws into ``ax`` or into a figure of its own.
"""

import numpy as np
from matplotlib.axes import Axes

from capsule_id.records.view import RecordView
from capsule_id.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PURPLE,
    VERMILION,
    make_room,
    new_figure,
    own_axes,
    set_legend,
    set_text,
    subfigure_at,
)

_MM = 1e3
# Channels in the order of the panels: axis label, display per SI, colour.
_CHANNELS = {
    "x_capsule": ("X2, mm", _MM, BLACK),
    "x_rel": ("X1 - X2, mm", _MM, BLUE),
    "acceleration_rod": ("acceleration\nof the rod, m/s²", 1.0, GREY),
    "current": ("current, A", 1.0, PURPLE),
}


def phase_plane_of_run(view: RecordView, ax: Axes | None = None) -> Axes:
    """Rate against x_rel, both filtered, with the impact line and the Poincaré points at the drive's phase."""
    ax = own_axes(ax)
    # At the ends of the record the derivative is that of a polynomial's edge, and mostly noise.
    inside = slice(view.samples // 2, len(view.time) - view.samples // 2)
    ax.plot(_MM * view.x_rel[inside], view.rate[inside], color=BLUE, lw=0.6)
    lines = []
    if np.isfinite(view.gap):
        lines.append(ax.axvline(_MM * view.gap, color=VERMILION, ls="--", lw=1.2, label="gap as stated"))
    if view.gap_seen is not None:
        lines.append(ax.axvline(_MM * view.gap_seen, color=VERMILION, ls=":", lw=1.6, label="contacts begin"))
    ax.plot(
        _MM * view.section_x_rel,
        view.section_rate,
        ls="none",
        marker="o",
        ms=4.5,
        color=GREEN,
        zorder=3,
        label="once a period",
    )
    set_text(ax, "X1 - X2, mm", "rate of X1 - X2, m/s", f"motion: {view.label}")
    below_legend = make_room(ax)
    for line in lines:
        line.set_ydata([0.0, below_legend])
    set_legend(ax, place="upper right")
    return ax


def force_on_rod(view: RecordView, ax: Axes | None = None, model: tuple[np.ndarray, np.ndarray] | None = None) -> Axes:
    """K times the current against time, and beside it a model's (times, force) where given, s and N.

    Raises
    ------
    ValueError
        If the view has no force: it was made without K, or from a table without current.
    """
    if view.force is None:
        raise ValueError("this view has no force: give view_record a K and a table with current")
    ax = own_axes(ax)
    ax.plot(view.time, view.force, color=PURPLE, lw=1.0, label="K times current")
    if model is not None:
        ax.plot(*model, color=BLACK, ls="--", lw=1.2, label="model")
    set_text(ax, "time, s", "force on the rod, N", f"motion: {view.label}")
    make_room(ax)
    set_legend(ax, place="upper right")
    return ax


def channel_history(view: RecordView, name: str, ax: Axes | None = None) -> Axes:
    """One raw channel against time; x_rel with the gap."""
    ax = own_axes(ax)
    label, scale, color = _CHANNELS[name]
    ax.plot(view.time, scale * view.channels[name], color=color, lw=0.7)
    if name == "x_rel" and np.isfinite(view.gap):
        ax.axhline(scale * view.gap, color=VERMILION, ls="--", lw=1.2)
    set_text(ax, "time, s", label)
    return ax


def overview_size(view: RecordView) -> tuple[float, float]:
    """Width and height of ``run_overview``, inches."""
    return 10.0, 1.2 + 1.25 * max(sum(name in view.channels for name in _CHANNELS), 3)


def run_overview(view: RecordView, ax: Axes | None = None) -> Axes:
    """Every recorded channel above each other, the phase plane beside them. Returns the phase plane."""
    names = [name for name in _CHANNELS if name in view.channels]
    figure = new_figure(*overview_size(view)) if ax is None else subfigure_at(ax)
    grid = figure.add_gridspec(len(names), 2, left=0.1, right=0.98, bottom=0.11, top=0.93, wspace=0.24, hspace=0.3)
    for row, name in enumerate(names):
        history = channel_history(view, name, figure.add_subplot(grid[row, 0]))
        if row + 1 < len(names):
            history.set_xlabel("")
            history.tick_params(labelbottom=False)
    return phase_plane_of_run(view, figure.add_subplot(grid[:, 1]))
