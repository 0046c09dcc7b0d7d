"""Tilt to slide: mu is the tangent of the angle at which the capsule breaks away (paper, section 2.2)."""

from types import ModuleType

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.families.friction_experiment import FrictionExperiment
from capsule_id.experiments.families.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.misfit import Misfit
from capsule_id.experiments.static_friction.declaration import TILT_SD
from capsule_id.physics.friction import CoulombStribeck
from capsule_id.rig.model import Rig, Table


class StaticFriction(FrictionExperiment):
    """Trials of one surface: angle_i = arctan(mu_0) + N(0, tilt_sd^2 + reading error^2).

    mu_0 is the coefficient at break-away. A capsule that slides down counts as one that slides forward.

    Where height and length are recorded instead of the angle, ``length_is`` selects the side of the triangle. This is
    the tilted board (sin = height/length) or the base (tan = height/length).
    """

    angle: np.ndarray
    reading_sd: np.ndarray

    role = "static"

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.friction = friction
        self.about = About(table, rig, (*friction.parameters_at_rest, TILT_SD))
        self.angle, self.reading_sd = _angles(table)

    @property
    def masses(self) -> tuple[str, ...]:
        """None for eq. (1): its break-away coefficient is mu."""
        return () if self.friction.law is CoulombStribeck else self.friction.masses

    @property
    def scatters(self) -> tuple[str]:
        return ("tilt_sd",)

    @property
    def observed(self) -> np.ndarray:
        return self.angle

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        angle = xp.arctan(self.friction.coefficient(theta).forward(0.0))
        return (Misfit(self.angle - angle, self.reading_sd**2, 1.0, no_design(self.n, xp)),)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points by the paper's formula: mu = tan(angle) at speed 0."""
        return np.zeros(self.n), np.tan(self.angle)

    def point_errors(self) -> tuple[np.ndarray, np.ndarray]:
        per_angle = 2.0 / np.sin(2.0 * self.angle)
        return self.reading_sd * per_angle, per_angle

    def starts(self) -> dict[str, Start]:
        scatter = np.std(self.angle, ddof=1) if self.n > 1 else 0.0
        return {
            "mu": Start(float(np.mean(np.tan(self.angle))), 0.3),
            "tilt_sd": Start(max(scatter, np.deg2rad(0.1)), 0.3),
        }


def _angles(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Angle and its reading error, (n,) rad each."""
    if "angle" in table.columns:
        angle = table.columns["angle"]
        return angle.values, np.full(len(angle.values), angle.reading_sd)
    height, length = table.columns["height"], table.columns["length"]
    ratio = height.values / length.values
    ratio_sd = ratio * np.hypot(height.reading_sd / height.values, length.reading_sd / length.values)
    if table.settings.length_is == "board":
        return np.arcsin(ratio), ratio_sd / np.sqrt(1.0 - ratio**2)
    return np.arctan(ratio), ratio_sd / (1.0 + ratio**2)
