"""Findings on the channels of a record, shared by all kinds with a column ``time``."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.records.faults.bursts import noisy_stretch
from capsule_id.records.faults.clipping import clipped_samples
from capsule_id.records.faults.phase import jump_or_noise
from capsule_id.records.faults.timing import dropouts, find_gaps, frozen_samples, time_rounding
from capsule_id.rig.filters import TIMING_TOLERANCE, hampel_outliers, largest_offset, median_step
from capsule_id.rig.model import Table
from capsule_id.views import Finding

#: Periods before a burst of noise or a jump that a decay is cut to; with fewer it begins behind it.
KEPT_PERIODS = 3
#: Most samples that are named as spikes, window of the rule that drops them, steps, and its limits, robust sds.
MOST_SPIKES, WINDOW, LIMITS = 20, 10, (20.0, 12.0, 8.0, 5.0)


def _rounded(table: Table[Any], used: slice, time: float) -> float:
    """A time with one digit more than the sampling step needs."""
    return float(np.round(time, max(0, int(np.ceil(-np.log10(median_step(table["time"][used]))))) + 1))


def _cut(table: Table[Any], used: slice, key: str, time: float) -> str:
    """The line that leaves out one side of a time of a decay; a run has no such key."""
    line = f'{key} = {{ value = {_rounded(table, used, time):.10g}, unit = "s" }}'
    decay = hasattr(table.settings, "stop")
    return f"Add this line to the experiment in rig.toml: {line}" if decay else "Record again."


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
            "cut": _cut(table, used, "start", float(time[min(found[-1] + 1, len(time) - 1)])),
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
                "lines": " ".join(map(str, table.rows[found])),
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
        return
    if jump.noisy:
        return
    # Samples are spikes where the record is smooth once a rule has dropped them.
    index = np.arange(len(values))
    for n_sd in LIMITS:
        spikes = np.flatnonzero(hampel_outliers(values, WINDOW + 1, n_sd))
        good = np.delete(index, spikes)
        left = jump_or_noise(np.interp(index, good, values[good]), period / step, alone)
        if 0 < len(spikes) <= MOST_SPIKES and (left is None or left.noisy):
            break
    else:
        spikes = index[:0]
    code, row = ("readings.spike", spikes[0]) if len(spikes) else ("readings.jump", jump.row)
    early = jump.row < KEPT_PERIODS * period / step
    facts = {
        "file": table.file,
        "column": name,
        "time": float(time[row]),
        "line": int(table.rows[used.start + row]),
        "lines": " ".join(map(str, table.rows[used.start + spikes])),
        "size": jump.size,
        "cut": _cut(table, used, "start" if early else "stop", float(time[row - (not early)])),
        "rule": f'{{ rule = "hampel", window = "{1e3 * float(f"{WINDOW * step:.6g}"):g} ms", n_sd = {n_sd:g} }}',
        "rows": (used.start + (spikes if len(spikes) else np.array([row]))).tolist(),
    }
    yield Finding(code, "fail", facts, table.label)


def _burst(table: Table[Any], name: str, burst: slice, used: slice, early: bool) -> Finding:
    """A stretch of noise, and the line of ``rig.toml`` that leaves it out: an ``early`` one with what is before it."""
    time = table["time"]
    begin, end = float(time[burst.start]), float(time[min(burst.stop, used.stop - 1)])
    facts = {
        "file": table.file,
        "line": int(table.rows[burst.start]),
        "column": name,
        "begin": begin,
        "end": end,
        "key": "start" if early else "stop",
        "value": _rounded(table, used, end if early else begin),
        "cut": _cut(table, used, "start" if early else "stop", end if early else begin),
        "rows": [burst.start, burst.stop - 1],
    }
    return Finding("readings.burst", "fail", facts, table.label)
