"""A capsule that slides along a slope: what brakes it, and the coefficient that a slide shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.parameters import Parameter
from capsule_id.physics.batches import array_module
from capsule_id.physics.friction import FrictionLaw, normal_force, slide_distance

#: A slide downhill is braked by this share of its friction at least. It then lasts far beyond any reading.
LEAST_BRAKING = 1e-3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Braking:
    """Friction and the weight along the slope, per normal force, 1."""

    law: FrictionLaw
    along: Any

    parameters: ClassVar[tuple[Parameter, ...]] = ()

    def forward(self, speed: Any) -> Any:
        """What brakes the recorded slide."""
        friction = self.law.forward(speed)
        return array_module(friction).maximum(friction + self.along, LEAST_BRAKING * friction)

    def backward(self, speed: Any) -> Any:
        """As ``forward``: a slide has one direction."""
        return self.forward(speed)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Sensitivity(Braking):
    """Resistance whose slide distance is the relative change of that of ``Braking`` with mu, with the sign changed."""

    def forward(self, speed: Any) -> Any:
        return super().forward(speed) ** 2 / self.law.forward(speed)


class Track(NamedTuple):
    """Normal force and weight along the slope, against the motion, per mass, m/s^2; None: level ground."""

    normal: Any
    along: Any

    def braking(self, law: FrictionLaw) -> FrictionLaw:
        """What brakes a slide with the friction coefficient ``law``, per normal force, 1."""
        return law if self.along is None else Braking(law, self.along / self.normal)

    def distance(self, law: FrictionLaw, speed: Any) -> Any:
        """Distance, m, of a slide from ``speed`` (n,), m/s, to rest; ``law`` is the friction coefficient."""
        return slide_distance(self.braking(law), 1.0 / self.normal, speed)

    def change(self, law: FrictionLaw, speed: Any) -> Any:
        """Change of ``distance`` per relative change of mu, m, with the sign changed."""
        if self.along is None:
            return self.distance(law, speed)
        return slide_distance(_Sensitivity(law, self.along / self.normal), 1.0 / self.normal, speed)

    def coefficient(self, speed: Any, distance: Any) -> Any:
        """The paper's coefficient v^2/(2gd) of a slide, with the weight along the slope taken off, 1."""
        braking = speed**2 / (2.0 * self.normal * distance)
        if self.along is None:
            return braking
        return array_module(braking).maximum(braking - self.along / self.normal, LEAST_BRAKING * braking)


def track_of(theta: ValuesBySymbol, ground: Mapping[str, Any], backward: bool) -> Track:
    """The track of a slide; theta has g and, where ``ground`` has N0, m1 and m2."""
    g = theta["g"]
    if not ground:
        return Track(g, None)
    mass = theta["m1"] + theta["m2"] if "N0" in ground else 1.0
    normal = normal_force(mass, 0.0, g, ground.get("slope"), ground.get("N0")) / mass
    return Track(normal, weight_along(1.0, g, ground, backward) if "slope" in ground else None)


def weight_along(mass: Any, g: Any, ground: Mapping[str, Any], backward: bool) -> Any:
    """Weight of ``mass`` along the slope, N, positive where it opposes the motion; "backward" runs downhill."""
    if "slope" not in ground:
        return 0.0
    uphill = mass * g * array_module(ground["slope"]).sin(ground["slope"])
    return -uphill if backward else uphill
