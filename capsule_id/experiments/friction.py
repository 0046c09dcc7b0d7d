"""Friction of a fit: slopes, the law and its parameters, shared declarations, and variants of the law."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from scipy import special

from capsule_id.errors import InputError
from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.kind import Values
from capsule_id.experiments.lint import lint_rows
from capsule_id.experiments.misfit import LOG_2PI
from capsule_id.parameters import QUANTILE_975, Parameter, Prior, parameter
from capsule_id.physics.batches import array_module
from capsule_id.physics.friction import CoulombStribeck, FrictionLaw, normal_force, slide_distance
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.rig.schema import ColumnRule, GroundSettings
from capsule_id.rig.tables import Entry
from capsule_id.rig.toml import POSITIVE
from capsule_id.views import Finding, Message, counted

if TYPE_CHECKING:
    from capsule_id.experiments.friction_experiment import FrictionExperiment
    from capsule_id.views import Comparison
from capsule_id.experiments.friction_model import CONSTANT, FrictionModel, Reversed

# friction: Shared declarations of friction experiments: eq. (1), the paper's fit, one panel, one rule on readings.


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings(GroundSettings):
    """``direction``: towards the support spring ("forward") or away from it; it matters where mu_back is free."""

    direction: Literal["forward", "backward"] = "forward"


@dataclass(frozen=True, kw_only=True)
class PullSettings(SurfaceSettings):
    """``load_is``: whether stated normal forces on a slope come from weights, or press without weight; else None."""

    load_is: Literal["weight", "pressed"] | None = None


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


def has_stated_load(table: Table[Any]) -> bool:
    """Whether pulls state their normal force, which then holds N0 too."""
    return isinstance(table.settings, PullSettings) and (
        "normal_force" in table.columns or getattr(table.settings, "normal_force", None) is not None
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
        rule = "load_is must say where a stated normal force on a slope comes from"
        remedy = (
            'write load_is = "weight" for weights on the capsule, or load_is = "pressed" for a force without weight'
        )
        raise entry.error("", rule, "none", remedy)
    if table.settings.load_is is not None and not needed:
        raise entry.error("load_is", "load_is needs a slope and a stated normal force", "no such", "remove it", True)


def lint_slides(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Warn where slides have few rows: constant friction has one unknown, another law mu and v_s."""
    return lint_rows(table, rig, 3 if rig.model.friction == "constant" else 5)


CAPTIONS = {
    "friction": "Counterpart of the paper's Fig. 2: coefficients as the paper reads them off, its curve, and ours."
}

#: A friction coefficient holds the viscous part as a force per weight.
MASSES_OF_FREE = {"viscous": ("m1", "m2")}

MESSAGES = {
    "friction.variants": Message(
        "friction law",
        ok=(
            "{name} explains the readings as well as the best of {count} friction laws, which is {factor:.2g} times as "
            "probable. The simplest law that does so is {simplest}: {line} in [model]"
        ),
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
            "above sliding friction is no fault, but constant friction cannot show it: give the slides a column speed and "
            'state friction = "stribeck", or fit both in folders of their own.'
        ),
    ),
}


def friction_estimates(experiments: Sequence["FrictionExperiment"]) -> Values:
    """Estimate mu and v_s as in the paper: fit eq. (1) to the points of all friction experiments."""
    from capsule_id.experiments.friction_experiment import paper_friction_fit

    points = [e.paper_points() for e in experiments]
    speed, coefficient = (np.concatenate(parts) for parts in zip(*points, strict=True))
    return paper_friction_fit(speed, coefficient)


def friction_panels(
    experiments: Sequence["FrictionExperiment"], values: Values, draws: Sequence[Values]
) -> tuple["Comparison"]:
    """Return one panel for all friction experiments."""
    from capsule_id.experiments.friction_experiment import friction_comparison

    # Local values differ in scatters only. Merged, they contain mu and v_s if any experiment has both.
    points: list[Values] = [{k: v for e in experiments for k, v in e.local(p).items()} for p in (values, *draws)]
    return (friction_comparison(list(experiments), points[0], points[1:]),)


def check_scatter(tables: Sequence[Table[Any]]) -> None:
    """Reject equal readings without reading error: a scatter of 0 makes the posterior improper.

    Raises
    ------
    InputError
        If all readings are equal and no reading error is stated.
    """
    if len({tuple(table.columns) for table in tables}) != 1:
        return
    rows = np.concatenate([np.stack([c.values for c in t.columns.values()], axis=1) for t in tables])
    if len(rows) < 2 or np.any(rows != rows[0]):
        return
    if not any(column.reading_sd > 0.0 for table in tables for column in table.columns.values()):
        name = next(iter(tables[0].columns))
        rule = f"{tables[0].kind} readings that are all the same need their reading step"
        raise InputError(rule, counted(len(rows), "row"), f"state {name}_resolution", tables[0].file)


# inclined: A capsule that slides along a slope: what brakes it, and the coefficient that a slide shows.


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


# friction variants: Variants of the friction law, compared by their marginal likelihoods on the friction experiments.
#
# The readings are the paper's points, (speed, coefficient), with relative errors. Few points leave several modes, where
# differences of maxima mislead. So each variant is integrated over its priors, by sequential Monte Carlo (Del Moral,
# Doucet & Jasra 2006): particles move from the prior to the posterior through powers of the likelihood.
# If the law in use is right, its marginal likelihood is ``FACTOR`` times smaller than another one's with probability at
# most 1/FACTOR (Markov's inequality, for parameters drawn from the prior).


#: Ratio of marginal likelihoods above which a variant is rejected, and above which data tell it from the best.
FACTOR, TELLING = 100.0, 10.0
#: Number of particles, Metropolis steps between two powers, and the part of the particles that a power must keep.
PARTICLES, MOVES, KEPT = 1000, 6, 0.5
#: Smallest relative error of a reading: rounding of equal readings.
SMALLEST_ERROR = 1e-6
#: Number of permutations of the runs test.
PERMUTATIONS = 4000


@dataclass(frozen=True)
class Variant:
    """One friction law fitted to the friction experiments.

    Attributes
    ----------
    line : what ``[model]`` of rig.toml must say
    values, sds : posterior means and standard deviations of the law's parameters, SI, by symbol
    log_likelihood : the largest of the sample
    evidence : log marginal likelihood
    bic : Schwarz's criterion
    lack_of_fit : p-value of the residuals' order, see ``order_p``
    """

    model: FrictionModel
    values: Mapping[str, float]
    sds: Mapping[str, float]
    log_likelihood: float
    evidence: float
    bic: float
    lack_of_fit: float

    @property
    def line(self) -> str:
        return model_lines(self.model)


def model_lines(model: FrictionModel) -> str:
    """What ``[model]`` must say for the law ``model``."""
    lines = ['friction = "constant"'] if model.constant else []
    if model.free:
        lines.append("free = [" + ", ".join(f'"{symbol}"' for symbol in model.free) + "]")
    return ", and on the next line ".join(lines) or 'friction = "stribeck"'


def candidates(experiments: "Sequence[FrictionExperiment]") -> list[FrictionModel]:
    """Return the laws that the experiments can tell apart, the law in use included, the simplest first."""
    in_use = replace(experiments[0].friction, direction="both")
    models = [FrictionModel(constant=True), FrictionModel(), FrictionModel(free=("ratio",))]
    # A viscous part over a normal force of every row is refused, so it is not proposed either.
    per_row = any("normal_force" in e.table.columns for e in experiments if e.role == "sliding")
    if experiments[0].rig.m1 is not None and experiments[0].rig.m2 is not None and not per_row:
        models += [FrictionModel(free=("viscous",), constant=True), FrictionModel(free=("ratio", "viscous"))]
    if len({e.friction.direction for e in experiments}) > 1:
        models += [replace(model, free=("mu_back", *model.free)) for model in models]
    return sorted({in_use, *models}, key=lambda m: (len(m.parameters), not m.constant, m.free))


@runtime_checkable
class Slide(Protocol):
    """A friction experiment that records slide distances."""

    @property
    def stated_track(self) -> Track: ...


class VariantPoints:
    """The paper's points of all friction experiments, and their density under a law."""

    def __init__(self, experiments: "Sequence[FrictionExperiment]") -> None:
        self.experiments = tuple(experiments)
        points = [e.paper_points() for e in experiments]
        self.speed = np.concatenate([speed for speed, _ in points])
        self.logs = [np.log(coefficient) for _, coefficient in points]
        self.errors = [e.point_errors() for e in experiments]
        rig = experiments[0].rig
        weighed = rig.m1 is not None and rig.m2 is not None
        self.normal_forces = [e.stated_normal_force if weighed else np.nan for e in experiments]
        self.priors = rig.priors

    def rows(self, model: FrictionModel) -> list[Parameter]:
        """The law's parameters, then the scatters, with the priors of the fit."""
        scatters = {row.symbol: row for e in self.experiments for row in e.parameters if row.symbol == e.scatters[0]}
        rows = [*model.parameters, *scatters.values()]
        return [row if row.name not in self.priors else row.named(row.of, self.priors[row.name]) for row in rows]

    def scaled(self, model: FrictionModel, theta: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Differences of log-coefficients and their sd, (s, n) each, at ``theta``: (s,) by symbol."""
        known = {row.symbol: theta[row.symbol] for row in model.parameters} | (CONSTANT if model.constant else {})
        viscous = known.pop("viscous", None)
        raw, sd = [], []
        for e, logs, (reading, per_scatter), N in zip(
            self.experiments, self.logs, self.errors, self.normal_forces, strict=True
        ):
            axes = (1, 2) if isinstance(e, Slide) else (1,)
            own = {**known, "viscous": 0.0 if viscous is None else viscous / N}
            law = CoulombStribeck(
                N=1.0,
                **{name: value if np.ndim(value) == 0 else np.expand_dims(value, axes) for name, value in own.items()},
            )
            law = Reversed(law) if e.friction.direction == "backward" else law
            speed = e.paper_points()[0]
            if isinstance(e, Slide):
                expected = e.stated_track.coefficient(speed, e.stated_track.distance(law, speed))
            else:
                expected = law.forward(speed)
            scatter = theta[str(e.scatters[0])][:, None] * per_scatter
            raw.append(logs - np.log(expected))
            sd.append(np.sqrt(reading**2 + scatter**2 + SMALLEST_ERROR**2) * np.ones(len(logs)))
        return np.concatenate(raw, axis=1), np.concatenate(sd, axis=1)

    def log_likelihood(self, model: FrictionModel, theta: Mapping[str, np.ndarray]) -> np.ndarray:
        """(s,) natural log-density of the log-coefficients."""
        raw, sd = self.scaled(model, theta)
        value = -0.5 * np.sum((raw / sd) ** 2 + LOG_2PI + 2.0 * np.log(sd), axis=1)
        return np.where(np.isfinite(value), value, -np.inf)


def fit_variant(points: VariantPoints, model: FrictionModel, seed: int, particles: int = PARTICLES) -> Variant:
    """Fit one law; the same seed gives the same numbers."""
    rows = points.rows(model)

    def theta_of(z: np.ndarray) -> dict[str, np.ndarray]:
        return {row.symbol: _from_normal(row, z[:, i]) for i, row in enumerate(rows)}

    def density(z: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return points.log_likelihood(model, theta_of(z))

    z, values, evidence = sequential_monte_carlo(density, len(rows), np.random.default_rng(seed), particles)
    theta, best = theta_of(z), int(np.argmax(values))
    raw, sd = points.scaled(model, {name: column[best : best + 1] for name, column in theta.items()})
    own = {row.symbol: theta[row.symbol] for row in model.parameters}
    # Readings at one speed have no order in speed; that of their rows is another check's.
    order = np.lexsort((np.random.default_rng(seed).random(len(points.speed)), points.speed))
    return Variant(
        model,
        {name: float(np.mean(column)) for name, column in own.items()},
        {name: float(np.std(column)) for name, column in own.items()},
        float(values[best]),
        evidence,
        len(rows) * float(np.log(len(points.speed))) - 2.0 * float(values[best]),
        order_p((raw / sd)[0][order], np.random.default_rng(seed)),
    )


def sequential_monte_carlo(
    density: Callable[[np.ndarray], np.ndarray], dimension: int, rng: np.random.Generator, particles: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Sample the posterior of a standard normal prior; return particles (s, d), log-likelihoods (s,), log evidence."""
    z = rng.standard_normal((particles, dimension))
    value, power, evidence = density(z), 0.0, 0.0
    while power < 1.0:
        step = _next_step(value, 1.0 - power)
        weight = np.exp(step * (value - np.max(value)))
        evidence += float(np.log(np.mean(weight)) + step * np.max(value))
        power += step
        mean = np.average(z, axis=0, weights=weight)
        root = np.linalg.cholesky(
            np.cov((z - mean).T, aweights=weight).reshape(dimension, dimension) + 1e-10 * np.eye(dimension)
        )
        position = (rng.random() + np.arange(particles)) / particles * np.sum(weight)
        chosen = np.minimum(np.searchsorted(np.cumsum(weight), position), particles - 1)
        z, value = _metropolis(density, (z[chosen], value[chosen]), power, root, rng)
    return z, value, evidence


def _metropolis(
    density: Callable[[np.ndarray], np.ndarray],
    particles: tuple[np.ndarray, np.ndarray],
    power: float,
    root: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Move ``particles``, z (s, d) with their log-likelihoods (s,), by ``MOVES`` steps of the Metropolis rule.

    root : (d, d) Cholesky factor of the covariance of z
    """
    z, value = particles
    for scale in np.geomspace(1.0, 0.1, MOVES):
        proposed = z + scale * 2.38 / np.sqrt(z.shape[1]) * rng.standard_normal(z.shape) @ root.T
        new = density(proposed)
        change = power * (new - value) - 0.5 * np.sum(proposed**2 - z**2, axis=1)
        accepted = np.log(rng.random(len(z))) < change
        z, value = np.where(accepted[:, None], proposed, z), np.where(accepted, new, value)
    return z, value


def order_p(residuals: np.ndarray, rng: np.random.Generator) -> float:
    """Permutation p-value of the sum of products of neighbouring residuals (n,), in the order of speed.

    Neighbours of one sign show a curve that misses the readings. The test is exact for exchangeable residuals.
    """

    def statistic(r: np.ndarray) -> np.ndarray:
        return np.sum(r[..., 1:] * r[..., :-1], axis=-1)

    shuffled = rng.permuted(np.tile(residuals, (PERMUTATIONS, 1)), axis=1)
    return float((1 + np.sum(statistic(shuffled) >= statistic(residuals))) / (1 + PERMUTATIONS))


def _next_step(value: np.ndarray, largest: float) -> float:
    """Largest increase of the power that keeps ``KEPT`` of the particles effective."""

    def effective(step: float) -> float:
        weight = np.exp(step * (value - np.max(value)))
        return float(np.sum(weight) ** 2 / np.sum(weight**2) / len(value))

    low, high = 0.0, largest
    if effective(high) >= KEPT:
        return high
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= KEPT else (low, middle)
    return max(low, 1e-9)


def _from_normal(row: Parameter, z: np.ndarray) -> np.ndarray:
    """Values of a parameter whose prior is that of a standard normal ``z``."""
    prior = row.prior if row.prior is not None else Prior("lognormal", 1.0, 10.0)
    if prior.kind == "halfnormal":
        return prior.spread * special.ndtri(0.5 * (1.0 + special.ndtr(z)))
    return prior.location * np.exp(np.log(prior.spread) / QUANTILE_975 * z)
