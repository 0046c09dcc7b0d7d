"""A capsule that slides along a slope: what brakes it, and the coefficient that a slide shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.families.friction import has_stated_load
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.physics.batches import array_module
from capsule_id.physics.friction import FrictionLaw, normal_force, slide_distance
from capsule_id.rig.model import Quantity, Rig, Table

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


def _acting_ground(table: Table[Any]) -> dict[str, Quantity]:
    """Stated slope and N0 that act on the readings."""
    held = has_stated_load(table)
    return {name: stated for name, stated in table.settings.ground.items() if name != "N0" or not held}


def ground_of(table: Table[Any]) -> dict[str, float | None]:
    """Slope, rad, and N0, N, where they differ from level ground and the weight alone; None: sampled, with its sd."""
    return {name: None if stated.sd else stated.value for name, stated in _acting_ground(table).items()}


def ground_parameters(table: Table[Any], rig: Rig) -> tuple[Parameter, ...]:
    """Parameters for slope and N0 where an sd is stated, with a normal prior.

    Equal statements of several experiments are one quantity; that of [rig] has no bracket.
    """
    rows = []
    for name, stated in _acting_ground(table).items():
        if stated.sd:
            same = (other.label for other in rig.tables if getattr(other.settings, name, None) == stated)
            of = "" if stated == getattr(rig, name) else next(same, table.label)
            rows.append(parameter(name, of, Prior("normal", stated.value, stated.sd)))
    return tuple(rows)


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
