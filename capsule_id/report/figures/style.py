"""How every figure looks, and the figures of simulated motions."""

import io
import warnings
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib import rc_context, rcParamsDefault
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import GridSpec
from PIL import Image

# style: How every figure looks: colour-blind-safe colours (Okabe and Ito), type sizes, and the way to PNG bytes.
#
# Nothing here touches pyplot: figures are plain ``matplotlib.figure.Figure`` objects and leave no global state.


BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#6B6B6B"
PALE_BLUE = "#BBD6EA"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)

DPI = 150
_PALETTE, _NEARLY_WHITE = 128, 253
# Readable at half of the printed size: 11 pt at a width of 6.4 in.
TEXT, SMALL = 11.0, 9.5
#: Heights of an entry of a legend and of its margins, and the largest part of the panel for both.
_ENTRY, _MARGINS, _MOST_ROOM = 1.5 * SMALL, 2.0 * SMALL, 0.5


def own_style() -> AbstractContextManager[None]:
    """Matplotlib's defaults in place of the user's matplotlibrc, which may ask for LaTeX or for fonts that are missing."""
    return rc_context(dict(rcParamsDefault))


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, inches."""
    return Figure(figsize=(width, height), dpi=DPI, facecolor="white")


def own_axes(ax: Axes | None, width: float = 6.4, height: float = 4.4) -> Axes:
    """``ax``, or the only axes of a new figure."""
    if ax is not None:
        return ax
    figure = new_figure(width, height)
    axes = figure.subplots()
    # Room for labels and title in inches: it does not shrink with the panel.
    figure.subplots_adjust(left=0.9 / width, right=1 - 0.2 / width, bottom=0.62 / height, top=1 - 0.39 / height)
    return axes


def figure_of(ax: Axes) -> Figure:
    """The figure that ``ax`` stands in."""
    figure = ax.get_figure(root=True)
    if figure is None:
        raise ValueError("these axes have been removed from their figure")
    return figure


def subfigure_at(ax: Axes) -> SubFigure:
    """A part of the figure of ``ax`` for several panels, which take the place of ``ax``."""
    figure, place = figure_of(ax), ax.get_subplotspec()
    ax.remove()
    return figure.add_subfigure(place or GridSpec(1, 1, figure=figure)[0])


def set_text(ax: Axes, x_label: str, y_label: str, title: str = "") -> None:
    """Labels and title as plain text: a ``$`` in somebody's file name is no mathematics."""
    ax.set_xlabel(x_label, fontsize=TEXT, parse_math=False)
    ax.set_ylabel(y_label, fontsize=TEXT, parse_math=False)
    ax.set_title(title, fontsize=TEXT, parse_math=False, loc="left", fontweight="bold")
    ax.tick_params(labelsize=SMALL, direction="out", length=3)
    ax.spines[["top", "right"]].set_visible(False)


def set_legend(ax: Axes, place: Literal["best", "upper right", "lower right", "above"] = "best") -> None:
    """A legend of the labelled artists, as plain text; ``above``: in one row over the axes, at the right."""
    handles, labels = ax.get_legend_handles_labels()
    if not handles:
        return
    where: dict[str, Any] = {"loc": place}
    if place == "above":
        where = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": len(handles), "borderaxespad": 0.1}
    legend = ax.legend(handles, labels, fontsize=SMALL, frameon=False, handlelength=1.8, **where)
    for text in legend.get_texts():
        text.set_parse_math(False)


def make_room(ax: Axes) -> float:
    """Space over the curves for a legend of all labelled artists; return the part of the panel's height below it."""
    height = 72.0 / figure_of(ax).dpi * ax.get_window_extent().height
    room = min((len(ax.get_legend_handles_labels()[1]) * _ENTRY + _MARGINS) / height, _MOST_ROOM)
    low, high = ax.get_ylim()
    ax.set_ylim(low, low + (high - low) / (1.0 - room))
    return 1.0 - room


def mark(figure: Figure, text: str) -> None:
    """Write a word into the corner of the picture itself, so that copies keep it."""
    figure.text(0.995, 0.995, text, ha="right", va="top", fontsize=SMALL, color=VERMILION, fontweight="bold")


def png(figure: Figure) -> bytes:
    """The figure as PNG at 150 dpi, in a palette of its own; the same figure gives the same bytes."""
    canvas = FigureCanvasAgg(figure)
    with warnings.catch_warnings():
        # A label in a script that the font lacks shows as boxes; the figure is still usable, so the user is not warned.
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        canvas.draw()
    pixels = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    # Line art in a palette is a third of the size of full colour, and every picture is also embedded in the page.
    small = pixels.quantize(_PALETTE, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    palette = np.array(small.getpalette())
    small.putpalette(np.where(palette >= _NEARLY_WHITE, 255, palette).tolist())  # octree averages white to 254
    buffer = io.BytesIO()
    small.save(buffer, format="PNG", dpi=(DPI, DPI))
    return buffer.getvalue()


# capsule: Figures of simulated motions: time histories and phase plane.
#
# Every figure is ``(data, ax=None) -> ax`` and draws into ``ax`` or into a figure of its own.


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
