"""Pushes: an initial speed and the distance slid, rod locked to the capsule (paper, section 2.2)."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.dynamic_friction.declaration import PUSH_SCATTER
from capsule_id.experiments.families.friction_experiment import FrictionExperiment
from capsule_id.experiments.families.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.families.inclined import Track, ground_of, ground_parameters, track_of
from capsule_id.experiments.misfit import Misfit
from capsule_id.rig.model import Rig, Table


class DynamicFriction(FrictionExperiment):
    """Pushes with d = slide_distance(v).

    The paper uses mu_d = v^2/(2gd) as mu at speed v, but it is an average over the slide.
    The variance of d has three terms: its reading error, that of v through dd/dv = v/(g mu_d(v)), and the scatter of
    mu from push to push. The last one is first order (d is proportional to 1/mu).
    """

    speed: np.ndarray
    distance: np.ndarray
    speed_sd: float
    distance_sd: float

    role = "dynamic"

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.friction = friction = replace(friction, direction=table.settings.direction)
        self.about = About(table, rig, (*friction.parameters, PUSH_SCATTER, *ground_parameters(table, rig)))
        self.ground = ground_of(table)
        self.speed, self.distance = table["speed"], table["distance"]
        self.speed_sd = table.columns["speed"].reading_sd
        self.distance_sd = table.columns["distance"].reading_sd

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2") if "N0" in self.ground else super().masses

    @property
    def scatters(self) -> tuple[str]:
        return ("push_scatter",)

    @property
    def observed(self) -> np.ndarray:
        return self.distance

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        distance, variance, change = self.locked_slide(theta)
        return (Misfit(self.distance - distance, variance, change, no_design(self.n, xp)),)

    def track(self, theta: ValuesBySymbol) -> Track:
        """Normal force and weight along the slope at ``theta``."""
        return track_of(theta, self.ground_at(theta), self.backward)

    def locked_slide(self, theta: ValuesBySymbol) -> tuple[Any, Any, Any]:
        """Slide with the rod locked: distance, m, its variance from reading errors, m^2, its change with mu, m; (n,)."""
        law, track = self.friction.coefficient({**theta, **self.ground_at(theta)}), self.track(theta)
        slope = self.speed / (track.normal * track.braking(law).forward(self.speed))
        variance = self.distance_sd**2 + (slope * self.speed_sd) ** 2
        return track.distance(law, self.speed), variance, track.change(law, self.speed)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points by the paper's formula: mu = v^2/(2gd) at the initial speed."""
        return self.speed, self.stated_track.coefficient(self.speed, self.distance)

    @property
    def stated_track(self) -> Track:
        """``track`` at the stated values."""
        stated = {name: self.rig.mass(name) for name in ("m1", "m2")} if "N0" in self.ground else {}
        return self.track({**stated, **self.stated_ground, "g": self.rig.g.value})

    def point_errors(self) -> tuple[np.ndarray, float]:
        relative = np.hypot(self.distance_sd / self.distance, 2.0 * self.speed_sd / self.speed)
        # The reading shows friction and the weight along the slope together.
        track, mu = self.stated_track, self.paper_points()[1]
        return relative * (1.0 if track.along is None else 1.0 + track.along / (track.normal * mu)), 1.0

    def starts(self) -> dict[str, Start]:
        return {**self.rough_starts(), "push_scatter": Start(0.02, 0.3)}
