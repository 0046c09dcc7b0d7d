"""Tilts until the capsule slips: columns, settings, rules, template and twin."""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from capsule_id.experiments.families.friction import (
    CAPTIONS,
    MESSAGES,
    check_scatter,
    friction_estimates,
    friction_panels,
)
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.experiments.lint import lint_rows
from capsule_id.parameters import Prior, scatter
from capsule_id.rig.domains import POSITIVE, SLOPE_ANGLE
from capsule_id.rig.entry import Entry
from capsule_id.rig.model import Settings
from capsule_id.rig.schema import ColumnRule

TILT_SD = scatter(
    "tilt_sd", "rad", "scatter of the tilt angle", r"\sigma_\mathrm{tilt}", Prior("halfnormal", 0.0, np.deg2rad(1.0))
)
#: Number of trials of the twin, and their scatter, rad.
TRIALS, TRIAL_SD = 4, np.deg2rad(0.5)


@dataclass(frozen=True, kw_only=True)
class TiltSettings(Settings):
    """Settings of tilts; ``length_is``: side of the triangle in the column length; None with a column angle."""

    length_is: Literal["board", "base"] | None = None


def _check_tilt(entry: Entry[TiltSettings]) -> None:
    """Require ``length_is`` where height and length are recorded, because the angle depends on it."""
    table, meaning = entry.table, entry.table.settings.length_is
    if "angle" in table.columns:
        if meaning is not None:
            remedy = "remove it, or give height and length"
            raise entry.error("length_is", "length_is needs the columns height and length", "angle", remedy)
        return
    if meaning is None:
        rule = "length_is must say which side of the triangle length is"
        remedy = 'write length_is = "board" for the sloping side, or length_is = "base" for the side on the floor'
        raise entry.error("", rule, "none", remedy)
    too_high = table["height"] >= table["length"]
    if meaning == "board" and too_high.any():
        row = int(np.argmax(too_high))
        value = " of ".join(
            f"{table[name][row] * table.columns[name].to_display:g} {table.columns[name].unit}"
            for name in ("height", "length")
        )
        remedy = 'correct it, or write length_is = "base"'
        raise entry.file.error(row, "height", "height must be less than the length of the board", value, remedy)


def tilts(
    rng: np.random.Generator, mu: float, trials: int = TRIALS, tilt_sd: float = TRIAL_SD
) -> dict[str, np.ndarray]:
    """Simulate a table by the paper's protocol: ``trials`` tilts with scatter ``tilt_sd``, rad."""
    angle = np.arctan(mu) + tilt_sd * rng.standard_normal(trials)
    return {"angle [deg]": np.rad2deg(angle)}


def _measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    del seed
    return Twin((TwinTable("static_friction.csv", tilts(rng, values["mu"])),))


TEMPLATE = """\
#: Tilts of the board until the capsule slips: mu. Column: angle [deg]; or height [mm] and length [mm] with
#: length_is = "board" (the sloping side) or "base" (the side on the floor).
# [[experiment]]
# kind = "static_friction"
# file = "static_friction.csv"
# angle_resolution = { value = 0.1, unit = "deg" }
"""

KIND = Kind(
    name="static_friction",
    columns={
        "angle": ColumnRule("rad", SLOPE_ANGLE),
        "height": ColumnRule("m", POSITIVE, usual=(5e-3, 5.0)),
        "length": ColumnRule("m", POSITIVE, usual=(5e-3, 5.0)),
    },
    sets=(("angle",), ("height", "length")),
    settings=TiltSettings,
    rules=(_check_tilt,),
    parameters=(TILT_SD,),
    make=made_by("capsule_id.experiments.static_friction.experiment:StaticFriction"),
    template=TEMPLATE,
    informs="mu",
    captions=CAPTIONS,
    messages=MESSAGES,
    lint=(partial(lint_rows, fewest=4),),
    check=check_scatter,
    paper=friction_estimates,
    panels=friction_panels,
    twin=_measure,
)
