"""Tilts or pulls until the capsule slips: mu is the tangent of the angle of breakaway (paper, section 2.2)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import equinox as eqx
import numpy as np

from capsule_id.experiments.base import Start, ValuesBySymbol
from capsule_id.experiments.friction import (
    CAPTIONS,
    MESSAGES,
    NORMAL_FORCE_COLUMN,
    SCATTER_OF_MU,
    FrictionExperiment,
    Pulls,
    PullSettings,
    check_load,
    check_normal_force,
    check_scatter,
    friction_estimates,
    friction_panels,
    masses_of_pulls,
)
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values
from capsule_id.experiments.lint import lint_rows
from capsule_id.parameters import INSTRUMENT_ERRORS, Prior, scatter
from capsule_id.physics.batches import array_module
from capsule_id.rig.model import Table
from capsule_id.rig.schema import ColumnRule, Entry, QuantityRule
from capsule_id.rig.toml import POSITIVE, SLOPE_ANGLE

# declaration: Tilts or pulls until the capsule slips: columns, settings, rules, template and twin.


TILT_SD = scatter(
    "tilt_sd", "rad", "scatter of the tilt angle", r"\sigma_\mathrm{tilt}", Prior("halfnormal", 0.0, np.deg2rad(1.0))
)
PULL_SCATTER = scatter(
    "pull_scatter", "1", "relative scatter of mu, pulls until slip", r"s_\mathrm{pull}", SCATTER_OF_MU
)
#: A side of the triangle below the board.
SIDE = ColumnRule("m", POSITIVE, usual=(5e-3, 5.0))
#: Number of trials of the twin, and their scatter, rad.
TRIALS, TRIAL_SD = 4, np.deg2rad(0.5)


@dataclass(frozen=True, kw_only=True)
class TiltSettings(PullSettings):
    """Settings of tilts; ``length_is``: side of the triangle, None without one; ``normal_force`` of a pull, N."""

    length_is: Literal["board", "base"] | None = None
    normal_force: Annotated[float | None, QuantityRule("N")] = None


def _check_tilt(entry: Entry[TiltSettings]) -> None:
    """Require ``length_is`` where height and length are recorded, because the angle depends on it."""
    table, meaning = entry.table, entry.table.settings.length_is
    if table.settings.normal_force is not None and "force" not in table.columns:
        remedy = "remove it, or give force"
        raise entry.error("normal_force", "normal_force needs the column force", next(iter(table.columns)), remedy)
    if "height" not in table.columns:
        if meaning is not None:
            remedy = "remove it, or give height and length"
            rule = "length_is needs the columns height and length"
            raise entry.error("length_is", rule, next(iter(table.columns)), remedy)
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


def _check_ground(entry: Entry[TiltSettings]) -> None:
    """Refuse a slope of its own and N0 for tilts, and N0 beside the normal force of a pull."""
    settings = entry.table.settings
    if "force" not in entry.table.columns:
        if "slope" in settings.ground and "slope" in entry.node:
            rule = "a tilt takes its own angle as slope"
            raise entry.error("slope", rule, "slope", "remove slope, or give the column force", of_key=True)
        entry.refuse_ground("N0", "a tilt must have the weight alone as normal force")
    elif settings.normal_force is not None and "N0" in entry.node:
        raise entry.error("N0", "normal_force holds N0 too", "both", "remove N0, or normal_force", of_key=True)


def tilts(rng: np.random.Generator, mu: float, trials: int = TRIALS, sd: float = TRIAL_SD) -> dict[str, np.ndarray]:
    """Simulate a table by the paper's protocol: ``trials`` tilts with scatter ``sd``, rad."""
    angle = np.arctan(mu) + sd * rng.standard_normal(trials)
    return {"angle [deg]": np.rad2deg(angle)}


def _measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    return Twin((TwinTable("static_friction.csv", tilts(rng, values["mu"], sd=values.get("tilt_sd", TRIAL_SD))),))


TEMPLATE = """\
#: Tilts of the board until the capsule slips: mu. Column: angle [deg]; or height [mm] and length [mm] with
#: length_is = "board" (the sloping side) or "base" (the side on the floor). Heights of one board of 950 mm:
#: columns = { height = { from = "height [mm]", unit = "mm" }, length = { from = 1, unit = "mm", scale = 0, offset = 950 } }
#: Or force [N]: the pull along the track at which the capsule slips. The normal force follows from the weight, slope
#: and N0, or is stated by normal_force = { value = 6.3, unit = "N" }, or for every row in a column normal_force [N].
# [[experiment]]
# kind = "static_friction"
# file = "static_friction.csv"
# angle_resolution = { value = 0.1, unit = "deg" }
# direction = "forward"                               # "backward": it slips away from the support spring
# slope = { value = 0, unit = "deg" }                   # of pulls, and N0; default: those of [rig]
#: On a slope a stated normal force needs load_is = "weight", or "pressed" for a force without weight.
# N0 = { value = 0, unit = "N" }
"""

KIND = Kind(
    name="static_friction",
    columns={
        "angle": ColumnRule("rad", SLOPE_ANGLE),
        "height": SIDE,
        "length": SIDE,
        "force": ColumnRule("N", POSITIVE),
        "normal_force": NORMAL_FORCE_COLUMN,
    },
    sets=(("angle",), ("height", "length"), ("force",)),
    optional=("normal_force",),
    masses=masses_of_pulls,
    settings=TiltSettings,
    meant=("break-away", "sliding", "no pull"),
    rules=(check_normal_force, _check_tilt, _check_ground, check_load),
    parameters=(TILT_SD, PULL_SCATTER),
    read_by=INSTRUMENT_ERRORS,
    test="tilt",
    minutes=1.0,
    make=lambda table, *rig: (StaticPulls if "force" in table.columns else StaticFriction).make(table, *rig),
    template=TEMPLATE,
    informs="mu",
    captions=CAPTIONS,
    messages=MESSAGES,
    lint=(partial(lint_rows, unknowns=1),),
    check=check_scatter,
    paper=friction_estimates,
    panels=friction_panels,
    twin=_measure,
)


# experiment: Tilt to slide: mu is the tangent of the angle at which the capsule breaks away (paper, section 2.2).


class StaticFriction(FrictionExperiment):
    """Trials of one surface: angle_i = arctan(mu_0) + N(0, tilt_sd^2 + reading error^2).

    mu_0 is the coefficient at break-away. A capsule that slides down counts as one that slides forward.

    Where height and length are recorded instead of the angle, ``length_is`` selects the side of the triangle. This is
    the tilted board (sin = height/length) or the base (tan = height/length).
    """

    side: Literal["board", "base"] | None = eqx.field(static=True)

    role, reading, scatter, relative, on_track = "static", "angle", TILT_SD, False, False

    def read(self, table: Table) -> tuple[dict[str, Any], dict[str, Any]]:
        """Angle, (n,) rad, and its reading error, () or (n,) rad."""
        (values, sds), self.side = super().read(table), None if "angle" in table.columns else table.settings.length_is
        if self.side is None:
            return values, sds
        height, length = values["height"], values["length"]
        ratio = height / length
        ratio_sd = ratio * np.hypot(sds["height"] / height, sds["length"] / length)
        per_ratio = 1.0 / np.sqrt(1.0 - ratio**2) if self.side == "board" else 1.0 / (1.0 + ratio**2)
        return {"angle": self._angle(ratio), "length": length}, {"angle": ratio_sd * per_ratio}

    def _angle(self, ratio: Any) -> Any:
        """The angle, rad, of a height over a length."""
        xp = array_module(ratio)
        return xp.arcsin(xp.minimum(ratio, 1.0)) if self.side == "board" else xp.arctan(ratio)

    def shown(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """The angle of the height and the length that their instruments read."""
        if self.side is None or not self.instruments:
            return super().shown(theta, x)
        angle = self.predict(theta, x)
        xp, (factor, offset) = array_module(angle), self.instrument("height", theta)
        height = self.true("length", x["length"], theta) * (xp.sin(angle) if self.side == "board" else xp.tan(angle))
        return self._angle((offset + factor * height) / x["length"])

    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        tangent = self.friction.coefficient(theta).forward(0.0)
        return array_module(tangent).arctan(tangent)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points by the paper's formula: mu = tan(angle) at speed 0."""
        return np.zeros(self.n), np.tan(self.observed)

    def point_errors(self) -> tuple[np.ndarray, np.ndarray]:
        per_angle = 2.0 / np.sin(2.0 * self.observed)
        return self.sds["angle"] * per_angle, per_angle

    def starts(self) -> dict[str, Start]:
        spread = np.std(self.observed, ddof=1) if self.n > 1 else 0.0
        mu = Start(float(np.mean(np.tan(self.observed))), 0.3)
        return {"mu": mu, "mu_back": mu, "tilt_sd": Start(max(spread, np.deg2rad(0.1)), 0.3)}


class StaticPulls(Pulls):
    """Pulls along the track until the capsule slips."""

    role, scatter = "static", PULL_SCATTER
