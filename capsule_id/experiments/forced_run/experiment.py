"""Likelihood of forced runs: the motor drives the capsule (paper, sections 3 and 4).

    theta -> capsule model from the first sample on -> channels -> misfit of each channel

The recorded channels (x_rel, x_capsule, acceleration_rod, current) are independent given the motion. Each has its own
noise, and an offset that enters linearly and is integrated out. A gain and, to first order, a delay are integrated
out too where their sd is stated. X2 = 0 at the first sample, because the offset of x_capsule is free.
"""

from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import Start, ValuesBySymbol
from capsule_id.experiments.checks.context import RunRecord
from capsule_id.experiments.clock import stated_rate, stretch
from capsule_id.experiments.families.capsule_experiment import CapsuleForward
from capsule_id.experiments.families.friction_model import EQUATION_1, NORMAL_FORCE, FrictionModel
from capsule_id.experiments.families.inclined import ground_of
from capsule_id.experiments.forced_run.checks.feasibility import check_feasible
from capsule_id.experiments.forced_run.checks.predictability import check_predictable, predictable_parts
from capsule_id.experiments.forced_run.checks.repeated import check_repeated
from capsule_id.experiments.forced_run.declaration import NOISE
from capsule_id.experiments.forced_run.nuisances import run_parameters, run_starts, stated_sds
from capsule_id.experiments.forced_run.panels import filtered_record, run_comparisons
from capsule_id.experiments.forced_run.parts import parts_of
from capsule_id.experiments.forced_run.second_fit import coloured_starts, second_fit_table
from capsule_id.experiments.forced_run.start_state.restart import corrected_start
from capsule_id.experiments.forced_run.start_state.rough import AboutRun, RunStart, rough_start
from capsule_id.experiments.forced_run.tables import predicted_motion, scaled_groups
from capsule_id.experiments.linear import NUISANCE_WIDTH
from capsule_id.experiments.misfit import Misfit, innovations
from capsule_id.physics.drive import Drive
from capsule_id.physics.forces import equilibrium, rod_acceleration
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Excitation, Trajectory
from capsule_id.records.stated_settings import stated_gap, stated_Omega
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison, Facts, Finding

#: Excitation periods from rest after which the motion counts as periodic (start = "settled").
SETTLING_PERIODS = 40


class ForcedRun(CapsuleForward):
    """One record of the driven capsule.

    The setting ``start`` in rig.toml selects the initial state: "stuck" (capsule at rest and held: Y2 = 0), "moving"
    (Y2 sampled too), "settled" (the periodic motion reached from rest), or "auto". "auto" estimates stuck or moving
    from the record.

    The drive is K times the recorded current, whose amplitude and phase are sampled. Without a current it is the
    stated P_d. Where both exist, P_d is a second reading of the same amplitude.

    Each part of a record (``parts``) has its own initial state and offsets. All parts share gap, drive, noise and
    delays.

    Attributes
    ----------
    time, values : (n,) s and (channels, n) SI
    widths : (channels,) sds of the offsets' priors, SI
    gain_sd, delay_sd : (channels,) stated, 1 and s
    reading_variance : (channels,) stated, SI
    moves : factor of ``capsule_start``, 0 or 1, so that one program computes runs of both kinds
    normal_force : stated, N; 0 where it is the weight
    first : time of the first sample of the whole record, s
    clock_rate, middle : 1 + the stated drift of the clock, and the middle of the whole record, s; None: an exact clock
    reaction : share of the drive's force that pushes the capsule back, 1
    """

    about: AboutRun = eqx.field(static=True)
    time: np.ndarray
    values: np.ndarray
    Omega: float
    gap: float
    drive: float
    drive_sd: float
    widths: np.ndarray
    gain_sd: np.ndarray
    delay_sd: np.ndarray
    reading_variance: np.ndarray
    moves: float
    normal_force: float
    clock_rate: float | None
    middle: float | None
    first: float
    channels: tuple[str, ...] = eqx.field(static=True)
    settled: bool = eqx.field(static=True)
    gap_known: bool = eqx.field(static=True)
    drive_known: bool = eqx.field(static=True)
    normal_force_stated: bool = eqx.field(static=True)
    has_gain: tuple[bool, ...] = eqx.field(static=True)
    has_delay: tuple[bool, ...] = eqx.field(static=True)
    coloured: bool = eqx.field(static=True)
    second_reading: bool = eqx.field(static=True)
    reaction: float = eqx.field(static=True)

    #: Whether the record prescribes the motion of the rod.
    prescribed: ClassVar[bool] = False
    #: Whether the phase of the drive is a parameter, and channels that are inputs, not readings.
    has_phase: ClassVar[bool] = True
    inputs: ClassVar[tuple[str, ...]] = ()
    time_series = True
    checks = (check_feasible, check_predictable, check_repeated)
    tables = (second_fit_table, predicted_motion, scaled_groups)

    def __init__(
        self,
        table: Table,
        rig: Rig,
        friction: FrictionModel = EQUATION_1,
        part_of: str | None = None,
        leads: bool = True,
        capsule_rate: float | None = None,
        coloured: bool = False,
    ) -> None:
        """Make one record, or a part of one.

        Parameters
        ----------
        part_of : label of the record; None: the table is a whole record
        leads : False for later parts of a record. The kind of their initial state is estimated again. A P_d that is a
            second reading of the current's amplitude counts in the first part only.
        capsule_rate : speed of the capsule at the first sample, m/s, 0 for stuck; None: as stated, or estimated
        coloured : whether the noise is AR(1), also where the settings leave it open
        """
        self.read_drive(table)
        settings, gap = table.settings, stated_gap(table)
        self.friction, self.smoothing, self.ground = friction, None, ground_of(table)
        self.reaction = rig.model.share_of_reaction
        self.channels = tuple(name for name in NOISE if name in table.columns and name not in self.inputs)
        self.time = table["time"]
        self.clock_rate = stated_rate(table)
        whole = next((other for other in rig.tables if other.label == part_of), table)["time"]
        self.first = float(whole[0])
        self.middle = None if self.clock_rate is None else 0.5 * float(whole[0] + whole[-1])
        self.values = np.stack([table[name] for name in self.channels])
        self.Omega = stated_Omega(table)
        self.gap, self.gap_known = gap.value, gap.sd == 0.0
        drive = settings.P_d if leads or not self.driven_by_current else None
        self.drive, self.drive_sd = (0.0, 0.0) if drive is None else (drive.value, drive.sd)
        self.drive_known = drive is None or drive.sd == 0.0
        self.normal_force_stated = settings.normal_force is not None
        self.normal_force = settings.normal_force or 0.0
        reading_sd = np.array([table.columns[name].reading_sd for name in self.channels])
        self.reading_variance = reading_sd**2
        # A constant channel has zero range, so its scale is the reading error, or 1e-9 in SI units.
        ranges = np.maximum(np.ptp(self.values, axis=1), np.maximum(reading_sd, 1e-9))
        self.widths = NUISANCE_WIDTH * ranges
        self.gain_sd, self.has_gain = stated_sds(settings, self.channels, "gain")
        self.delay_sd, self.has_delay = stated_sds(settings, self.channels, "delay")
        self.second_reading = self.driven_by_current and self.drive_sd > 0.0
        self.coloured = coloured or settings.noise == "ar1"
        rough = self.first_state(table).at_rate(capsule_rate)
        is_open = settings.start == "auto" or not leads
        start = rough.kind if is_open else settings.start
        self.settled = start == "settled"
        self.moves = float(start == "moving")
        self.about = AboutRun(table, rig, (), part_of or table.label, leads, start, is_open, rough)
        self.about = replace(self.about, parameters=run_parameters(self, ranges))

    def read_drive(self, table: Table) -> None:
        """Set the fields that a subclass has besides those of this class; ``__init__`` calls it first."""

    def first_state(self, table: Table) -> RunStart:
        """Starting values from the record."""
        return rough_start(table["time"], {name: table[name] for name in self.channels}, self.Omega)

    @classmethod
    def make(cls, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> "tuple[ForcedRun, ...]":
        """Make a run, or its parts where ``segment`` is stated."""
        run, seconds = cls(table, rig, friction), table.settings.segment
        return (run,) if seconds is None else run.parts(seconds)

    def parts(self, seconds: float) -> "tuple[ForcedRun, ...]":
        """Divide the record into parts of about ``seconds``; return the run itself if it is not longer."""
        tables = parts_of(self.table, seconds)
        made = (self._remade(table, self.about.leads and i == 0) for i, table in enumerate(tables))
        return tuple(made) if len(tables) > 1 else (self,)

    def restarted(self, capsule_rate: float) -> "ForcedRun":
        """Return the same record with this capsule speed at the first sample, m/s; 0: stuck."""
        return self._remade(self.table, self.about.leads, capsule_rate)

    def with_friction(self, friction: FrictionModel) -> "ForcedRun":
        return self._remade(self.table, self.about.leads, self.rough.capsule_rate, friction=friction)

    def _remade(self, table: Table, leads: bool, rate: float | None = None, **changed: Any) -> "ForcedRun":
        own = {"friction": self.friction, "part_of": self.about.record, "coloured": self.coloured, **changed}
        return type(self)(table, self.rig, leads=leads, capsule_rate=rate, **own).with_smoothing(self.smoothing)

    def noise_facts(self) -> Facts:
        noise = "ar1" if self.coloured else self.table.settings.noise
        return {**super().noise_facts(), "noise": noise, "spring": self.spring is not None}

    @property
    def shares_noise(self) -> str:
        return self.about.record

    def with_coloured_noise(self, theta: ValuesBySymbol) -> "tuple[ForcedRun, dict[str, float]] | None":
        if self.coloured or self.table.settings.noise is not None:
            return None
        leads, rate = self.about.leads, self.rough.capsule_rate
        return self._remade(self.table, leads, rate, coloured=True), coloured_starts(self, theta)

    @property
    def excitation_period(self) -> float | None:
        return 2.0 * np.pi / self.Omega

    @property
    def rough(self) -> RunStart:
        return self.about.rough

    @property
    def spring(self) -> str | None:
        return self.table.settings.spring

    @property
    def driven_by_current(self) -> bool:
        return "current" in self.channels

    @property
    def observed(self) -> np.ndarray:
        """Readings channel by channel, then the stated P_d where the current is recorded too, SI."""
        return np.concatenate([*self.values, [self.drive]] if self.second_reading else self.values)

    @property
    def scatters(self) -> tuple[str | None, ...]:
        own: tuple[str | None, ...] = tuple(f"noise_{name}" for name in self.channels)
        return (*own, None) if self.second_reading else own

    def starts(self) -> dict[str, Start]:
        return run_starts(self)

    # -- the motion and its recorded channels -----------------------------------------------------------------------

    def law(self, theta: ValuesBySymbol) -> FrictionLaw:
        return super().law({**theta, NORMAL_FORCE: self.normal_force} if self.normal_force_stated else theta)

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        """Return parameters and drive of this run; leaves as in ``theta``."""
        stated: Any = self.drive if self.drive_known else theta.get("P_d")
        force = theta["K"] * theta["I_d"] if self.driven_by_current else stated
        return self.with_spring(theta), Excitation(force, self.Omega, theta["phase"], self.reaction)

    def with_spring(self, theta: ValuesBySymbol) -> CapsuleParameters:
        """Parameters at ``theta`` with the support spring of this run; k2 = 0 where there is none."""
        return self.parameters_of(theta, theta.get("k2", 0.0), self.gap if self.gap_known else theta["G"])

    def true_time(self, theta: ValuesBySymbol) -> Any:
        """Times of the samples (..., n), s, with the drift of the clock at ``theta``."""
        if self.middle is None:
            return self.time
        # About the middle of the record the drift is nearly independent of the phase.
        return self.middle + jnp.multiply.outer(stretch(self.clock_rate, theta), self.time - self.middle)

    def motion(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Trajectory:
        """Simulate the motion at the samples (n,), X2 = 0 at the first."""
        p, e = self.capsule(theta)
        time = self.true_time(theta)
        if self.settled:
            early = time[..., :1] - SETTLING_PERIODS * 2.0 * np.pi / self.Omega
            rest = (equilibrium(p), 0.0, 0.0, 0.0) if "slope" in self.ground else None
            run = self.simulated(theta, p, e, xp.concatenate([early, time], axis=-1), rest)
            settled = {name: getattr(run, name)[1:] for name in ("times", "X1", "Y1", "X2", "Y2")}
            X2 = settled["X2"][0]
            return replace(run, **settled | {"X1": settled["X1"] - X2, "X2": settled["X2"] - X2})
        Y2 = self.moves * theta.get("capsule_start", 0.0) + 0.0 * theta["x_start"]
        initial = (theta["x_start"], theta.get("y_start", 0.0) + Y2, 0.0, Y2)
        return self.simulated(theta, p, e, time, initial)

    def predict(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> list[Any]:
        """Predict noise-free channels (n,), without offsets and gains, in the order of ``channels``.

        Concrete values in ``theta`` may have a batch axis (draws,); the result is then (draws, n).
        """
        run = self.motion(theta, xp)
        x_rel, rate = xp.asarray(run.X1 - run.X2), xp.asarray(run.Y1 - run.Y2)

        seen: list[Any] = []
        for name in self.channels:
            if name == "x_rel":
                seen.append(x_rel)
            elif name == "x_capsule":
                seen.append(xp.asarray(run.X2))
            elif name == "acceleration_rod":
                seen.append(self.acceleration(theta, x_rel, rate, xp))
            else:
                # A batch axis of the leaves precedes the axis of the samples.
                e, I_d = jax.tree.map(lambda leaf: xp.asarray(leaf)[..., None], (self.capsule(theta)[1], theta["I_d"]))
                assert isinstance(e, Excitation), "a current belongs to a harmonic drive"
                seen.append(I_d * e.cosine(self.true_time(theta)))
        return seen

    def acceleration(self, theta: ValuesBySymbol, x_rel: Any, rate: Any, xp: ModuleType) -> Any:
        """Acceleration of the rod at the samples, m/s^2, from x_rel (..., n), m, and its rate."""
        p, e = jax.tree.map(lambda leaf: xp.asarray(leaf)[..., None], self.capsule(theta))
        return rod_acceleration(p, e, self.true_time(theta), x_rel, rate)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        parts = []
        for i, (name, seen) in enumerate(zip(self.channels, self.predict(theta, xp), strict=True)):
            columns = [self.widths[i] * xp.ones(len(self.time))]
            if self.has_gain[i]:
                columns.append(self.gain_sd[i] * seen)
            if self.has_delay[i]:
                # First order in the delay suffices, because the delay is shorter than a sampling step.
                columns.append(-self.delay_sd[i] * xp.gradient(seen) / xp.gradient(xp.asarray(self.time)))
            raw, design = self.values[i] - seen, xp.stack(columns, axis=1)
            if self.coloured:
                parts.append(innovations(raw, self.reading_variance[i], design, xp.tanh(theta[f"ar1_{name}"]), xp))
            else:
                parts.append(Misfit(raw, self.reading_variance[i], 1.0, design))
        if self.second_reading:
            raw = self.drive - theta["K"] * theta["I_d"]
            parts.append(Misfit(xp.reshape(raw, (1,)), self.drive_sd**2, 0.0, xp.zeros((1, 0))))
        return tuple(parts)

    # -- interface to the fit, the checks and the report -------------------------------------------------------------

    def predictable_parts(self, theta: ValuesBySymbol) -> "tuple[tuple[ForcedRun, ...], list[Finding]]":
        return predictable_parts(self, theta)

    def corrected_start(self, theta: ValuesBySymbol) -> "tuple[ForcedRun, dict[str, float]] | None":
        return corrected_start(self, theta)

    def excess_noise(self, theta: ValuesBySymbol) -> float:
        # A record alone does not determine the level of coloured noise.
        if self.coloured:
            return 0.0
        shown = [max(self.rough.noise[name], self.table.columns[name].reading_sd) for name in self.channels]
        return max(float(theta[f"noise_{name}"]) / sd for name, sd in zip(self.channels, shown, strict=True))

    def record_view(self, theta: ValuesBySymbol) -> RunRecord | None:
        return filtered_record(self, theta)

    def records(self, theta: ValuesBySymbol) -> list[tuple[str, np.ndarray]]:
        parts = zip(self.channels, self.scaled(theta, np), strict=False)  # a second reading of P_d is no record
        return [(f"{self.label} {name}", np.asarray(part.at_nuisance_mean(np)[0])) for name, part in parts]

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        return self.comparisons(theta, draws)[0]

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        return run_comparisons(self, theta, draws)
