"""Friction experiments: coefficient against velocity (Fig. 2), the paper's protocol, checks of the law."""

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import equinox as eqx
import numpy as np
import pandas as pd
from scipy.optimize import OptimizeWarning, curve_fit

from capsule_id.errors import InputError
from capsule_id.experiments.base import Start, ValuesBySymbol, band
from capsule_id.experiments.checks import LEVEL
from capsule_id.experiments.context import Fitted
from capsule_id.experiments.friction import FACTOR, TELLING, VariantPoints, candidates, fit_variant, weight_along
from capsule_id.experiments.friction_model import FrictionModel, GroundExperiment
from capsule_id.physics.batches import array_module
from capsule_id.physics.friction import CoulombStribeck, normal_force, slide_distance
from capsule_id.rig.model import Table
from capsule_id.views import Comparison, Curve, Finding, Points, ResultTable

# friction checks: Checks of the friction law: comparison with other laws, order of the residuals in speed.


#: Smallest number of sliding readings for a comparison of laws, and seed of its sampler.
FEWEST_SLIDES, SEED = 3, 0


def check_variants(experiments: "Sequence[FrictionExperiment]", fit: Fitted) -> list[Finding]:
    """Compare the friction law in use with other laws, and recommend the simplest that the readings allow.

    The law in use fails where another one has a marginal likelihood ``FACTOR`` times larger, or where its residuals are
    ordered by speed.
    """
    del fit
    experiments = [e for e in experiments if e.speeds_known]
    if not experiments:
        return []
    in_use = replace(experiments[0].friction, direction="both")
    if in_use.law is not CoulombStribeck or sum(e.n for e in experiments if e.role != "static") < FEWEST_SLIDES:
        return []
    points = VariantPoints(experiments)
    variants = [fit_variant(points, model, SEED) for model in candidates(experiments)]
    highest = max(variant.evidence for variant in variants)
    used = next(variant for variant in variants if variant.model == in_use)
    simplest = next(variant for variant in variants if highest - variant.evidence < np.log(TELLING))
    facts = {
        "name": in_use.name,
        "labels": ", ".join(e.label for e in experiments),
        "count": len(variants),
        "factor": float(np.exp(min(highest - used.evidence, 700.0))),
        "simplest": simplest.model.name,
        "line": simplest.line,
        "p": used.lack_of_fit,
        "variants": tuple(variants),
    }
    names = tuple(row.name for row in in_use.parameters)
    rejected, ordered = facts["factor"] > FACTOR, used.lack_of_fit < LEVEL
    return [
        Finding("friction.variants", "fail" if rejected else "ok", facts, parameters=names),
        Finding("friction.order", "fail" if ordered else "ok", facts, parameters=names),
    ]


def variant_table(experiments: "Sequence[FrictionExperiment]", fit: Fitted) -> list[ResultTable]:
    """Show the laws of ``check_variants`` side by side."""
    del experiments
    variants = next((f.facts["variants"] for f in fit.findings if f.code == "friction.variants"), ())
    if not variants:
        return []
    rows = [
        {
            "law": variant.model.name,
            "parameters": "; ".join(
                f"{name} = {value:.4g} ± {variant.sds[name]:.2g}" for name, value in variant.values.items()
            ),
            "log-likelihood": variant.log_likelihood,
            "BIC": variant.bic - min(other.bic for other in variants),
            "log marginal likelihood": variant.evidence - max(other.evidence for other in variants),
            "order of residuals, p": variant.lack_of_fit,
            "[model]": variant.line,
        }
        for variant in variants
    ]
    return [ResultTable("friction.variants", pd.DataFrame(rows).set_index("law"))]


# friction experiment: Friction experiments: coefficient against velocity (Fig. 2), the paper's protocol, consistency
# of the surface.


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
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OptimizeWarning)
            (mu, v_s), covariance = curve_fit(
                lambda v, mu, v_s: unit_law(mu, v_s).forward(v),
                speed,
                coefficient,
                p0=start,
                bounds=([0.0, LOWEST_V_S], [np.inf, np.inf]),
            )
    except RuntimeError:
        return {}
    if v_s < 1.01 * LOWEST_V_S:
        return {}
    # Two points determine both values, without a standard error.
    known = v_s <= LARGEST_V_S * np.max(speed) and (len(speed) == 2 or np.sqrt(covariance[1, 1]) <= v_s)
    return {"mu": float(mu), "v_s": float(v_s)} if known else {"mu": float(mu)}


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


class FrictionExperiment(GroundExperiment):
    """A friction experiment; all of them share the friction law, the paper's protocol and one panel."""

    role: ClassVar[Literal["static", "dynamic", "sliding"]]
    checks = (check_one_surface, check_variants)
    tables = (variant_table,)

    @property
    def masses(self) -> tuple[str, ...]:
        return self.friction.masses

    @property
    def speeds_known(self) -> bool:
        """Whether each reading has a speed, so that laws that depend on it can be compared."""
        return True

    @property
    def backward(self) -> bool:
        """Whether the capsule slides away from the support spring, which is downhill for slope > 0."""
        return self.friction.direction == "backward"

    @property
    def stated_normal_force(self) -> float:
        """N of the stated masses."""
        return normal_force(self.rig.mass("m1"), self.rig.mass("m2"), self.rig.g.value, **self.stated_ground)

    def along(self, theta: ValuesBySymbol) -> Any:
        """Weight of capsule and rod along the slope, N, positive where it opposes the motion."""
        if "slope" not in self.ground:
            return 0.0
        return weight_along(theta["m1"] + theta["m2"], theta["g"], self.ground_at(theta), self.backward)

    @property
    def stated_along(self) -> np.ndarray:
        """``along`` at the stated masses, () or (n,) N."""
        stated = {name: self.rig.mass(name) for name in ("m1", "m2") if name in self.masses}
        return np.asarray(self.along({**stated, **self.stated_ground, "g": self.rig.g.value}))

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

    def rough_starts(self) -> dict[str, Start]:
        """Starts of mu and v_s from the paper's estimates; another law starts at its prior medians."""
        speed, coefficient = self.paper_points()
        mu = Start(float(np.max(coefficient)), 0.3)
        return {"mu": mu, "mu_back": mu, "v_s": Start(float(np.median(speed)), 0.5)}

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        return friction_comparison([self], theta, draws)


class LoadedExperiment(FrictionExperiment):
    """Forces that overcome friction, where the normal force may be stated for all trials or for each.

    On a slope such a normal force N comes from weights, whose part along the slope is N tan(slope), or presses without
    weight beside the weight of capsule and rod.
    """

    #: () or (n,), N; None: that of the weight
    normal_force: np.ndarray | None
    normal_force_sd: float
    #: Whether the stated normal force comes from weights.
    of_weights: bool = eqx.field(static=True)

    @property
    def weighed(self) -> bool:
        """Whether the force depends on the masses."""
        return self.normal_force is None or ("slope" in self.ground and not self.of_weights)

    @property
    def loads(self) -> tuple[np.ndarray, np.ndarray] | None:
        several = self.normal_force is not None and np.size(self.normal_force) > 1
        return (np.asarray(self.normal_force), self.paper_points()[1]) if several else None

    def alternatives(self, theta: ValuesBySymbol) -> dict[str, np.ndarray]:
        """The load shows a constant force beside the friction, 1 N."""
        loads = {"loads": np.ones(self.n)} if self.loads is not None and np.ptp(self.loads[0]) > 0.0 else {}
        return {**super().alternatives(theta), **loads}

    def along(self, theta: ValuesBySymbol) -> Any:
        """Weight along the slope, N, () or (n,)."""
        if self.normal_force is None or not self.of_weights:
            return super().along(theta)
        slope = self.ground_at(theta)["slope"]
        uphill = self.normal_force * array_module(slope).tan(slope)
        return -uphill if self.backward else uphill

    def refuse_weight_along(self, force: np.ndarray) -> None:
        """Refuse forces (n,) of which none exceeds the weight along the slope.

        Raises
        ------
        InputError
            At the row with the largest friction.
        """
        if "slope" not in self.ground or np.any(force > self.stated_along):
            return
        row = int(np.argmax(force - self.stated_along))
        along = float(np.broadcast_to(self.stated_along, force.shape)[row])
        rule = f"a force must exceed the weight along the slope, {along:.4g} N"
        remedy = "correct slope, direction or load_is"
        raise InputError(rule, f"{force[row]:.4g} N", remedy, self.table.file, int(self.table.rows[row]))

    def of_normal_force(self, coefficient: Any, along: Any) -> Any:
        """Change of the force with its normal force, from the ``coefficient`` of friction."""
        return coefficient + along / self.normal_force if self.of_weights else coefficient

    def relative_errors(self, force: np.ndarray, force_sd: float) -> np.ndarray:
        """Relative sd (n,) of the coefficients (force - along)/N, from the errors of force (n,) and N."""
        along = self.stated_along
        of_force = force_sd / (force - along)
        if self.normal_force is None:
            return np.abs(of_force)
        share = force / (force - along) if self.of_weights else 1.0
        return np.hypot(of_force, share * self.normal_force_sd / self.normal_force)


def stated_normal_forces(table: Table[Any]) -> tuple[np.ndarray | None, float]:
    """Return the column ``normal_force``, (n,) N, or None, and its reading error, N."""
    column = table.columns.get("normal_force")
    return (None, 0.0) if column is None else (column.values, column.reading_sd)


def friction_comparison(
    experiments: list[FrictionExperiment], theta: ValuesBySymbol, draws: list[ValuesBySymbol]
) -> Comparison:
    """Plot data of friction coefficient against velocity: readings, the paper's curve, this fit (paper, Fig. 2)."""
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
        lower, upper = band(np.array([curve(law, draw) for draw in draws]))
        name = f"this fit, {law.name}" + (f", {law.direction}" if len(laws) > 1 else "")
        curves.append(Curve(name, speed, curve(law, theta), lower, upper))
    paper = paper_friction_fit(np.concatenate([p.x for p in points]), np.concatenate([p.y for p in points]))
    if "v_s" in paper:
        curves.append(Curve("the paper's fit", speed, unit_law(**paper).forward(speed), role="paper"))
    if any(e.role == "dynamic" for e in experiments) and not any(e.ground for e in experiments):
        reading = np.maximum(speed[1:], 1e-3 * speed[-1])
        distance = slide_distance(friction.coefficient(theta), 1.0 / theta["g"], reading)
        expected = reading**2 / (2.0 * theta["g"] * distance)
        curves.append(Curve("this fit, read as v²/(2gd)", reading, expected, role="alternative"))
    return Comparison(
        "friction",
        "friction",
        "Friction coefficient against velocity",
        "velocity [m/s]",
        "friction coefficient [1]",
        tuple(points),
        tuple(curves),
    )
