"""Findings on the channels of a record, shared by all kinds with a column ``time``."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.records.faults.bursts import noisy_stretch
from capsule_id.records.faults.clipping import clipped_samples
from capsule_id.records.faults.phase import jump_or_noise, single_spike
from capsule_id.records.faults.timing import dropouts, find_gaps, frozen_samples, time_rounding
from capsule_id.rig.filters import TIMING_TOLERANCE, largest_offset, median_step
from capsule_id.rig.model import Table
from capsule_id.views import Finding

#: Periods before a burst of noise that a decay is cut to; with fewer it begins behind the burst.
KEPT_PERIODS = 3


def lint_times(table: Table[Any], used: slice) -> Iterable[Finding]:
    """Report gaps and rounded times.

    Parameters
    ----------
    used : the rows that a fit reads
    """
    time = table["time"][used]
    gaps = find_gaps(time)
    if gaps is not None:
        first = used.start + int(gaps.rows[0])
        facts = {
            "file": table.file,
            "line": int(table.rows[first]),
            "time": float(table["time"][first]),
            "gaps": len(gaps.rows),
            "lost": int(gaps.lost.sum()),
            "step": gaps.step,
            "rows": (used.start + gaps.rows).tolist(),
        }
        yield Finding("readings.gaps", "warn", facts, table.label)
        return
    rounding = time_rounding(time)
    if rounding is not None:
        yield Finding("readings.rounded_times", "warn", {"step": rounding, "file": table.file}, table.label)


def lint_channel(table: Table[Any], name: str, used: slice, period: float) -> Iterable[Finding]:
    """Report clipped samples, drop-outs and a frozen sensor.

    Parameters
    ----------
    name : of the column
    used : the rows that a fit reads
    period : of the oscillation, s; infinite where it is unknown
    """
    column, time = table.columns[name], table["time"]
    values, unit = column.values[used], column.to_display
    if len(time[used]) < 2 or np.ptp(values) == 0.0:
        return
    values = values * unit if unit != 1.0 else values
    step = median_step(time[used])
    where = {"file": table.file, "column": name, "unit": column.unit}
    for clipped in clipped_samples(values, period / step):
        found = used.start + clipped.rows
        facts = where | {
            "side": clipped.side,
            "level": clipped.level,
            "samples": len(found),
            "share": len(found) / len(values),
            "line": int(table.rows[found[0]]),
            "time": float(time[found[-1]]),
            "after": float(time[min(found[-1] + 1, len(time) - 1)]),
            "rows": found.tolist(),
        }
        yield Finding("readings.clipped", "fail", facts, table.label)
    for code, wrong in (("readings.dropouts", dropouts(values)), ("readings.frozen", frozen_samples(values))):
        if len(wrong):
            found = used.start + wrong
            facts = where | {
                "value": float(values[wrong[0]]),
                "samples": len(found),
                "line": int(table.rows[found[0]]),
                "time": float(time[found[0]]),
                "rows": found.tolist(),
            }
            yield Finding(code, "fail", facts, table.label)
            return


def lint_smooth(table: Table[Any], name: str, used: slice, period: float, alone: bool = False) -> Iterable[Finding]:
    """Report samples of a smooth oscillation that were lost without a gap in the times, or a burst of noise.

    Parameters
    ----------
    name : of the column
    used : the rows of the oscillation
    period : of the oscillation, s
    alone : leave out jumps that recur every half period
    """
    time = table["time"][used]
    step = median_step(time)
    if largest_offset(time, step) > TIMING_TOLERANCE * step:
        return
    values = table[name][used]
    jump = jump_or_noise(values, period / step, alone)
    if jump is None:
        return
    burst = noisy_stretch(values, period / step, jump.row)
    if burst is not None:
        rows = slice(used.start + burst.start, used.start + burst.stop)
        yield _burst(table, name, rows, used, burst.start < KEPT_PERIODS * period / step)
    elif not jump.noisy:
        spike = single_spike(values, jump, period / step, alone)
        row = used.start + (jump.row if spike is None else spike)
        facts = {
            "file": table.file,
            "column": name,
            "time": float(table["time"][row]),
            "line": int(table.rows[row]),
            "size": jump.size,
            "rows": [row],
        }
        yield Finding("readings.jump" if spike is None else "readings.spike", "fail", facts, table.label)


def _burst(table: Table[Any], name: str, burst: slice, used: slice, early: bool) -> Finding:
    """A stretch of noise, and the line of ``rig.toml`` that leaves it out: an ``early`` one with what is before it."""
    time = table["time"]
    digits = max(0, int(np.ceil(-np.log10(median_step(time[used]))))) + 1
    begin, end = float(time[burst.start]), float(time[min(burst.stop, used.stop - 1)])
    facts = {
        "file": table.file,
        "line": int(table.rows[burst.start]),
        "column": name,
        "begin": begin,
        "end": end,
        "key": "start" if early else "stop",
        "value": float(np.round(end if early else begin, digits)),
        "rows": [burst.start, burst.stop - 1],
    }
    return Finding("readings.burst", "fail", facts, table.label)
