"""Steady sliding: friction force, or coefficient, at a held speed."""

from dataclasses import replace
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.families.friction_experiment import LoadedExperiment, stated_normal_forces
from capsule_id.experiments.families.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.families.inclined import ground_of, ground_parameters
from capsule_id.experiments.misfit import Misfit
from capsule_id.experiments.sliding_friction.declaration import SLIDING_SCATTER
from capsule_id.physics.friction import FrictionLaw
from capsule_id.rig.model import Rig, Table


class SlidingFriction(LoadedExperiment):
    """Steady sliding, y = mu_d(v) for a coefficient. A force is N mu_d(v) and the weight along the slope.

    N is that of the weight, or stated for every row. Without a speed the friction must not depend on it.

    The variance has reading errors of y, of v (through the slope of the friction law) and of N (through the
    coefficient), and relative scatter of mu.
    """

    speed: np.ndarray
    values: np.ndarray
    speed_sd: float
    values_sd: float
    quantity: str = eqx.field(static=True)

    role = "sliding"

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.friction = friction = replace(friction, direction=table.settings.direction)
        self.about = About(table, rig, (*friction.parameters, SLIDING_SCATTER, *ground_parameters(table, rig)))
        self.ground = ground_of(table)
        self.quantity = "force" if "force" in table.columns else "coefficient"
        self.values = table[self.quantity]
        self.speed = table["speed"] if self.speeds_known else np.zeros(len(self.values))
        self.speed_sd = table.columns["speed"].reading_sd if self.speeds_known else 0.0
        self.normal_force, self.normal_force_sd = stated_normal_forces(table)
        self.of_weights = table.settings.load_is == "weight"
        self.values_sd = table.columns[self.quantity].reading_sd
        if self.quantity == "force":
            self.refuse_weight_along(self.values)

    @property
    def speeds_known(self) -> bool:
        return "speed" in self.table.columns

    @property
    def scatters(self) -> tuple[str]:
        return ("sliding_scatter",)

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2") if self.quantity == "force" and self.weighed else super().masses

    @property
    def observed(self) -> np.ndarray:
        return self.values

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        theta = {**theta, **self.ground_at(theta)}
        of_weight = self.quantity == "force" and self.normal_force is None
        law = self.friction.force(theta) if of_weight else self.friction.coefficient(theta)
        normal = 1.0 if self.normal_force is None else self.normal_force
        value, slope = (xp.asarray(values) for values in _value_and_slope(law, self.speed))
        predicted = normal * value
        along = self.along(theta) if self.quantity == "force" else 0.0
        of_normal = self.of_normal_force(value, along) * self.normal_force_sd
        variance = self.values_sd**2 + (normal * slope * self.speed_sd) ** 2 + of_normal**2
        raw = self.values - predicted - along
        return (Misfit(raw, variance, predicted, no_design(self.n, xp)),)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured points (speed, coefficient)."""
        if self.quantity == "coefficient":
            return self.speed, self.values
        normal = self.stated_normal_force if self.normal_force is None else self.normal_force
        return self.speed, (self.values - self.stated_along) / normal

    def point_errors(self) -> tuple[np.ndarray, float]:
        """The reading error of the speed is left out: it enters through the slope of the law."""
        if self.quantity == "coefficient":
            return self.values_sd / self.values, 1.0
        return self.relative_errors(self.values, self.values_sd), 1.0

    def starts(self) -> dict[str, Start]:
        return {**self.rough_starts(), "sliding_scatter": Start(0.02, 0.3)}


@jax.jit
def _value_and_slope(law: FrictionLaw, speed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Resistance and its derivative with respect to the speed, (n,) each."""
    return jax.jvp(law.forward, (speed,), (jnp.ones_like(speed),))
