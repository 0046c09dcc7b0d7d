"""Pushes: an initial speed and the distance slid, rod locked to the capsule (paper, section 2.2)."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.friction import (
    CAPTIONS,
    MASSES_OF_FREE,
    MESSAGES,
    SCATTER_OF_MU,
    FrictionExperiment,
    SurfaceSettings,
    check_scatter,
    friction_estimates,
    friction_panels,
    lint_slides,
    unit_law,
    weight_along,
)
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.experiments.lint import lint_reading_errors
from capsule_id.parameters import INSTRUMENT_ERRORS, scatter
from capsule_id.physics.batches import array_module
from capsule_id.physics.forces import FrictionLaw, normal_force, slide_distance
from capsule_id.records.tones import VISIBLE
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import ColumnRule, Entry
from capsule_id.rig.toml import POSITIVE
from capsule_id.views import Finding, Message

# lint: Findings on the readings of pushes: the distance grows with the speed.


#: Smallest power of the speed in the distance; constant friction gives 2, swapped columns 1/2.
SMALLEST_POWER = 1.0
#: Smallest ratio of the speeds, and fewest pushes, that show it.
SPEED_RATIO, FEWEST_PUSHES = 1.5, 3


def lint_pushes(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report distances that do not grow with the speed as those of a sliding body do."""
    speed, distance = np.log(table["speed"]), np.log(table["distance"])
    if len(speed) < FEWEST_PUSHES or np.ptp(speed) < np.log(SPEED_RATIO):
        return
    (power, _), covariance = np.polyfit(speed, distance, 1, cov=True)
    error = np.sqrt(covariance[0, 0])
    if power + VISIBLE * error < SMALLEST_POWER:
        facts = {"file": table.file, "power": float(power), "error": float(error)}
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
    "push_scatter", "1", "relative scatter of mu from push to push", r"s_\mathrm{push}", SCATTER_OF_MU
)
#: Pushes of the twin: speeds, m/s; reading errors, m/s and m; relative scatter of mu.
SPEEDS = np.array([0.15, 0.3, 0.5, 0.75, 1.0])
SPEED_SD, DISTANCE_SD, SURFACE_SCATTER = 5e-3, 0.3e-3, 0.015


@dataclass(frozen=True, kw_only=True)
class PushSettings(SurfaceSettings):
    """Settings of pushes; ``forward`` selects the closed form of a locked rod or the capsule model of a free rod."""

    forward: Literal["closed", "capsule"] = "closed"


def pushes(
    rng: np.random.Generator, mu: float, v_s: float, g: float, scatter: float = SURFACE_SCATTER
) -> dict[str, np.ndarray]:
    """Simulate a table of pushes at ``SPEEDS`` with their errors; ``scatter`` of mu is relative."""
    surface = mu * (1.0 + scatter * rng.standard_normal(len(SPEEDS)))
    distance = slide_distance(unit_law(1.0, v_s), 1.0 / g, SPEEDS) / surface
    return {
        "speed [m/s]": SPEEDS + SPEED_SD * rng.standard_normal(len(SPEEDS)),
        "distance [mm]": 1e3 * (distance + DISTANCE_SD * rng.standard_normal(len(SPEEDS))),
    }


def _measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    errors = (
        f'speed_sd = {{ value = {1e3 * SPEED_SD:g}, unit = "mm/s" }}',
        f'distance_sd = {{ value = {1e3 * DISTANCE_SD:g}, unit = "mm" }}',
    )
    return Twin(
        (
            TwinTable(
                "dynamic_friction.csv",
                pushes(rng, values["mu"], values["v_s"], values["g"], values.get("push_scatter", SURFACE_SCATTER)),
                errors,
            ),
        )
    )


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
    read_by=INSTRUMENT_ERRORS,
    test="push",
    minutes=0.5,
    set_by="speed",
    make=made_by(
        f"{__name__}:DynamicFriction",
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


# inclined: A capsule that slides along a slope: what brakes it, and the coefficient that a slide shows.


#: A slide downhill is braked by this share of its friction at least. It then lasts far beyond any reading.
LEAST_BRAKING = 1e-3


class Track(NamedTuple):
    """Normal force and weight along the slope, against the motion, per mass, m/s^2."""

    normal: Any
    along: Any

    def braking(self, friction: Any) -> Any:
        """Braking force over the normal force, 1: the coefficient of ``friction`` and the weight along the slope."""
        return array_module(friction).maximum(friction + self.along / self.normal, LEAST_BRAKING * friction)

    def distance(self, law: FrictionLaw, speed: Any, change: bool = False) -> Any:
        """Distance, m, of a slide from ``speed`` (n,), m/s, to rest; ``law`` is the friction coefficient.

        With ``change`` its change per relative change of mu, with the sign changed.
        """

        def forward(u: Any) -> Any:
            friction = law.forward(u)
            braking = self.braking(friction)
            return braking**2 / friction if change else braking

        braked: Any = SimpleNamespace(forward=forward)
        return slide_distance(braked, 1.0 / self.normal, speed)

    def coefficient(self, speed: Any, distance: Any) -> Any:
        """The paper's coefficient v^2/(2gd) of a slide, with the weight along the slope taken off, 1."""
        braking = speed**2 / (2.0 * self.normal * distance)
        return array_module(braking).maximum(braking - self.along / self.normal, LEAST_BRAKING * braking)


# experiment: Pushes: an initial speed and the distance slid, rod locked to the capsule (paper, section 2.2).


class DynamicFriction(FrictionExperiment):
    """Pushes with d = slide_distance(v).

    The paper uses mu_d = v^2/(2gd) as mu at speed v, but it is an average over the slide.
    The variance of d has three terms: its reading error, that of v through dd/dv = v/(g mu_d(v)), and the scatter of
    mu from push to push. The last one is first order (d is proportional to 1/mu).
    """

    role, reading, scatter = "dynamic", "distance", PUSH_SCATTER

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2") if "N0" in self.ground else super().masses

    def track(self, theta: ValuesBySymbol) -> Track:
        """Normal force and weight along the slope at ``theta``."""
        ground, mass = self.ground_at(theta), theta["m1"] + theta["m2"] if "N0" in self.ground else 1.0
        normal = normal_force(mass, 0.0, theta["g"], **ground) / mass
        return Track(normal, weight_along(1.0, theta["g"], ground, self.backward))

    def coefficient(self, theta: ValuesBySymbol) -> FrictionLaw:
        """The friction coefficient at ``theta``."""
        return self.friction.coefficient({**theta, **self.ground_at(theta)})

    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        return self.track(theta).distance(self.coefficient(theta), x["speed"])

    def slopes(self, theta: ValuesBySymbol) -> Mapping[str, Any]:
        """In closed form: NumPy residuals then need no compiled program."""
        track, speed = self.track(theta), self.true("speed", self.readings["speed"], theta)
        braking = track.normal * track.braking(self.coefficient(theta).forward(speed))
        return {"speed": self.as_read(speed / braking, "speed", theta)}

    def change(self, theta: ValuesBySymbol) -> Any:
        return self.track(theta).distance(self.coefficient(theta), self.readings["speed"], change=True)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points by the paper's formula: mu = v^2/(2gd) at the initial speed."""
        speed = self.readings["speed"]
        return speed, self.track(self.stated).coefficient(speed, self.observed)

    def paper_coefficient(self, law: FrictionLaw, speed: np.ndarray) -> Any:
        track = self.track(self.stated)
        return track.coefficient(speed, track.distance(law, speed))

    def point_errors(self) -> tuple[np.ndarray, float]:
        speed, mu = self.paper_points()
        relative = np.hypot(self.sds["distance"] / self.observed, 2.0 * self.sds["speed"] / speed)
        # The reading shows friction and the weight along the slope together.
        track = self.track(self.stated)
        return relative * (1.0 + track.along / (track.normal * mu)), 1.0
