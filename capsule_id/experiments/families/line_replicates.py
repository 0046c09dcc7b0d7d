"""Lack of fit of a calibration line against the scatter of repeated readings."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.families.line_experiment import Line

#: Values of x closer than this count as repeated, relative to their range.
SAME = 1e-9
#: Smallest deviation of the levels from the line that counts, in sd of the repeated readings.
SMALLEST_DEVIATION = 0.5


def check_replicates(lines: "Sequence[Line]", fit: Fitted) -> list[Finding]:
    """Check that the means of repeated readings lie on the line (F test; Draper & Smith 1998, section 2.1)."""
    judged, findings = 0, []
    for e in lines:
        keep = np.setdiff1d(np.arange(e.n), fit.flagged.get(e.label, []))
        found = lack_of_fit(e.x[keep], e.y[keep])
        if found is None:
            continue
        judged += 1
        deviation, p = found
        if p * len(lines) < LEVEL and deviation > SMALLEST_DEVIATION:
            facts = {"name": e.slope.name, "x": e.x_name, "deviation": deviation, "p": p}
            findings.append(Finding("lines.replicates", "fail", facts, e.label))
    return findings or [Finding("lines.replicates", "ok", {"number": judged})] * bool(judged)


def lack_of_fit(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Deviation of the levels from the line, in sd of repeated readings, and p-value; None without repetitions."""
    order = np.argsort(x, kind="stable")
    level = np.concatenate([[0], np.cumsum(np.diff(x[order]) > SAME * np.ptp(x))])
    count = np.bincount(level)
    levels, freedom = len(count), len(x) - len(count)
    if levels < 3 or freedom < 3:
        return None
    mean = np.bincount(level, y[order]) / count
    within = float(np.sum((y[order] - mean[level]) ** 2)) / freedom
    total = np.polyval(np.polyfit(x, y, 1), x[order])
    between = float(np.sum((mean[level] - total) ** 2)) / (levels - 2)
    if within == 0.0:
        return None
    size = len(x) / levels
    return float(np.sqrt(max(between / within - 1.0, 0.0) / size)), float(
        stats.f.sf(between / within, levels - 2, freedom)
    )
