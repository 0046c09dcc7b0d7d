"""Tilt to slide: mu is the tangent of the angle at which the capsule breaks away (paper, section 2.2)."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.families.friction_experiment import (
    FrictionExperiment,
    LoadedExperiment,
    stated_normal_forces,
)
from capsule_id.experiments.families.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.families.inclined import ground_of, ground_parameters
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.experiments.static_friction.declaration import PULL_SCATTER, TILT_SD
from capsule_id.physics.friction import CoulombStribeck, normal_force
from capsule_id.rig.model import Rig, Table


class StaticFriction(FrictionExperiment):
    """Trials of one surface: angle_i = arctan(mu_0) + N(0, tilt_sd^2 + reading error^2).

    mu_0 is the coefficient at break-away. A capsule that slides down counts as one that slides forward.

    Where height and length are recorded instead of the angle, ``length_is`` selects the side of the triangle. This is
    the tilted board (sin = height/length) or the base (tan = height/length).
    """

    angle: np.ndarray
    #: () where it is the same for all trials, else (n,)
    reading_sd: np.ndarray
    mean: float
    squares: float

    role = "static"

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.friction = friction = replace(friction, direction=table.settings.direction)
        self.ground = {}
        self.about = About(table, rig, (*friction.parameters_at_rest, TILT_SD))
        self.angle, self.reading_sd = _angles(table)
        self.mean, self.squares = float(np.mean(self.angle)), float(np.sum((self.angle - np.mean(self.angle)) ** 2))

    @classmethod
    def make(cls, table: Table, rig: Rig, friction: FrictionModel) -> tuple[FrictionExperiment, ...]:
        return (StaticPulls(table, rig, friction) if "force" in table.columns else cls(table, rig, friction),)

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

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        """Mean and sum of squares are sufficient where all trials have one reading error."""
        if np.ndim(self.reading_sd):
            return super().summaries(theta, xp)
        angle = xp.arctan(self.friction.coefficient(theta).forward(0.0))
        yy = self.squares + self.n * (self.mean - angle) ** 2
        return (Moments(yy, xp.zeros(0), xp.zeros((0, 0)), self.n, self.reading_sd**2),)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points by the paper's formula: mu = tan(angle) at speed 0."""
        return np.zeros(self.n), np.tan(self.angle)

    def point_errors(self) -> tuple[np.ndarray, np.ndarray]:
        per_angle = 2.0 / np.sin(2.0 * self.angle)
        return self.reading_sd * per_angle, per_angle

    def starts(self) -> dict[str, Start]:
        scatter = np.std(self.angle, ddof=1) if self.n > 1 else 0.0
        mu = Start(float(np.mean(np.tan(self.angle))), 0.3)
        return {
            "mu": mu,
            "mu_back": mu,
            "tilt_sd": Start(max(scatter, np.deg2rad(0.1)), 0.3),
        }


class StaticPulls(LoadedExperiment):
    """Pulls along the track: force_i = mu_0 N (1 + N(0, pull_scatter^2)) + (m1 + m2) g sin(slope) + reading error.

    N is stated for all trials or for each, or follows from weight, slope and N0. The weight along the slope is negative
    for a pull downhill, and that of weights is N tan(slope). The reading error of N counts too.
    """

    force: np.ndarray
    reading_sd: float

    role = "static"

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.friction = friction = replace(friction, direction=table.settings.direction)
        self.ground = ground_of(table)
        self.about = About(table, rig, (*friction.parameters_at_rest, PULL_SCATTER, *ground_parameters(table, rig)))
        self.force, self.reading_sd = table["force"], table.columns["force"].reading_sd
        self.normal_force, self.normal_force_sd = stated_normal_forces(table)
        self.of_weights = table.settings.load_is == "weight"
        if table.settings.normal_force is not None:
            self.normal_force = np.asarray(table.settings.normal_force)
        self.refuse_weight_along(self.force)

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2") if self.weighed or self.friction.law is not CoulombStribeck else ()

    @property
    def scatters(self) -> tuple[str]:
        return ("pull_scatter",)

    @property
    def observed(self) -> np.ndarray:
        return self.force

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        normal: Any = self.normal_force
        if normal is None:
            normal = normal_force(theta["m1"], theta["m2"], theta["g"], **self.ground_at(theta))
        coefficient: Any = self.friction.coefficient(theta).forward(0.0)
        friction = normal * coefficient
        along = self.along(theta)
        variance = self.reading_sd**2 + (self.of_normal_force(coefficient, along) * self.normal_force_sd) ** 2
        return (Misfit(self.force - friction - along, variance, friction, no_design(self.n, xp)),)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points by the paper's formula: mu = force/N at speed 0, without the weight along the slope."""
        normal = self.stated_normal_force if self.normal_force is None else self.normal_force
        return np.zeros(self.n), (self.force - self.stated_along) / normal

    def point_errors(self) -> tuple[np.ndarray, float]:
        return self.relative_errors(self.force, self.reading_sd), 1.0

    def starts(self) -> dict[str, Start]:
        # Pulls have no speed that could start v_s.
        rough = {name: start for name, start in self.rough_starts().items() if name != "v_s"}
        return {**rough, "pull_scatter": Start(0.02, 0.3)}


def _angles(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Angle, (n,) rad, and its reading error, () or (n,) rad."""
    if "angle" in table.columns:
        angle = table.columns["angle"]
        return angle.values, np.asarray(angle.reading_sd)
    height, length = table.columns["height"], table.columns["length"]
    ratio = height.values / length.values
    ratio_sd = ratio * np.hypot(height.reading_sd / height.values, length.reading_sd / length.values)
    if table.settings.length_is == "board":
        return np.arcsin(ratio), ratio_sd / np.sqrt(1.0 - ratio**2)
    return np.arctan(ratio), ratio_sd / (1.0 + ratio**2)
