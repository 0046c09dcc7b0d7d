"""The parameter table for standard output."""

from collections.abc import Sequence

import pandas as pd

from capsule_id.report.columns import columns_of, table_rows
from capsule_id.views import Trust

WIDTH = 110
_SHORTEST_NAME = 8
_GAP = "  "

SYNTHETIC = "*** SYNTHETIC RIG: computer-made data, nothing here was measured ***"


def table_text(summary: pd.DataFrame, *, synthetic: bool) -> str:
    """The parameter table as aligned text, at most 110 columns wide.

    Parameters
    ----------
    summary : as ``Result.summary``; without a sample the sampled columns are left out
    synthetic : the rig is a synthetic one: said in a line of its own
    """
    columns = columns_of("console", summary)
    table = [["", *(column.header for column in columns)]]
    for row in table_rows(summary):
        cells = [column.text(row) for column in columns]
        table.append([row.name, *("NO" if cell == "no" else cell for cell in cells)])
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    # Only names can be of any length (a spring may be called anything), so they give way.
    others = sum(widths[1:]) + len(_GAP) * (len(widths) - 1)
    widths[0] = min(widths[0], max(WIDTH - others, _SHORTEST_NAME))
    lines = [_line(cells, widths) for cells in table]
    rule = "-" * max(map(len, lines))
    return "\n".join([*([SYNTHETIC] if synthetic else []), lines[0], rule, *lines[1:]])


def verdict_text(trust: Trust, failed: Sequence[str]) -> str:
    """The verdict in one line; ``failed`` are the titles of the failed checks."""
    if failed:
        return f"verdict: {trust}; failed: {', '.join(failed)}"
    return f"verdict: {trust}; no check failed" + (
        ", but not every number could be checked" if trust == "not judged" else ""
    )


def _line(cells: list[str], widths: list[int]) -> str:
    name = cells[0] if len(cells[0]) <= widths[0] else cells[0][: widths[0] - 1] + "…"
    words = [name.ljust(widths[0]), cells[1].ljust(widths[1])]
    words += [cell.rjust(width) for cell, width in zip(cells[2:], widths[2:], strict=True)]
    return _GAP.join(words).rstrip()
