"""Likelihood of forced runs: the motor drives the capsule (paper, sections 3 and 4)."""

from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.base import Start, ValuesBySymbol, clock_parameters, scatter_prior, stated_rate, stretch
from capsule_id.experiments.capsule_experiment import (
    CapsuleForward,
    free_parameters,
    lag_parameters,
    stated_parameters,
    stated_starts,
    support_parameters,
)
from capsule_id.experiments.forced_run.declaration import (
    CAPSULE_START,
    CORRELATION,
    CURRENT_AMPLITUDE,
    NOISE,
    SETTLING_PERIODS,
)
from capsule_id.experiments.forced_run.start_state import (
    AboutRun,
    RunStart,
    parts_of,
    rough_start,
)
from capsule_id.experiments.friction_model import (
    EQUATION_1,
    FrictionModel,
    ground_parameters,
    instrument_parameters,
)
from capsule_id.experiments.misfit import NUISANCE_WIDTH, Misfit, innovations
from capsule_id.experiments.statistics import autocorrelation
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.physics.forces import equilibrium
from capsule_id.physics.model import CapsuleParameters, Drive, Excitation, Trajectory, rod_acceleration
from capsule_id.records.tones import stated_Omega
from capsule_id.rig.model import Instrument, Quantity, Rig, Table
from capsule_id.views import Facts, Finding

# channel: A recorded channel of a run, and the errors of its sensor.


class Channel(eqx.Module):
    """A recorded channel, and the errors of its sensor that enter linearly and are integrated out.

    Attributes
    ----------
    values : (n,) SI
    reading_variance : stated, SI
    extent : range of the readings, SI; the prior of the offset is wide beside it
    gain_sd, delay_sd : stated, 1 and s; None: the sensor has no such error
    """

    name: str = eqx.field(static=True)
    values: np.ndarray
    reading_variance: float
    extent: float
    gain_sd: float | None
    delay_sd: float | None

    def __init__(self, table: Table, name: str) -> None:
        column = table.columns[name]
        self.name, self.values, self.reading_variance = name, column.values, column.reading_sd**2
        # A constant channel has zero range, so its scale is the reading error, or 1e-9 in SI units.
        self.extent = max(float(np.ptp(column.values)), column.reading_sd, 1e-9)
        self.gain_sd, self.delay_sd = (getattr(table.settings, f"{name}_{error}_sd") for error in ("gain", "delay"))

    @property
    def width(self) -> float:
        """sd of the prior of the offset, SI."""
        return NUISANCE_WIDTH * self.extent

    def misfit(self, seen: Any, time: np.ndarray, rho: Any, xp: ModuleType) -> Misfit:
        """Misfit to the prediction ``seen`` (n,); ``rho`` : lag-1 correlation of the noise, None: white."""
        columns = [self.width * xp.ones(len(time))]
        if self.gain_sd is not None:
            columns.append(self.gain_sd * seen)
        if self.delay_sd is not None:
            # First order in the delay suffices, because the delay is shorter than a sampling step.
            columns.append(-self.delay_sd * xp.gradient(seen) / xp.gradient(xp.asarray(time)))
        raw, design = self.values - seen, xp.stack(columns, axis=1)
        if rho is None:
            return Misfit(raw, self.reading_variance, 1.0, design)
        return innovations(raw, self.reading_variance, design, rho, xp)


# experiment: Likelihood of forced runs: the motor drives the capsule (paper, sections 3 and 4).
#
#     theta -> capsule model from the first sample on -> channels -> misfit of each channel
#
# The recorded channels (x_rel, x_capsule, acceleration_rod, current) are independent given the motion. Each has its own
# noise, and an offset that enters linearly and is integrated out. A gain and, to first order, a delay are integrated
# out too where their sd is stated. X2 = 0 at the first sample, because the offset of x_capsule is free.


#: Default prior of the current's amplitude: log-normal about half its range.
AMPLITUDE_FACTOR = 3.0
#: Largest lag-1 correlation of the noise at which a fit starts.
LARGEST_CORRELATION = 0.99


def before_samples(tree: Any, xp: ModuleType) -> Any:
    """``tree`` with an axis for the samples behind the batch axis of its leaves."""
    return jax.tree.map(lambda leaf: xp.asarray(leaf)[..., None], tree)


class CapsuleRun(CapsuleForward):
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
    time : (n,) s
    second_reading : amplitude of the drive beside that from the current, and its sd, N; None: there is none
    moves : factor of ``capsule_start``, 0 or 1, so that one program computes runs of both kinds
    clock : 1 + the stated drift of the clock, and the middle of the whole record, s; None: an exact clock
    first : time of the first sample of the whole record, s
    """

    about: AboutRun = eqx.field(static=True)
    time: np.ndarray
    channels: tuple[Channel, ...]
    Omega: float
    second_reading: tuple[float, float] | None
    moves: float
    clock: tuple[float, float] | None
    first: float
    settled: bool = eqx.field(static=True)
    coloured: bool = eqx.field(static=True)

    #: Whether the record prescribes the motion of the rod.
    prescribed: ClassVar[bool] = False
    #: Channels that are inputs, not readings.
    inputs: ClassVar[tuple[str, ...]] = ()
    time_series = True

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
        self.read_drive(table, rig)
        self.set_model(table, rig, friction)
        settings = table.settings
        self.channels = tuple(
            Channel(table, name) for name in NOISE if name in table.columns and name not in self.inputs
        )
        if unread := sorted({name for name, _ in self.instruments} - {*self.names, "time"}):
            rule = f"an instrument of a run must have read a channel, not {unread[0]}, which drives it"
            raise InputError(rule, table.label, f"remove {unread[0]}_instrument", rig.folder / "rig.toml")
        self.time, self.Omega = table["time"], stated_Omega(table)
        whole = next((other for other in rig.tables if other.label == part_of), table)["time"]
        rate, self.first = stated_rate(table), float(whole[0])
        self.clock = None if rate is None else (rate, 0.5 * float(whole[0] + whole[-1]))
        P_d, by_current = settings.P_d, "current" in self.names
        self.second_reading = (P_d.value, P_d.sd) if P_d and P_d.sd > 0.0 and by_current and leads else None
        self.coloured = coloured or settings.noise == "ar1"
        rough = self.first_state(table)
        rough = rough if capsule_rate is None else replace(rough, capsule_rate=capsule_rate)
        is_open = settings.start == "auto" or not leads
        self.settled = settings.start == "settled" and not is_open
        self.moves = float(rough.capsule_rate != 0.0 if is_open else settings.start == "moving")
        self.about = AboutRun(table, rig, (), part_of or table.label, leads, is_open, rough)
        self.about = replace(self.about, parameters=tuple(self._sampled()))

    def read_drive(self, table: Table, rig: Rig) -> None:
        """Set the fields that a subclass has besides those of this class; ``__init__`` calls it first."""

    def first_state(self, table: Table) -> RunStart:
        """Starting values from the record."""
        return rough_start(table["time"], {name: table[name] for name in self.names}, self.Omega)

    def _sampled(self) -> list[Parameter]:
        """The parameters of the run with their priors."""
        of, whole, settings = self.label, self.about.record, self.table.settings
        rows = [parameter("k1"), parameter("c"), *self.friction.parameters, *ground_parameters(self.table, self.rig)]
        rows += free_parameters(self.rig, damped=self.spring is not None and self.friction.contact is None)
        # All parts were read by one clock.
        rows += [*clock_parameters(replace(self.table, label=whole), self.rig), *instrument_parameters(self.table)]
        rows += support_parameters(self.table, self.friction, whole)
        if "current" in self.names:
            amplitude = 0.5 * float(np.ptp(self.table["current"]))
            rows += [parameter("K"), CURRENT_AMPLITUDE.named(whole, Prior("lognormal", amplitude, AMPLITUDE_FACTOR))]
        else:
            rows += stated_parameters("P_d", settings.P_d, whole)
        rows += [parameter("K")] if "current" in self.inputs else []
        rows += [*stated_parameters("P_on", settings.P_on, kind="normal"), *lag_parameters(self.table, self.rig)]
        if not (self.inputs or self.prescribed):
            rows.append(parameter("phase", whole, Prior("normal", 0.0, np.pi)))  # wide but proper
        length = NUISANCE_WIDTH * self.rough.length
        position, rate = Prior("normal", 0.0, length), Prior("normal", 0.0, self.Omega * length)
        rows += [] if self.settled else [parameter("x_start", of, position)]
        rows += [] if self.settled or self.prescribed else [parameter("y_start", of, rate)]
        rows += [CAPSULE_START.named(of, rate)] if self.moves else []
        return [
            *rows,
            *(NOISE[channel.name].named(whole, scatter_prior(channel.extent)) for channel in self.channels),
            *(CORRELATION[name].named(whole) for name in self.names if self.coloured),
        ]

    def unstated_errors(self, symbol: str) -> set[str]:
        """The offsets of all channels are free."""
        known = {channel.name for channel in self.channels if channel.gain_sd is not None} | {
            *dict(self.instruments),
            "time",
        }
        return super().unstated_errors(symbol) | (set() if known.issuperset(self.table.columns) else {"gain"})

    def starts(self) -> dict[str, Start]:
        """Starts of the nuisances from the record, sampled or not; other parameters start at bench estimates or priors."""
        rough, of, settings = self.rough, self.about.record, self.table.settings
        state = {"x_start": rough.x_rel, "y_start": rough.rate, "capsule_start": rough.capsule_rate}
        spreads = 0.03 * rough.length * np.array([1.0, self.Omega, self.Omega])
        pairs = zip(state.items(), spreads.tolist(), strict=True)
        starts = {f"{symbol}[{self.label}]": Start(value, spread) for (symbol, value), spread in pairs}
        if not self.about.leads:
            return starts
        return starts | {
            f"phase[{of}]": Start(rough.phase, 0.02),
            **stated_starts(of, G=settings.gap, G_back=settings.gap_back, P_d=settings.P_d),
            f"I_d[{of}]": Start(rough.amplitude, 0.005),
            **{f"noise_{name}[{of}]": Start(noise, 0.1) for name, noise in rough.noise.items()},
            **{f"ar1_{name}[{of}]": Start(0.0, 0.1) for name in self.names},
        }

    # -- the same record, changed -----------------------------------------------------------------------------------

    @classmethod
    def make(cls, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> "tuple[CapsuleRun, ...]":
        """Make a run, or its parts where ``segment`` is stated."""
        run, seconds = cls(table, rig, friction), table.settings.segment
        return (run,) if seconds is None else run.parts(seconds)

    def parts(self, seconds: float) -> "tuple[CapsuleRun, ...]":
        """Divide the record into parts of about ``seconds``; return the run itself if it is not longer."""
        tables = parts_of(_with_sampled_gains(self.table, self.about.record), seconds)
        own = (
            self.remade(table, capsule_rate=None, leads=self.about.leads and i == 0) for i, table in enumerate(tables)
        )
        return tuple(own) if len(tables) > 1 else (self,)

    def with_friction(self, friction: FrictionModel) -> "CapsuleRun":
        return self.remade(self.table, friction=friction)

    def with_coloured_noise(self, theta: ValuesBySymbol) -> "tuple[CapsuleRun, dict[str, float]] | None":
        if self.coloured or self.table.settings.noise is not None:
            return None
        values = {}
        for name, (_, residuals) in zip(self.names, self.records(theta), strict=True):
            rho = float(np.clip(autocorrelation(residuals, 1)[0], 0.0, LARGEST_CORRELATION))
            values[f"ar1_{name}[{self.about.record}]"] = float(np.arctanh(rho))
            values[f"noise_{name}[{self.about.record}]"] = theta[f"noise_{name}"] * float(np.sqrt(1.0 - rho**2))
        return self.remade(self.table, coloured=True), values

    def remade(self, table: Table, **changed: Any) -> "CapsuleRun":
        """Return a run of ``table``, the record or a part of it, with other arguments of the constructor."""
        own = {
            "friction": self.friction,
            "part_of": self.about.record,
            "leads": self.about.leads,
            "capsule_rate": self.rough.capsule_rate,
            "coloured": self.coloured,
            **changed,
        }
        return type(self)(table, self.rig, **own).with_smoothing(self.smoothing)

    # -- what the record is -----------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Of the channels that enter the likelihood."""
        return tuple(channel.name for channel in self.channels)

    @property
    def shares_noise(self) -> str:
        return self.about.record

    @property
    def cycles(self) -> np.ndarray:
        return self.table["time"] / (2.0 * np.pi / self.Omega)

    @property
    def rough(self) -> RunStart:
        return self.about.rough

    @property
    def spring(self) -> str | None:
        return self.table.settings.spring

    @property
    def observed(self) -> np.ndarray:
        """Readings channel by channel, then the stated P_d where the current is recorded too, SI."""
        return np.concatenate([*(channel.values for channel in self.channels), (self.second_reading or ())[:1]])

    @property
    def scatters(self) -> tuple[str | None, ...]:
        own = tuple(f"noise_{name}" for name in self.names)
        return (*own, None) if self.second_reading else own

    def noise_facts(self) -> Facts:
        noise = "ar1" if self.coloured else self.table.settings.noise
        return {
            **super().noise_facts(),
            "noise": noise,
            "spring": {self.spring, self.table.settings.spring_back} != {None},
        }

    def excess_noise(self, theta: ValuesBySymbol) -> float:
        # A record alone does not determine the level of coloured noise.
        if self.coloured:
            return 0.0
        shown = {name: max(self.rough.noise[name], self.table.columns[name].reading_sd) for name in self.names}
        return max(float(theta[f"noise_{name}"]) / sd for name, sd in shown.items())

    def records(self, theta: ValuesBySymbol) -> list[tuple[str, np.ndarray]]:
        parts = zip(self.names, self.scaled(theta, np), strict=False)  # a second reading of P_d is no record
        return [(f"{self.label} {name}", np.asarray(part.at_nuisance_mean(np)[0])) for name, part in parts]

    # -- the motion and its recorded channels -----------------------------------------------------------------------

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        """Return parameters and drive of this run; leaves as in ``theta``."""
        force = theta["K"] * theta["I_d"] if "current" in self.names else {**self.exact, **theta}["P_d"]
        return self.parameters_of(theta), Excitation(force, self.Omega, theta["phase"], self.reaction)

    def true_time(self, theta: ValuesBySymbol) -> Any:
        """Times of the samples (..., n), s, with the drift of the clock at ``theta``."""
        if self.clock is None:
            return self.time
        # About the middle of the record the drift is nearly independent of the phase.
        rate, middle = self.clock
        return middle + jnp.multiply.outer(stretch(rate, theta), self.time - middle)

    def drive_time(self, times: Any) -> Any:
        """``times`` of the record, s, on the clock of the drive of ``capsule``."""
        return times

    def motion(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Trajectory:
        """Simulate the motion at the samples (n,), X2 = 0 at the first."""
        p, e = self.capsule(theta)
        time = self.true_time(theta)
        if self.settled:
            early = time[..., :1] - SETTLING_PERIODS * 2.0 * np.pi / self.Omega
            rest = (equilibrium(p), 0.0, 0.0, 0.0) if "slope" in self.ground else None
            run = self.simulated(theta, p, e, xp.concatenate([early, time], axis=-1), rest)
            settled = {name: getattr(run, name)[..., 1:] for name in ("times", "X1", "Y1", "X2", "Y2")}
            X2 = settled["X2"][..., :1]
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
        seen = {
            "x_rel": lambda: x_rel,
            "x_capsule": lambda: xp.asarray(run.X2),
            "acceleration_rod": lambda: self.acceleration(theta, x_rel, rate, xp),
            "current": lambda: self.current_of(theta, xp),
        }
        return [seen[name]() for name in self.names]

    def current_of(self, theta: ValuesBySymbol, xp: ModuleType) -> Any:
        """Current at the samples, A, of a harmonic drive."""
        e, I_d = before_samples((self.capsule(theta)[1], theta["I_d"]), xp)
        return I_d * e.cosine(self.true_time(theta))

    def acceleration(self, theta: ValuesBySymbol, x_rel: Any, rate: Any, xp: ModuleType) -> Any:
        """Acceleration of the rod at the samples, m/s^2, from x_rel (..., n), m, and its rate."""
        p, e = before_samples(self.capsule(theta), xp)
        return rod_acceleration(p, e, self.drive_time(self.true_time(theta)), x_rel, rate)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        parts = []
        for channel, seen in zip(self.channels, self.predict(theta, xp), strict=True):
            rho = xp.tanh(theta[f"ar1_{channel.name}"]) if self.coloured else None
            parts.append(channel.misfit(self.instrument(channel.name, theta)[0] * seen, self.time, rho, xp))
        if self.second_reading is not None:
            stated, sd = self.second_reading
            raw = stated - theta["K"] * theta["I_d"]
            parts.append(Misfit(xp.reshape(raw, (1,)), sd**2, 0.0, xp.zeros((1, 0))))
        return tuple(parts)

    # -- whether one initial state predicts the record ----------------------------------------------------------------

    def predictable_parts(self, theta: ValuesBySymbol) -> "tuple[tuple[CapsuleRun, ...], list[Finding]]":
        factor = 0.0 if self.settled else growth(self, theta)
        if factor <= LARGEST_GROWTH:
            return (self,), []
        duration = float(self.time[-1] - self.time[0])
        # Errors grow about ``PART_GROWTH`` times within a part.
        length = duration * np.log(PART_GROWTH) / np.log(factor) if np.isfinite(factor) else 0.0
        parts = self.parts(max(PART_PERIODS * 2.0 * np.pi / self.Omega, length))
        facts = {"growth": factor, "parts": len(parts), "seconds": duration / len(parts)}
        return parts, [Finding("runs.cut", "warn", facts, self.label)] if len(parts) > 1 else []

    def corrected_start(self, theta: ValuesBySymbol) -> "tuple[CapsuleRun, dict[str, float]] | None":
        # The initial state may be stated, and without x_capsule nothing decides.
        may_change = self.about.start_is_open and "x_capsule" in self.names
        better = better_start(self, theta) if may_change else None
        if better is None:
            return None
        restarted = self.remade(self.table, capsule_rate=better["capsule_start"])
        # A prescribed rod has no initial speed to sample, and a capsule at rest none either.
        sampled = {row.symbol for row in restarted.parameters}
        return restarted, {f"{symbol}[{self.label}]": value for symbol, value in better.items() if symbol in sampled}


# state: The initial state of a run: whether it predicts the whole record, and whether the capsule rests in it.
#
# The first samples alone do not distinguish a slowly sliding capsule from one that is about to slip. Given the other
# parameters, the later motion does. Both questions are put to the exact engine: the steps of the smoothed one hide
# small changes of the state.


#: Largest growth factor of an initial error within the record, dimensionless. Above it one initial state cannot fit it.
LARGEST_GROWTH = 1e3
#: Target growth factor of an initial error within a part, dimensionless; shortest part, excitation periods.
PART_GROWTH, PART_PERIODS = 30.0, 2.0
#: Initial errors of the difference quotients, relative to the motion; factors up to this are read off; instants of a
#: record at which they are read.
STEP, MEASURABLE, INSTANTS = 1e-11, 1e8, 8
#: Trial speeds of the capsule at the first sample, m/s, and index of zero among those of both directions. Logarithmic
#: spacing resolves slow and fast sliding.
_SPEEDS = np.geomspace(0.5e-3, 60e-3, 13)
TRIAL_SPEEDS, ZERO_SPEED = np.concatenate([-_SPEEDS[::-1], [0.0], _SPEEDS]), len(_SPEEDS)
#: Number of Gauss–Newton steps.
GAUSS_NEWTON_STEPS = 5
#: Steps of the difference quotients, and largest Gauss–Newton steps, of x_rel, m, and of the rod's speed, m/s.
DIFFERENCE_STEPS, LARGEST_STEPS = np.array([1e-8, 1e-6]), np.array([[2e-4], [0.1]])
#: Smallest increase in log-likelihood over a capsule at rest for which the capsule counts as moving.
LOG_LIKELIHOOD_RATIO = 3.0


def growth(run: CapsuleRun, theta: ValuesBySymbol) -> float:
    """Largest growth factor of a small initial error at the end of the record, dimensionless; inf where it is not finite.

    Positions are scaled by the amplitude of the motion, velocities by amplitude times Omega. Central differences come
    from one batch of runs, because exact derivatives take ten times as long to compile. A factor above ``MEASURABLE``
    within the record is extrapolated from there, because differences cannot outgrow the motion. Below 1e-3: rounding.
    """
    run, size = run.with_smoothing(None), np.array([1.0, run.Omega, run.Omega]) * run.rough.length
    motion = run.motion(theta, np)
    start = np.array([float(motion.x_rel[0]), float(motion.Y1[0] - motion.Y2[0]), float(motion.Y2[0])])
    x_rel, rate, Y2 = np.concatenate([start + STEP * np.diag(size), start - STEP * np.diag(size)]).T
    time = np.asarray(run.true_time(theta))
    instants = np.linspace(time[0], time[-1], INSTANTS + 1)[1:]
    # As many samples as the record has: then one compiled program serves all batches of its motions.
    times = np.union1d(time, instants)
    t = run.simulated(theta, *run.capsule(theta), times, (x_rel, rate + Y2, np.zeros(6), Y2))
    states = np.stack([t.x_rel, t.Y1 - t.Y2, t.Y2], axis=-1)[:, np.searchsorted(times, instants)] / (2.0 * STEP * size)
    if not np.isfinite(states).all():
        return float("inf")
    factors = np.linalg.norm(np.swapaxes(states[:3] - states[3:], 0, 1), 2, axis=(1, 2))
    last = int(np.argmax(factors > MEASURABLE)) if np.any(factors > MEASURABLE) else INSTANTS - 1
    with np.errstate(over="ignore"):
        return float(factors[last] ** (INSTANTS / (last + 1)))


def better_start(run: CapsuleRun, theta: ValuesBySymbol) -> dict[str, float] | None:
    """Initial state, SI by symbol, that fits the whole record better than that of ``theta``; None: there is none.

    capsule_start is 0 where it does not differ significantly from rest. For every trial speed, Gauss–Newton estimates
    position and speed of the rod again, because they compensate much of the change. Other values are as in ``theta``.
    """
    moving, own = run.remade(run.table, capsule_rate=1.0).with_smoothing(None), float(theta.get("capsule_start", 0.0))
    speeds = np.append(TRIAL_SPEEDS, own)
    rod = np.full((2, len(speeds)), [[theta["x_start"]], [theta.get("y_start", 0.0) + own]])
    offsets = np.array([[0.0, 0.0], [DIFFERENCE_STEPS[0], 0.0], [0.0, DIFFERENCE_STEPS[1]]])
    best, where = np.full(len(speeds), np.inf), rod
    for _ in range(GAUSS_NEWTON_STEPS):
        miss = np.stack([_misses(moving, theta, *one, speeds) for one in rod + offsets[..., None]])
        cost = 0.5 * np.sum(miss[0] ** 2, axis=1)
        better = cost < best
        best, where = np.where(better, cost, best), np.where(better, rod, where)
        slope = (miss[1:] - miss[0]) / DIFFERENCE_STEPS[:, None, None]
        normal = np.einsum("iln,jln->lij", slope, slope)
        pull = np.einsum("iln,ln->li", slope, miss[0])
        known = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(pull).all(axis=1)
        normal, pull = np.where(known[:, None, None], normal, np.eye(2)), np.where(known[:, None], pull, 0.0)
        step = -np.einsum("lij,lj->il", np.linalg.pinv(normal), pull)
        rod = rod + np.clip(step, -LARGEST_STEPS, LARGEST_STEPS)
    found = int(np.argmin(best))
    if best[ZERO_SPEED] - best[found] < LOG_LIKELIHOOD_RATIO:
        found = ZERO_SPEED
    # The last speed is that of ``theta``.
    same_kind = np.sign(speeds[found]) == (np.sign(own) if run.moves else 0.0)
    if same_kind or (best[-1] - best[found] < LOG_LIKELIHOOD_RATIO and speeds[found] != 0.0):
        return None
    x, Y1 = where[:, found].tolist()
    speed = float(speeds[found])
    return {"x_start": x, "y_start": Y1 - speed, "capsule_start": speed}


def _misses(run: CapsuleRun, theta: ValuesBySymbol, x: np.ndarray, Y1: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """(lanes, readings) residuals of the channels that depend on the motion, without offsets, in units of noise."""
    lanes = {name: np.full(len(x), value) for name, value in theta.items() if np.ndim(value) == 0}
    seen = run.predict({**lanes, "x_start": x, "y_start": Y1 - speeds, "capsule_start": speeds}, np)
    parts = []
    for channel, model in zip(run.channels, seen, strict=True):
        if channel.name != "current":
            seen_by = run.instrument(channel.name, theta)[0]
            miss = (channel.values - seen_by * model) / theta[f"noise_{channel.name}"]
            parts.append(miss - np.mean(miss, axis=1, keepdims=True))
    return np.concatenate(parts, axis=1)


def _with_sampled_gains(table: Table, record: str) -> Table:
    """``table`` with an instrument for each column of a stated gain: all parts of a record have one gain, which is sampled.

    Integrated out in each part, its error would be drawn anew and average out.
    """
    columns, changed = dict(table.columns), dict[str, None]()
    for name, column in table.columns.items():
        sd = getattr(table.settings, f"{name}_gain_sd", None)
        if sd is not None and column.instrument is None:
            own = Instrument(f"{record}_{name}", errors={"gain": Quantity(0.0, sd)})
            columns[name], changed[f"{name}_gain_sd"] = replace(column, instrument=own), None
    return replace(table, columns=columns, settings=replace(table.settings, **changed)) if changed else table
