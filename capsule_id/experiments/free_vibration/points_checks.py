"""Checks of turning points: no further force explains them better, and both halves give the same parameters.

measured minus predicted, and its derivatives -> coefficients of a further force, or of both halves (least squares)
    -> Student's t of that force, or of the differences between the halves
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.linalg import block_diag

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.free_vibration.settings import DAMPING
from capsule_id.parameters import Parameter, is_stated, parameter
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.turning_points import TurningPoints

#: Joint sds from which halves disagree or a force is present, and from which that fails, as for records.
DISAGREE, FAIL = 3.0, 4.0
#: Fewest turning points that are judged.
FEWEST_TURNS = 8
#: Relative step of difference quotients, and passes that estimate the noise levels.
STEP, PASSES = 1e-5, 4


def check_forces_of_points(tables: "Sequence[TurningPoints]", fit: Fitted) -> list[Finding]:
    """Check that no further force of the decay explains the turning points better than the fitted model."""
    findings, checked = [], []
    for e in tables:
        theta, best = e.local(fit.values), None
        for word, symbol, line in _further(e):
            found = with_force(e, theta, word, symbol)
            if found is None:
                continue
            if e.label not in checked:
                checked.append(e.label)
            z, value, moved = found
            if z > DISAGREE and (best is None or z > best[0]):
                unit = parameter(symbol).unit
                facts = {"label": e.label, "name": symbol, "value": value, "unit": unit, "z": z, "line": line}
                best = z, moved, {**facts, "model": e.model.name}
        if best is not None:
            level = "fail" if best[0] > FAIL and best[1] else "warn"
            findings.append(Finding("decays.forces", level, best[2], e.label))
    if checked and not findings:
        findings.append(Finding("decays.forces", "ok", {"labels": ", ".join(checked)}))
    return findings


def check_halves_of_points(tables: "Sequence[TurningPoints]", fit: Fitted) -> list[Finding]:
    """Check that both halves of every table of turning points give the same parameters, where it is long enough."""
    compared, findings = [], []
    for e in tables:
        theta = e.local(fit.values)
        freedom, changes = changes_of_second_half(e, theta)
        if freedom == 0.0:
            continue
        compared.append(e.label)
        z = {name: _normal((b - a) / sd, freedom) for name, (a, b, sd) in changes.items()}
        name = max(z, key=lambda name: z[name])
        if z[name] > DISAGREE:
            first, second, _ = changes[name]
            facts = {"label": e.label, "name": name, "first": first, "second": second, "z": z[name]}
            facts |= {"unit": parameter(name).unit, "model": e.model.name, "stated": ()}
            moved = 0.5 * abs(second - first) > _share_of_mass(e) * abs(theta[name])
            level = "fail" if z[name] > FAIL and moved else "warn"
            findings.append(Finding("decays.halves", level, facts, e.label))
    if compared and not findings:
        findings.append(Finding("decays.halves", "ok", {"labels": ", ".join(compared)}))
    return findings


def with_force(e: "TurningPoints", theta: ValuesBySymbol, word: str, symbol: str) -> tuple[float, float, bool] | None:
    """Effect of a further force: its estimate over its sd, the estimate, SI, and whether it moves another parameter.

    A parameter moves where it changes by more than the sd that the fitted model gives it, that of the mass included.
    None for a table that is too short. The model is linearised at ``theta``.
    """
    settings = e.table.settings
    more = {"stiffness": "cubic"} if word == "cubic" else {"damping": (*(settings.damping or ("viscous",)), word)}
    wider = type(e)(replace(e.table, settings=replace(settings, **more)), e.rig, e.friction)
    size = float(np.max(np.abs(e.values)))
    step = {"F_dry": 1e-5 * theta["k1"] * size, "k_cubic": 1e-5 * theta["k1"] / size**2}
    step["c_q"] = 1e-4 * theta["c"] / (float(np.sqrt(theta["k1"] / theta["m1"])) * size)
    columns, rows = _columns(e, theta)
    if len(e.values) < FEWEST_TURNS or len(e.values) <= columns.shape[1] + 1:
        return None
    column = (_raw(wider, {**theta, symbol: step[symbol]}) - _raw(e, theta)) / step[symbol]
    raw = _raw(e, theta)
    _, own, _ = _least_squares(columns, -raw, len(e.values))
    found, sd, freedom = _least_squares(np.column_stack([columns, column]), -raw, len(e.values))
    if found[-1] <= 0.0 and symbol != "k_cubic":
        return 0.0, 0.0, False  # friction cannot push
    mass = _share_of_mass(e)
    moved = any(
        row.physical and abs(found[k]) > np.hypot(own[k], mass * theta[row.symbol]) for k, row in enumerate(rows)
    )
    return _normal(found[-1] / sd[-1], freedom), float(found[-1]), moved


def changes_of_second_half(
    e: "TurningPoints", theta: ValuesBySymbol
) -> tuple[float, dict[str, tuple[float, float, float]]]:
    """Degrees of freedom, 0 for a short table; both halves' value of each physical parameter and the sd of their difference.

    The model is linearised at ``theta``. Positions and times each have one noise level, that of the residuals left.
    """
    n = len(e.values)
    one, rows = _columns(e, theta)
    if n < FEWEST_TURNS or n <= one.shape[1]:
        return 0.0, {}
    # The second half has an amplitude, a rest position and a beginning of its own too.
    second = np.tile(np.arange(n) >= n // 2, 2)[:, None]
    found, sd, freedom = _least_squares(np.concatenate([one, one * second], axis=1), -_raw(e, theta), n)
    changes = {}
    for k, row in enumerate(rows):
        if row.physical:
            first, further = theta[row.symbol] + found[k], one.shape[1] + k
            changes[row.symbol] = (float(first), float(first + found[further]), float(sd[further]))
    return freedom, changes


def _columns(e: "TurningPoints", theta: ValuesBySymbol) -> tuple[Float[np.ndarray, "m p"], list[Parameter]]:
    """Derivatives of measured minus predicted, those of the parameters first; the parameters."""
    rows = [row for row in e.parameters if not row.scatter and not is_stated(row.name)]
    slopes = []
    for row in rows:
        step = STEP * (abs(theta[row.symbol]) or 1.0)
        sides = [_raw(e, {**theta, row.symbol: theta[row.symbol] + sign * step}) for sign in (1.0, -1.0)]
        slopes.append((sides[0] - sides[1]) / (2.0 * step))
    nuisances = np.asarray(block_diag(*(np.asarray(misfit.design) for misfit in e.misfits(theta, np))))
    return np.column_stack([*slopes, -nuisances]), rows


def _raw(e: "TurningPoints", theta: ValuesBySymbol) -> Float[np.ndarray, " m"]:
    """Measured minus predicted, positions and then times, SI."""
    return np.concatenate([np.asarray(misfit.raw) for misfit in e.misfits(theta, np)])


def _share_of_mass(e: "TurningPoints") -> float:
    """Relative sd of the mass, to which all parameters are in proportion."""
    assert e.rig.m1 is not None, "the kind needs m1"
    return e.rig.m1.sd / e.rig.m1.value


def _normal(t: float, freedom: float) -> float:
    """As many sds of a normal variable as the t statistic is worth."""
    return float(stats.norm.isf(stats.t.sf(abs(t), freedom)))


def _further(e: "TurningPoints") -> list[tuple[str, str, str]]:
    """Word, symbol and line of rig.toml of every force that the model lacks."""
    found = []
    for word, symbol in DAMPING.items():
        if word not in e.model.damping:
            words = ", ".join(f'"{one}"' for one in ("viscous", *e.model.damping, word))
            found.append((word, symbol, f"damping = [{words}]"))
    return found if e.model.cubic else [*found, ("cubic", "k_cubic", 'stiffness = "cubic"')]


def _least_squares(
    columns: Float[np.ndarray, "m p"], y: Float[np.ndarray, " m"], n: int
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"], float]:
    """Coefficients, their sds, and degrees of freedom; the first n rows and the others each have one noise level."""
    columns = columns / (size := np.linalg.norm(columns, axis=0))
    group = np.repeat([0, 1], [n, len(y) - n])
    noise = np.array([np.std(y[group == one]) for one in (0, 1)])
    for _ in range(PASSES):
        weight = 1.0 / np.maximum(noise, 1e-12 * np.max(np.abs(y)))[group]
        scaled = columns * weight[:, None]
        found = np.linalg.lstsq(scaled, weight * y, rcond=None)[0]
        # Leverages share the degrees of freedom out between positions and times.
        leverage = np.sum(np.linalg.qr(scaled)[0] ** 2, axis=1)
        freedom = np.maximum(np.bincount(group, 1.0 - leverage), 0.5)
        noise = np.sqrt(np.bincount(group, (y - columns @ found) ** 2) / freedom)
    sd = np.linalg.norm(np.linalg.pinv(scaled), axis=1)
    return found / size, sd / size, float(np.min(freedom))
