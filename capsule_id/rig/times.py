"""Times as loggers write them: clocks that start anew, times that repeat, and why others do not increase."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from capsule_id.parameters import STEP_SD
from capsule_id.rig.filters import FEWEST_PERIODS, FEWEST_SAMPLES, clock_starts
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.model import NO_DRIFT, Quantity
from capsule_id.views import Finding, counted

# records: Records of one file, each with times that increase.


#: Largest share of rows with a repeated time where the clock stood still; of rounded times more are repeated.
STANDS = 0.05
#: Largest distance of stamps from an even grid, in ticks of their clock; a tick is printed with few digits.
TICK = 1.1


class Evened(NamedTuple):
    """Times that increase, (n,), in place of stamps that repeat.

    Attributes
    ----------
    code : of the finding that says what was done
    tick : of the clock that wrote the stamps
    sd : of the sampling rate found from the counts, relative
    """

    times: np.ndarray
    code: str
    tick: float
    sd: float


def evened(time: np.ndarray) -> Evened | None:
    """Times in place of stamps that repeat and never fall, (n,); None where the samples need not have been even.

    A clock that stood still makes up for it in one step: only the rows with a repeated time get times between their
    neighbours. Stamps in ticks of a clock get the even times that differ from no stamp by more than a tick.
    """
    index, (levels, first, counts) = np.arange(len(time)), np.unique(time, return_index=True, return_counts=True)
    if len(time) < FEWEST_SAMPLES or len(levels) in (len(time), 1, 2) or np.any(np.diff(time) < 0.0):
        return None
    even, tick = float(time[-1] - time[0]) / (len(time) - 1), float(np.median(np.diff(levels)))
    behind = np.diff(levels) - counts[:-1] * even
    if len(time) - len(levels) <= STANDS * len(time) and np.all(np.abs(behind[counts[:-1] > 1]) < 0.5 * even):
        ends = counts[-1] == 1  # a repeated last time has no later one to end at
        return Evened(np.interp(index, first, levels), "times.held", tick, 0.0) if ends else None
    # Of the points of a line the outermost limit it.
    k = ConvexHull(
        np.column_stack([index / len(time), (time - time[0]) / np.ptp(time) - index / (len(time) - 1)])
    ).vertices
    rise = np.column_stack([np.ones(len(k)), k - 0.5 * (len(time) - 1)])
    bound = (time[k] - time[0] - even * k) / tick  # of the difference from the even grid between the ends, in ticks
    least = linprog([0, 0, 1], np.block([[-rise, -np.ones((len(k), 1))], [rise, -np.ones((len(k), 1))]]), [*-bound, *bound],
                    bounds=[(None, None)] * 3)  # fmt: skip
    if not least.success or 2.0 * least.x[2] > TICK:
        return None
    limits = [*(0.5 * TICK - bound), *(0.5 * TICK + bound)]
    ends = [linprog([0, sign], np.vstack([-rise, rise]), limits, bounds=[(None, None)] * 2).x[1] for sign in (1, -1)]
    step = even + tick * float(np.mean(ends))
    times = float(np.mean(time)) + step * (index - 0.5 * (len(time) - 1))
    return Evened(times, "times.ticks", tick, tick * float(np.ptp(ends)) * STEP_SD / step)


class Record(NamedTuple):
    """A record of a table, the standard deviation of its clock's drift as found, and what was done to its times."""

    raw: RawTable
    drift: Quantity = NO_DRIFT
    findings: tuple[Finding, ...] = ()


def records_of(raw: RawTable, file: str) -> list[Record]:
    """The records of a table in the order of its rows: a clock that starts anew begins another one."""
    time = raw.columns[raw.names.index("time")]
    starts = [0, *clock_starts(time), len(time)]
    if len(starts) == 2:
        return [_in_order(raw, file, ())]
    done = Finding(
        "times.records",
        "ok",
        {"file": file, "records": len(starts) - 1, "lines": " ".join(map(str, raw.rows[starts[1:-1]]))},
    )
    owners = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return [_in_order(part, file, (done,) * (k == 0)) for k, part in enumerate(raw.divided(owners))]


def _in_order(raw: RawTable, file: str, findings: tuple[Finding, ...]) -> Record:
    """The record with times that increase, where their stamps repeat and tell how; else as it is."""
    index = raw.names.index("time")
    time = raw.columns[index]
    again = np.diff(time) <= 0.0
    if not again.any():
        return Record(raw, NO_DRIFT, findings)
    copies = np.all([np.diff(column) == 0.0 for column in raw.columns], axis=0)
    facts = {"file": file, "line": int(raw.rows[1 + int(np.argmax(again))]), "rows": int(np.sum(again))}
    found, once = evened(time), np.flatnonzero(np.append(True, ~copies))
    if (found is None or found.code == "times.ticks") and np.all(np.diff(time[once]) > 0.0):
        return Record(raw.taken(once), NO_DRIFT, (*findings, Finding("times.copies", "warn", facts)))
    if found is None:
        return Record(raw, NO_DRIFT, findings)
    columns = tuple(found.times if k == index else column for k, column in enumerate(raw.columns))
    rate = {"tick": found.tick, "unit": raw.units[index], "step": float(np.mean(np.diff(found.times))), "sd": found.sd}
    drift = Quantity(0.0, found.sd) if found.sd else NO_DRIFT
    return Record(replace(raw, columns=columns), drift, (*findings, Finding(found.code, "warn", {**facts, **rate})))


_MOST_LINES = 20  # named in a remedy


def remedy_of_order(raw: RawTable, index: int) -> str:
    """The cause that keeps column ``index`` from increasing, tested on the rows, and its remedy; else what is seen."""
    time, name, step = raw.columns[index], raw.names[index], np.diff(raw.columns[index])
    back = 1 + np.flatnonzero(step <= 0.0)
    few, falls = len(back) * FEWEST_PERIODS < len(time), bool(np.any(step < 0.0))
    rising = [
        other for other, c in zip(raw.names, raw.columns, strict=True) if other != name and np.all(np.diff(c) > 0.0)
    ]
    equal = np.lexsort(raw.columns)  # equal rows one behind the other, the first one first
    copies = np.sort(equal[1:][np.all([one[equal[1:]] == one[equal[:-1]] for one in raw.columns], axis=0)])
    order = np.argsort(time, kind="stable")
    rough = [sum(float(np.sum(np.abs(np.diff(c[rows])))) for c in raw.columns) for rows in (order, slice(None))]
    counts = np.unique(time, return_counts=True)[1]
    where, repeated = (
        f"line {' '.join(map(str, raw.rows[rows][:_MOST_LINES]))}{' …' if len(rows) > _MOST_LINES else ''}"
        for rows in (back, copies)
    )
    files, rows = f"at {counted(len(back), 'row')} ({where}): write a file of each record", counted(len(back), "row")
    causes = (
        (rising and not few, f"{' '.join(rising)} increases in every row and {name} does not: exchange the headers of "
         f"{name} and {' '.join(rising)}, or their from in a column map"),
        (len(copies) and np.all(np.diff(np.delete(time, copies)) > 0.0),
         f"delete the repeated rows: {repeated}"),
        (not falls, f"the times are rounded, up to {counted(int(counts.max()), 'row')} share one: export them with more "
         f"digits, or delete the rows with a repeated time: {where}"),
        (len(counts) == len(time) and rough[0] <= rough[1],
         f"sort the rows by {name}: in that order the readings are smoother"),
        (few, f"the clock is set back {files}"),
    )  # fmt: skip
    other = f"{name} falls or stays in {rows} of {len(time)}: check which column holds the times"
    return next((text for holds, text in causes if holds), other)
