"""Further fits of runs whose residuals are correlated: coloured noise, then other friction laws.

first joint fit -> residuals correlated -> joint fit with AR(1) noise, quoted where it explains more
    -> residuals still correlated -> joint fits with other friction laws, which are named and never quoted
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.checks.series import correlated_records
from capsule_id.experiments.families.friction_model import FrictionModel, SurfaceExperiment
from capsule_id.experiments.families.friction_variants import model_lines
from capsule_id.inference.fit.joint_fit import joint_fit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target.compiling import release_memory
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.parameters import is_stated
from capsule_id.physics.friction import CoulombStribeck
from capsule_id.views import Finding

#: Friction laws that are compared, the simplest first.
LAWS = (FrictionModel(constant=True), FrictionModel(), FrictionModel(free=("ratio",)))
#: Difference of penalised log-posteriors that rejects a simpler law: "strong" (Kass & Raftery 1995).
STRONG = 3.0


def fit_coloured(target: LogPosterior, first: PointFit, seed: int) -> tuple[LogPosterior, PointFit, list[Finding]]:
    """Fit runs again with coloured noise where their residuals are correlated and the settings state no noise.

    The second fit is returned where it explains the readings better, and a finding that shows both.
    """
    values = target.mapping(target.theta(first.u))
    correlated = {one.experiment.shares_noise for one in correlated_records(target.experiments, values)[0]}
    changed = [
        e.with_coloured_noise(e.local(values)) if e.shares_noise in correlated else None for e in target.experiments
    ]
    if not any(changed):
        return target, first, []
    experiments = [e if new is None else new[0] for e, new in zip(target.experiments, changed, strict=True)]
    starts = {name: value for new in changed if new is not None for name, value in new[1].items()}
    second_target, second = _fitted(target, experiments, {**values, **starts}, seed)
    if _height(second_target, second) < _height(target, first):
        return target, first, []
    rows = [_row("first, white noise", target, first), _row("quoted, AR(1) noise", second_target, second)]
    records = list(dict.fromkeys(e.shares_noise for e, new in zip(target.experiments, changed, strict=True) if new))
    return second_target, second, [Finding("runs.second_fit", "warn", {"records": records, "fits": rows}, records[0])]


def compare_laws(target: LogPosterior, fit: PointFit, seed: int) -> list[Finding]:
    """Fit other friction laws to runs whose residuals are correlated; a finding names the simplest of the best ones.

    Only where runs alone measure friction: friction tests compare the laws themselves.
    """
    values = target.mapping(target.theta(fit.u))
    own = law_of_runs(target.experiments)
    correlated, _ = correlated_records(target.experiments, values)
    if own is None or not any(one.experiment.event_driven for one in correlated):
        return []
    fits = {own: (target, fit)}
    for law in LAWS:
        if law not in fits:
            experiments = [e.with_friction(law) if isinstance(e, SurfaceExperiment) else e for e in target.experiments]
            try:
                fits[law] = _fitted(target, experiments, values, seed)
            except InputError:
                continue  # no motion with this law is finite
    height = {law: _height(*one) for law, one in fits.items()}
    best = max(height.values())
    rows = [
        {**_row(law.name, *fits[law]), "difference": height[law] - best}
        for law in sorted(fits, key=lambda a: -height[a])
    ]
    simplest = min(
        (law for law in fits if height[law] >= best - STRONG), key=lambda law: (len(law.parameters), law.free)
    )
    chosen = own if height[own] >= best - STRONG and len(own.parameters) <= len(simplest.parameters) else simplest
    shown = [row.name for row in target.parameters if row.physical and not is_stated(row.name)]
    moved = [(name, values[name], fits[chosen][1].values[name]) for name in shown if name in fits[chosen][1].values]
    facts = {
        "own": own.name,
        "law": chosen.name,
        "line": model_lines(chosen),
        "gain": height[chosen] - height[own],
        "moved": moved,
        "laws": rows,
    }
    return [Finding("runs.laws", "ok" if chosen == own else "warn", facts, correlated[0].experiment.label)]


def law_of_runs(experiments: Sequence[Experiment]) -> FrictionModel | None:
    """The friction law of the runs; None where other tests measure friction, or the law is a user's own."""
    symbols = {row.symbol for row in CoulombStribeck.parameters}
    users = [e for e in experiments if symbols & {row.symbol for row in e.parameters}]
    laws = [e.friction for e in users if isinstance(e, SurfaceExperiment) and e.event_driven and e.time_series]
    return laws[0] if laws and len(laws) == len(users) and laws[0].law is CoulombStribeck else None


def _fitted(
    target: LogPosterior, experiments: Sequence[Experiment], values: Mapping[str, float], seed: int
) -> tuple[LogPosterior, PointFit]:
    """Fit other models of the same readings, from ``values`` by name."""
    release_memory()
    other = LogPosterior(target.rig, experiments)
    return other, joint_fit(other, values, seed)


def _height(target: LogPosterior, fit: PointFit) -> float:
    """Largest log-posterior, less Schwarz's penalty for the number of parameters."""
    readings = sum(e.n for e in target.experiments)
    return float(np.max(fit.log_posterior)) - 0.5 * target.dimension * float(np.log(readings))


def _row(name: str, target: LogPosterior, fit: PointFit) -> dict[str, Any]:
    """Row of a table that compares fits of the same readings."""
    physical = [row for row in target.parameters if row.physical and not is_stated(row.name)]
    listed = [f"{row.name} = {fit.values[row.name]:.5g} ± {fit.standard_errors[row.name]:.2g}" for row in physical]
    correlated, _ = correlated_records(target.experiments, target.mapping(target.theta(fit.u)))
    return {
        "fit": name,
        "parameters": ", ".join(listed),
        "log-posterior": float(np.max(fit.log_posterior)),
        "residuals white": "no" if correlated else "yes",
    }
