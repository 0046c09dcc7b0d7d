"""Free vibration of the rod, motor switched on, capsule at rest (paper, section 2.2): k1 and c."""

from dataclasses import replace
from functools import cached_property
from types import ModuleType

import jax.numpy as jnp
import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment, Start, Theta, axis_label, band
from capsule_id.experiments.free_vibration.decay_models import (
    STEP_PHASE,
    dry_decay,
    quadratic_decay,
    rates,
    viscous_basis,
)
from capsule_id.experiments.free_vibration.decay_moments import decay_moments, fold, uniform_step
from capsule_id.experiments.free_vibration.decay_trend import describe_trend
from capsule_id.experiments.free_vibration.decrement import Decrement, equilibrium, logarithmic_decrement
from capsule_id.experiments.linear import NUISANCE_WIDTH
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.records.noise import noise_level
from capsule_id.rig.filters import choose_window, sampling_step, savitzky_golay
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.rig.windows import decay_window
from capsule_id.views import Comparison, Curve, Finding, Points

#: Default prior of a record's noise: log-normal, median 1 % of its range, factor 100, beside the reading error.
NOISE_MEDIAN, NOISE_FACTOR = 0.01, 100.0
#: Polynomial order of the Savitzky–Golay filter that serves the paper's estimator.
SMOOTHING_ORDER = 3


class FreeVibration(Experiment):
    """x_rel(t) of one record: the whole record, raw, white noise; k1 and c are shared by all records.

    Viscous damping: the two solutions and the offset enter linearly and are integrated out. Dry or quadratic damping
    (``damping`` in rig.toml) act beside the viscous one; then the start of the motion is sampled with the rest.
    """

    time_series = True
    masses = ("m1",)
    scatters = ("noise_sd",)
    ARRAYS = ("time", "values", "width", "reading_sd", "side", "folded", "step")
    STATIC = ("damping", "half_cycles", "substeps", "uniform")

    def __init__(self, table: Table, rig: Rig) -> None:
        super().__init__(table, rig)
        self.column = table.columns["x_rel"]
        time, self.values = decay_window(table)
        self.time0 = float(time[0])
        self.time = time - self.time0
        self.damping = str(table.settings.get("damping", "viscous"))
        self.width = NUISANCE_WIDTH * float(np.ptp(self.values))
        self.reading_sd = self.column.reading_sd
        step = uniform_step(self.time)
        self.uniform = step is not None and self.damping == "viscous"
        self.step = step or 0.0
        self.folded = fold(self.values) if self.uniform else np.zeros((0, 0))

    def with_damping(self, damping: str) -> "FreeVibration":
        """The same record under another damping model."""
        table = replace(self.table, settings={**self.table.settings, "damping": damping})
        return FreeVibration(table, self.rig)

    @property
    def observed(self) -> np.ndarray:
        return self.values

    @property
    def model_name(self) -> str:
        """For the legend."""
        return f"{self.damping} damping"

    @property
    def noise_name(self) -> str:
        return f"noise_sd[{self.label}]"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        scale = float(np.ptp(self.values))
        noise = parameter("noise_sd", self.label, self.noise_prior(scale))
        shared = (parameter("k1"), parameter("c"))
        if self.damping == "dry":
            amplitude = parameter("amplitude", self.label, Prior("lognormal", scale, NUISANCE_WIDTH))
            turning = parameter("turning_time", self.label, Prior("normal", 0.0, float(self.time[-1])))
            return *shared, parameter("F_dry"), noise, amplitude, turning
        if self.damping == "quadratic":
            x_start = parameter("x_start", self.label, Prior("normal", 0.0, self.width))
            y_start = parameter("y_start", self.label, Prior("normal", 0.0, self.width * self._rough.Omega_o))
            return *shared, parameter("c_q"), noise, x_start, y_start
        return *shared, noise

    @staticmethod
    def noise_prior(scale: float) -> Prior:
        """Of a record whose range is ``scale``, m."""
        return Prior("lognormal", NOISE_MEDIAN * scale, NOISE_FACTOR)

    def misfits(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit]:
        k1, c, m1 = theta["k1"], theta["c"], theta["m1"]
        one = xp.ones((len(self.time), 1))
        raw, design = self.values, one
        if self.damping == "dry":
            raw = raw - self.side * dry_decay(
                self.time,
                k1,
                c,
                m1,
                theta["F_dry"],
                theta["amplitude"],
                theta["turning_time"],
                half_cycles=self.half_cycles,
            )
        elif self.damping == "quadratic":
            start = theta["x_start"], theta["y_start"]
            raw = raw - quadratic_decay(self.time, k1, c, m1, theta["c_q"], *start, substeps=self.substeps)
        else:
            design = xp.concatenate([viscous_basis(self.time, k1, c, m1, xp), one], axis=1)
        return (Misfit(raw, self.reading_sd**2, 1.0, self.width * design),)

    def summaries(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        if not self.uniform or xp is np:
            return super().summaries(theta, xp)
        gamma, omega = rates(theta["k1"], theta["c"], theta["m1"])
        yy, ay, aa = decay_moments(self.folded, self.n, self.step, gamma, omega)
        return (Moments(yy, self.width * ay, self.width**2 * aa, self.n, self.reading_sd**2),)

    # -- the paper's estimator and starts ---------------------------------------------------------------------------

    def smoothed(self) -> np.ndarray:
        """(n,) the record after Savitzky–Golay; a record sampled unevenly, which that filter refuses, stays raw."""
        try:
            sampling_step(self.time)
        except InputError:
            return self.values
        window = self.table.settings.get("smoothing_window")
        if window is None:
            window = choose_window(self.time, self.values, SMOOTHING_ORDER)
        return savitzky_golay(self.time, self.values, float(window), SMOOTHING_ORDER)  # type: ignore[arg-type]

    def paper_decrement(self, smooth: bool = True) -> Decrement | None:
        """The paper's k1 and c of this record, from the smoothed or the raw peaks."""
        smoothed = self.smoothed()
        return logarithmic_decrement(self.time, smoothed if smooth else self.values, self.mass, smoothed)

    @property
    def mass(self) -> float:
        """Weighed mass of the rod, kg (the schema asks for it beside a free vibration)."""
        assert self.rig.m1 is not None
        return self.rig.m1.value

    @cached_property
    def _rough(self) -> Decrement:
        """The paper's estimate, or, where too few peaks stand out, one from the first zero crossings."""
        decrement = self.paper_decrement()
        if decrement is not None and decrement.delta > 0.0:
            return decrement
        x = self.values - equilibrium(self.values)
        crossings = np.flatnonzero(np.diff(np.signbit(x)))
        spacing = np.median(np.diff(self.time[crossings])) if len(crossings) > 2 else 0.5 * self.time[-1]
        omega = float(np.pi / spacing)
        k1 = self.mass * omega**2
        return Decrement(np.array([0.0]), x[:1], omega, 0.6, k1, 0.2 * float(np.sqrt(k1 * self.mass)))

    @cached_property
    def side(self) -> float:
        """Sign of the first turning point; 1 where not needed."""
        if self.damping != "dry":
            return 1.0
        return float(np.sign(self._rough.peaks[0]))

    @cached_property
    def half_cycles(self) -> int:
        """Bound on the half cycles of the record, with room for a frequency half as high again; 0 where not needed."""
        if self.damping != "dry":
            return 0
        return int(1.5 * self._rough.Omega_o * self.time[-1] / np.pi) + 4

    @cached_property
    def substeps(self) -> int:
        """Runge–Kutta steps between two samples; 0 where not needed."""
        if self.damping != "quadratic":
            return 0
        return max(1, int(np.ceil(self._rough.Omega_o * np.max(np.diff(self.time)) / STEP_PHASE)))

    def starts(self) -> dict[str, Start]:
        rough = self._rough
        # A start must keep in step with the record for as long as it rings, or it falls into a side lobe.
        ringing = min(self.time[-1], 4.0 * self.mass / rough.c)
        spread = min(0.3, 1.0 / (rough.Omega_o * ringing))
        noise = max(noise_level(self.values), 1e-4 * float(np.ptp(self.values)))
        starts = {
            "k1": Start(rough.k1, spread),
            "c": Start(rough.c, 0.3),
            self.noise_name: Start(noise, 0.2),
        }
        if self.damping == "dry":
            starts["F_dry"] = Start(0.02 * rough.k1 * abs(float(rough.peaks[0])), 0.3)
            starts[f"amplitude[{self.label}]"] = Start(abs(float(rough.peaks[0])), 0.05)
            starts[f"turning_time[{self.label}]"] = Start(float(rough.times[0]), 0.05 / rough.Omega_o)
        elif self.damping == "quadratic":
            speed = rough.Omega_o * abs(float(rough.peaks[0]))
            starts["c_q"] = Start(0.5 * rough.c / speed, 0.3)
            starts |= self.starts_of_motion()
        return starts

    def starts_of_motion(self) -> dict[str, Start]:
        """Of x_rel and its rate at the first sample."""
        size = abs(float(self._rough.peaks[0]))
        rate = np.polyfit(self.time[:5], self.values[:5], 1)[0]
        return {
            f"x_start[{self.label}]": Start(float(self.values[0] - equilibrium(self.values)), 0.02 * size),
            f"y_start[{self.label}]": Start(float(rate), 0.05 * self._rough.Omega_o * size),
        }

    # -- what the report and the checks see -------------------------------------------------------------------------

    @property
    def largest_deflection(self) -> float:
        """Largest distance of a sample from the rest position, m."""
        return float(np.max(np.abs(self.values - equilibrium(self.values))))

    def damping_trend(self) -> str:
        """What the peaks say of damping and frequency against amplitude; "" where nothing drifts."""
        decrement = self.paper_decrement()
        return "" if decrement is None else describe_trend(decrement, noise_level(self.values))

    def largest_force(self, theta: Theta) -> float:
        """max |f|, f = k1 x_rel + c d(x_rel)/dt, over the record, N."""
        x = self.smoothed() - equilibrium(self.values)
        return float(np.max(np.abs(theta["k1"] * x + theta["c"] * np.gradient(x, self.time))))

    def lint(self, theta: Theta) -> list[Finding]:
        findings = []
        if self.table.settings.get("capsule", "held") == "free" and "mu" in theta and "m2" in theta:
            force = self.largest_force(theta)
            threshold = float(theta["mu"] * (theta["m1"] + theta["m2"]) * theta["g"])
            if force > threshold:
                text = (
                    f"{self.label}: a free capsule stays at rest while |f| <= F_b = {threshold:.3g} N; the record "
                    f"reaches {force:.3g} N, so the capsule slips and this is no free decay: hold the capsule, or "
                    "release from a smaller deflection"
                )
                findings.append(Finding("free decay", "fail", text, self.label))
        gap = self.table.settings.get("gap")
        if isinstance(gap, Quantity):
            reach, limit = float(np.max(self.values - equilibrium(self.values))), gap.value
            if reach >= limit:
                text = (
                    f"{self.label}: x_rel reaches {reach:.3g} m, the support spring stands at {limit:.3g} m, so the "
                    "rod hits it and this is no free decay: move the spring away, or start the window later"
                )
                findings.append(Finding("free decay", "fail", text, self.label))
        return findings

    def comparison(self, theta: Theta, draws: list[Theta]) -> Comparison:
        def curve(values: Theta) -> np.ndarray:
            misfit = self.misfit(values)
            return self.values - misfit.raw + misfit.design @ misfit.at_nuisance_mean(np)[1]

        unit, time = self.column.to_display, self.time + self.time0
        lower, upper = band(np.array([curve(draw) for draw in draws[:50]]) * unit)
        residuals = np.asarray(self.residuals(theta, np))[: self.n]
        return Comparison(
            self.kind,
            self.label,
            f"{self.label}: free decay",
            "time [s]",
            axis_label(self.column),
            (Points(self.label, time, self.values * unit),),
            (Curve(f"this fit, {self.model_name}", time, curve(theta) * unit, lower, upper),),
            time,
            residuals,
            autocorrelation(residuals, min(60, self.n // 4)),
            1.96 / float(np.sqrt(self.n)),
        )


def autocorrelation(residuals: np.ndarray, lags: int) -> np.ndarray:
    """(lags,) sample autocorrelation at lags 1 .. lags."""
    r = residuals - np.mean(residuals)
    power = float(r @ r)
    return np.array([float(r[lag:] @ r[:-lag]) for lag in range(1, lags + 1)]) / power


def twin(
    rng: np.random.Generator,
    k1: float,
    c: float,
    m1: float,
    release: float,
    relative_sd: float,
    duration: float = 0.5,
    rate: float = 2000.0,
) -> dict[str, np.ndarray]:
    """A synthetic decay, released at rest from ``release`` m at time 0; noise is ``relative_sd`` of the release."""
    time = np.arange(round(duration * rate)) / rate
    gamma, omega = rates(k1, c, m1, np)
    cosine, sine = viscous_basis(time, k1, c, m1, np).T
    x = release * (cosine + gamma / omega * sine)
    return {"time [s]": time, "x_rel [mm]": 1e3 * (x + relative_sd * release * rng.standard_normal(time.size))}
