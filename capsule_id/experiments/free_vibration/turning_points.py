"""Turning points of a free decay, read one by one: times and positions (``samples = "turning_points"``)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats
from scipy.linalg import block_diag

from capsule_id.experiments.base import (
    About,
    Start,
    ValuesBySymbol,
    axis_label,
    band,
    clock_parameters,
    stated_rate,
    stretch,
)
from capsule_id.experiments.context import Fitted
from capsule_id.experiments.free_vibration.declaration import AMPLITUDE, NOISE_SD, TIME_SD
from capsule_id.experiments.free_vibration.hidden_terms import check_hidden_terms, open_forces
from capsule_id.experiments.free_vibration.models import Decrement, half_cycles
from capsule_id.experiments.free_vibration.readings import DAMPING, DecayModel, decay_window
from capsule_id.experiments.free_vibration.second_fit import further_parameters
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel, SurfaceExperiment
from capsule_id.experiments.misfit import NUISANCE_WIDTH, Misfit
from capsule_id.parameters import Parameter, Prior, is_stated, parameter
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison, Curve, Finding, Points, ResultTable

# linear: Least squares of turning points: fits of one table, effects of further forces, and changes between its halves.
#
# measured minus predicted, and its derivatives -> coefficients of a further force, or of both halves (least squares)
#     -> Student's t of that force, or of the differences between the halves


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


# checks: Checks of turning points: step of their digits, further forces, and the parameters of both halves.


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


# second fit: Choice of the forces of turning points where the readings contradict the stated ones.
#
# A force is added where the readings demand it by ``FAIL`` sds and exclude every other one in its place. Amplitudes
# of one side must also exclude that they are counted from another place than the rest position.


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


# experiment: Turning points of a free decay, read one by one: times and positions (``samples = "turning_points"``).


#: Default priors of the noise of positions and times: log-normal, this fraction of the range and of the median step.
NOISE_FRACTION, NOISE_FACTOR = 0.01, 100.0


class TurningPoints(SurfaceExperiment):
    """Positions and times of turning points, both with white noise.

    Turning points of both sides have a free rest position. Those of one side are amplitudes, counted from the rest
    position; one lies a period after the other. A larger step of the times counts as missed turning points. The
    rounding error of the last digit (``steps``: of the positions and the times) is a part of the noise.
    """

    time: np.ndarray
    values: np.ndarray
    index: np.ndarray
    sides: np.ndarray
    width: float
    time_width: float
    reading_sd: float
    time_reading_sd: float
    clock_rate: float | None
    steps: tuple[float, ...] = eqx.field(static=True)
    last: int = eqx.field(static=True)
    both_sides: bool = eqx.field(static=True)
    model: DecayModel = eqx.field(static=True)

    checks = (check_steps, check_forces, check_halves, check_hidden_terms)
    tables = (second_fit_table,)

    def __init__(
        self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1, model: DecayModel | None = None
    ) -> None:
        self.friction, self.model = friction, model or DecayModel.stated(table.settings)
        time, self.values = decay_window(table)
        self.time = time - time[0]
        step = np.diff(self.time)
        turns = np.diff(np.sign(np.diff(self.values))) != 0
        self.both_sides = bool(np.mean(turns) > 0.5)
        index = np.cumsum(np.append(0, np.maximum(1, np.rint(step / np.median(step))))) * (1 if self.both_sides else 2)
        self.index, self.last = index, int(index[-1])
        first = np.sign(self.values[0] - self.values[1]) if self.both_sides else np.sign(self.values[0])
        self.sides = first * np.where(index % 2 == 0, 1.0, -1.0)
        self.width = NUISANCE_WIDTH * float(np.ptp(self.values))
        self.time_width = NUISANCE_WIDTH * float(self.time[-1])
        columns = [table.columns[name] for name in ("x_rel", "time")]
        self.steps = tuple(column.unstated_step for column in columns)
        errors = [
            float(np.hypot(column.reading_sd, step / np.sqrt(12.0)))
            for column, step in zip(columns, self.steps, strict=True)
        ]
        self.reading_sd, self.time_reading_sd = errors
        scales = float(np.ptp(self.values)), float(np.median(step))
        noise = [Prior("lognormal", NOISE_FRACTION * scale, NOISE_FACTOR) for scale in scales]
        self.clock_rate = stated_rate(table)
        self.about = About(table, rig, ())
        rough = self.paper_decrement()
        size = float(np.max(np.abs(rough.peaks)))
        rows = [parameter("k1"), parameter("c")]
        rows += further_parameters(self.model.symbols, rough.k1, rig.mass("m1"), size)
        rows += [
            AMPLITUDE.named(table.label, Prior("lognormal", abs(float(rough.peaks[0])), NUISANCE_WIDTH)),
            NOISE_SD.named(table.label, noise[0]),
            TIME_SD.named(table.label, noise[1]),
            *clock_parameters(table, rig),
        ]
        self.about = About(table, rig, tuple(rows))

    def with_model(self, model: DecayModel) -> "TurningPoints":
        """Return the same turning points with other forces."""
        return TurningPoints(self.table, self.rig, self.friction, model)

    @classmethod
    def second_models(
        cls, records: "Sequence[Any]", readings: Sequence[Finding] = ()
    ) -> tuple[list[Any], list[Finding]]:
        del readings
        return second_models(records)

    def reduced(self, theta: ValuesBySymbol) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See ``capsule_id.experiments.free_vibration.hidden_terms.Decay``."""
        return reduced_points(self, theta)

    @property
    def scatters(self) -> tuple[str, str]:
        return ("noise_sd", "time_sd")

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1",)

    @property
    def observed(self) -> np.ndarray:
        return np.concatenate([self.values, self.time])

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, Misfit]:
        forces = {symbol: theta[symbol] for symbol in ("k1", "c", "m1", *self.model.symbols)}
        path = half_cycles(forces, theta["amplitude"], 0.0, self.last + 1)
        index = xp.asarray(self.index).astype(int)
        one = xp.ones((self.values.shape[0], 1))
        positions = self.values - self.sides * xp.asarray(path.amplitudes)[index]
        times = self.time - xp.asarray(path.times)[index] / stretch(self.clock_rate, theta)
        rest = self.width * one[:, : int(self.both_sides)]
        return (
            Misfit(positions, self.reading_sd**2, 1.0, rest),
            Misfit(times, self.time_reading_sd**2, 1.0, self.time_width * one),
        )

    def paper_decrement(self, smooth: bool = True) -> Decrement:
        """Observed frequency and logarithmic decrement of the turning points; ``smooth`` has no effect."""
        del smooth
        index = self.index
        peaks = self.values - (0.5 * (self.values[-1] + self.values[-2]) if self.both_sides else 0.0)
        used = np.abs(peaks) > 0.05 * np.max(np.abs(peaks))
        Omega_o = float(np.pi / np.polyfit(index, self.time, 1)[0])
        delta = float(-2.0 * np.polyfit(index[used], np.log(np.abs(peaks[used])), 1)[0])
        mass = self.rig.mass("m1")
        k1 = mass * Omega_o**2
        return Decrement(self.time, peaks, Omega_o, delta, k1, delta / np.pi * float(np.sqrt(k1 * mass)))

    def starts(self) -> dict[str, Start]:
        rough = self.paper_decrement()
        size, c = abs(float(rough.peaks[0])), max(rough.c, 1e-4 * rough.k1 / rough.Omega_o)
        forces = {
            "F_dry": Start(0.02 * rough.k1 * size, 0.3),
            "c_q": Start(0.5 * c / (rough.Omega_o * size), 0.3),
            "k_cubic": Start(0.0, 0.01 * rough.k1 / size**2),
        }
        return {
            "k1": Start(rough.k1, 0.01),
            "c": Start(c, 0.2),
            **{symbol: forces[symbol] for symbol in self.model.symbols},
            f"amplitude[{self.label}]": Start(size, 0.02),
            f"noise_sd[{self.label}]": Start(0.3 * NOISE_FRACTION * float(np.ptp(self.values)), 0.3),
            f"time_sd[{self.label}]": Start(0.1 * NOISE_FRACTION * float(np.median(np.diff(self.time))), 0.3),
        }

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        def curve(values: ValuesBySymbol) -> np.ndarray:
            first, _ = self.misfits(values, np)
            rest = self.nuisance_mean(values)[: int(self.both_sides)]
            return self.values - np.asarray(first.raw) + np.asarray(first.design) @ rest

        column = self.table.columns["x_rel"]
        time, unit = self.time + float(decay_window(self.table)[0][0]), column.to_display
        lower, upper = band(np.array([curve(draw) for draw in draws[:50]]) * unit)
        residuals = np.asarray(self.residuals(theta, np))[: len(time)]
        return Comparison(
            self.kind,
            self.label,
            f"{self.label}: turning points of a free decay",
            "time [s]",
            axis_label(column),
            (Points(self.label, time, self.values * unit),),
            (Curve(f"this fit, {self.model.name}", time, curve(theta) * unit, lower, upper),),
            time,
            residuals,
        )
