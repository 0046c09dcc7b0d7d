"""Finds why the times of a table do not increase, and the remedy that cures this cause."""

import numpy as np

from capsule_id.rig.filters import FEWEST_PERIODS, clock_starts
from capsule_id.rig.formats.raw import RawTable
from capsule_id.views import counted

#: Largest share of rows with a repeated time where the clock stood still; of rounded times more are repeated.
STANDS = 0.05
_MOST_LINES = 20  # named in a remedy


def remedy_of_order(raw: RawTable, index: int) -> str:
    """The cause that keeps column ``index`` from increasing, tested on the rows, and its remedy; else what is seen."""
    time, name, step = raw.columns[index], raw.names[index], np.diff(raw.columns[index])
    back = 1 + np.flatnonzero(step <= 0.0)
    few, falls = len(back) * FEWEST_PERIODS < len(time), bool(np.any(step < 0.0))
    rising = [
        other for other, c in zip(raw.names, raw.columns, strict=True) if other != name and np.all(np.diff(c) > 0.0)
    ]
    copies = np.setdiff1d(np.arange(len(time)), np.unique(raw.values, axis=0, return_index=True)[1])
    order = np.argsort(time, kind="stable")
    rough = [sum(float(np.sum(np.abs(np.diff(c[rows])))) for c in raw.columns) for rows in (order, slice(None))]
    # A clock that stood still makes up for the lost time in one step.
    levels, counts = np.unique(time, return_counts=True)
    even = (time[-1] - time[0]) / (len(time) - 1)
    made_up = np.all(np.abs(np.diff(levels) - counts[:-1] * even)[counts[:-1] > 1] < 0.5 * even)
    where = f"line {' '.join(map(str, raw.rows[back][:_MOST_LINES]))}{' …' if len(back) > _MOST_LINES else ''}"
    files, rows = f"at {counted(len(back), 'row')} ({where}): write a file of each record", counted(len(back), "row")
    still = "the clock stands still and then goes on; delete the rows with a repeated time:"
    causes = (
        (rising and not few, f"{' '.join(rising)} increases in every row and {name} does not: exchange the headers of "
         f"{name} and {' '.join(rising)}, or their from in a column map"),
        (len(clock_starts(time)) and np.all(step[back - 1] < 0.0), f"the clock starts anew {files}"),
        (len(copies) and np.all(np.diff(np.delete(time, copies)) > 0.0),
         f"delete the repeated rows: line {' '.join(map(str, raw.rows[copies]))}"),
        (not falls and len(back) <= STANDS * len(time) and made_up, f"{still} {where}"),
        (not falls, f"the times are rounded, up to {counted(int(counts.max()), 'row')} share one: export them with more "
         "digits"),
        (len(levels) == len(time) and rough[0] <= rough[1],
         f"sort the rows by {name}: in that order the readings are smoother"),
        (few, f"the clock is set back {files}"),
    )  # fmt: skip
    other = f"{name} falls or stays in {rows} of {len(time)}: check which column holds the times"
    return next((text for holds, text in causes if holds), other)
