"""Figures of simulated motions: time histories and phase plane.

Every figure is ``(data, ax=None) -> ax`` and draws into ``ax`` or into a figure of its own.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsule_id.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    VERMILION,
    make_room,
    new_figure,
    own_axes,
    set_legend,
    set_text,
)

_MM = 1e3


@dataclass(frozen=True)
class MotionView:
    """One motion, SI: samples (n,), the states at the drive's phase (m,), and the gap G."""

    times: np.ndarray
    x_rel: np.ndarray
    X2: np.ndarray
    relative_velocity: np.ndarray
    section_x_rel: np.ndarray
    section_relative_velocity: np.ndarray
    G: float
    title: str = ""


def relative_displacement(view: MotionView, ax: Axes | None = None) -> Axes:
    """x_rel against time, with the impact line x_rel = G."""
    ax = own_axes(ax)
    ax.plot(view.times, _MM * view.x_rel, color=BLUE, lw=1.0)
    ax.axhline(_MM * view.G, color=VERMILION, ls="--", lw=1.2, label="support spring")
    set_text(ax, "time, s", "X1 - X2, mm", view.title)
    make_room(ax)
    set_legend(ax, place="upper right")
    return ax


def capsule_displacement(view: MotionView, ax: Axes | None = None) -> Axes:
    """X2 against time."""
    ax = own_axes(ax)
    ax.plot(view.times, _MM * view.X2, color=BLACK, lw=1.2)
    set_text(ax, "time, s", "X2, mm", view.title)
    return ax


def phase_plane(view: MotionView, ax: Axes | None = None) -> Axes:
    """The relative velocity against x_rel, with the impact line and the Poincaré points at the drive's phase."""
    ax = own_axes(ax)
    ax.plot(_MM * view.x_rel, view.relative_velocity, color=BLUE, lw=0.7)
    ax.axvline(_MM * view.G, color=VERMILION, ls="--", lw=1.2, label="impact line")
    ax.plot(
        _MM * view.section_x_rel,
        view.section_relative_velocity,
        ls="none",
        marker="o",
        ms=4.5,
        color=GREEN,
        label="once a period",
    )
    set_text(ax, "X1 - X2, mm", "Y1 - Y2, m/s", view.title)
    make_room(ax)
    set_legend(ax, place="upper right")
    return ax


def motion(view: MotionView) -> Figure:
    """Time histories above each other, the phase plane beside them."""
    figure = new_figure(10.0, 4.8)
    grid = figure.add_gridspec(2, 2, left=0.08, right=0.98, bottom=0.12, top=0.93, wspace=0.25, hspace=0.45)
    relative_displacement(view, figure.add_subplot(grid[0, 0]))
    capsule_displacement(view, figure.add_subplot(grid[1, 0]))
    phase_plane(view, figure.add_subplot(grid[:, 1]))
    return figure
