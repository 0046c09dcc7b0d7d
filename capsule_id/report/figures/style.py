"""How every figure looks: colours, type sizes, margins, legends, and the way to PNG bytes."""

import io
import re
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, Literal, cast

import numpy as np
from matplotlib import rc_context, rcParamsDefault
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import GridSpec
from matplotlib.lines import Line2D
from PIL import Image

# Colour-blind-safe colours (Okabe and Ito). Nothing here touches pyplot: figures are plain
# ``matplotlib.figure.Figure`` objects and leave no global state. A panel is a function ``(data, ax)`` that draws.


WHITE, BLACK, ORANGE, SKY, GREEN = "#ffffff", "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#6B6B6B"
PALE_BLUE = "#BBD6EA"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)

DPI, MM = 150, 1e3
_PALETTE, _NEARLY_WHITE = 128, 253
# Readable at half of the printed size: 11 pt at a width of 6.4 in.
TEXT, SMALL = 11.0, 9.5
#: Heights of an entry of a legend and of its margins, and the largest part of the panel for both.
_ENTRY, _MARGINS, _MOST_ROOM = 1.5 * SMALL, 2.0 * SMALL, 0.5
#: Most entries of a legend over the curves in one column.
_ONE_COLUMN = 3

#: Where a legend stands: over the curves of its panel, over the panel in one row at the right, or beside it.
_PLACES: dict[str, dict[str, Any]] = {
    "upper right": {"loc": "upper right"},
    "above": {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1},
    "beside": {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.3},
}


def own_style() -> AbstractContextManager[None]:
    """Matplotlib's defaults in place of the user's matplotlibrc, which may ask for LaTeX or for fonts that are missing."""
    return rc_context(dict(rcParamsDefault))


def new_figure(width: float, height: float, **margins: float) -> Figure:
    """An empty figure, inches; ``margins`` as of ``set_margins``."""
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    set_margins(figure, **margins)
    return figure


def set_margins(
    figure: Figure | SubFigure,
    left: float = 0.9,
    right: float = 0.2,
    bottom: float = 0.62,
    top: float = 0.39,
    **spaces: float,
) -> None:
    """Room for labels and title in inches: it does not shrink with the panels. ``spaces``: between them, in panels."""
    width, height = (pixels / figure.dpi for pixels in figure.bbox.size)
    figure.subplots_adjust(left / width, bottom / height, 1.0 - right / width, 1.0 - top / height, **spaces)


def new_axes(width: float = 6.4, height: float = 4.4, **margins: float) -> Axes:
    """The only axes of a new figure."""
    return new_figure(width, height, **margins).subplots()


def figure_of(ax: Axes) -> Figure:
    """The figure that ``ax`` stands in."""
    return cast(Figure, ax.get_figure(root=True))


def subfigure_at(ax: Axes) -> SubFigure:
    """A part of the figure of ``ax`` for several panels, which take the place of ``ax``."""
    figure, place = figure_of(ax), ax.get_subplotspec()
    ax.remove()
    return figure.add_subfigure(place or GridSpec(1, 1, figure=figure)[0])


def set_text(ax: Axes, x_label: str, y_label: str, title: str = "", *, size: float = TEXT) -> None:
    """Labels and title as plain text: a ``$`` in somebody's file name is no mathematics."""
    ax.set_xlabel(x_label, fontsize=size, parse_math=False)
    ax.set_ylabel(y_label, fontsize=size, parse_math=False)
    ax.set_title(title, fontsize=TEXT, parse_math=False, loc="left", fontweight="bold")
    ax.tick_params(labelsize=SMALL, direction="out", length=3)
    ax.spines[["top", "right"]].set_visible(False)


def set_legend(
    ax: Axes,
    place: Literal["upper right", "above", "beside"] = "upper right",
    handles: Sequence[Artist] = (),
    **look: Any,
) -> float:
    """A legend of ``handles``, by default of the labelled artists, as plain text.

    "upper right" makes space over the curves, with two columns for many entries. No legend covers data. Returns the part
    of the panel's height below that space.
    """
    shown, below = handles or ax.get_legend_handles_labels()[0], 1.0
    if not shown:
        return below
    columns = len(shown) if place == "above" else 2 if place == "upper right" and len(shown) > _ONE_COLUMN else 1
    if place == "upper right":
        height = 72.0 / figure_of(ax).dpi * ax.get_window_extent().height
        below -= min((-(-len(shown) // columns) * _ENTRY + _MARGINS) / height, _MOST_ROOM)
        low, high = ax.get_ylim()
        ax.set_ylim(low, low + (high - low) / below)
    looks = {"fontsize": SMALL, "frameon": False, "handlelength": 1.8, "ncols": columns, **_PLACES[place], **look}
    for text in ax.legend(handles=shown, **looks).get_texts():
        text.set_parse_math(False)
    return below


#: Largest SVG, in sizes of the PNG of the same figure; lines are below it, clouds of points far above.
_LARGEST_SVG = 1.5
#: Bytes of a marker in an SVG, at least: the text of 100,000 points is not made in order to be dropped.
_MARKER = 40
#: Colours of an SVG by those of the figure: its paper is that of the page, and it follows the dark mode of the browser.
_THEMED = {WHITE: "none", BLACK: "currentColor", BLUE.lower(): "var(--blue)", GREY.lower(): "var(--grey)"}
_THEME = """<style>:root { color: #1b1b1b; fill: currentColor; --blue: #0072b2; --grey: #6b6b6b; }
@media screen and (prefers-color-scheme: dark) { :root { color: #e6e4df; --blue: #56a9dd; --grey: #a5a5a5; } }
text { font-family: "DejaVu Sans", Verdana, system-ui, sans-serif !important; }</style>"""


def mark(figure: Figure, text: str) -> None:
    """Write a word into the corner of the picture itself, so that copies keep it."""
    figure.text(0.995, 0.995, text, ha="right", va="top", fontsize=SMALL, color=VERMILION, fontweight="bold")


def png(figure: Figure, synthetic: bool = False) -> bytes:
    """The figure as PNG at 150 dpi, in a palette of its own; the same figure gives the same bytes.

    synthetic : the figure shows synthetic data, which a word in it says from here on
    """
    if synthetic:
        mark(figure, "synthetic data")
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


def svg(figure: Figure, most: int) -> bytes:
    """The figure as SVG in the colours of the page; b"" beyond ``_LARGEST_SVG`` times ``most`` bytes, its size as PNG.

    This is the rule of every picture of the page: SVG for lines, PNG for clouds of points.
    """
    lines = (line for line in figure.findobj(Line2D) if line.get_marker() not in ("None", "", " ", None))
    areas = (path for many in figure.findobj(Collection) for path in cast(Collection, many).get_paths())
    # A vertex of an area takes half the bytes of a marker.
    points = sum(np.size(line.get_xdata()) for line in lines) + sum(len(path) for path in areas) / 2
    if _MARKER * points > _LARGEST_SVG * most:
        return b""
    buffer = io.StringIO()
    with warnings.catch_warnings(), rc_context({"svg.fonttype": "none", "svg.hashsalt": "capsule-id"}):
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = re.sub(
        r"<metadata>.*?</metadata>|<!--.*?-->|<\?xml.*?\?>|<!DOCTYPE.*?>", "", buffer.getvalue(), flags=re.DOTALL
    )
    # A hundredth of a point of a line or a marker is not seen. Numbers that are read, in texts, stay as they are.
    text = re.sub(r' (?:d|x|y)="[^"]*"', lambda place: re.sub(r"(\.\d\d)\d+", r"\1", place[0]), text)
    text = re.sub(r"\s+", " ", text)
    for colour, themed in _THEMED.items():
        text = text.replace(f": {colour}", f": {themed}")
    made = re.sub(r"(<svg [^>]*>)", lambda head: head[1] + _THEME, text, count=1).strip().encode()
    return made if len(made) <= _LARGEST_SVG * most else b""
