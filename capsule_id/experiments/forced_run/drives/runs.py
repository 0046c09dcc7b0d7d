"""Runs with a drive that is not harmonic: pulses, or K times the recorded current."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks.context import RunRecord
from capsule_id.experiments.forced_run.checks.predictability import check_predictable
from capsule_id.experiments.forced_run.checks.repeated import check_repeated
from capsule_id.experiments.forced_run.experiment import ForcedRun
from capsule_id.experiments.forced_run.second_fit import second_fit_table
from capsule_id.experiments.forced_run.tables import predicted_motion
from capsule_id.physics.drive import Drive
from capsule_id.physics.drives.pulses import Pulses
from capsule_id.physics.drives.recorded import RecordedDrive
from capsule_id.physics.forces import downhill, rod_on_capsule
from capsule_id.physics.model import CapsuleParameters, Trajectory
from capsule_id.rig.model import Table

#: Periods before the first sample from which pulses act: a lag forgets its start in a few periods.
EARLIER_PERIODS = 50.0


class OtherRun(ForcedRun):
    """A run without a harmonic force: what the paper's protocol and figures take from one is left out."""

    checks = (check_predictable, check_repeated)
    tables = (second_fit_table, predicted_motion)

    def record_view(self, theta: ValuesBySymbol) -> RunRecord | None:
        del theta
        return None


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

    def read_drive(self, table: Table) -> None:
        self.current = table["current"]

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        force = jnp.multiply.outer(jnp.asarray(theta["K"]), self.current)
        return self.with_spring(theta), RecordedDrive(self.true_time(theta), force, self.reaction)

    def acceleration(self, theta: ValuesBySymbol, x_rel: Any, rate: Any, xp: ModuleType) -> Any:
        p = jax.tree.map(lambda leaf: xp.asarray(leaf)[..., None], self.with_spring(theta))
        force = xp.asarray(theta["K"])[..., None] * self.current
        return (force - rod_on_capsule(p, x_rel, rate) - downhill(p, p.m1)) / p.m1


class PulseRun(OtherRun):
    """One record driven by pulses of stated period and duty, which act since long before the first sample.

    Attributes
    ----------
    duty, P_on, lag : 1, N, s; stated, the last two where they are exact
    """

    duty: float
    P_on: float
    lag: float

    def read_drive(self, table: Table) -> None:
        settings = table.settings
        self.duty, self.P_on = settings.duty, settings.P_on.value
        self.lag = 0.0 if settings.lag is None else settings.lag.value

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        force, lag = theta.get("P_on", self.P_on), theta.get("lag", self.lag)
        period = 2.0 * np.pi / self.Omega
        return self.with_spring(theta), Pulses(
            force, period, self.duty, phase=theta["phase"], lag=lag, reaction=self.reaction
        )

    def simulated(
        self, theta: ValuesBySymbol, p: CapsuleParameters, e: Drive, times: ArrayLike, initial: Any = None
    ) -> Trajectory:
        earlier = EARLIER_PERIODS * 2.0 * np.pi / self.Omega
        return super().simulated(theta, p, e, jnp.asarray(times) - self.first + earlier, initial)
