"""Pushes: an initial speed and the distance slid, rod locked to the capsule (paper, section 2.2)."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.friction import (
    CAPTIONS,
    MASSES_OF_FREE,
    MESSAGES,
    SurfaceSettings,
    Track,
    check_scatter,
    friction_estimates,
    friction_panels,
    ground_of,
    ground_parameters,
    lint_slides,
    track_of,
)
from capsule_id.experiments.friction_experiment import FrictionExperiment
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.experiments.lint import lint_reading_errors
from capsule_id.experiments.misfit import Misfit
from capsule_id.parameters import Prior, scatter
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import ColumnRule
from capsule_id.rig.tables import Entry
from capsule_id.rig.toml import POSITIVE
from capsule_id.views import Finding, Message

# lint: Findings on the readings of pushes: the distance grows with the speed.


#: Smallest power of the speed in the distance; constant friction gives 2, swapped columns 1/2.
SMALLEST_POWER = 1.0
#: Standard errors by which the power must lie below; smallest ratio of the speeds, and fewest pushes, that show it.
STANDARD_ERRORS, SPEED_RATIO, FEWEST_PUSHES = 3.0, 1.5, 3


def lint_pushes(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report distances that do not grow with the speed as those of a sliding body do."""
    del rig
    speed, distance = np.log(table["speed"]), np.log(table["distance"])
    if len(speed) < FEWEST_PUSHES or np.ptp(speed) < np.log(SPEED_RATIO):
        return
    centred = speed - np.mean(speed)
    power = float(centred @ distance / (centred @ centred))
    rest = distance - np.mean(distance) - power * centred
    error = float(np.sqrt(rest @ rest / (len(speed) - 2) / (centred @ centred)))
    if power + STANDARD_ERRORS * error < SMALLEST_POWER:
        facts = {"file": table.file, "power": power, "error": error}
        yield Finding("pushes.power", "fail", facts, table.label)


LINT_MESSAGES = {
    "pushes.power": Message(
        "columns of pushes",
        fail=(
            "{file}: the distance of a push grows about as the square of its speed; found the power {power:.2g} ± "
            "{error:.1g}. Check that speed and distance are not swapped."
        ),
    )
}


# declaration: Pushes: columns, settings, template and twin.


PUSH_SCATTER = scatter(
    "push_scatter", "1", "relative scatter of mu from push to push", r"s_\mathrm{push}", Prior("halfnormal", 0.0, 0.05)
)
#: Pushes of the twin: speeds, m/s; reading errors, m/s and m; relative scatter of mu.
SPEEDS = np.array([0.15, 0.3, 0.5, 0.75, 1.0])
SPEED_SD, DISTANCE_SD, SURFACE_SCATTER = 5e-3, 0.3e-3, 0.015


@dataclass(frozen=True, kw_only=True)
class PushSettings(SurfaceSettings):
    """Settings of pushes; ``forward`` selects the closed form of a locked rod or the capsule model of a free rod."""

    forward: Literal["closed", "capsule"] = "closed"


def pushes(
    rng: np.random.Generator,
    mu: float,
    v_s: float,
    g: float,
    speeds: np.ndarray = SPEEDS,
    speed_sd: float = SPEED_SD,
    distance_sd: float = DISTANCE_SD,
    surface_scatter: float = SURFACE_SCATTER,
) -> dict[str, np.ndarray]:
    """Simulate a table of pushes at ``speeds`` (n,) m/s with errors ``speed_sd`` m/s and ``distance_sd`` m.

    The surface's mu scatters by ``surface_scatter`` (relative) from push to push. Each argument is one quantity of the
    protocol, so there are more than six.
    """
    from capsule_id.experiments.friction_experiment import unit_law
    from capsule_id.physics.friction import slide_distance

    surface = mu * (1.0 + surface_scatter * rng.standard_normal(len(speeds)))
    distance = slide_distance(unit_law(1.0, v_s), 1.0 / g, speeds) / surface
    return {
        "speed [m/s]": speeds + speed_sd * rng.standard_normal(len(speeds)),
        "distance [mm]": 1e3 * (distance + distance_sd * rng.standard_normal(len(speeds))),
    }


def _measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    del seed
    errors = (
        f'speed_sd = {{ value = {1e3 * SPEED_SD:g}, unit = "mm/s" }}',
        f'distance_sd = {{ value = {1e3 * DISTANCE_SD:g}, unit = "mm" }}',
    )
    return Twin((TwinTable("dynamic_friction.csv", pushes(rng, values["mu"], values["v_s"], values["g"]), errors),))


def _check_ground(entry: Entry[PushSettings]) -> None:
    """Refuse a slope for the capsule model of a free rod."""
    if entry.table.settings.forward == "capsule":
        entry.refuse_ground("slope", 'pushes with forward = "capsule" must be on level ground')


TEMPLATE = """\
#: Pushes, a row each, the rod locked to the capsule: mu and v_s. Columns: speed [m/s], distance [mm].
# [[experiment]]
# kind = "dynamic_friction"
# file = "dynamic_friction.csv"
# speed_sd = { value = 5, unit = "mm/s" }
# distance_sd = { value = 0.3, unit = "mm" }
# forward = "closed"                                  # "capsule": the rod was free and vibrates
# direction = "forward"                               # "backward": pushed away from the support spring
# slope = { value = 0, unit = "deg" }                   # this one alone; default: [rig]
# N0 = { value = 0, unit = "N" }
"""

KIND = Kind(
    name="dynamic_friction",
    columns={"speed": ColumnRule("m/s", POSITIVE), "distance": ColumnRule("m", POSITIVE)},
    sets=(("speed", "distance"),),
    settings=PushSettings,
    masses=lambda table: ("m1", "m2") if table.settings.forward == "capsule" or "N0" in table.settings.ground else (),
    rules=(_check_ground,),
    masses_of_free=MASSES_OF_FREE,
    parameters=(PUSH_SCATTER,),
    make=made_by(
        "capsule_id.experiments.dynamic_friction:DynamicFriction",
        capsule="capsule_id.experiments.capsule_experiment:CapsulePushes",
    ),
    template=TEMPLATE,
    informs="mu, v_s",
    captions=CAPTIONS,
    messages={**MESSAGES, **LINT_MESSAGES},
    lint=(lint_slides, lint_reading_errors, lint_pushes),
    check=check_scatter,
    paper=friction_estimates,
    panels=friction_panels,
    twin=_measure,
)


# experiment: Pushes: an initial speed and the distance slid, rod locked to the capsule (paper, section 2.2).


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
