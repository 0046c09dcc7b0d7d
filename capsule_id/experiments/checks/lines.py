"""Checks and table of calibration lines."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy import stats

from capsule_id.experiments.checks.context import Fitted, ok_if_empty
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.views import Finding, NoteTable

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
            text = (
                f"{e.label}: {e.slope.name} is positive, the line falls ({slope:.3g} {e.slope.unit}): check the signs of "
                f"{e.x_name} and {e.y_name}"
            )
            findings.append(Finding("linearity", "fail", text, e.label))
            continue
        bend, p = curvature_test(e, theta, left_out)
        if p * len(lines) < LEVEL:
            text = (
                f"{e.label}: expected a straight line; a parabola departs from it by {100 * bend:.1f} % of the range at "
                f"mid range (p = {p:.1g}), so {e.slope.name} depends on where it is read: use the part of the range "
                "that the runs use"
            )
            findings.append(Finding("linearity", "fail", text, e.label))
    return ok_if_empty(findings, "linearity", f"{len(lines)} calibration lines are straight")


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


def line_table(lines: "Sequence[Line]", fit: Fitted) -> list[NoteTable]:
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
    caption = (
        "Slopes by generalised least squares; the ordinary line is the paper's. Flagged rows are shown, not dropped."
    )
    return [NoteTable("Calibration lines", caption, pd.DataFrame(rows).set_index("table"))]
