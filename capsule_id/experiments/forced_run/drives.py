"""Runs with another drive than a harmonic force: pulses, a recorded current, a prescribed motion of the rod."""

from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.experiments.base import Start, ValuesBySymbol, stretch
from capsule_id.experiments.capsule_experiment import lag_of
from capsule_id.experiments.context import RunRecord
from capsule_id.experiments.forced_run.checks import (
    check_feasible,
    check_predictable,
    check_repeated,
    filtered_record,
    predicted_motion,
    run_comparisons,
    scaled_groups,
)
from capsule_id.experiments.forced_run.experiment import CapsuleRun, before_samples
from capsule_id.experiments.forced_run.start_state import RunStart, rough_start, slides
from capsule_id.physics.drive import Drive
from capsule_id.physics.drives import Pulses, RecordedDrive, RodMotion
from capsule_id.physics.forces import downhill, rod_on_capsule
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Trajectory
from capsule_id.records.tones import relative_position
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison

# runs: Runs by drive, with their checks, tables and panels. What the paper's protocol and figures take from a harmonic
# force is left out of the others.


#: Periods before the first sample from which pulses act: a lag forgets its start in a few periods.
EARLIER_PERIODS = 50.0


class OtherRun(CapsuleRun):
    """A run with any drive: the checks, tables and panels that need no harmonic force."""

    checks = (check_predictable, check_repeated)
    tables = (predicted_motion,)

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        return self.comparisons(theta, draws)[0]

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        return run_comparisons(self, theta, draws)


class ForcedRun(OtherRun):
    """A run with a harmonic force."""

    checks = (check_feasible, *OtherRun.checks)
    tables = (*OtherRun.tables, scaled_groups)

    def record_view(self, theta: ValuesBySymbol) -> RunRecord | None:
        return filtered_record(self, theta)


class RecordedRun(OtherRun):
    """One record whose drive is K times the recorded current, linear between the samples.

    The current is taken as recorded: its noise and the phase shift of its filter act as a force on the rod. Noise of
    standard deviation s at n samples per period changes the amplitude of a tone by about s sqrt(2/n), which the noise
    levels of the other channels absorb. An offset of the current is a constant force.

    Attributes
    ----------
    current : (n,) A
    """

    current: np.ndarray

    has_phase = False
    inputs = ("current",)

    def read_drive(self, table: Table, rig: Rig) -> None:
        self.current = table["current"]

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        force = jnp.multiply.outer(jnp.asarray(theta["K"]), self.current)
        return self.with_spring(theta), RecordedDrive(self.true_time(theta), force, self.reaction)

    def acceleration(self, theta: ValuesBySymbol, x_rel: Any, rate: Any, xp: ModuleType) -> Any:
        p, K = before_samples((self.with_spring(theta), theta["K"]), xp)
        return (K * self.current - rod_on_capsule(p, x_rel, rate) - downhill(p, p.m1)) / p.m1


class PulseRun(OtherRun):
    """One record driven by pulses of stated period and duty, which act since long before the first sample.

    Attributes
    ----------
    duty, P_on, lag : 1, N, s; stated, None where they are parameters
    """

    duty: float
    P_on: float | None
    lag: float | None

    def read_drive(self, table: Table, rig: Rig) -> None:
        force = table.settings.P_on
        self.duty, self.P_on = table.settings.duty, force.value if force.sd == 0.0 else None
        self.lag = lag_of(table, rig)[1]

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        force: Any = theta["P_on"] if self.P_on is None else self.P_on
        lag: Any = theta["lag"] if self.lag is None else self.lag
        wave = 2.0 * np.pi / self.Omega, self.duty
        return self.with_spring(theta), Pulses(force, *wave, phase=theta["phase"], lag=lag, reaction=self.reaction)

    def simulated(
        self, theta: ValuesBySymbol, p: CapsuleParameters, e: Drive, times: ArrayLike, initial: Any = None
    ) -> Trajectory:
        earlier = EARLIER_PERIODS * 2.0 * np.pi / self.Omega
        return super().simulated(theta, p, e, jnp.asarray(times) - self.first + earlier, initial)


# base run: Runs whose record prescribes the motion of the rod: a shaken base, or a position-controlled inner mass.
#
#     x_base -> X1(t) -> capsule model -> x_capsule, x_rel
#
# Only the equation of the capsule is left. X1 is the cubic spline through x_base, whose own noise is neglected. The
# zeros of x_base and x_capsule are independent, so the extension of the rod's spring at the first sample is
# sampled.


#: Dispersion of the starts of k1, c and mu about their estimates from the record, natural logarithm.
SPREAD = {"k1": 0.05, "c": 0.5, "mu": 0.1}


class BaseRun(OtherRun):
    """One record of a capsule on a spring whose other end moves as recorded.

    Attributes
    ----------
    base, base_rate : (n,) X1 relative to the first sample, m, and its velocity, m/s
    """

    base: np.ndarray
    base_rate: np.ndarray

    prescribed = True

    def read_drive(self, table: Table, rig: Rig) -> None:
        motion = RodMotion.through(table["time"], table["x_base"] - table["x_base"][0])
        self.base, self.base_rate = np.asarray(motion.X1), np.asarray(motion.Y1)

    @property
    def masses(self) -> tuple[str, ...]:
        # The rod's mass acts through the normal force alone.
        return ("m2",) if self.normal_force is not None or self.rig.m1 is None else ("m1", "m2")

    def first_state(self, table: Table) -> RunStart:
        relative = relative_position(table)
        assert relative is not None, "the reader requires x_capsule or x_rel beside x_base"
        # Friction is about as strong in both directions, so the spring is unextended near the mean.
        seen = {name: table[name] for name in self.names} | {"x_rel": relative[0] - np.mean(relative[0])}
        return rough_start(table["time"], seen, self.Omega)

    def starts(self) -> dict[str, Start]:
        """Starts as of any run, and those of spring, damper and friction from the slides of the record."""
        starts, relative = super().starts(), relative_position(self.table)
        if relative is None or self.rig.m2 is None or self.spring is not None:
            return starts
        r = relative[0] - np.mean(relative[0])
        found = slides(self.time, r, self.table["x_base"] - relative[0], 2.0 * np.pi / self.Omega, self.rig.m2.value)
        if found is None:
            return starts
        m1 = 0.0 if self.rig.m1 is None else self.rig.m1.value
        masses = {"m1": m1, "m2": self.rig.m2.value, "g": self.rig.g.value}
        per_mu = self.law({**masses, **self.stated_ground, "mu": 1.0, "mu_back": 1.0}).forward(found.speed)
        values = {"k1": found.k1, "c": found.c, "mu": found.friction / float(per_mu)}
        sampled = {row.symbol for row in self.parameters}
        starts |= {name: Start(value, SPREAD[name]) for name, value in values.items() if name in sampled}
        at_first = f"x_start[{self.label}]"
        return starts | {at_first: Start(float(r[0]) + found.extension, starts[at_first].spread)}

    def law(self, theta: ValuesBySymbol) -> FrictionLaw:
        return super().law({"m1": 0.0, **theta})

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Any]:
        X1, time = jnp.add.outer(theta["x_start"], self.base), self.true_time(theta)
        rate = jnp.multiply.outer(1.0 / stretch(self.clock and self.clock[0], theta), self.base_rate)
        return self.with_spring({"m1": 0.0, **theta}), RodMotion(time, X1, rate)
