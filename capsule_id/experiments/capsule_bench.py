"""Bench tests with the capsule model as their forward model (``forward = "capsule"`` in rig.toml).

The closed forms hold where the capsule stays at rest, and where the rod is locked to it. A rod released from farther
away than F_b/k1 moves its capsule; a rod that is not locked rings on k1 and c while the capsule slides. There the closed
form is biased and the capsule model, the one of the forced runs with the drive off, is not.
"""

from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import Start, Theta, no_design
from capsule_id.experiments.dynamic_friction.experiment import DynamicFriction
from capsule_id.experiments.forward import CapsuleForward
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.friction_curve import unit_law
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.physics.friction import slide_distance
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.views import Finding

#: No drive: its frequency means nothing then.
OFF = Excitation(0.0, 1.0)
#: A push is followed for this many times the slide that its distance stands for, and then until the rod has come to rest:
#: a surface this much slipperier than the readings say is far outside the posterior.
SLIDES, REST = 6.0, 0.5
#: Spring out of reach, m.
FAR = 1e3


class CapsuleDecay(CapsuleForward, FreeVibration):
    """x_rel(t) of a rod released at the first sample, drive off, the capsule at rest there and free to slip.

    Start of the motion and offset are the record's own; with ``spring`` and ``gap`` the rod may hit the support spring.
    """

    model_name = "capsule model"  # pyright: ignore[reportAssignmentType, reportIncompatibleVariableOverride]
    masses = ("m1", "m2")
    ARRAYS = ("time", "values", "width", "reading_sd", "gap", "smoothing")
    STATIC = ("model", "within_reach", "gap_known")

    def __init__(self, table: Table, rig: Rig) -> None:
        super().__init__(table, rig)
        gap = table.settings.get("gap")
        self.within_reach = isinstance(gap, Quantity)
        self.gap, self.gap_sd = (gap.value, gap.sd) if isinstance(gap, Quantity) else (FAR, 0.0)
        self.gap_known = self.gap_sd == 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        of, scale = self.label, float(np.ptp(self.values))
        rows = [parameter(symbol) for symbol in ("k1", "c", "mu", "v_s")]
        if self.within_reach:
            rows.append(parameter("k2", str(self.table.settings["spring"])))
        if not self.gap_known:
            rows.append(parameter("G", of, Prior("positive_normal", self.gap, self.gap_sd)))
        rows.append(parameter("x_start", of, Prior("normal", 0.0, self.width)))
        rows.append(parameter("y_start", of, Prior("normal", 0.0, self.width * self._rough.Omega_o)))
        return (*rows, parameter("noise_sd", of, self.noise_prior(scale)))

    def motion_of(self, theta: Theta) -> Any:
        """(n,) x_rel of the model."""
        p = _capsule(theta, theta.get("k2", 0.0), self.gap if self.gap_known else theta["G"])
        initial = (theta["x_start"], theta["y_start"], 0.0, 0.0)
        t = self.simulated(p, OFF, self.time, initial)
        return t.X1 - t.X2

    def misfits(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit]:
        raw = self.values - xp.asarray(self.motion_of(theta))
        return (Misfit(raw, self.reading_sd**2, 1.0, self.width * xp.ones((len(self.time), 1))),)

    def summaries(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        return tuple(misfit.summary() for misfit in self.misfits(theta, xp))

    def starts(self) -> dict[str, Start]:
        starts = super().starts() | self.starts_of_motion()
        if not self.gap_known:
            starts[f"G[{self.label}]"] = Start(self.gap, 0.5 * self.gap_sd / self.gap)
        return starts

    def lint(self, theta: Theta) -> list[Finding]:
        """A slip and a hit are in the model."""
        del theta
        return []


class CapsulePushes(CapsuleForward, DynamicFriction):
    """Pushes with the rod free on k1 and c: both masses start at speed v; the distance is the capsule's, once at rest.

    Variances are those of the locked rod (first order in reading errors and scatter).
    """

    masses = ("m1", "m2")
    ARRAYS = ("speed", "distance", "speed_sd", "distance_sd", "horizon", "smoothing")
    STATIC = ("model",)

    def __init__(self, table: Table, rig: Rig) -> None:
        super().__init__(table, rig)
        #: (n,) s at which every push has come to rest.
        self.horizon = SLIDES * 2.0 * self.distance / self.speed + REST

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*(parameter(symbol) for symbol in ("k1", "c", "mu", "v_s")), parameter("push_scatter"))

    def slide(self, theta: Theta, xp: ModuleType = jnp) -> Any:
        """(n,) m that the capsule goes."""
        still, v = xp.zeros(self.n), xp.asarray(self.speed)
        times = xp.stack([xp.zeros(self.n), xp.asarray(self.horizon)], axis=1)
        t = self.simulated(_capsule(theta, 0.0, FAR), OFF, times, (still, v, still, v))
        return xp.asarray(t.X2)[:, -1]

    def misfits(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit]:
        law, g = unit_law(theta["mu"], theta["v_s"]), theta["g"]
        locked = slide_distance(law, 1.0 / g, self.speed)
        slope = self.speed / (g * law.forward(self.speed))
        variance = self.distance_sd**2 + (slope * self.speed_sd) ** 2
        return (Misfit(self.distance - self.slide(theta, xp), variance, locked, no_design(self.n, xp)),)


def _capsule(theta: Theta, k2: Any, gap: Any) -> CapsuleParameters:
    return CapsuleParameters(G=gap, k2=k2, **{name: theta[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s", "g")})
