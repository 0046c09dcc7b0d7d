"""Least squares of turning points: fits of one table, effects of further forces, and changes between its halves.

measured minus predicted, and its derivatives -> coefficients of a further force, or of both halves (least squares)
    -> Student's t of that force, or of the differences between the halves
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.linalg import block_diag

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.free_vibration.settings import DAMPING, DecayModel
from capsule_id.parameters import Parameter, is_stated

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.turning_points.experiment import TurningPoints

#: Joint sds from which halves disagree or a force is present, and from which that fails, as for records.
DISAGREE, FAIL = 3.0, 4.0
#: Fewest turning points that are judged.
FEWEST_TURNS = 8
#: Relative step of difference quotients, and passes that estimate the noise levels.
STEP, PASSES = 1e-5, 4
#: Largest number of Gauss-Newton steps, of their bisections, and change, in sds, below which a fit has converged.
STEPS, BISECTIONS, CONVERGED = 30, 10, 1e-3


@dataclass(frozen=True)
class FurtherForce:
    """Effect of a force that the fitted model lacks.

    Attributes
    ----------
    model : the fitted model with this force
    value : estimate of the parameter ``symbol``, SI
    z : that over its sd, as of a normal variable; 0 for friction that pushes
    moved : whether another parameter changes by more than the sd that the fitted model gives it, that of the mass included
    """

    model: DecayModel
    symbol: str
    value: float
    z: float
    moved: bool

    @property
    def line(self) -> str:
        """Line of ``rig.toml`` that adds the force."""
        return self.model.stiffness_line if self.symbol == "k_cubic" else self.model.damping_line


def wider_models(model: DecayModel) -> dict[str, DecayModel]:
    """``model`` with one further force, by the symbol of its parameter."""
    found = {
        symbol: replace(model, damping=tuple(one for one in DAMPING if one in (*model.damping, word)))
        for word, symbol in DAMPING.items()
        if word not in model.damping
    }
    return found if model.cubic else {**found, "k_cubic": replace(model, cubic=True)}


def further_force(e: "TurningPoints", theta: ValuesBySymbol, symbol: str, offset: bool = False) -> FurtherForce | None:
    """Estimate the force with this parameter beside those of the fit ``theta``, about which the model is linearised.

    None for a table that is too short.

    Parameters
    ----------
    offset : whether amplitudes of one side may be counted from another place than the rest position
    """
    columns, rows = derivatives(e, theta)
    if offset and not e.both_sides:
        columns = np.column_stack([columns, np.repeat([1.0, 0.0], len(e.values))])
    if len(e.values) < FEWEST_TURNS or len(e.values) <= columns.shape[1] + 1:
        return None
    raw, model = misfit(e, theta), wider_models(e.model)[symbol]
    _, own, _ = least_squares(columns, -raw, len(e.values))
    both = np.column_stack([columns, derivative_of_force(e, theta, symbol)])
    found, sd, freedom = least_squares(both, -raw, len(e.values))
    if found[-1] <= 0.0 and symbol != "k_cubic":
        return FurtherForce(model, symbol, 0.0, 0.0, False)
    mass = relative_sd_of_mass(e)
    moved = any(
        row.physical and abs(found[k]) > np.hypot(own[k], mass * theta[row.symbol]) for k, row in enumerate(rows)
    )
    return FurtherForce(model, symbol, float(found[-1]), as_normal(found[-1] / sd[-1], freedom), moved)


def derivative_of_force(e: "TurningPoints", theta: ValuesBySymbol, symbol: str) -> Float[np.ndarray, " m"]:
    """Derivative of measured minus predicted with respect to a force that the model lacks, at zero force."""
    step = STEP * natural_units(e, theta)[symbol]
    wider = e.with_model(wider_models(e.model)[symbol])
    return (misfit(wider, {**theta, symbol: step}) - misfit(e, theta)) / step


def natural_units(e: "TurningPoints", theta: ValuesBySymbol) -> dict[str, float]:
    """Natural units of the parameters of the forces, SI: those that change the motion by as much as itself."""
    size, k1, m1 = float(np.max(np.abs(e.values))), theta["k1"], theta["m1"]
    units = {"F_dry": k1 * size, "c_q": m1 / size, "k_cubic": k1 / size**2}
    return units | {"k1": k1, "c": float(np.sqrt(k1 * m1)), "amplitude": size}


def reduced_points(
    e: "TurningPoints", theta: ValuesBySymbol
) -> tuple[Float[np.ndarray, "m p"], Float[np.ndarray, "m q"], Float[np.ndarray, " m"]]:
    """``Decay.reduced`` of turning points."""
    columns, rows = derivatives(e, theta)
    further = np.column_stack([derivative_of_force(e, theta, symbol) for symbol in e.model.absent])
    left, n = misfit(e, theta), len(e.values)
    noise = np.repeat(noise_levels(columns, -left, n), [n, len(left) - n])
    shared = [k for k, row in enumerate(rows) if row.physical]
    own = np.linalg.qr(np.delete(columns, shared, axis=1) / noise[:, None])[0]
    parts = (part / noise[:, None] for part in (columns[:, shared], further, left[:, None]))
    known, others, residuals = (part - own @ (own.T @ part) for part in parts)
    return known, others, residuals[:, 0]


def fitted(e: "TurningPoints") -> dict[str, float]:
    """Parameters of ``e`` by symbol, SI, from its readings alone: Gauss-Newton steps from its starting point."""
    starts = e.starts()
    theta = {row.symbol: float(starts[row.name].centre) for row in e.parameters if row.name in starts}
    theta["m1"] = e.rig.mass("m1")
    cost = _cost(e, theta)
    for _ in range(STEPS):
        columns, rows = derivatives(e, theta)
        change, sd, _ = least_squares(columns, -misfit(e, theta), len(e.values))
        for bisection in range(BISECTIONS):
            moved = {row.symbol: theta[row.symbol] + 0.5**bisection * change[k] for k, row in enumerate(rows)}
            trial = {**theta, **moved}
            possible = all(moved[row.symbol] > 0.0 for row in rows if row.positive)
            if possible and (lower := _cost(e, trial)) <= cost:
                theta, cost = trial, lower
                break
        else:
            return theta
        if np.all(np.abs(change[: len(rows)]) < CONVERGED * sd[: len(rows)]):
            return theta
    return theta


def standard_errors(e: "TurningPoints", theta: ValuesBySymbol) -> dict[str, float]:
    """Standard errors of the physical parameters at the fit ``theta``, by symbol, SI."""
    columns, rows = derivatives(e, theta)
    _, sd, _ = least_squares(columns, -misfit(e, theta), len(e.values))
    return {row.symbol: float(sd[k]) for k, row in enumerate(rows) if row.physical}


def bic(e: "TurningPoints", theta: ValuesBySymbol) -> float:
    """Bayesian information criterion of the fit ``theta``, up to a constant of the readings."""
    columns, _ = derivatives(e, theta)
    return 2.0 * _cost(e, theta) + (columns.shape[1] + 2) * float(np.log(2 * len(e.values)))


def changes_of_second_half(
    e: "TurningPoints", theta: ValuesBySymbol
) -> tuple[float, dict[str, tuple[float, float, float]]]:
    """Degrees of freedom, 0 for a short table; both halves' value of each physical parameter and the sd of their difference.

    The model is linearised at ``theta``. Positions and times each have one noise level, that of the residuals left.
    """
    n = len(e.values)
    one, rows = derivatives(e, theta)
    if n < FEWEST_TURNS or n <= one.shape[1]:
        return 0.0, {}
    # The second half has an amplitude, a rest position and a beginning of its own too.
    second = np.tile(np.arange(n) >= n // 2, 2)[:, None]
    found, sd, freedom = least_squares(np.concatenate([one, one * second], axis=1), -misfit(e, theta), n)
    changes = {}
    for k, row in enumerate(rows):
        if row.physical:
            first, further = theta[row.symbol] + found[k], one.shape[1] + k
            changes[row.symbol] = (float(first), float(first + found[further]), float(sd[further]))
    return freedom, changes


def derivatives(e: "TurningPoints", theta: ValuesBySymbol) -> tuple[Float[np.ndarray, "m p"], list[Parameter]]:
    """Derivatives of measured minus predicted, those of the parameters first; the parameters."""
    rows = [row for row in e.parameters if not row.scatter and not is_stated(row.name)]
    slopes, units = [], natural_units(e, theta)
    for row in rows:
        step = STEP * max(abs(theta[row.symbol]), 0.01 * units[row.symbol])
        sides = [misfit(e, {**theta, row.symbol: theta[row.symbol] + sign * step}) for sign in (1.0, -1.0)]
        slopes.append((sides[0] - sides[1]) / (2.0 * step))
    nuisances = np.asarray(block_diag(*(np.asarray(one.design) for one in e.misfits(theta, np))))
    return np.column_stack([*slopes, -nuisances]), rows


def misfit(e: "TurningPoints", theta: ValuesBySymbol) -> Float[np.ndarray, " m"]:
    """Measured minus predicted, positions and then times, SI."""
    return np.concatenate([np.asarray(one.raw) for one in e.misfits(theta, np)])


def relative_sd_of_mass(e: "TurningPoints") -> float:
    """Relative sd of the mass, to which all parameters are in proportion."""
    assert e.rig.m1 is not None, "the kind needs m1"
    return e.rig.m1.sd / e.rig.m1.value


def as_normal(t: float, freedom: float) -> float:
    """As many sds of a normal variable as the t statistic is worth."""
    return float(stats.norm.isf(stats.t.sf(abs(t), freedom)))


def least_squares(
    columns: Float[np.ndarray, "m p"], y: Float[np.ndarray, " m"], n: int
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"], float]:
    """Coefficients, their sds, and degrees of freedom; the first n rows and the others each have one noise level."""
    size = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    found, scaled, freedom, _ = _weighted(columns / size, y, n)
    return found / size, np.linalg.norm(np.linalg.pinv(scaled), axis=1) / size, float(np.min(freedom))


def noise_levels(columns: Float[np.ndarray, "m p"], y: Float[np.ndarray, " m"], n: int) -> Float[np.ndarray, "2"]:
    """Noise levels of the first n rows and of the others beside a least-squares fit."""
    return _weighted(columns / np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny), y, n)[3]


def _weighted(
    columns: Float[np.ndarray, "m p"], y: Float[np.ndarray, " m"], n: int
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "m p"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Coefficients, weighted columns, and degrees of freedom and noise levels of the first n rows and of the others."""
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
    return found, scaled, freedom, noise


def _cost(e: "TurningPoints", theta: ValuesBySymbol) -> float:
    """Negative log-likelihood up to a constant, at the best noise levels and nuisances; inf where the model has no motion."""
    cost = 0.0
    for one in e.misfits(theta, np):
        raw, design = np.asarray(one.raw), np.asarray(one.design)
        if not np.isfinite(raw).all():
            return np.inf
        rest = raw - design @ np.linalg.lstsq(design, raw, rcond=None)[0] if design.shape[1] else raw
        cost += len(raw) * float(np.log(np.sqrt(np.mean(rest**2)) + np.finfo(float).tiny))
    return cost
