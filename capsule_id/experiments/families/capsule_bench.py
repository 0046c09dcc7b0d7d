"""Bench tests with the capsule model as their forward model (``forward = "capsule"`` in rig.toml).

The closed forms hold where the capsule stays at rest, and where the rod is locked to it. A rod released from farther
away than F_b/k1 moves its capsule. An unlocked rod oscillates on k1 and c while the capsule slides. In both cases the
closed form is biased. The capsule model of the forced runs, with the drive off, is not.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Experiment, Start, ValuesBySymbol, no_design
from capsule_id.experiments.clock import clock_parameters, stretch
from capsule_id.experiments.dynamic_friction.experiment import DynamicFriction
from capsule_id.experiments.families.capsule_experiment import CapsuleForward
from capsule_id.experiments.families.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.families.inclined import ground_of, ground_parameters
from capsule_id.experiments.free_vibration.declaration import NOISE_SD
from capsule_id.experiments.free_vibration.experiment import DecayAbout, FreeVibration
from capsule_id.experiments.free_vibration.settings import DecayModel
from capsule_id.experiments.free_vibration.starts import starts_of_motion
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.parameters import Prior, parameter
from capsule_id.physics.model import Excitation
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Finding

#: Zero drive; its frequency has no effect.
OFF = Excitation(0.0, 1.0)
#: Simulated duration of a push relative to the duration of a slide over the recorded distance, before the rod's decay.
#: A surface with this much less friction than the readings imply is far outside the posterior.
SLIDES, REST = 6.0, 0.5
#: Gap of a support spring out of reach, m.
FAR = 1e3


class CapsuleDecay(CapsuleForward, FreeVibration):
    """x_rel(t) of a rod released at the first sample, drive off, with the capsule at rest there and free to slip.

    Initial conditions and offset belong to the record. With ``spring`` and ``gap`` the rod may hit the support spring.
    """

    gap: float
    within_reach: bool = eqx.field(static=True)
    gap_known: bool = eqx.field(static=True)

    checks = ()
    tables = ()

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        FreeVibration.__init__(self, table, rig, friction, DecayModel())
        self.smoothing, self.ground = None, ground_of(table)
        gap = table.settings.gap
        self.within_reach = gap is not None
        self.gap = FAR if gap is None else gap.value
        self.gap_known = gap is None or gap.sd == 0.0
        rows = [parameter("k1"), parameter("c"), *friction.parameters]
        if gap is not None:
            rows.append(parameter("k2", table.settings.spring))
            if gap.sd > 0.0:
                rows.append(parameter("G", table.label, Prior("positive_normal", gap.value, gap.sd)))
        rows += self.motion_parameters(self.rough_decrement())
        rows += [NOISE_SD.named(table.label, self.noise_prior()), *ground_parameters(table, rig)]
        rows += clock_parameters(table, rig)
        self.about = DecayAbout(table, rig, tuple(rows))

    @classmethod
    def second_models(cls, records: Sequence[Any], readings: Sequence[Finding] = ()) -> tuple[list[Any], list[Finding]]:
        return Experiment.second_models(records, readings)

    @property
    def model_name(self) -> str:
        return "capsule model"

    def motion_of(self, theta: ValuesBySymbol) -> Any:
        """(n,) x_rel of the model, m."""
        p = self.parameters_of(theta, theta.get("k2", 0.0), self.gap if self.gap_known else theta["G"])
        initial = (theta["x_start"], theta["y_start"], 0.0, 0.0)
        times = jnp.multiply.outer(stretch(self.clock_rate, theta), self.time)
        t = self.simulated(theta, p, OFF, times, initial)
        return t.X1 - t.X2

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        raw = self.values - xp.asarray(self.motion_of(theta))
        return (Misfit(raw, self.reading_sd**2, 1.0, self.width * xp.ones((len(self.time), 1))),)

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        return Experiment.summaries(self, theta, xp)

    def starts(self) -> dict[str, Start]:
        starts = super().starts() | starts_of_motion(self, self.rough_decrement())
        if not self.gap_known:
            starts[f"G[{self.label}]"] = Start(self.gap, 0.5 * self.table.settings.gap.sd / self.gap)
        return starts


class CapsulePushes(CapsuleForward, DynamicFriction):
    """Pushes with the rod free on k1 and c: both masses start at speed v, and the capsule's final distance is recorded.

    Variances are those of the locked rod (first order in reading errors and scatter).
    """

    #: (n,) time at which each push is at rest, s.
    horizon: np.ndarray

    # A push with the capsule model depends on k1 and c too, so it is no friction test alone.
    checks = ()

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        DynamicFriction.__init__(self, table, rig, friction)
        self.smoothing = None
        self.horizon = SLIDES * 2.0 * self.distance / self.speed + REST
        self.about = About(table, rig, (parameter("k1"), parameter("c"), *self.parameters))

    def slide(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Any:
        """(n,) slide distance of the capsule, m."""
        still, v = xp.zeros(self.n), xp.asarray(self.speed)
        times = xp.stack([xp.zeros(self.n), xp.asarray(self.horizon)], axis=1)
        t = self.simulated(theta, self.parameters_of(theta, 0.0, FAR), OFF, times, (still, v, still, v))
        return xp.asarray(t.X2)[:, -1]

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        _, variance, change = self.locked_slide(theta)
        return (Misfit(self.distance - self.slide(theta, xp), variance, change, no_design(self.n, xp)),)
