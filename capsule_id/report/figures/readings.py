"""Figures of the readings of one experiment with what ``capsule-id check`` found in them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsule_id.report.figures.style import (
    BLUE,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    own_axes,
    set_legend,
    set_text,
)
from capsule_id.rig.model import Table
from capsule_id.views import Finding

#: A record with more samples than this is a line without markers.
MOST_MARKERS = 200
#: Marks of rows that findings name: code, words of the legend, marker, colour.
_MARKS = (
    ("readings.clipped", "clipped", "v", VERMILION),
    ("readings.dropouts", "drop-out", "X", PURPLE),
    ("readings.frozen", "frozen", "s", ORANGE),
    ("readings.repeated", "repeated", "D", ORANGE),
    ("readings.repeated_file", "repeated", "D", ORANGE),
    ("readings.jump", "jump", "P", PURPLE),
    ("readings.burst", "burst of noise", "P", PURPLE),
    ("readings.spike", "spike", "P", PURPLE),
)
#: Times that findings propose: fact, words of the legend, line style.
_TIMES = (("start", "release found", "--"), ("stop", "end found", ":"))


def readings_figure(table: Table[Any], findings: Sequence[Finding]) -> Figure:
    """Draw the channels of a record against time, or the columns of a table against the first one.

    Parameters
    ----------
    findings : on this table; their facts name rows and times
    """
    names = list(table.columns)
    across, channels = (names[0], names[1:]) if len(names) > 1 else ("", names)
    figure = new_figure(8.0, 0.9 + 2.1 * len(channels))
    axes = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    figure.subplots_adjust(
        left=0.12, right=0.97, bottom=0.62 / figure.get_figheight(), top=1 - 0.4 / figure.get_figheight()
    )
    for index, (ax, name) in enumerate(zip(axes, channels, strict=True)):
        channel_with_findings(table, name, findings, ax, across)
        ax.set_title(f"{table.kind} {table.label}" if index == 0 else "", loc="left", parse_math=False)
        if index + 1 < len(channels):
            ax.set_xlabel("")
    return figure


def channel_with_findings(
    table: Table[Any], name: str, findings: Sequence[Finding], ax: Axes | None = None, across: str = "time"
) -> Axes:
    """Draw one column against the column ``across`` ("": row numbers), in the units of the file, with marked findings."""
    ax = own_axes(ax)
    y = _displayed(table, name)
    x = _displayed(table, across) if across else np.arange(1.0, len(y) + 1.0)
    record = "time" in table.columns
    marker = "" if record and len(y) > MOST_MARKERS else "o"
    ax.plot(x, y, color=BLUE, lw=0.8 if record else 0.0, marker=marker, ms=3.5, label="readings")
    if record:
        _mark_times(table, findings, ax)
    for code, words, marker, color in _MARKS:
        rows = [
            row
            for found in findings
            if found.code == code and found.facts.get("column", name) == name
            for row in found.facts["rows"]
        ]
        if rows:
            ax.plot(x[rows], y[rows], ls="none", marker=marker, ms=5.0, color=color, label=words, zorder=3)
    set_text(ax, _label(table, across) if across else "row", _label(table, name))
    set_legend(ax, place="above")
    return ax


def _mark_times(table: Table[Any], findings: Sequence[Finding], ax: Axes) -> None:
    """Shade gaps and the part outside the stated window; draw lines at the times that findings propose."""
    time = [float(value) for value in _displayed(table, "time")]
    scale = table.columns["time"].to_display
    for found in findings:
        if found.code == "readings.gaps":
            for index, row in enumerate(found.facts["rows"]):
                label = "gap" if index == 0 else None
                ax.axvspan(time[row], time[row + 1], color=ORANGE, alpha=0.6, lw=1.5, label=label)
        for fact, words, line in _TIMES:
            if isinstance(found.facts.get(fact), float) and found.code.startswith("decays."):
                ax.axvline(scale * found.facts[fact], color=VERMILION, ls=line, lw=1.4, label=words)
    stated = [getattr(table.settings, key, None) for key in ("start", "stop")]
    for edge, outside in zip(stated, (time[0], time[-1]), strict=True):
        if isinstance(edge, float):
            ax.axvspan(min(scale * edge, outside), max(scale * edge, outside), color=GREY, alpha=0.2, lw=0.0)
            ax.axvline(scale * edge, color=SKY, lw=1.2)


def _displayed(table: Table[Any], name: str) -> np.ndarray:
    """Values of a column in the unit of the file, (n,)."""
    return table[name] * table.columns[name].to_display


def _label(table: Table[Any], name: str) -> str:
    return f"{name}, {table.columns[name].unit}"
