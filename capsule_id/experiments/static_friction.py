"""Tilts or pulls until the capsule slips: mu is the tangent of the angle of breakaway (paper, section 2.2)."""

from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.friction import (
    CAPTIONS,
    MESSAGES,
    NORMAL_FORCE_COLUMN,
    PullSettings,
    check_load,
    check_normal_force,
    check_scatter,
    friction_estimates,
    friction_panels,
    ground_of,
    ground_parameters,
)
from capsule_id.experiments.friction_experiment import FrictionExperiment, LoadedExperiment, stated_normal_forces
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.experiments.lint import lint_rows
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.parameters import Prior, scatter
from capsule_id.physics.friction import CoulombStribeck, normal_force
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import ColumnRule, QuantityRule
from capsule_id.rig.tables import Entry
from capsule_id.rig.toml import POSITIVE, SLOPE_ANGLE

# declaration: Tilts or pulls until the capsule slips: columns, settings, rules, template and twin.


TILT_SD = scatter(
    "tilt_sd", "rad", "scatter of the tilt angle", r"\sigma_\mathrm{tilt}", Prior("halfnormal", 0.0, np.deg2rad(1.0))
)
PULL_SCATTER = scatter(
    "pull_scatter", "1", "relative scatter of mu, pulls until slip", r"s_\mathrm{pull}", Prior("halfnormal", 0.0, 0.05)
)
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


def _masses(table: Table[TiltSettings]) -> tuple[str, ...]:
    # The pull overcomes the weight along the slope too.
    stated = table.settings.normal_force is not None or "normal_force" in table.columns
    weighed = not stated or table.settings.load_is == "pressed"
    return ("m1", "m2") if "force" in table.columns and weighed else ()


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
        "height": ColumnRule("m", POSITIVE, usual=(5e-3, 5.0)),
        "length": ColumnRule("m", POSITIVE, usual=(5e-3, 5.0)),
        "force": ColumnRule("N", POSITIVE),
        "normal_force": NORMAL_FORCE_COLUMN,
    },
    sets=(("angle",), ("height", "length"), ("force",)),
    optional=("normal_force",),
    masses=_masses,
    settings=TiltSettings,
    meant=("break-away", "sliding", "no pull"),
    rules=(check_normal_force, _check_tilt, _check_ground, check_load),
    parameters=(TILT_SD, PULL_SCATTER),
    make=made_by("capsule_id.experiments.static_friction:StaticFriction"),
    template=TEMPLATE,
    informs="mu",
    captions=CAPTIONS,
    messages=MESSAGES,
    lint=(partial(lint_rows, fewest=3),),
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
