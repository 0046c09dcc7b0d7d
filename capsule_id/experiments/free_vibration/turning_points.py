"""Turning points of a free decay, read one by one: times and positions (``samples = "turning_points"``)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from capsule_id.experiments.base import (
    Fitted,
    Start,
    ValuesBySymbol,
    clock_parameters,
    scatter_prior,
    stated_rate,
    stretch,
)
from capsule_id.experiments.free_vibration.declaration import AMPLITUDE, NOISE_SD, TIME_SD
from capsule_id.experiments.free_vibration.decrement import Decrement
from capsule_id.experiments.free_vibration.experiment import Graded, check_free_decay, each, graded, halves
from capsule_id.experiments.free_vibration.hidden_terms import (
    FEWEST_HALF_SWINGS,
    check_hidden_terms,
    further_sensitivities,
    open_forces,
    sensitivities,
)
from capsule_id.experiments.free_vibration.models import half_cycles
from capsule_id.experiments.free_vibration.readings import (
    DecayModel,
    decay_window,
    further_parameters,
    on_both_sides,
)
from capsule_id.experiments.free_vibration.record import Decay, DecayAbout, Screened, force_starts
from capsule_id.experiments.free_vibration.second_fit import Demanded, replaced
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.misfit import NUISANCE_WIDTH, Misfit
from capsule_id.parameters import STEP_SD, Prior, parameter
from capsule_id.records.tones import SIGNIFICANT, VISIBLE
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Facts, Finding

# linear: Least squares of turning points: fits of one table, effects of further forces, and changes between its halves.
#
# measured minus predicted, and its derivatives -> coefficients of a further force, or of both halves (least squares)
#     -> Student's t of that force, or of the differences between the halves


#: The rest position of amplitudes of one side, in the place of a force.
ZERO = "rest position"
#: Passes that estimate the noise levels.
PASSES = 4
#: Largest number of Gauss-Newton steps, of their bisections, and change, in sds, below which a fit has converged.
STEPS, BISECTIONS, CONVERGED = 30, 10, 1e-3


def further_force(e: "TurningPoints", theta: ValuesBySymbol, symbol: str, offset: bool = False) -> Facts | None:
    """Estimate the force with this parameter, or ``ZERO``, beside those of the fit, about which the model is linearised.

    Parameters
    ----------
    offset : whether amplitudes of one side may be counted from another place than the rest position

    Returns
    -------
    ``name`` of its parameter, its estimate ``value``, SI, and its ``unit``. ``z``: the estimate over its sd, as of a normal
    variable; 0 for friction that pushes. ``moved``: whether another parameter changes by more than the sd that the fitted
    model gives it, that of the mass included. None for a table that is too short.
    """
    columns, left, symbols = linear(e, theta)
    zero = np.repeat([-1.0, 0.0], len(e.values))
    if offset and not e.both_sides:
        columns = np.column_stack([columns, zero])
    if len(e.values) < FEWEST_HALF_SWINGS or len(e.values) <= columns.shape[1] + 1:
        return None
    _, own, _ = least_squares(columns, -left, len(e.values))
    both = np.column_stack([columns, zero if symbol == ZERO else further_sensitivities(e, theta)[symbol]])
    found, sd, freedom = least_squares(both, -left, len(e.values))
    pushes, mass = found[-1] <= 0.0 and symbol not in ("k_cubic", ZERO), relative_sd_of_mass(e)
    moved = any(abs(found[k]) > np.hypot(own[k], mass * theta[name]) for k, name in enumerate(symbols))
    value, z = (0.0, 0.0) if pushes else (float(found[-1]), as_normal(found[-1] / sd[-1], freedom))
    x_rel = e.table.columns["x_rel"]
    value, unit = (value * x_rel.to_display, x_rel.unit) if symbol == ZERO else (value, parameter(symbol).unit)
    return {"name": symbol, "value": value, "unit": unit, "z": z, "moved": moved and not pushes}


def linear(e: "TurningPoints", theta: ValuesBySymbol) -> tuple[Float[np.ndarray, "m p"], np.ndarray, tuple[str, ...]]:
    """Derivatives of the residuals (m,), those with respect to the parameters of the forces first; residuals; these symbols."""
    left, design, moved = sensitivities(e, theta)
    return np.column_stack([*moved.values(), -design]), left, ("k1", "c", *e.model.symbols)


def fitted(e: "TurningPoints") -> dict[str, float]:
    """Parameters of ``e`` by symbol, SI, from its readings alone: Gauss-Newton steps from its starting point."""
    starts = e.starts()
    theta = {row.symbol: float(starts[row.name].centre) for row in e.parameters if row.name in starts}
    theta["m1"] = e.mass
    names, cost = ("k1", "c", *e.model.symbols, *e.own_symbols), _cost(e, theta)
    for _ in range(STEPS):
        columns, left, _ = linear(e, theta)
        change, sd, _ = least_squares(columns, -left, len(e.values))
        steps = [dict(zip(names, 0.5**k * change[: len(names)], strict=True)) for k in range(BISECTIONS)]
        trials = ({**theta, **{name: theta[name] + step[name] for name in names}} for step in steps)
        trial = next((one for one in trials if _cost(e, one) <= cost), None)
        if trial is None:
            break
        theta, cost = trial, _cost(e, trial)
        if np.all(np.abs(change[: len(names)]) < CONVERGED * sd[: len(names)]):
            break
    return {**theta, **dict(zip(e.scatters, noise_levels(e, theta), strict=True))}


def noise_levels(e: "TurningPoints", theta: ValuesBySymbol) -> list[float]:
    """Rms residuals of the positions, m, and of the times, s, beside the nuisances; NaN where the model has no motion."""
    levels = []
    for one in e.misfits(theta, np):
        raw, design = np.asarray(one.raw), np.asarray(one.design)
        finite = np.isfinite(raw).all()
        rest = raw - design @ np.linalg.lstsq(design, raw, rcond=None)[0] if finite and design.shape[1] else raw
        levels.append(float(np.sqrt(np.mean(rest**2))) if finite else np.nan)
    return levels


def screened(e: "TurningPoints", model: DecayModel) -> Screened:
    """Fit the turning points alone under a model; the BIC is that up to a constant of the readings."""
    e = e.with_model(model)
    theta = fitted(e)
    columns, left, symbols = linear(e, theta)
    _, sd, _ = least_squares(columns, -left, len(e.values))
    bic = 2.0 * _cost(e, theta) + (columns.shape[1] + 2) * float(np.log(2 * len(e.values)))
    return Screened(bic, theta, dict(zip(symbols, sd, strict=False)), theta["noise_sd"], left)


def changes_of_second_half(e: "TurningPoints", theta: ValuesBySymbol) -> dict[str, tuple[float, float, float, bool]]:
    """See ``checks.Changes``: the second half has an amplitude, a rest position and a beginning of its own too.

    The model is linearised at ``theta``. Positions and times each have one noise level, that of the residuals left.
    """
    n = len(e.values)
    one, left, symbols = linear(e, theta)
    if n < FEWEST_HALF_SWINGS or n <= one.shape[1]:
        return {}
    second = np.tile(np.arange(n) >= n // 2, 2)[:, None]
    found, sd, freedom = least_squares(np.concatenate([one, one * second], axis=1), -left, n)
    changes = {}
    for k, name in enumerate(symbols):
        change = found[one.shape[1] + k]
        z = as_normal(float(change / sd[one.shape[1] + k]), freedom)
        matters = 0.5 * abs(change) > relative_sd_of_mass(e) * abs(theta[name])
        changes[name] = (float(theta[name] + found[k]), float(theta[name] + found[k] + change), z, bool(matters))
    return changes


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
    size, group = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny), np.repeat([0, 1], [n, len(y) - n])
    noise = np.array([np.std(y[group == one]) for one in (0, 1)])
    for _ in range(PASSES):
        weight = 1.0 / np.maximum(noise, 1e-12 * np.max(np.abs(y)))[group]
        scaled = columns / size * weight[:, None]
        found = np.linalg.lstsq(scaled, weight * y, rcond=None)[0]
        # Leverages share the degrees of freedom out between positions and times.
        leverage = np.sum(np.linalg.qr(scaled)[0] ** 2, axis=1)
        freedom = np.maximum(np.bincount(group, 1.0 - leverage), 0.5)
        noise = np.sqrt(np.bincount(group, (y - columns / size @ found) ** 2) / freedom)
    return found / size, np.linalg.norm(np.linalg.pinv(scaled), axis=1) / size, float(np.min(freedom))


def _cost(e: "TurningPoints", theta: ValuesBySymbol) -> float:
    """Negative log-likelihood up to a constant, at the best noise levels and nuisances; inf where the model has no motion."""
    if min(theta[name] for name in ("k1", "c", *e.model.symbols, *e.own_symbols) if name != "k_cubic") <= 0.0:
        return np.inf
    cost = len(e.values) * float(np.sum(np.log(np.array(noise_levels(e, theta)) + np.finfo(float).tiny)))
    return cost if np.isfinite(cost) else np.inf


# checks: Checks of turning points: step of their digits, further forces, and the parameters of both halves.


def check_steps(tables: "Sequence[TurningPoints]", fit: Fitted) -> list[Finding]:
    """Warn where the readings are more regular than their digits show, so that the rounding error is all that is known."""
    # The positions tell the damping, the times the stiffness.
    return [
        Finding(
            "decays.step",
            "warn",
            {
                "label": e.label,
                "column": name,
                "unit": e.table.columns[name].unit,
                "step": step * e.table.columns[name].to_display,
                "name": told,
            },
            e.label,
            (told,),
        )
        for e in tables
        for name, symbol, told, step in zip(("x_rel", "time"), e.scatters, ("c", "k1"), e.steps, strict=True)
        if e.local(fit.values)[symbol] < step * STEP_SD
    ]


def forces(e: "TurningPoints", theta: ValuesBySymbol) -> tuple[Facts, Graded] | None:
    """Judge whether a further force, or another zero of one side, explains the turning points better than the fitted model."""
    names = (*e.model.absent, *([] if e.both_sides else [ZERO]))
    found = [one for symbol in names if (one := further_force(e, theta, symbol))]
    if not found:
        return None
    best = max(found, key=lambda one: one["z"])
    key = "stiffness" if best["name"] == "k_cubic" else "damping"
    line = "" if best["name"] == ZERO else e.model.with_force(best["name"]).lines(key)
    facts = {**best, "line": line, "model": e.model.name, "one_side": not e.both_sides}
    return facts, graded(best["z"], best["moved"])


# second fit: Choice of the forces of turning points where the readings contradict the stated ones.
#
# A force is added where the readings demand it by ``SIGNIFICANT`` sds and exclude every other one in its place. Amplitudes
# of one side must also exclude that they are counted from another place than the rest position.


#: Sds from zero of a force that another one must exclude.
RIVAL = 2.0


def demanded(tables: "Sequence[TurningPoints]") -> Demanded:
    """Return ``tables`` with the forces that they demand, one after the other."""
    labels, own = list[str](), list(tables)
    while found := _demanded_force(own):
        label, symbol, _ = found
        labels.append(label)
        own = [e.with_model(e.model.with_force(symbol)) for e in own]
    chosen = [e.with_model(e.model, screened(e, e.model)) for e in own] if labels else own
    return labels, chosen, {"labels": [e.label for e in own]}


def _demanded_force(tables: "Sequence[TurningPoints]") -> tuple[str, str, float] | None:
    """The label of a table that demands a force, and its parameter and its z: the most significant one."""
    found = []
    for e in tables:
        symbols, cubic = open_forces(e), e.table.settings.offers_cubic
        theta = fitted(e) if symbols else {}
        z = {symbol: one["z"] for symbol in symbols if (one := further_force(e, theta, symbol))}
        offered = [symbol for symbol in z if z[symbol] > SIGNIFICANT and (cubic or symbol != "k_cubic")]
        best = max(offered, key=lambda symbol: z[symbol], default="")
        rivals = (symbol for symbol in z if symbol != best and z[symbol] > RIVAL)
        others = (e.with_model(e.model.with_force(symbol)) for symbol in rivals)
        # It is demanded beside an offset, and beside every other force.
        if best and _demands(e, theta, best, offset=True) and all(_demands(one, fitted(one), best) for one in others):
            found.append((e.label, best, z[best]))
    return max(found, key=lambda one: one[2], default=None)


def _demands(e: "TurningPoints", theta: ValuesBySymbol, symbol: str, offset: bool = False) -> bool:
    """Whether the readings demand the force with the parameter ``symbol`` at the fit ``theta``."""
    force = further_force(e, theta, symbol, offset)
    return force is not None and force["z"] > VISIBLE


# experiment: Turning points of a free decay, read one by one: times and positions (``samples = "turning_points"``).


class TurningPoints(Decay):
    """Positions and times of turning points, both with white noise.

    Turning points of both sides have a free rest position. Those of one side are amplitudes, counted from the rest
    position; one lies a period after the other. A larger step of the times counts as missed turning points. The
    rounding error of the last digit (``steps``: of the positions and the times) is a part of the noise.
    """

    index: np.ndarray
    sides: np.ndarray
    width: float
    time_reading_sd: float
    steps: tuple[float, ...] = eqx.field(static=True)
    last: int = eqx.field(static=True)
    both_sides: bool = eqx.field(static=True)

    title = "turning points of a free decay"
    scatters: ClassVar[tuple[str, str]] = ("noise_sd", "time_sd")
    checks = (
        check_steps,
        each("decays.forces", forces),
        halves(changes_of_second_half),
        check_free_decay,
        check_hidden_terms,
    )

    def __init__(
        self,
        table: Table,
        rig: Rig,
        friction: FrictionModel = EQUATION_1,
        model: DecayModel | None = None,
        screened: Screened | None = None,
    ) -> None:
        self.friction, self.model = friction, model or DecayModel.stated(table.settings)
        time, self.values = decay_window(table)
        self.time = time - time[0]
        step = np.diff(self.time)
        self.both_sides = on_both_sides(self.values)
        index = np.cumsum(np.append(0, np.maximum(1, np.rint(step / np.median(step))))) * (1 if self.both_sides else 2)
        self.index, self.last = index, int(index[-1])
        first = np.sign(self.values[0] - self.values[1]) if self.both_sides else np.sign(self.values[0])
        self.sides = first * np.where(index % 2 == 0, 1.0, -1.0)
        self.width = NUISANCE_WIDTH * float(np.ptp(self.values))
        columns = [table.columns[name] for name in ("x_rel", "time")]
        self.steps = tuple(column.unstated_step for column in columns)
        errors = [
            float(np.hypot(column.reading_sd, step * STEP_SD)) for column, step in zip(columns, self.steps, strict=True)
        ]
        self.reading_sd, self.time_reading_sd = errors
        self.clock_rate = stated_rate(table)
        self.about = DecayAbout(table, rig, ())
        rough = self.paper_decrement()
        rows = (
            parameter("k1"),
            parameter("c"),
            *further_parameters(self.model.symbols, rough.k1, self.mass, float(np.max(np.abs(rough.peaks)))),
            AMPLITUDE.named(table.label, Prior("lognormal", abs(float(rough.peaks[0])), NUISANCE_WIDTH)),
            NOISE_SD.named(table.label, scatter_prior(float(np.ptp(self.values)))),
            TIME_SD.named(table.label, scatter_prior(float(np.median(step)))),
            *clock_parameters(table, rig),
        )
        self.about = DecayAbout(table, rig, rows, screened, rough)

    def unstated_errors(self, symbol: str) -> set[str]:
        """Those of one side are amplitudes, counted from a zero that the readings do not show."""
        return super().unstated_errors(symbol) | (set() if self.both_sides else {"zero"})

    def with_readings(self, changed: Mapping[str, np.ndarray]) -> Self:
        """The turning points with other values of some columns."""
        columns = {name: replace(c, values=changed.get(name, c.values)) for name, c in self.table.columns.items()}
        return self.with_model(self.model, table=replace(self.table, columns=columns))

    @property
    def lines(self) -> str:
        return self.model.lines("damping", "stiffness")

    @classmethod
    def second_models(
        cls, records: "Sequence[Any]", readings: Sequence[Finding] = ()
    ) -> tuple[list[Any], list[Finding]]:
        return replaced(records, range(len(records)), demanded, screened)

    def unwhitened(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Any, Any]:
        misfit = self.misfit(theta)
        return misfit.raw, misfit.design

    def whitened(self, theta: Mapping[str, float], columns: np.ndarray) -> np.ndarray:
        return (columns.T / self.misfit(theta).sd).T

    @property
    def moved(self) -> np.ndarray:
        peaks = self.rough.peaks
        # Between two turning points of one side lies one of the other side.
        return (
            peaks if self.both_sides else np.append(peaks, -np.sign(peaks[0]) * np.sqrt(np.abs(peaks[1:] * peaks[:-1])))
        )

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
            Misfit(times, self.time_reading_sd**2, 1.0, NUISANCE_WIDTH * self.time[-1] * one),
        )

    def paper_decrement(self) -> Decrement:
        """Observed frequency and logarithmic decrement of the turning points."""
        peaks = self.values - (0.5 * (self.values[-1] + self.values[-2]) if self.both_sides else 0.0)
        return Decrement.of(self.index, self.time, peaks, self.mass, smallest=0.05)

    def starts(self) -> dict[str, Start]:
        size, c = abs(float(self.rough.peaks[0])), max(self.rough.c, 1e-4 * self.rough.k1 / self.rough.Omega_o)
        forces = force_starts(self.rough, c, size)
        return {
            "k1": Start(self.rough.k1, 0.01),
            "c": Start(c, 0.2),
            **{symbol: forces[symbol] for symbol in self.model.symbols},
            f"amplitude[{self.label}]": Start(size, 0.02),
            f"noise_sd[{self.label}]": Start(0.003 * float(np.ptp(self.values)), 0.3),
            f"time_sd[{self.label}]": Start(0.001 * float(np.median(np.diff(self.time))), 0.3),
        }
