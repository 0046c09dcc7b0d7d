"""Checks of free decays: equal stiffness at every amplitude, no slip and no contact."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.experiments.free_vibration.decrement import equilibrium
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration


def check_stiffness(records: "Sequence[FreeVibration]", fit: Fitted) -> list[Finding]:
    """Check that k1 of single records does not depend on amplitude (the paper's "linear near the working point")."""
    if len(records) < 2:
        return []
    k1, sd, _ = stiffness_by_record(records, fit.values)
    weight = sd**-2.0
    mean = np.average(k1, weights=weight)
    q = float(np.sum(weight * (k1 - mean) ** 2))
    p = float(stats.chi2.sf(q, len(records) - 1))
    facts = {"records": len(records), "low": k1.min(), "high": k1.max(), "chi_square": q, "p": p}
    return [Finding("decays.stiffness", "fail" if p < LEVEL else "ok", facts)]


def stiffness_by_record(
    records: "Sequence[FreeVibration]", values: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate k1, its standard error and the largest deflection of every record, (records,) SI."""
    estimates = [refit(e, e.local(values), [])["k1"] for e in records]
    k1, sd = (np.array(column) for column in zip(*estimates, strict=True))
    return k1, sd, np.array([e.largest_deflection for e in records])


def check_free_decay(records: "Sequence[FreeVibration]", fit: Fitted) -> list[Finding]:
    """Check that a free capsule does not slip and that the rod does not touch the support spring."""
    findings, theta = [], fit.values
    for e in records:
        needed = {"m2", *(row.symbol for row in e.friction.parameters_at_rest)}
        if e.table.settings.capsule == "free" and needed <= set(theta):
            force = e.largest_force(theta)
            threshold = float(e.friction.force(theta).forward(0.0))
            if force > threshold:
                findings.append(Finding("decays.slip", "fail", {"force": force, "F_b": threshold}, e.label))
        gap = e.table.settings.gap
        reach = float(np.max(e.values - equilibrium(e.values)))
        if gap is not None and reach >= gap.value:
            findings.append(Finding("decays.contact", "fail", {"reach": reach, "gap": gap.value}, e.label))
    return findings
