"""Findings on the channels of a record, shared by all kinds with a column ``time``."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.records.faults.clipping import clipped_samples
from capsule_id.records.faults.phase import phase_jump
from capsule_id.records.faults.timing import dropouts, find_gaps, frozen_samples, time_rounding
from capsule_id.rig.filters import TIMING_TOLERANCE
from capsule_id.rig.model import Table
from capsule_id.views import Finding


def lint_times(table: Table[Any], used: np.ndarray) -> Iterable[Finding]:
    """Report gaps and rounded times.

    Parameters
    ----------
    used : (n,) bool, the rows that a fit reads
    """
    rows = np.flatnonzero(used)
    time = table["time"][rows]
    gaps = find_gaps(time)
    if gaps is not None:
        first = rows[gaps.rows[0]]
        facts = {
            "file": table.file,
            "line": int(table.rows[first]),
            "time": float(table["time"][first]),
            "gaps": len(gaps.rows),
            "lost": int(gaps.lost.sum()),
            "step": gaps.step,
            "rows": rows[gaps.rows].tolist(),
        }
        yield Finding("readings.gaps", "warn", facts, table.label)
        return
    rounding = time_rounding(time)
    if rounding is not None:
        yield Finding("readings.rounded_times", "warn", {"step": rounding, "file": table.file}, table.label)


def lint_channel(table: Table[Any], name: str, used: np.ndarray, period: float) -> Iterable[Finding]:
    """Report clipped samples, drop-outs and a frozen sensor.

    Parameters
    ----------
    name : of the column
    used : (n,) bool, the rows that a fit reads
    period : of the oscillation, s; infinite where it is unknown
    """
    rows = np.flatnonzero(used)
    if len(rows) < 2 or np.ptp(table[name][rows]) == 0.0:
        return
    column, time = table.columns[name], table["time"]
    values = column.values[rows] * column.to_display
    step = float(np.median(np.diff(time[rows])))
    where = {"file": table.file, "column": name, "unit": column.unit}
    for clipped in clipped_samples(values, period / step):
        found = rows[clipped.rows]
        facts = where | {
            "side": clipped.side,
            "level": clipped.level,
            "samples": len(found),
            "share": len(found) / len(rows),
            "line": int(table.rows[found[0]]),
            "time": float(time[found[-1]]),
            "after": float(time[min(found[-1] + 1, len(time) - 1)]),
            "rows": found.tolist(),
        }
        yield Finding("readings.clipped", "fail", facts, table.label)
    for code, wrong in (("readings.dropouts", dropouts(values)), ("readings.frozen", frozen_samples(values))):
        if len(wrong):
            found = rows[wrong]
            facts = where | {
                "value": float(values[wrong[0]]),
                "samples": len(found),
                "line": int(table.rows[found[0]]),
                "time": float(time[found[0]]),
                "rows": found.tolist(),
            }
            yield Finding(code, "fail", facts, table.label)
            return


def lint_smooth(table: Table[Any], name: str, used: np.ndarray, period: float) -> Iterable[Finding]:
    """Report samples of a smooth oscillation that were lost without a gap in the times.

    Parameters
    ----------
    name : of the column
    used : (n,) bool, the rows of the oscillation
    period : of the oscillation, s
    """
    rows = np.flatnonzero(used)
    time = table["time"][rows]
    step = float(np.median(np.diff(time)))
    if np.max(np.abs(time - time[0] - step * np.arange(len(rows)))) > TIMING_TOLERANCE * step:
        return
    jump = phase_jump(table[name][rows], period / step)
    if jump is not None:
        row = int(rows[jump.row])
        facts = {
            "file": table.file,
            "column": name,
            "time": float(table["time"][row]),
            "line": int(table.rows[row]),
            "size": jump.size,
            "rows": [row],
        }
        yield Finding("readings.jump", "fail", facts, table.label)
