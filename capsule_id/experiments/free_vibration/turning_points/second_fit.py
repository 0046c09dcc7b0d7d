"""Choice of the forces of turning points where the readings contradict the stated ones.

A force is added where the readings demand it by ``FAIL`` sds and exclude every other one in its place. Amplitudes of one
side must also exclude that they are counted from another place than the rest position.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import pandas as pd

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.free_vibration.second_fit.hidden_terms import open_forces
from capsule_id.experiments.free_vibration.settings import DecayModel
from capsule_id.experiments.free_vibration.turning_points.linear import (
    DISAGREE,
    FAIL,
    FurtherForce,
    bic,
    fitted,
    further_force,
    standard_errors,
)
from capsule_id.views import Finding, ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.turning_points.experiment import TurningPoints

#: Sds from zero of a force that another one must exclude.
RIVAL = 2.0


def second_models(tables: "Sequence[TurningPoints]") -> "tuple[list[TurningPoints], list[Finding]]":
    """Return ``tables`` under the models that they demand, and findings that name them.

    Tables with the same stated words share their parameters, and so their model.
    """
    chosen, findings = list(tables), list[Finding]()
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, e in enumerate(tables):
        settings = e.table.settings
        groups.setdefault((settings.damping, settings.stiffness, settings.offers_cubic, e.model.cubic), []).append(i)
    for members in groups.values():
        own, contradicting = [tables[i] for i in members], list[str]()
        while demanded := _demanded_force(own):
            label, force = demanded
            contradicting.append(label)
            own = [e.with_model(force.model) for e in own]
        if contradicting:
            first, second = tables[members[0]].model, own[0].model
            facts = {
                "labels": [e.label for e in own],
                "first": first.name,
                "second": second.name,
                "lines": second.force_lines,
            }
            findings.append(Finding("decays.second_fit", "warn", {**facts, "drift": ""}, contradicting[0]))
            for i, e in zip(members, own, strict=True):
                chosen[i] = e
    return chosen, findings


def second_fit_table(tables: "Sequence[TurningPoints]", fit: Fitted) -> list[ResultTable]:
    """Compare the turning points under the stated model and under the quoted one; [] where both are the same."""
    del fit
    replaced = [e for e in tables if e.model != DecayModel.stated(e.table.settings)]
    rows = []
    for e in replaced:
        own = []
        for role, one in (("stated", e.with_model(DecayModel.stated(e.table.settings))), ("quoted", e)):
            theta = fitted(one)
            estimates = standard_errors(one, theta)
            text = ", ".join(f"{name} = {theta[name]:.5g} ± {sd:.2g}" for name, sd in estimates.items())
            fit_name = role if len(replaced) == 1 else f"{role}, {e.label}"
            own.append({"fit": fit_name, "model": one.model.name, "parameters": text, "BIC": bic(one, theta)})
        lowest = min(row["BIC"] for row in own)
        rows += [{**row, "BIC": row["BIC"] - lowest} for row in own]
    if not rows:
        return []
    lines = replaced[0].model.force_lines
    return [ResultTable("decays.second_fit", pd.DataFrame(rows).set_index("fit"), {"lines": lines})]


def _demanded_force(tables: "Sequence[TurningPoints]") -> tuple[str, FurtherForce] | None:
    """The most significant force that a table demands, with the label of that table."""
    found = []
    for e in tables:
        symbols, cubic = open_forces(e), e.table.settings.offers_cubic
        theta = fitted(e) if symbols else {}
        forces = [one for symbol in symbols if (one := further_force(e, theta, symbol))]
        offered = [one for one in forces if one.z > FAIL and (cubic or one.symbol != "k_cubic")]
        if not offered:
            continue
        best = max(offered, key=lambda one: one.z)
        rivals = [one for one in forces if one is not best and one.z > RIVAL]
        beside_offset = further_force(e, theta, best.symbol, offset=True)
        if beside_offset and beside_offset.z > DISAGREE and all(_excluded(e, one, best.symbol) for one in rivals):
            found.append((e.label, best))
    return max(found, key=lambda pair: pair[1].z) if found else None


def _excluded(e: "TurningPoints", other: FurtherForce, symbol: str) -> bool:
    """Whether the readings demand the force with the parameter ``symbol`` even beside the force ``other``."""
    with_other = e.with_model(other.model)
    theta: ValuesBySymbol = fitted(with_other)
    force = further_force(with_other, theta, symbol)
    return force is not None and force.z > DISAGREE
