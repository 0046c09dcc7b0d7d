"""Friction experiments: shared declarations, the paper's protocol, one panel, pulls, and the consistency of the surface."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import equinox as eqx
import numpy as np
from scipy.optimize import least_squares

from capsule_id.errors import InputError
from capsule_id.experiments.base import LEVEL, Fitted, Start, ValuesBySymbol, band
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel, has_stated_load
from capsule_id.experiments.friction_variants import check_variants
from capsule_id.experiments.kind import Values
from capsule_id.experiments.lint import lint_rows
from capsule_id.experiments.point_test import FRICTION, PointTest
from capsule_id.parameters import Parameter, Prior
from capsule_id.physics.batches import array_module
from capsule_id.physics.forces import CoulombStribeck, FrictionLaw, normal_force, slide_distance
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import ColumnRule, Entry, GroundSettings
from capsule_id.rig.toml import POSITIVE
from capsule_id.views import Comparison, Curve, Facts, Finding, Message, Points, counted, filled_in

# declarations: Settings, columns, rules and messages that friction experiments share.


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings(GroundSettings):
    """``direction``: towards the support spring ("forward") or away from it; it matters where mu_back is free."""

    direction: Literal["forward", "backward"] = "forward"


@dataclass(frozen=True, kw_only=True)
class PullSettings(SurfaceSettings):
    """``load_is``: whether stated normal forces on a slope come from weights, or press without weight; else None."""

    load_is: Literal["weight", "pressed"] | None = None


#: Prior of the relative scatter of mu from trial to trial.
SCATTER_OF_MU = Prior("halfnormal", 0.0, 0.05)
#: Column of the normal force of every trial, where it differs from trial to trial.
NORMAL_FORCE_COLUMN = ColumnRule("N", POSITIVE)


def check_normal_force(entry: Entry[Any]) -> None:
    """Require a force beside a column of normal forces, and refuse another statement of the normal force.

    Raises
    ------
    InputError
        At the entry or its setting.
    """
    columns = entry.table.columns
    if "normal_force" not in columns:
        return
    if "force" not in columns:
        raise entry.error(
            "", "the column normal_force needs the column force", " ".join(columns), "remove normal_force"
        )
    for key in ("normal_force", "N0"):
        if key in entry.node:
            raise entry.error(
                key, f"{key} must not stand beside the column normal_force", "both", f"remove {key}", True
            )


def check_load(entry: Entry[Any]) -> None:
    """Require ``load_is`` where the normal force is stated on a slope: weights pull along the slope too.

    Raises
    ------
    InputError
        At the entry or its setting.
    """
    table = entry.table
    needed = has_stated_load(table) and "force" in table.columns and "slope" in table.settings.ground
    if needed and table.settings.load_is is None:
        raise entry.error(
            "",
            "load_is must say where a stated normal force on a slope comes from",
            "none",
            'write load_is = "weight" for weights on the capsule, or load_is = "pressed" for a force without weight',
        )
    if table.settings.load_is is not None and not needed:
        raise entry.error("load_is", "load_is needs a slope and a stated normal force", "no such", "remove it", True)


def masses_of_pulls(table: Table[Any]) -> tuple[str, ...]:
    """Symbols of the masses that pulls need: a force that no stated load explains alone overcomes the weight."""
    weighed = not has_stated_load(table) or table.settings.load_is == "pressed"
    return ("m1", "m2") if "force" in table.columns and weighed else ()


def lint_slides(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Warn where slides have few rows: constant friction has one unknown, another law mu and v_s."""
    return lint_rows(table, rig, 1 if rig.model.friction == "constant" else 2)


CAPTIONS = {
    "friction": (
        "Counterpart of the paper's Fig. 2: coefficients as the paper reads them off, its curve, and ours. A push stands "
        "twice: as the paper reads it, v²/(2 g d) from its distance d, and at the coefficient that d means at its speed v."
    )
}

#: A friction coefficient holds the viscous part as a force per weight.
MASSES_OF_FREE = {"viscous": ("m1", "m2")}


def _of_laws(facts: Facts) -> str:
    """What all laws together say, the readings that are missing, and the words that state a law."""
    name, other = facts["name"], facts["other"]
    more = "slides at higher speeds" if facts["slow"] else "slides at other speeds"
    wider = (
        f"{other} is {facts['other_factor']:.2g} times as probable and contains {name}: to fit it, write in [model] of "
        f"rig.toml: {facts['other_line']}. "
    )
    return (
        f"{facts['labels']}: which friction law holds is not known from these readings. All laws together, by their "
        f"probabilities, give {facts['means']}; {name} alone gives {facts['now']}. To decide, add "
        f"{more if facts['tilts'] else 'tilts (static_friction)'}. {wider * (other is not None)}"
        f"Where you know that {name} holds, write in [rig]: confirmed = [{facts['confirmed']}]"
    )


_BEST = "the readings do not reject {name}: the best of {count} friction laws is {factor:.2g} times as probable. "
_NONE = "the readings do not reject {name}: none of {count} friction laws is more probable. "
_SIMPLEST = "The simplest law that the readings cannot tell from the best is {simplest} (in [model]: {line})"
MESSAGES = {
    "friction.variants": Message(
        "friction law",
        ok=lambda facts: filled_in((_BEST if facts["factor"] > 1.05 else _NONE) + _SIMPLEST, facts),
        warn=_of_laws,
        fail=(
            "{labels}: expected readings that {name} explains; found them {factor:.3g} times more probable under another "
            "friction law. Write in [model] of rig.toml: {line}"
        ),
        caption=(
            "Friction laws fitted to the friction experiments alone: posterior mean ± sd, largest log-likelihood, BIC and "
            "log marginal likelihood (differences from the best), p-value of residuals ordered by speed."
        ),
    ),
    "friction.order": Message(
        "friction against speed",
        ok="the residuals show no order in speed ({p:p})",
        fail=(
            "{labels}: expected residuals without order in speed; found neighbours of one sign under {name} ({p:p}). "
            "Compare the friction laws in the report, or repeat the readings at more speeds."
        ),
    ),
    "friction.one_surface": Message(
        "experiments agree",
        ok=(
            "tilts and slides agree on one surface: mu = {mu_tilts:.3f} from the tilts alone, {mu_slides:.3f} from the slides "
            "alone; a difference this large is expected from their errors with probability {p:.2g}"
        ),
        fail=(
            "{tilts} and {slides}: expected one surface; found mu = {mu_tilts:.3f} at rest and {mu_slides:.3f} by "
            "sliding ({p:p}). Measure both on the same surface, and read the tilt or pull at break-away. Static friction "
            "above sliding friction is no fault of the rig: slides with a column speed show it under eq. (1), with "
            'free = ["ratio"] in [model] also where they are slow; constant friction cannot. Else fit both in folders of their '
            "own."
        ),
    ),
}


def check_scatter(tables: Sequence[Table[Any]]) -> None:
    """Reject equal readings without reading error: a scatter of 0 makes the posterior improper.

    Raises
    ------
    InputError
        If readings repeat at no more settings than the law has parameters, and no reading error is stated.
    """
    # Tilts have a scatter of their own, pulls and slides another one.
    for tilted in (True, False):
        alike = [table for table in tables if tilted == bool({"angle", "height"} & set(table.columns))]
        columns, *others = dict.fromkeys(tuple(table.columns) for table in alike) or ((),)
        if others or not alike:
            continue
        rows = np.concatenate([np.stack([c.values for c in table.columns.values()], axis=1) for table in alike])
        # A law through two points, mu and v_s, leaves no scatter either; readings of one setting that differ do.
        settings = rows[:, [name in ("speed", "normal_force") for name in columns]]
        distinct, known = len(np.unique(rows, axis=0)), 2 if "speed" in columns else 1
        distinct = distinct if distinct == len(np.unique(settings, axis=0)) else len(rows)
        stated = any(column.reading_sd > 0.0 for table in alike for column in table.columns.values())
        if distinct <= known and distinct < len(rows) and not stated:
            raise InputError(
                f"{alike[0].kind} readings that are all the same need their reading step",
                counted(len(rows), "row"),
                f"state {next(name for name in columns if name not in ('speed', 'normal_force'))}_resolution",
                alike[0].file,
            )


# paper: The paper's estimate of eq. (1), and its panel: coefficient against velocity (Fig. 2).


#: Lower bound of v_s in the paper's fit, m/s.
LOWEST_V_S = 1e-6
#: Largest v_s that readings tell, in units of their largest speed: far above it eq. (1) is level.
LARGEST_V_S = 100.0
#: Ratio of the largest to the smallest value of a setting from which it varies; another ratio of kinetic to static friction.
VARIED, OTHER_RATIO = 1.2, 0.6


def varies(setting: np.ndarray) -> bool:
    """Whether positive values (n,) of a setting are not those of one setting."""
    return bool(np.max(setting) > VARIED * np.min(setting) > 0.0)


def unit_law(mu: Any, v_s: Any) -> CoulombStribeck:
    """Return eq. (1) for a normal force of 1 N: its resistance is the friction coefficient, its mass is 1/g."""
    return CoulombStribeck(mu, 1.0, v_s)


def paper_friction_fit(speed: np.ndarray, coefficient: np.ndarray) -> dict[str, float]:
    """Fit eq. (1) by least squares to points (speed, coefficient), as in the paper; static points have speed 0.

    Return mu and, with at least one sliding point, v_s. v_s is left out where its standard error exceeds its value or
    readings show no fall with speed. Everything is left out where the fit does not converge or ends at its lower bound of
    v_s: mu is then not determined either.
    """
    sliding = speed > 0.0
    if not sliding.any():
        return {"mu": float(np.mean(coefficient))}
    if len(np.unique(speed)) < 2:
        return {}
    start = (float(np.max(coefficient)), float(np.median(speed[sliding])))
    bounds = [0.0, LOWEST_V_S], [np.inf, np.inf]
    found = least_squares(lambda own: unit_law(*own).forward(speed) - coefficient, start, bounds=bounds)
    if not found.success or found.active_mask[1]:
        return {}
    mu, v_s = found.x
    variance = np.linalg.pinv(found.jac.T @ found.jac)[1, 1] * 2.0 * found.cost / max(len(speed) - 2, 1)
    # Two points determine both values, without a standard error.
    known = v_s <= LARGEST_V_S * np.max(speed) and (len(speed) == 2 or np.sqrt(variance) <= v_s)
    return {"mu": float(mu), "v_s": float(v_s)} if known else {"mu": float(mu)}


def friction_panels(
    experiments: "Sequence[FrictionExperiment]", values: Values, draws: Sequence[Values]
) -> tuple[Comparison]:
    """Friction coefficient against velocity: readings of all experiments, the paper's curve, this fit (paper, Fig. 2)."""
    # Local values differ in scatters only. Merged, they contain mu and v_s if any experiment has both.
    theta, *own = ({k: v for e in experiments for k, v in e.local(p).items()} for p in (values, *draws))
    laws = list(dict.fromkeys(e.friction for e in experiments))
    friction = laws[0]
    points = [Points(e.label, *e.paper_points(), role=e.role) for e in experiments]
    top = max(float(np.max(p.x)) for p in points)
    speed = np.linspace(0.0, 1.15 * top if top > 0 else 1.0, 161)

    def curve(friction: FrictionModel, values: ValuesBySymbol) -> np.ndarray:
        # Tilts alone do not determine the sliding friction, so their line is horizontal.
        known = all(row.symbol in values for row in friction.parameters)
        return np.asarray(friction.coefficient(values).forward(speed if known else 0.0 * speed))

    curves = []
    for law in laws:
        lower, upper = band(np.array([curve(law, draw) for draw in own]))
        name = f"this fit, {law.name}" + (f", {law.direction}" if len(laws) > 1 else "")
        curves.append(Curve(name, speed, curve(law, theta), lower, upper))
    paper = paper_friction_fit(np.concatenate([p.x for p in points]), np.concatenate([p.y for p in points]))
    if "v_s" in paper:
        curves.append(Curve("the paper's fit", speed, unit_law(**paper).forward(speed), role="paper"))
    if any(e.role == "dynamic" for e in experiments) and not any(e.ground for e in experiments):
        # v²/(2gd) is a mean over all speeds of a slide. Over this fit's mean, times its coefficient at the speed of the
        # push, it is the coefficient that the reading means there.
        def mean_of_slides(law: FrictionModel, speeds: np.ndarray) -> np.ndarray:
            return speeds**2 / (2.0 * theta["g"] * slide_distance(law.coefficient(theta), 1.0 / theta["g"], speeds))

        slow = np.maximum(speed[1:], 1e-3 * speed[-1])
        curves.append(Curve("this fit, read as v²/(2gd)", slow, mean_of_slides(friction, slow), role="alternative"))
        for at, (e, read) in enumerate(zip(experiments, tuple(points), strict=True)):
            if e.role == "dynamic":
                known = e.friction.coefficient(theta).forward(read.x) / mean_of_slides(e.friction, read.x)
                points[at] = replace(read, y=read.y * np.asarray(known))
                points.append(replace(read, label=f"{e.label}, read as v²/(2gd)", role="mean"))
    panel = Comparison(
        "friction",
        "friction",
        "Friction coefficient against velocity",
        "velocity, m/s",
        "friction coefficient",
        tuple(points),
        tuple(curves),
    )
    return (panel,)


def friction_estimates(experiments: "Sequence[FrictionExperiment]") -> Values:
    """Estimate mu and v_s as in the paper: fit eq. (1) to the points of all friction experiments."""
    points = [e.paper_points() for e in experiments]
    speed, coefficient = (np.concatenate(parts) for parts in zip(*points, strict=True))
    return paper_friction_fit(speed, coefficient)


# experiment: What friction experiments share, and whether they agree on the surface.


def check_one_surface(experiments: "Sequence[FrictionExperiment]", fit: Fitted) -> list[Finding]:
    """Check that tilts and slides agree on the coefficient at break-away."""
    tilts = [e for e in experiments if e.role == "static"]
    slides = [e for e in experiments if e.role != "static" and tilts and e.friction == tilts[0].friction]
    if not tilts or not slides:
        return []
    found, friction = fit.tension(tilts, slides), tilts[0].friction
    by_tilting, by_sliding = (friction.coefficient(values).forward(0.0) for values in (found.one, found.other))
    facts = {
        "tilts": ", ".join(e.label for e in tilts),
        "slides": ", ".join(e.label for e in slides),
        "mu_tilts": float(by_tilting),
        "mu_slides": float(by_sliding),
        "p": found.p,
    }
    if not found.p >= LEVEL:  # nor where there is no p-value
        return [Finding("friction.one_surface", "fail", facts, tilts[0].label)]
    return [Finding("friction.one_surface", "ok", facts)]


class FrictionExperiment(PointTest):
    """A friction experiment; all of them share the friction law, the paper's protocol and one panel."""

    role: ClassVar[Literal["static", "dynamic", "sliding"]]
    reads = (FRICTION,)
    checks = (check_one_surface, check_variants)

    def own_parameters(self, table: Table) -> tuple[Parameter, ...]:
        return (
            (*self.friction.parameters_at_rest, self.scatter)
            if self.role == "static"
            else super().own_parameters(table)
        )

    @property
    def masses(self) -> tuple[str, ...]:
        """None for eq. (1) at rest: its break-away coefficient is mu."""
        return () if self.role == "static" and self.friction.law is CoulombStribeck else self.friction.masses

    @property
    def backward(self) -> bool:
        """Whether the capsule slides away from the support spring, which is downhill for slope > 0."""
        return self.friction.direction == "backward"

    @property
    def stated(self) -> dict[str, float]:
        """What ``local`` selects beside the sampled parameters, slope and N0, as stated."""
        return {
            **{name: getattr(self.rig, name).value for name in self.masses},
            **self.stated_ground,
            "g": self.rig.g.value,
        }

    @property
    def stated_normal_force(self) -> float:
        """N of the stated masses."""
        return normal_force(self.rig.mass("m1"), self.rig.mass("m2"), self.rig.g.value, **self.stated_ground)

    def alternatives(self, theta: ValuesBySymbol) -> dict[str, np.ndarray]:
        """The speed shows another ratio of eq. (1), which acts as a constant force does; constant friction: a fall."""
        speed, friction = self.paper_points()[0], self.friction
        if friction.law is not CoulombStribeck or "ratio" in friction.free:
            return {}
        if not varies(speed):
            return {"speeds": np.zeros(self.n)}
        other = {"v_s": float(np.median(speed))} if friction.constant else {"ratio": OTHER_RATIO}
        free = () if friction.constant else ("ratio",)
        changed = self.with_friction(replace(friction, constant=False, free=(*friction.free, *free)))
        return {"speeds": self.misfit(theta).raw - changed.misfit({**theta, **other}).raw}

    @abstractmethod
    def point_errors(self) -> tuple[Any, Any]:
        """Relative sd of the paper's points from the reading errors, and per unit of the scatter; () or (n,) each."""

    @abstractmethod
    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Speed, m/s, and friction coefficient by the paper's formulas, (n,) each."""

    def paper_coefficient(self, law: FrictionLaw, speed: np.ndarray) -> Any:
        """The paper's coefficients (..., n) at ``speed`` (n,), m/s, where ``law``, leaves (..., 1, 1), is the coefficient."""
        return law.forward(speed[:, None])[..., 0]

    def starts(self) -> dict[str, Start]:
        """Starts of mu and v_s from the paper's estimates; another law starts at its prior medians."""
        speed, coefficient = self.paper_points()
        mu = Start(float(np.max(coefficient)), 0.3)
        sliding = {} if self.role == "static" else {"v_s": Start(float(np.median(speed)), 0.5)}
        return {"mu": mu, "mu_back": mu, **sliding, self.scatter.symbol: Start(0.02, 0.3)}


# pulls: Forces that overcome friction, at rest or at a held speed.


def weight_along(mass: Any, g: Any, ground: Mapping[str, Any], backward: bool) -> Any:
    """Weight of ``mass`` along the slope, N, positive where it opposes the motion; "backward" runs downhill."""
    if "slope" not in ground:
        return 0.0
    uphill = mass * g * array_module(ground["slope"]).sin(ground["slope"])
    return -uphill if backward else uphill


class Pulls(FrictionExperiment):
    """Forces N mu(v), with the weight along the slope, or coefficients mu(v); speed 0 at break-away.

    N is that of the weight, or stated for all trials or for each. On a slope a stated N comes from weights, whose part
    along the slope is N tan(slope), or presses without weight beside the weight of capsule and rod. Reading errors of
    speed and N count too, through the law and the coefficient; the scatter is relative to mu.

    Attributes
    ----------
    of_weights : whether the stated normal force comes from weights
    """

    of_weights: bool = eqx.field(static=True)

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        PointTest.__init__(self, table, rig, friction)
        self.of_weights = table.settings.load_is == "weight"
        force, along = self.observed, np.broadcast_to(self.stated_along, self.n)
        if "slope" in self.ground and np.all(force <= along):
            row = int(np.argmax(force - along))
            raise InputError(
                f"a force must exceed the weight along the slope, {along[row]:.4g} N",
                f"{force[row]:.4g} N",
                "correct slope, direction or load_is",
                table.file,
                int(table.rows[row]),
            )

    def read(self, table: Table) -> tuple[dict[str, Any], dict[str, Any]]:
        readings, sds = super().read(table)
        stated = getattr(table.settings, "normal_force", None)
        load = {} if stated is None else {"normal_force": np.asarray(stated)}
        return {"speed": np.zeros(len(table.rows)), **load, **readings}, sds

    @property
    def reading(self) -> str:  # type: ignore[override]  # pyright: ignore
        return "force" if "force" in self.readings else "coefficient"

    @property
    def masses(self) -> tuple[str, ...]:
        alone = "normal_force" in self.readings and ("slope" not in self.ground or self.of_weights)
        return ("m1", "m2") if self.reading == "force" and not alone else super().masses

    @property
    def loads(self) -> tuple[np.ndarray, np.ndarray] | None:
        load = self.readings.get("normal_force", np.zeros(1))
        return (load, self.paper_points()[1]) if load.size > 1 else None

    def alternatives(self, theta: ValuesBySymbol) -> dict[str, np.ndarray]:
        """The load shows a constant force beside the friction, 1 N."""
        loads = {"loads": np.ones(self.n)} if self.loads is not None and np.ptp(self.loads[0]) > 0.0 else {}
        return {**super().alternatives(theta), **loads}

    def along(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """Weight along the slope, N, () or (n,), positive where it opposes the motion; it changes no coefficient."""
        if "slope" not in self.ground or self.reading != "force":
            return 0.0
        ground = self.ground_at(theta)
        if not self.of_weights:
            return weight_along(theta["m1"] + theta["m2"], theta["g"], ground, self.backward)
        uphill = x["normal_force"] * array_module(ground["slope"]).tan(ground["slope"])
        return -uphill if self.backward else uphill

    @property
    def stated_along(self) -> np.ndarray:
        """``along`` as stated, () or (n,) N."""
        return np.asarray(self.along(self.stated, self.readings))

    def resistance(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """Friction, N, or its coefficient."""
        of_weight = self.reading == "force" and "normal_force" not in x
        law = self.law(theta) if of_weight else self.friction.coefficient({**theta, **self.ground_at(theta)})
        return x.get("normal_force", 1.0) * law.forward(x["speed"])

    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        return self.resistance(theta, x) + self.along(theta, x)

    def change(self, theta: ValuesBySymbol) -> Any:
        return self.resistance(theta, self.readings)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Points by the paper's formula: mu = force/N, without the weight along the slope, or the coefficient."""
        of_weight = self.reading == "force" and "normal_force" not in self.readings
        load = self.stated_normal_force if of_weight else self.readings.get("normal_force", 1.0)
        return self.readings["speed"], (self.observed - self.stated_along) / load

    def point_errors(self) -> tuple[np.ndarray, float]:
        """The reading error of the speed is left out: it enters through the slope of the law."""
        net = self.observed - self.stated_along
        share = self.observed / net if self.of_weights else 1.0
        of_load = share * self.sds.get("normal_force", 0.0) / self.readings.get("normal_force", 1.0)
        return np.hypot(self.sds[self.reading] / net, of_load), 1.0
