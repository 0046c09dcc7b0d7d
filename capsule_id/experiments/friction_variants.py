"""Variants of the friction law, compared by their marginal likelihoods on the friction experiments, and their checks."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy import optimize, special

from capsule_id.experiments.base import LEVEL, Fitted
from capsule_id.experiments.friction_model import FrictionModel, Reversed, model_lines
from capsule_id.experiments.misfit import LOG_2PI
from capsule_id.experiments.statistics import of_neighbours, permutation_p
from capsule_id.parameters import CONSTANT, QUANTILE_975, SAME, Parameter, Prior
from capsule_id.physics.forces import CoulombStribeck
from capsule_id.rig.model import ModelChoices, Quantity
from capsule_id.views import Finding, Level, after_number

# friction variants: Variants of the friction law, compared by their marginal likelihoods on the friction experiments.
#
# The readings are the paper's points, (speed, coefficient), with relative errors. Few points leave several modes, where
# differences of maxima mislead. So each variant is integrated over its priors, by sequential Monte Carlo (Del Moral,
# Doucet & Jasra 2006): particles move from the prior to the posterior through powers of the likelihood.
# If the law in use is right, its marginal likelihood is ``FACTOR`` times smaller than another one's with probability at
# most 1/FACTOR (Markov's inequality, for parameters drawn from the prior).


#: Ratio of marginal likelihoods above which a variant is rejected, and above which data tell it from the best.
FACTOR, TELLING = 100.0, 10.0
#: Rms error of a value over all laws, with their probabilities as weights, in its sd, from which it is in doubt.
#: Of 80 clean rigs with 8 tilts and 8 slides 3 are, of 80 with a ratio of 0.8 or 0.65 all; of 40 with 10 tilts and 12
#: pushes 4. Without tilts, or where all slides are slower than v_s, many clean ones are: their readings do not tell.
DOUBTFUL = 3.0
#: Largest speed relative to v_s from which slides show where the friction ends to fall.
FAST = 1.5
#: Number of groups of readings, neighbours in speed: time and memory do not grow with the readings beyond.
GROUPS = 128
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
    model : the law
    values, sds : posterior means and standard deviations of the law's parameters, SI, by symbol
    log_likelihood : the largest of the sample
    evidence : log marginal likelihood
    bic : Schwarz's criterion
    lack_of_fit : p-value of the residuals' order in speed: neighbours of one sign show a curve that misses the readings
    """

    model: FrictionModel
    values: Mapping[str, float]
    sds: Mapping[str, float]
    log_likelihood: float
    evidence: float
    bic: float
    lack_of_fit: float


def candidates(experiments: Sequence[Any]) -> list[FrictionModel]:
    """Return the laws that the experiments can tell apart, the law in use included, the simplest first."""
    in_use = replace(experiments[0].friction, direction="both", contact=None)
    models = [FrictionModel(constant=True), FrictionModel(), FrictionModel(free=("ratio",))]
    # A viscous part over a normal force of every row is refused, so it is not proposed either.
    per_row = any("normal_force" in e.table.columns for e in experiments if e.role == "sliding")
    if experiments[0].rig.m1 is not None and experiments[0].rig.m2 is not None and not per_row:
        models += [FrictionModel(free=("viscous",), constant=True), FrictionModel(free=("ratio", "viscous"))]
    if len({e.friction.direction for e in experiments}) > 1:
        models += [replace(model, free=("mu_back", *model.free)) for model in models]
    return sorted({in_use, *models}, key=lambda m: (len(m.parameters), not m.constant, m.free))


def _grouped(e: Any, most: int) -> tuple[np.ndarray, ...]:
    """The points of a friction experiment in ``most`` groups of neighbours in speed; each alone where they are no more.

    Returns
    -------
    (g,) each: means of the points' speeds, m/s, and of the logarithms of their coefficients; relative sd of a point from
    the reading errors, and per unit of the scatter; number of points, and the sum of squares of their logarithms about
    the curve, from the differences of neighbours.
    """
    speed, coefficient = e.paper_points()
    order = np.argsort(speed, kind="stable") if e.n > most else np.arange(e.n)
    first = np.unique(np.linspace(0, e.n, min(e.n, most), endpoint=False).astype(int))
    number, logs = np.diff(np.append(first, e.n)), np.log(coefficient)[order]
    step = np.diff(logs, prepend=0.0)
    step[first] = 0.0

    def mean(x: Any) -> np.ndarray:
        return np.add.reduceat(np.broadcast_to(x, e.n)[order], first) / number

    errors = (np.sqrt(mean(np.square(x))) for x in e.point_errors())
    logs = np.add.reduceat(logs, first) / number
    return mean(speed), logs, *errors, number, np.add.reduceat(0.5 * step**2, first)


class VariantPoints:
    """The paper's points of all friction experiments, and their density under a law."""

    def __init__(self, experiments: Sequence[Any]) -> None:
        self.experiments = tuple(experiments)
        self.n = sum(e.n for e in experiments)
        self.parts = [_grouped(e, -(-GROUPS * e.n // self.n)) for e in experiments]
        self.speed, *_, self.number, self.spread = (np.concatenate(column) for column in zip(*self.parts, strict=True))
        rig = experiments[0].rig
        weighed = rig.m1 is not None and rig.m2 is not None
        self.normal_forces = [e.stated_normal_force if weighed else np.nan for e in experiments]

    def rows(self, model: FrictionModel) -> list[Parameter]:
        """The law's parameters, then the scatters, with the priors of the fit."""
        scatters = {row.symbol: row for e in self.experiments for row in e.parameters if row.symbol == e.scatter.symbol}
        rows = [*model.parameters, *scatters.values()]
        stated = self.experiments[0].rig.priors
        return [row.named(row.of, stated.get(row.name)) for row in rows]

    def scaled(self, model: FrictionModel, theta: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Differences of the groups' log-coefficients, and the sd of a reading, (s, g) each, at ``theta``: (s,) by symbol."""
        known = {row.symbol: theta[row.symbol] for row in model.parameters} | (CONSTANT if model.constant else {})
        viscous = known.pop("viscous", None)
        raw, sd = [], []
        for e, (speed, logs, reading, per_scatter, *_), N in zip(
            self.experiments, self.parts, self.normal_forces, strict=True
        ):
            own = {**known, "viscous": 0.0 if viscous is None else viscous / N}
            leaves = {name: value if np.ndim(value) == 0 else value[:, None, None] for name, value in own.items()}
            law = CoulombStribeck(N=1.0, **leaves)
            law = Reversed(law) if e.friction.direction == "backward" else law
            scatter = theta[e.scatter.symbol][:, None] * per_scatter
            raw.append(logs - np.log(e.paper_coefficient(law, speed)))
            sd.append(np.sqrt(reading**2 + scatter**2 + SMALLEST_ERROR**2))
        return np.concatenate(raw, axis=1), np.concatenate(sd, axis=1)

    def log_likelihood(self, model: FrictionModel, theta: Mapping[str, np.ndarray]) -> np.ndarray:
        """(s,) natural log-density of the log-coefficients."""
        raw, sd = self.scaled(model, theta)
        squares = self.number * (raw / sd) ** 2 + self.spread / sd**2
        value = -0.5 * np.sum(squares + self.number * (LOG_2PI + 2.0 * np.log(sd)), axis=1)
        return np.where(np.isfinite(value), value, -np.inf)


def fit_variant(points: VariantPoints, model: FrictionModel, seed: int) -> Variant:
    """Fit one law; the same seed gives the same numbers."""
    rows = points.rows(model)

    def theta_of(z: np.ndarray) -> dict[str, np.ndarray]:
        return {row.symbol: _from_normal(row, z[:, i]) for i, row in enumerate(rows)}

    def density(z: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return points.log_likelihood(model, theta_of(z))

    z, values, evidence = sequential_monte_carlo(density, len(rows), np.random.default_rng(seed))
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
        len(rows) * float(np.log(points.n)) - 2.0 * float(values[best]),
        permutation_p((np.sqrt(points.number) * raw / sd)[0][order], of_neighbours, PERMUTATIONS),
    )


def sequential_monte_carlo(
    density: Callable[[np.ndarray], np.ndarray], dimension: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Sample the posterior of a standard normal prior; return particles (s, d), log-likelihoods (s,), log evidence."""
    z = rng.standard_normal((PARTICLES, dimension))
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
        position = (rng.random() + np.arange(PARTICLES)) / PARTICLES * np.sum(weight)
        chosen = np.minimum(np.searchsorted(np.cumsum(weight), position), PARTICLES - 1)
        z, value = z[chosen], value[chosen]
        for scale in np.geomspace(1.0, 0.1, MOVES):
            proposed = z + scale * 2.38 / np.sqrt(dimension) * rng.standard_normal(z.shape) @ root.T
            new = density(proposed)
            change = power * (new - value) - 0.5 * np.sum(proposed**2 - z**2, axis=1)
            accepted = np.log(rng.random(PARTICLES)) < change
            z, value = np.where(accepted[:, None], proposed, z), np.where(accepted, new, value)
    return z, value, evidence


def _next_step(value: np.ndarray, largest: float) -> float:
    """Largest increase of the power that keeps ``KEPT`` of the particles effective."""

    def effective(step: float) -> float:
        weight = np.exp(step * (value - np.max(value)))
        return float(np.sum(weight) ** 2 / np.sum(weight**2) / len(value))

    if effective(largest) >= KEPT:
        return largest
    return max(optimize.root_scalar(lambda step: effective(step) - KEPT, bracket=(0.0, largest)).root, SAME)


def _from_normal(row: Parameter, z: np.ndarray) -> np.ndarray:
    """Values of a parameter whose prior is that of a standard normal ``z``."""
    prior = row.prior if row.prior is not None else Prior("lognormal", 1.0, 10.0)
    if prior.kind == "halfnormal":
        return prior.spread * special.ndtri(0.5 * (1.0 + special.ndtr(z)))
    return prior.location * np.exp(np.log(prior.spread) / QUANTILE_975 * z)


# checks: Comparison with other laws, order of the residuals in speed.


#: Smallest number of sliding readings for a comparison of laws, and seed of its sampler.
FEWEST_SLIDES, SEED = 3, 0


def _doubt(
    variants: Sequence[Variant], used: Variant, fastest: float, choices: ModelChoices
) -> tuple[list[Parameter], dict[str, Any]]:
    """Parameters that all laws together know ``DOUBTFUL`` times worse (Hoeting et al. 1999), and the facts of its words.

    Means, and mean squares about the value of the law in use, are over the laws that have the parameter, by their
    probabilities. ``fastest``: largest speed of a slide, m/s.
    """
    means, spreads = {}, {}
    for name in used.values.keys() | {"v_s"}:
        own = [variant for variant in variants if name in variant.values]
        weights = special.softmax([variant.evidence for variant in own])
        values, sds = np.array([(variant.values[name], variant.sds[name]) for variant in own]).T
        means[name] = float(np.dot(weights, values))
        about = values - used.values.get(name, means[name])
        spreads[name] = float(np.sqrt(np.dot(weights, about**2 + sds**2)))
    shifts = {name: spreads[name] / used.sds[name] for name in used.values}
    moved = [row for row in used.model.parameters if shifts[row.symbol] > DOUBTFUL]
    # A law that contains the one in use takes nothing away from it.
    wider = [variant for variant in variants if used.values.keys() < variant.values.keys()]
    other = max(wider, key=lambda variant: variant.evidence, default=used)
    return moved, {
        "other": None if other is used else other.model.name,
        "other_line": model_lines(other.model, choices),
        "other_factor": float(np.exp(np.clip(other.evidence - used.evidence, -700.0, 700.0))),
        "slow": fastest < FAST * means["v_s"],
        "shift": max(shifts.values()),
        "means": ", ".join(
            f"{row.name} = {means[row.symbol]:.3g} ± {spreads[row.symbol]:.2g}{after_number(row.unit)}" for row in moved
        ),
        "now": ", ".join(
            f"{row.name} = {used.values[row.symbol]:.3g} ± {used.sds[row.symbol]:.2g}{after_number(row.unit)}"
            for row in moved
        ),
    }


def _corrected(e: Any, fit: Fitted) -> Any:
    """The experiment at the slope and N0 that the fit found, without the errors of its instruments: no law has them."""
    sampled = [name for name, value in e.ground.items() if value is None]
    if not (e.instruments or sampled):
        return e
    theta, columns = e.local(fit.values), dict(e.table.columns)
    settings = replace(e.table.settings, **{name: Quantity(float(theta[name])) for name in sampled})
    for name, _ in e.instruments:
        factor, offset = e.instrument(name, theta)
        values = (columns[name].values - offset) / factor
        if np.any(values <= 0.0):  # a point of the paper is positive
            return e
        columns[name] = replace(columns[name], values=values, instrument=None)
    return type(e)(replace(e.table, columns=columns, settings=settings), e.rig, e.friction)


def check_variants(experiments: Sequence[Any], fit: Fitted) -> list[Finding]:
    """Compare the friction law in use with other laws, and recommend the simplest that the readings allow.

    The law in use fails where another one has a marginal likelihood ``FACTOR`` times larger, or where its residuals are
    ordered by speed. Else a parameter that all laws together know ``DOUBTFUL`` times worse is not judged, unless the law
    is confirmed.
    """
    # Laws that depend on the speed can be compared where each reading has one.
    experiments = [e for e in experiments if e.role == "static" or "speed" in e.table.columns]
    experiments = [e for e in map(partial(_corrected, fit=fit), experiments) if np.all(e.paper_points()[1] > 0.0)]
    in_use = replace(experiments[0].friction, direction="both", contact=None) if experiments else FrictionModel()
    if in_use.law is not CoulombStribeck or sum(e.n for e in experiments if e.role != "static") < FEWEST_SLIDES:
        return []
    points = VariantPoints(experiments)
    variants = [fit_variant(points, model, SEED) for model in candidates(experiments)]
    highest = max(variant.evidence for variant in variants)
    used = next(variant for variant in variants if variant.model == in_use)
    simplest = next(variant for variant in variants if highest - variant.evidence < np.log(TELLING))
    rig = experiments[0].rig
    moved, doubt = _doubt(variants, used, float(np.max(points.speed)), rig.model)
    facts = {
        "name": in_use.name,
        "labels": ", ".join(e.label for e in experiments),
        "count": len(variants),
        "factor": float(np.exp(min(highest - used.evidence, 700.0))),
        "simplest": simplest.model.name,
        "line": model_lines(simplest.model, rig.model),
        "p": used.lack_of_fit,
        **doubt,
        "tilts": any(e.role == "static" for e in experiments),
        "confirmed": ", ".join(f'"{name}"' for name in (*rig.confirmed, "friction")),
    }
    names = tuple(row.name for row in in_use.parameters)
    rows = [
        {
            "law": variant.model.name,
            "parameters": "; ".join(
                f"{name} = {value:.4g} ± {variant.sds[name]:.2g}" for name, value in variant.values.items()
            ),
            "log-likelihood": variant.log_likelihood,
            "BIC": variant.bic - min(other.bic for other in variants),
            "log marginal likelihood": variant.evidence - highest,
            "order of residuals, p": variant.lack_of_fit,
            "[model]": model_lines(variant.model, rig.model),
        }
        for variant in variants
    ]
    # A law that the one in use contains is more probable for having fewer parameters: the numbers hold.
    best = max(variants, key=lambda variant: variant.evidence).values.keys()
    contained = {"v_s"} <= best < used.values.keys()
    rejected, ordered = facts["factor"] > FACTOR and not contained, used.lack_of_fit < LEVEL
    level: Level = "fail" if rejected else "warn" if moved and "friction" not in rig.confirmed else "ok"
    concerned = tuple(row.name for row in moved) if level == "warn" else names
    return [
        Finding("friction.variants", level, {**facts, "alternatives": rows}, parameters=concerned),
        Finding("friction.order", "fail" if ordered else "ok", facts, parameters=names),
    ]
