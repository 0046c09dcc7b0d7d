"""No text of a figure leaves the picture or lies on another one: boxes measured by matplotlib's renderer."""

import itertools
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text

from capsule_id.inference.result import Result
from capsule_id.report.columns import sampled_parameters
from capsule_id.report.figures.fits import comparison_figure, corner, corner_size
from capsule_id.report.figures.style import figure_of, new_axes, new_figure, set_legend
from capsule_id.report.html import drawings
from tests.report.test_figures import forced_run

#: Boxes may share this much, pixels: a renderer rounds.
SLACK = 1.0


def drawn_texts(figure: Figure) -> list[Text]:
    """The texts that a drawing shows: those of ticks outside an axis are not drawn."""
    FigureCanvasAgg(figure).draw()
    hidden: set[Text] = set()
    for axis in (axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)):
        shown = axis._update_ticks() if axis.axes.axison else []  # pyright: ignore[reportAttributeAccessIssue]
        hidden |= {
            label
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks())
            if tick not in shown
            for label in (tick.label1, tick.label2)
        }
    texts: list[Text] = figure.findobj(Text)  # type: ignore[assignment]  # pyright: ignore[reportAssignmentType]
    return [text for text in texts if text.get_visible() and text.get_text().strip() and text not in hidden]


def faults(figure: Figure) -> list[str]:
    """Texts that leave the figure, and pairs of texts that overlap."""
    texts = drawn_texts(figure)
    found, boxes = [], []
    for text in texts:
        box = text.get_window_extent()
        if box.x0 < -SLACK or box.y0 < -SLACK or box.x1 > figure.bbox.x1 + SLACK or box.y1 > figure.bbox.y1 + SLACK:
            found.append(f"{text.get_text()!r} leaves the figure")
        if text.get_rotation() % 90.0 == 0.0:
            boxes.append((text.get_text(), box))
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        if min(a.x1, b.x1) - max(a.x0, b.x0) > SLACK and min(a.y1, b.y1) - max(a.y0, b.y0) > SLACK:
            found.append(f"{one!r} lies on {other!r}")
    return found + rotated_faults([text for text in texts if text.get_rotation() % 90.0])


def rotated_faults(texts: list[Text]) -> list[str]:
    """Pairs of parallel texts on one line whose distance across their direction is less than their height."""
    found = []
    for one, other in itertools.combinations(texts, 2):
        (x0, y0), (x1, y1) = (text.get_transform().transform(text.get_position()) for text in (one, other))
        angle = np.deg2rad(one.get_rotation())
        height = one.get_fontsize() * figure_dpi(one) / 72.0
        if abs(y0 - y1) < 1.0 and abs(x1 - x0) * np.sin(angle) < 0.9 * height:
            found.append(f"{one.get_text()!r} lies on {other.get_text()!r}")
    return found


def figure_dpi(text: Text) -> float:
    return cast(Figure, text.get_figure(root=True)).dpi


def test_texts_of_every_figure_are_apart(result: Result) -> None:
    found = {name: faults(figure) for name, _, _, _, figure, *_ in drawings(result)}
    assert {"corner", "traces", "point_fit_starts", "friction", "free_vibration_1"} < set(found)
    assert {name: fault for name, fault in found.items() if fault} == {}


def test_texts_of_a_forced_run_and_of_a_large_corner_plot_are_apart(result: Result) -> None:
    assert faults(comparison_figure(forced_run())) == []
    columns = sampled_parameters(result)
    # Round numbers at both ends of every axis: they lay on those of the next panel.
    shifted = replace(
        columns, draws=np.broadcast_to(np.linspace(1420.0, 1423.2, 9)[:, None, None], (1, 9, 1, len(columns.names)))
    )
    corner(shifted, figure := new_figure(*corner_size(shifted)))
    assert len(columns.names) > 8
    assert faults(figure) == []


def test_overlaps_and_clipped_texts_would_be_found() -> None:
    """Negative control: long ticks side by side, a label below the edge, two parallel texts."""
    figure = Figure(figsize=(3.0, 2.0))
    ax = figure.subplots()
    ax.set_xticks([0.5, 0.51], ["a long label", "another label"])
    ax.set_xlabel("time", labelpad=40)
    ax.text(0.2, 0.5, "one", rotation=40)
    ax.text(0.21, 0.5, "two", rotation=40)
    found = " ".join(faults(figure))
    for fault in ("'a long label' lies on 'another label'", "'time' leaves the figure", "'one' lies on 'two'"):
        assert fault in found


@pytest.mark.parametrize("entries", [1, 3, 5])
@pytest.mark.parametrize("height", [4.4, 5.6])
def test_a_legend_over_a_record_hides_no_sample(entries: int, height: float) -> None:
    """Three entries over a forced run lay on its last peaks: the space did not depend on their number."""
    ax = new_axes(height=height)
    t = np.linspace(0.0, 1.0, 400)
    for number in range(entries):
        ax.plot(t, np.sin(60.0 * t), label=f"curve {number}")
    below = set_legend(ax, "upper right")
    figure = figure_of(ax)
    FigureCanvasAgg(figure).draw()
    legend = cast(Legend, ax.get_legend())
    top = ax.transData.transform((0.0, 1.0))[1]
    texts = [text.get_window_extent() for text in legend.get_texts()]
    assert min(box.y0 for box in texts) > top
    assert ax.transAxes.transform((0.0, below))[1] < min(box.y0 for box in texts)
