"""Pushes: columns, settings, template and twin."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from capsule_id.experiments.dynamic_friction.lint import MESSAGES as LINT_MESSAGES
from capsule_id.experiments.dynamic_friction.lint import lint_pushes
from capsule_id.experiments.families.friction import (
    CAPTIONS,
    MASSES_OF_FREE,
    MESSAGES,
    SurfaceSettings,
    check_scatter,
    friction_estimates,
    friction_panels,
    lint_slides,
)
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.experiments.lint import lint_reading_errors
from capsule_id.parameters import Prior, scatter
from capsule_id.rig.domains import POSITIVE
from capsule_id.rig.entry import Entry
from capsule_id.rig.schema import ColumnRule

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
    from capsule_id.experiments.families.friction_experiment import unit_law
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
        "capsule_id.experiments.dynamic_friction.experiment:DynamicFriction",
        capsule="capsule_id.experiments.families.capsule_bench:CapsulePushes",
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
