"""Checks of turning points: step of their digits, further forces, and the parameters of both halves."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.free_vibration.turning_points.linear import (
    DISAGREE,
    FAIL,
    as_normal,
    changes_of_second_half,
    further_force,
    relative_sd_of_mass,
    wider_models,
)
from capsule_id.parameters import parameter
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.turning_points.experiment import TurningPoints


def check_steps(tables: "Sequence[TurningPoints]", fit: Fitted) -> list[Finding]:
    """Warn where the readings are more regular than their digits show, so that the rounding error is all that is known."""
    findings = []
    for e in tables:
        theta = e.local(fit.values)
        # The positions tell the damping, the times the stiffness.
        for name, symbol, told, step in zip(("x_rel", "time"), e.scatters, ("c", "k1"), e.steps, strict=True):
            if theta[symbol] >= step / np.sqrt(12.0):
                continue
            column = e.table.columns[name]
            facts = {
                "label": e.label,
                "column": name,
                "unit": column.unit,
                "step": step * column.to_display,
                "name": told,
            }
            findings.append(Finding("decays.step", "warn", facts, e.label, (told,)))
    return findings


def check_forces(tables: "Sequence[TurningPoints]", fit: Fitted) -> list[Finding]:
    """Check that no further force of the decay explains the turning points better than the fitted model."""
    findings, checked = [], []
    for e in tables:
        theta = e.local(fit.values)
        forces = [one for symbol in wider_models(e.model) if (one := further_force(e, theta, symbol))]
        if not forces:
            continue
        checked.append(e.label)
        best = max(forces, key=lambda one: one.z)
        if best.z > DISAGREE:
            facts = {"label": e.label, "name": best.symbol, "value": best.value, "unit": parameter(best.symbol).unit}
            facts |= {"z": best.z, "line": best.line, "model": e.model.name, "one_side": not e.both_sides}
            level = "fail" if best.z > FAIL and best.moved else "warn"
            findings.append(Finding("decays.forces", level, facts, e.label))
    if checked and not findings:
        findings.append(Finding("decays.forces", "ok", {"labels": ", ".join(checked)}))
    return findings


def check_halves(tables: "Sequence[TurningPoints]", fit: Fitted) -> list[Finding]:
    """Check that both halves of every table of turning points give the same parameters, where it is long enough."""
    compared, findings = [], []
    for e in tables:
        theta = e.local(fit.values)
        freedom, changes = changes_of_second_half(e, theta)
        if freedom == 0.0:
            continue
        compared.append(e.label)
        z = {name: as_normal((b - a) / sd, freedom) for name, (a, b, sd) in changes.items()}
        name = max(z, key=lambda name: z[name])
        if z[name] > DISAGREE:
            first, second, _ = changes[name]
            facts = {"label": e.label, "name": name, "first": first, "second": second, "z": z[name]}
            facts |= {"unit": parameter(name).unit, "model": e.model.name, "stated": ()}
            moved = 0.5 * abs(second - first) > relative_sd_of_mass(e) * abs(theta[name])
            level = "fail" if z[name] > FAIL and moved else "warn"
            findings.append(Finding("decays.halves", level, facts, e.label))
    if compared and not findings:
        findings.append(Finding("decays.halves", "ok", {"labels": ", ".join(compared)}))
    return findings
