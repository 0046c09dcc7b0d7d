"""Checks of the residuals of every experiment at the point fit.

Every check that can fail has a family-wise false-alarm rate of ``LEVEL`` over its experiments (Bonferroni).
"""

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.context import ok_if_empty
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LAGS, LEVEL, ljung_box
from capsule_id.inference.checks.regression import MOST_FLAGGED, outliers
from capsule_id.inference.checks.setting import Setting
from capsule_id.views import Finding


def check_whiteness(s: Setting) -> list[Finding]:
    """Expected: residuals of every record white (Ljung–Box)."""
    records = [
        (e, label, residuals)
        for e in s.experiments
        if e.time_series
        for label, residuals in e.records(e.local(s.values))
    ]
    findings = []
    for e, label, residuals in records:
        q, p, lags = ljung_box(residuals)
        if p * len(records) < LEVEL:
            text = (
                f"{label}: expected white residuals; Ljung–Box Q = {q:.0f} over {lags} lags (p = {p:.1g}), so the model "
                f"misses something or the noise is coloured, and the intervals are not to be trusted"
                f"{e.advice_on_coloured_noise()}"
            )
            findings.append(Finding("residuals white", "fail", text, e.label))
    if not records:
        return []
    return ok_if_empty(
        findings, "residuals white", f"residuals of {len(records)} records are white (Ljung–Box, {LAGS} lags)"
    )


def check_outliers(s: Setting) -> tuple[list[Finding], dict[str, list[int]]]:
    """Expected: no reading far from the rest of its table; also the rows (indices) flagged, by label."""
    tables = [e for e in s.experiments if not e.time_series]
    findings, flagged = [], {}
    for e in tables:
        theta = e.local(s.values)
        found = outliers(e, theta, LEVEL / len(tables))
        if not found:
            continue
        rows = [o.row for o in found]
        flagged[e.label] = rows
        several, most = len(found) > 1, len(found) == MOST_FLAGGED
        numbers = [str(line) for line in sorted(int(e.table.rows[o.row]) for o in found)]
        lines = (
            f"lines {', '.join(numbers[:-1])} and {numbers[-1]} stand up to" if several else f"line {numbers[0]} stands"
        )
        more = (
            f" (no more than {MOST_FLAGGED} rows are named: if more stand off, look at the whole table)" if most else ""
        )
        physical = [row for row in e.parameters if row.physical]
        without = refit(e, theta, rows)
        change = "; ".join(
            f"{row.name} = {s.values[row.name]:.5g} {row.unit} with {'them' if several else 'it'}, "
            f"{without[row.symbol][0]:.5g} without"
            for row in physical
        )
        text = (
            f"{e.label}: {e.table.file} {lines} {abs(found[0].score):.3g} studentised residuals off the others "
            f"(p = {found[0].p:.1g}){more}; {change}. Nothing was dropped: check the reading, correct or remove it yourself"
        )
        findings.append(Finding("outliers", "fail", text, e.label))
    if not tables:
        return [], {}
    return ok_if_empty(findings, "outliers", "no reading stands apart from the others of its table"), flagged


def check_stated_errors(s: Setting) -> list[Finding]:
    """Expected: where reading errors are stated, they explain the scatter (chi-square)."""
    known = [e for e in s.experiments if e.scale_known and e.label not in s.flagged]
    findings = []
    for e in known:
        square = float(np.sum(np.asarray(e.residuals(e.local(s.values), np))[: e.n] ** 2))
        freedom = e.n - 2
        p = float(stats.chi2.sf(square, freedom)) if freedom > 0 else 1.0
        if p * len(known) < LEVEL:
            text = (
                f"{e.label}: the stated reading errors explain a chi-square of about {freedom}; {square:.0f} was seen "
                f"(p = {p:.1g}): the errors are larger than stated, or the line is not straight"
            )
            findings.append(Finding("stated errors", "fail", text, e.label))
    return ok_if_empty(findings, "stated errors", "stated reading errors explain the scatter") if known else []
