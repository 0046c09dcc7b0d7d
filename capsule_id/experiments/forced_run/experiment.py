"""Forced runs: the capsule driven by the motor, recorded in full motion (paper, sections 3 and 4).

    theta -> capsule model from the first sample on -> channels -> misfit of each channel

The channels that are recorded (x_rel, x_capsule, acceleration_rod, current) are independent given the motion; each has
its own noise, and an offset that enters linearly and is integrated out (a gain and, to first order, a delay too, where
their sd is stated). X2 = 0 at the first sample by convention: X2 and the offset of x_capsule cannot both be free.
"""

from dataclasses import replace
from functools import cached_property
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import Experiment, Start, Theta
from capsule_id.experiments.forced_run.feasibility import feasibility
from capsule_id.experiments.forced_run.panels import run_comparisons
from capsule_id.experiments.forced_run.parts import leads, record_of
from capsule_id.experiments.forced_run.start import SPEED_FOUND, RunStart, rough_start
from capsule_id.experiments.forward import CapsuleForward
from capsule_id.experiments.linear import NUISANCE_WIDTH
from capsule_id.experiments.misfit import Misfit, ScaledMisfit
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.physics.forces import rod_acceleration
from capsule_id.physics.model import CapsuleParameters, Excitation, Trajectory
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.views import Comparison, Finding

#: Channel of the table -> symbol of its noise; the order of the misfits.
NOISES = {
    "x_rel": "noise_x_rel",
    "x_capsule": "noise_x_capsule",
    "acceleration_rod": "noise_acceleration_rod",
    "current": "noise_current",
}
#: Default prior of a channel's noise: log-normal, median 1 % of its range, factor 100, beside the reading error.
NOISE_MEDIAN, NOISE_FACTOR = 0.01, 100.0
#: Default prior of the current's amplitude: log-normal about half its range.
AMPLITUDE_FACTOR = 3.0
#: sd of the normal prior of the drive's phase, rad: wide, and proper.
PHASE_WIDTH = np.pi
#: Periods from rest after which a motion counts as settled (start = "settled").
SETTLING_PERIODS = 40


class ForcedRun(CapsuleForward, Experiment):
    """One record of the driven capsule.

    Initial state, by ``start`` in rig.toml: "stuck" (capsule at rest and held: Y2 = 0), "moving" (Y2 sampled too),
    "settled" (the periodic motion that the capsule settles on from rest), or "auto": stuck or moving, as the record
    shows it.

    The drive is K times the recorded current, whose amplitude and phase are sampled; without a current it is the stated
    P_d. Where both are there, P_d is a second reading of the same amplitude.

    A part of a record (``run_parts``) has a start and offsets of its own; gap, drive, noise and delays are the record's.
    """

    time_series = True
    masses = ("m1", "m2")
    ARRAYS = (
        "time", "values", "Omega", "gap", "drive", "drive_sd", "widths", "gains", "delays", "reading_variance",
        "smoothing", "moves",
    )  # fmt: skip
    STATIC = (
        "channels", "settled", "gap_known", "drive_known", "gained", "delayed", "coloured", "second_reading", "model",
    )  # fmt: skip

    def __init__(self, table: Table, rig: Rig) -> None:
        super().__init__(table, rig)
        self.channels = tuple(name for name in NOISES if name in table.columns)
        self.time = table["time"]
        self.values = np.stack([table[name] for name in self.channels])
        self.Omega = _angular_frequency(table)
        self.spring = str(table.settings["spring"])
        gap, drive = table.settings["gap"], table.settings.get("P_d")
        assert isinstance(gap, Quantity), "the schema makes it one"
        self.gap, self.gap_sd = gap.value, gap.sd
        self.gap_known = gap.sd == 0.0
        assert drive is None or isinstance(drive, Quantity), "the schema makes it one"
        self.drive, self.drive_sd = (0.0, 0.0) if drive is None else (drive.value, drive.sd)
        self.drive_known = drive is not None and drive.sd == 0.0
        self.reading_variance = np.array([table.columns[name].reading_sd ** 2 for name in self.channels])
        self.ranges = np.array([max(float(np.ptp(y)), _floor(table, name)) for name, y in self._by_channel()])
        self.widths = NUISANCE_WIDTH * self.ranges
        self.gains, self.gained = self._asked_for("gain")
        self.delays, self.delayed = self._asked_for("delay")
        self.second_reading = self.driven_by_current and self.drive_sd > 0.0
        self.coloured = table.settings.get("noise") == "ar1"
        wanted = str(table.settings.get("start", "auto"))
        self.start_is_open = wanted == "auto"
        self.start = self.rough.kind if self.start_is_open else wanted
        self.settled = self.start == "settled"
        #: Factor of ``capsule_start``, so that runs of both kinds are computed together.
        self.moves = float(self.start == "moving")

    def _asked_for(self, nuisance: str) -> tuple[np.ndarray, tuple[bool, ...]]:
        """Stated sd of a gain or delay by channel, and whether there is one."""
        keys = [f"{name}_{nuisance}_sd" for name in self.channels]
        sds = np.array([float(self.table.settings.get(key, 0.0)) for key in keys])  # type: ignore[arg-type]
        return sds, tuple(key in self.table.settings for key in keys)

    def _by_channel(self) -> list[tuple[str, np.ndarray]]:
        return list(zip(self.channels, self.values, strict=True))

    @cached_property
    def rough(self) -> RunStart:
        """State and drive at the first sample, read off the record (the speed by the model, where that found one)."""
        rough = rough_start(self.time, dict(self._by_channel()), self.Omega)
        speed = self.table.settings.get(SPEED_FOUND)
        if not isinstance(speed, float):
            return rough
        return replace(rough, capsule_rate=speed, kind="stuck" if speed == 0.0 else "moving")

    @property
    def driven_by_current(self) -> bool:
        return "current" in self.channels

    @property
    def observed(self) -> np.ndarray:
        """Channel after channel, then the stated P_d where the current is recorded too."""
        readings = list(self.values)
        return np.concatenate([*readings, [self.drive]] if self.second_reading else readings)

    # -- parameters -------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        of, whole = self.label, record_of(self.table)
        rows = [parameter(symbol) for symbol in ("k1", "c", "mu", "v_s")] + [parameter("k2", self.spring)]
        if not self.gap_known:
            rows.append(parameter("G", whole, Prior("positive_normal", self.gap, self.gap_sd)))
        if self.driven_by_current:
            amplitude = 0.5 * float(np.ptp(self.table["current"]))
            rows += [parameter("K"), parameter("I_d", whole, Prior("lognormal", amplitude, AMPLITUDE_FACTOR))]
        elif not self.drive_known:
            rows.append(parameter("P_d", whole, Prior("positive_normal", self.drive, self.drive_sd)))
        rows.append(parameter("phase", whole, Prior("normal", 0.0, PHASE_WIDTH)))
        if not self.settled:
            length = NUISANCE_WIDTH * self.rough.length
            rows.append(parameter("x_start", of, Prior("normal", 0.0, length)))
            rows.append(parameter("y_start", of, Prior("normal", 0.0, self.Omega * length)))
        if self.start == "moving":
            rows.append(
                parameter("capsule_start", of, Prior("normal", 0.0, self.Omega * NUISANCE_WIDTH * self.rough.length))
            )
        for name, scale in zip(self.channels, self.ranges, strict=True):
            rows.append(parameter(NOISES[name], whole, Prior("lognormal", NOISE_MEDIAN * scale, NOISE_FACTOR)))
        if self.coloured:
            rows += [parameter(f"ar1_{name}", whole) for name in self.channels]
        return tuple(rows)

    @property
    def scatters(self) -> tuple[str | None, ...]:
        own: tuple[str | None, ...] = tuple(NOISES[name] for name in self.channels)
        return (*own, None) if self.second_reading else own

    def starts(self) -> dict[str, Start]:
        """From the record: nuisances alone; what the bench measures has its start there, or at its prior's centre."""
        rough, of = self.rough, self.label
        starts = self._starts_of_record() if leads(self.table) else {}
        if not self.settled:
            starts[f"x_start[{of}]"] = Start(rough.x_rel, 0.03 * rough.length)
            starts[f"y_start[{of}]"] = Start(rough.rate, 0.03 * self.Omega * rough.length)
        if self.start == "moving":
            starts[f"capsule_start[{of}]"] = Start(rough.capsule_rate, 0.03 * self.Omega * rough.length)
        return starts

    def _starts_of_record(self) -> dict[str, Start]:
        rough, of = self.rough, record_of(self.table)
        starts = {f"phase[{of}]": Start(rough.phase, 0.02)}
        if not self.gap_known:
            starts[f"G[{of}]"] = Start(self.gap, 0.5 * self.gap_sd / self.gap)
        if self.driven_by_current:
            starts[f"I_d[{of}]"] = Start(rough.amplitude, 0.005)
        elif not self.drive_known:
            starts[f"P_d[{of}]"] = Start(self.drive, 0.5 * self.drive_sd / self.drive)
        for name, noise in rough.noise.items():
            starts[f"{NOISES[name]}[{of}]"] = Start(noise, 0.1)
        if self.coloured:
            starts |= {f"ar1_{name}[{of}]": Start(0.0, 0.1) for name in self.channels}
        return starts

    # -- the motion and what is seen of it --------------------------------------------------------------------------

    def capsule(self, theta: Theta) -> tuple[CapsuleParameters, Excitation]:
        """Parameters and drive of this run; leaves as in ``theta``."""
        gap = self.gap if self.gap_known else theta["G"]
        stated: Any = self.drive if self.drive_known else theta.get("P_d")
        force = theta["K"] * theta["I_d"] if self.driven_by_current else stated
        names = ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "g")
        return CapsuleParameters(G=gap, **{name: theta[name] for name in names}), Excitation(
            force, self.Omega, theta["phase"]
        )

    def motion(self, theta: Theta, xp: ModuleType = jnp) -> Trajectory:
        """The model's motion at the samples (n,), X2 = 0 at the first."""
        p, e = self.capsule(theta)
        if self.settled:
            early = self.time[:1] - SETTLING_PERIODS * 2.0 * np.pi / self.Omega
            run = self.simulated(p, e, xp.concatenate([early, self.time]))
            settled = {name: getattr(run, name)[1:] for name in ("times", "X1", "Y1", "X2", "Y2")}
            X2 = settled["X2"][0]
            return replace(run, **settled | {"X1": settled["X1"] - X2, "X2": settled["X2"] - X2})
        Y2 = self.moves * theta.get("capsule_start", 0.0) + 0.0 * theta["x_start"]
        initial = (theta["x_start"], theta["y_start"] + Y2, 0.0, Y2)
        return self.simulated(p, e, self.time, initial)

    def predict(self, theta: Theta, xp: ModuleType = jnp) -> list[Any]:
        """Noise-free channels (n,), offsets and gains left out, in the order of ``channels``.

        Concrete values in ``theta`` may carry a batch axis (draws,): then (draws, n).
        """
        p, e = self.capsule(theta)
        run = self.motion(theta, xp)
        x_rel, rate = xp.asarray(run.X1 - run.X2), xp.asarray(run.Y1 - run.Y2)

        # A batch axis of the leaves stands before the samples.
        p, e, I_d = jax.tree.map(lambda leaf: xp.asarray(leaf)[..., None], (p, e, theta.get("I_d", 0.0)))
        seen: list[Any] = []
        for name in self.channels:
            if name == "x_rel":
                seen.append(x_rel)
            elif name == "x_capsule":
                seen.append(xp.asarray(run.X2))
            elif name == "acceleration_rod":
                seen.append(rod_acceleration(p, e, self.time, x_rel, rate))
            else:
                seen.append(I_d * e.cosine(self.time))
        return seen

    def misfits(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        parts = []
        for i, (name, seen) in enumerate(zip(self.channels, self.predict(theta, xp), strict=True)):
            columns = [self.widths[i] * xp.ones(len(self.time))]
            if self.gained[i]:
                columns.append(self.gains[i] * seen)
            if self.delayed[i]:
                # To first order in the delay, which is a part of a sampling step.
                columns.append(-self.delays[i] * xp.gradient(seen) / xp.gradient(xp.asarray(self.time)))
            raw, design = self.values[i] - seen, xp.stack(columns, axis=1)
            if self.coloured:
                parts.append(_coloured(raw, self.reading_variance[i], design, xp.tanh(theta[f"ar1_{name}"]), xp))
            else:
                parts.append(Misfit(raw, self.reading_variance[i], 1.0, design))
        if self.second_reading:
            raw = self.drive - theta["K"] * theta["I_d"]
            parts.append(Misfit(xp.reshape(raw, (1,)), self.drive_sd**2, 0.0, xp.zeros((1, 0))))
        return tuple(parts)

    # -- what the report sees -----------------------------------------------------------------------------------------

    def scaled(self, theta: Theta) -> list[ScaledMisfit]:
        """The misfits at the scatters of ``theta``, NumPy."""
        return self._scaled(theta, np)

    def lint(self, theta: Theta) -> list[Finding]:
        theta = self.local(theta)
        drive = theta["K"] * theta["I_d"] if self.driven_by_current else theta.get("P_d", self.drive)
        gap = theta.get("G", self.gap)
        settings = {**self.table.settings, "P_d": Quantity(float(drive)), "gap": Quantity(float(gap))}
        return feasibility(replace(self.table, settings=settings), theta)

    def records(self, theta: Theta) -> list[tuple[str, np.ndarray]]:
        scaled = self.scaled(theta)[: len(self.channels)]
        parts = zip(self.channels, scaled, strict=True)
        return [(f"{self.label} {name}", np.asarray(part.at_nuisance_mean(np)[0])) for name, part in parts]

    def comparison(self, theta: Theta, draws: list[Theta]) -> Comparison:
        return self.comparisons(theta, draws)[0]

    def comparisons(self, theta: Theta, draws: list[Theta]) -> tuple[Comparison, ...]:
        return run_comparisons(self, theta, draws)


def _coloured(raw: Any, variance: Any, design: Any, rho: Any, xp: ModuleType) -> Misfit:
    """Readings with AR(1) noise as their innovations: e_t = rho e_(t-1) + N(0, variance + scatter^2), stationary."""

    def whiten(y: Any) -> Any:
        return xp.concatenate([y[:1], y[1:] - rho * y[:-1]])

    first = 1.0 / xp.sqrt(1.0 - rho**2)
    scale = xp.concatenate([xp.reshape(first, (1,)), xp.ones(raw.shape[0] - 1)])
    return Misfit(whiten(raw), variance * scale**2, scale, whiten(design))


def _angular_frequency(table: Table) -> float:
    """Stated drive frequency, rad/s; ``rules.py`` sees to it that one is stated."""
    stated = table.settings.get("Omega")
    return float(stated) if stated is not None else 2.0 * np.pi * float(table.settings["f"])  # type: ignore[arg-type]


def _floor(table: Table, name: str) -> float:
    """A channel that does not vary has the size of its reading step, or next to none."""
    return max(table.columns[name].reading_sd, 1e-9)
