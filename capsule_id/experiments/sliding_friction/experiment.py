"""Steady sliding: friction force, or coefficient, at a held speed, on eq. (1)."""

from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.friction_curve import FrictionExperiment, unit_law
from capsule_id.experiments.misfit import Misfit
from capsule_id.experiments.sliding_friction.declaration import SLIDING_SCATTER
from capsule_id.parameters import parameter
from capsule_id.physics.friction import normal_force
from capsule_id.rig.model import Rig, Table


class SlidingFriction(FrictionExperiment):
    """y = w mu_d(v), w = (m1 + m2) g for a force and 1 for a coefficient.

    Variance: reading errors of y and of v (through the slope of eq. (1)) and the relative scatter of mu.
    """

    speed: np.ndarray
    values: np.ndarray
    speed_sd: float
    values_sd: float
    quantity: str = eqx.field(static=True)

    role = "sliding"

    def __init__(self, table: Table, rig: Rig) -> None:
        self.about = About(table, rig, (parameter("mu"), parameter("v_s"), SLIDING_SCATTER))
        self.quantity = "force" if "force" in table.columns else "coefficient"
        self.speed, self.values = table["speed"], table[self.quantity]
        self.speed_sd = table.columns["speed"].reading_sd
        self.values_sd = table.columns[self.quantity].reading_sd

    @property
    def scatters(self) -> tuple[str]:
        return ("sliding_scatter",)

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2") if self.quantity == "force" else ()

    @property
    def observed(self) -> np.ndarray:
        return self.values

    def _weight(self, theta: ValuesBySymbol) -> Any:
        return normal_force(theta["m1"], theta["m2"], theta["g"]) if self.quantity == "force" else 1.0

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        mu, v_s, weight = theta["mu"], theta["v_s"], self._weight(theta)
        predicted = weight * unit_law(mu, v_s).forward(self.speed)
        slope = -0.5 * weight * mu * xp.exp(-self.speed / v_s) / v_s
        variance = self.values_sd**2 + (slope * self.speed_sd) ** 2
        return (Misfit(self.values - predicted, variance, predicted, no_design(self.n, xp)),)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Steady sliding is read as measured."""
        if self.quantity == "coefficient":
            return self.speed, self.values
        m1, m2 = self.rig.m1, self.rig.m2
        assert m1 is not None, "the schema asks for both masses beside a sliding force"
        assert m2 is not None, "the schema asks for both masses beside a sliding force"
        return self.speed, self.values / normal_force(m1.value, m2.value, self.rig.g.value)

    def starts(self) -> dict[str, Start]:
        speed, coefficient = self.paper_points()
        return {
            "mu": Start(float(np.max(coefficient)), 0.3),
            "v_s": Start(float(np.median(speed)), 0.5),
            "sliding_scatter": Start(0.02, 0.3),
        }
