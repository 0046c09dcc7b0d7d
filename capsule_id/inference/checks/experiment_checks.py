"""Residual checks of every experiment at the point fit.

Every check of level ``fail`` has a family-wise false-alarm rate of ``LEVEL`` over its experiments (Bonferroni).
"""

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LAGS, LEVEL, correlated_records
from capsule_id.inference.checks.regression import MOST_FLAGGED, outliers
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.views import Finding


def check_whiteness(s: SampledFit) -> list[Finding]:
    """Check that the residuals of every record are white (Ljung–Box)."""
    correlated, records = correlated_records(s.experiments, s.values)
    findings = [
        Finding("residuals.white", "fail", {**one._asdict(), **one.experiment.noise_facts()}, one.experiment.label)
        for one in correlated
    ]
    return findings or [Finding("residuals.white", "ok", {"records": records, "lags": LAGS})] * bool(records)


def check_outliers(s: SampledFit) -> tuple[list[Finding], dict[str, list[int]]]:
    """Check every table for outliers; also return the flagged row indices, by label."""
    tables = [e for e in s.experiments if not e.time_series]
    findings, flagged = [], {}
    for e in tables:
        theta = e.local(s.values)
        found = outliers(e, theta, LEVEL / len(tables))
        if not found:
            continue
        rows = [o.row for o in found]
        flagged[e.label] = rows
        without = refit(e, theta, rows)
        facts = {
            "file": e.table.file,
            "lines": sorted(int(e.table.rows[row]) for row in rows),
            "score": abs(found[0].score),
            "p": found[0].p,
            "most": MOST_FLAGGED,
            "estimates": [
                (row.name, row.unit, s.values[row.name], without[row.symbol][0])
                for row in e.parameters
                if row.symbol in without
            ],
        }
        findings.append(Finding("outliers", "fail", facts, e.label))
    return findings or [Finding("outliers", "ok")] * bool(tables), flagged


def check_stated_errors(s: SampledFit) -> list[Finding]:
    """Check that stated reading errors explain the scatter (chi-square)."""
    known = [e for e in s.experiments if e.scale_known and e.label not in s.flagged]
    findings = []
    for e in known:
        square = float(np.sum(np.asarray(e.residuals(e.local(s.values), np))[: e.n] ** 2))
        freedom = e.n - 2
        p = float(stats.chi2.sf(square, freedom)) if freedom > 0 else 1.0
        if p * len(known) < LEVEL:
            facts = {"freedom": freedom, "chi_square": square, "p": p}
            findings.append(Finding("errors.stated", "fail", facts, e.label))
    return findings or [Finding("errors.stated", "ok")] * bool(known)
