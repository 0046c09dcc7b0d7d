"""The parameter table for standard output."""

import pandas as pd

from capsule_id.report.columns import columns_of, table_rows

WIDTH = 110
_SHORTEST_NAME = 8
_GAP = "  "

SYNTHETIC = "*** SYNTHETIC RIG: computer-made data, nothing here was measured ***"
NOT_CLEAN = "*** VERDICT NOT CLEAN: the intervals below are not to be trusted, see the findings ***"


def table_text(summary: pd.DataFrame, *, synthetic: bool, clean: bool) -> str:
    """The parameter table as aligned text, at most 110 columns wide.

    Parameters
    ----------
    summary : as ``Result.summary``; without a sample the sampled columns are left out
    synthetic : the rig is a synthetic one: said in a line of its own
    clean : the verdict; where it is not clean a line says so
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
    loud = [text for text, on in ((SYNTHETIC, synthetic), (NOT_CLEAN, not clean)) if on]
    return "\n".join([*loud, lines[0], rule, *lines[1:]])


def _line(cells: list[str], widths: list[int]) -> str:
    name = cells[0] if len(cells[0]) <= widths[0] else cells[0][: widths[0] - 1] + "…"
    words = [name.ljust(widths[0]), cells[1].ljust(widths[1])]
    words += [cell.rjust(width) for cell, width in zip(cells[2:], widths[2:], strict=True)]
    return _GAP.join(words).rstrip()
