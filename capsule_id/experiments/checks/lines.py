"""Checks and table of calibration lines."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy import stats

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.views import Finding, ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.base import ValuesBySymbol
    from capsule_id.experiments.line import Line


def check_linearity(lines: "Sequence[Line]", fit: Fitted) -> list[Finding]:
    """Expected: calibration lines that rise and are straight, flagged rows left out."""
    findings = []
    for e in lines:
        theta, left_out = e.local(fit.values), fit.flagged.get(e.label, [])
        # A single wild reading can tilt the whole line: that is the outlier's finding, not this one's.
        slope = refit(e, theta, left_out)[e.symbol][0]
        if slope <= 0.0:
            facts = {"name": e.slope.name, "slope": slope, "unit": e.slope.unit, "x": e.x_name, "y": e.y_name}
            findings.append(Finding("lines.rise", "fail", facts, e.label))
            continue
        bend, p = curvature_test(e, theta, left_out)
        if p * len(lines) < LEVEL:
            facts = {"name": e.slope.name, "departure": bend, "p": p}
            findings.append(Finding("lines.straight", "fail", facts, e.label))
    return findings or [Finding("lines.straight", "ok", {"number": len(lines)})]


def curvature_test(line: "Line", theta: "ValuesBySymbol", left_out: Sequence[int]) -> tuple[float, float]:
    """Is a calibration line bent? Relative departure at mid range of the best parabola, and the p-value of "none"."""
    misfit = line.misfit(theta)
    keep = np.setdiff1d(np.arange(line.n), left_out)
    x, sd = line.x[keep], misfit.sd[keep]
    if len(keep) < 4 or len(np.unique(x)) < 3:
        return 0.0, 1.0
    z = (x - np.mean(x)) / np.ptp(x)
    columns = np.stack([np.ones_like(z), z, z**2], axis=1) / sd[:, None]
    y = line.y[keep] / sd
    coefficients, *_ = np.linalg.lstsq(columns, y, rcond=None)
    rest = y - columns @ coefficients
    covariance = np.linalg.inv(columns.T @ columns)
    freedom = len(keep) - 3
    variance = 1.0 if line.scale_known else float(rest @ rest) / max(freedom, 1)
    score = abs(coefficients[2]) / np.sqrt(max(variance * covariance[2, 2], 1e-300))
    p = 2.0 * (stats.norm.sf(score) if line.scale_known else stats.t.sf(score, max(freedom, 1)))
    return float(coefficients[2] * 0.25 / abs(coefficients[1])), float(p)


def line_table(lines: "Sequence[Line]", fit: Fitted) -> list[ResultTable]:
    """Slopes with and without flagged rows, beside the paper's ordinary line."""
    rows = []
    for e in lines:
        theta, left_out = e.local(fit.values), fit.flagged.get(e.label, [])
        value, sd = refit(e, theta, [])[e.symbol]
        row: dict[str, object] = {
            "table": e.label,
            "slope": f"{e.slope.name}, {e.slope.unit}",
            "all rows": value,
            "±": sd,
            "ordinary line": e.ordinary_line()[0],
        }
        if fit.flagged:
            without = refit(e, theta, left_out)[e.symbol] if left_out else (np.nan, np.nan)
            row |= {"without flagged rows": without[0], "± without": without[1]}
        rows.append(row | e.table_extras() | {"errors": e.errors})
    return [ResultTable("lines.slopes", pd.DataFrame(rows).set_index("table"))]
