"""Checks of free decays: equal stiffness at every amplitude, equal halves, no slip and no contact."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.experiments.free_vibration.decrement import equilibrium
from capsule_id.experiments.free_vibration.second_fit.fits import Screening
from capsule_id.experiments.free_vibration.settings import decay_window
from capsule_id.parameters import parameter
from capsule_id.views import Finding

#: Joint sds apart from which halves of a record disagree, and from which that fails.
HALVES_DISAGREE, HALVES_FAIL = 3.0, 4.0
#: Fewest readings and half cycles of a half.
FEWEST_READINGS, FEWEST_HALF_CYCLES = 40, 4

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
        reach = float(np.max(e.values - equilibrium(e.values))) if e.order == 0 else e.largest_deflection
        if gap is not None and reach >= gap.value:
            findings.append(Finding("decays.contact", "fail", {"reach": reach, "gap": gap.value}, e.label))
    return findings


def check_halves(records: "Sequence[FreeVibration]", fit: Fitted) -> list[Finding]:
    """Check that both halves of every record give the same parameters, where they are long enough."""
    compared, findings = [], []
    for e in records:
        halves = _halves(e)
        if not halves:
            continue
        compared.append(e.label)
        (first, first_sd), (second, second_sd) = (_estimates(half, e.local(fit.values)) for half in halves)
        z = {name: (second[name] - first[name]) / np.hypot(first_sd[name], second_sd[name]) for name in first}
        name = max(z, key=lambda name: abs(z[name]))
        size = float(abs(z[name]))
        if size > HALVES_DISAGREE:
            facts = {"label": e.label, "name": name, "first": first[name], "second": second[name], "z": size}
            facts |= {"unit": parameter(name).unit, "model": e.model_name}
            findings.append(Finding("decays.halves", "fail" if size > HALVES_FAIL else "warn", facts, e.label))
    if compared and not findings:
        findings.append(Finding("decays.halves", "ok", {"labels": ", ".join(compared)}))
    return findings


def _halves(e: "FreeVibration") -> "list[FreeVibration]":
    """The first and the second half of the part of ``e`` whose peaks exceed its noise; [] for a short one."""
    decrement = e.decrement()
    if decrement is None or len(decrement.times) < 2 * FEWEST_HALF_CYCLES:
        return []
    if e.order == 2 and "dry" in e.model.damping:
        return []  # the acceleration jumps where the rod turns, so difference quotients give no standard errors
    time = e.whole[0][e.whole[0] <= decrement.times[-1]]
    if len(time) < 2 * FEWEST_READINGS * e.model.thin:
        return []
    begin = float(decay_window(e.table)[0][0])
    middle, end = begin + float(time[len(time) // 2]), begin + float(time[-1])
    settings = e.table.settings
    spans = (replace(settings, start=begin, stop=middle), replace(settings, start=middle, stop=end))
    tables = [replace(e.table, settings=span) for span in spans]
    return [type(e)(table, e.rig, e.friction, e.model) for table in tables]


def _estimates(half: "FreeVibration", theta: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Estimates and standard errors of the physical parameters from one half, from the values ``theta`` of the whole."""
    if half.closed and not half.model.whitened:
        pairs = refit(half, theta, [])
        return {name: v for name, (v, _) in pairs.items()}, {name: sd for name, (_, sd) in pairs.items()}
    screening = Screening(half)
    found, _ = screening.fit(half.model, screening.scaled(theta))
    names = ("k1", "c", *half.model.symbols)
    return {name: found.values[name] for name in names}, {name: found.errors[name] for name in names}
