"""The parameter table for standard output."""

import shutil
import textwrap
from collections.abc import Sequence

import pandas as pd

from capsule_id.report.columns import columns_of, skewed_names, table_rows
from capsule_id.views import Trust, counted

#: Width of the table where standard output is no terminal.
WIDTH = 110
#: Columns that are printed at any width: unit, value ± sd and trust.
KEPT = 3
_GAP = "  "

SYNTHETIC = "*** SYNTHETIC RIG: computer-made data, nothing here was measured ***"


def table_text(summary: pd.DataFrame, *, synthetic: bool, width: int | None = None) -> str:
    """The parameter table as aligned text. Columns at the right give way where the terminal is narrow; names are whole.

    Parameters
    ----------
    summary : as ``Result.summary``; without a sample the sampled columns are left out
    synthetic : the rig is a synthetic one: said in a line of its own
    width : columns of the terminal; None: those of standard output
    """
    width = shutil.get_terminal_size((WIDTH, 24)).columns if width is None else width
    columns = columns_of("console", summary)
    table = [["", *(column.header for column in columns)]]
    for row in table_rows(summary):
        cells = [column.text(row) for column in columns]
        table.append([row.name, *("NO" if cell == "no" else cell for cell in cells)])
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    shown = len(widths)
    while shown > 1 + KEPT and sum(widths[:shown]) + len(_GAP) * (shown - 1) > width:
        shown -= 1
    lines = [_line(cells[:shown], widths[:shown]) for cells in table]
    rule = "-" * max(map(len, lines))
    left_out = ", ".join(table[0][shown:])
    more = wrapped([f"in a wider terminal and in report.html: {left_out}"] if left_out else [], width)
    if skewed := skewed_names(summary):
        names = f"{', '.join(skewed)}: skewed; quote the value with its 95 % interval"
        more = [*wrapped([names], width), *more]
    return "\n".join([*([SYNTHETIC] if synthetic else []), lines[0], rule, *lines[1:], *more])


def wrapped(texts: Sequence[str], width: int | None = None) -> list[str]:
    """Lines of the ``texts``, no wider than the terminal."""
    width = shutil.get_terminal_size((WIDTH, 24)).columns if width is None else width
    return [line for text in texts for line in textwrap.wrap(text, max(width, 20), break_on_hyphens=False)]


def verdict_text(trust: Trust, failed: Sequence[str], warned: int) -> str:
    """The verdict in one line: titles of the ``failed`` checks, number of warnings. Console and report have these words."""
    found = f"failed: {', '.join(failed)}" if failed else "no check failed"
    if trust == "not judged" and not failed:
        found += ", but not every number could be checked"
    return f"verdict: {trust}; {found}" + (f"; {counted(warned, 'warning')}" if warned else "")


def _line(cells: list[str], widths: list[int]) -> str:
    words = [cells[0].ljust(widths[0]), cells[1].ljust(widths[1])]
    words += [cell.rjust(width) for cell, width in zip(cells[2:], widths[2:], strict=True)]
    return _GAP.join(words).rstrip()
