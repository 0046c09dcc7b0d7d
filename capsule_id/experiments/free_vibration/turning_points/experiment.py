"""Turning points of a free decay, read one by one: times and positions (``samples = "turning_points"``)."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, axis_label, band
from capsule_id.experiments.clock import clock_parameters, stated_rate, stretch
from capsule_id.experiments.families.friction_model import EQUATION_1, FrictionModel, SurfaceExperiment
from capsule_id.experiments.free_vibration.decay_models import half_cycles
from capsule_id.experiments.free_vibration.declaration import AMPLITUDE, NOISE_SD, TIME_SD
from capsule_id.experiments.free_vibration.decrement import Decrement
from capsule_id.experiments.free_vibration.second_fit.hidden_terms import check_hidden_terms
from capsule_id.experiments.free_vibration.settings import DecayModel, decay_window
from capsule_id.experiments.free_vibration.starts import further_parameters
from capsule_id.experiments.free_vibration.turning_points.checks import check_forces, check_halves, check_steps
from capsule_id.experiments.free_vibration.turning_points.linear import reduced_points
from capsule_id.experiments.free_vibration.turning_points.second_fit import second_fit_table, second_models
from capsule_id.experiments.linear import NUISANCE_WIDTH
from capsule_id.experiments.misfit import Misfit
from capsule_id.parameters import Prior, parameter
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison, Curve, Finding, Points

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
        """See ``capsule_id.experiments.free_vibration.second_fit.hidden_terms.Decay``."""
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
