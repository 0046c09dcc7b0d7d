"""Predictions from a fit with progressions: new trials at other settings, and readings that are left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from capsule_id.errors import InputError
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference.curvature import PerPoint, Random
from capsule_id.inference.marginal import MarginalPosterior, trials_of
from capsule_id.inference.proposal import BlockProposal, effective_size
from capsule_id.inference.result import PointFit, Result
from capsule_id.inference.sampling import Emulation, ExactMotions, adapted_proposal, emulation, laplace_proposal
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import Column, Table
from capsule_id.rig.read import read_settings
from capsule_id.views import Comparison, counted

#: Draws of the posterior; the ends of the 95 % interval then have a standard error of a tenth of its sd.
DRAWS = 1000
#: The reading that is predicted.
READING = "distance"


@dataclass(frozen=True)
class Prediction:
    """Predicted displacements as a table, and panels of mean velocity against period with the trials of the fit."""

    table: pd.DataFrame
    panels: tuple[Comparison, ...]


def random_draws(result: Result, number: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """``number`` draws of the sample, taken at random without repetition: name -> (number,), SI.

    Raises
    ------
    InputError
        If nothing was sampled, or there are fewer draws.
    """
    if result.posterior is None:
        raise InputError(
            "draws need a sample", "the point fit alone", "fit without --no-sample, in Python without budget=None"
        )
    flat = result.posterior.draws.reshape(-1, len(result.posterior.names))
    if not 1 <= number <= len(flat):
        raise InputError("draws must lie between 1 and the sample's", str(number), f"give at most {len(flat)}")
    chosen = flat[rng.choice(len(flat), number, replace=False)]
    return dict(zip(result.posterior.names, chosen.T, strict=True))


def predict(result: Result, settings: str | Path, draws: int = DRAWS, seed: int = 0) -> Prediction:
    """Predict a new trial in a new session at each row of a table of settings.

    Parameters
    ----------
    result : of a fit with a progression, sampled; the first one gives reading error and drive
    settings : a file with the columns of that progression, without ``distance``
    draws : draws of the posterior, at most those of the sample
    seed : of the choice of draws, and of sessions and trials

    Returns
    -------
    Its ``table`` has a row per row of ``settings``: ``distance [mm]`` (median), ``distance_lower [mm]`` and
    ``distance_upper [mm]`` (central 95 %, all scatter included), ``mean_velocity [mm/s]`` (of the median).

    Raises
    ------
    InputError
        If nothing was sampled, no progression was fitted, ``draws`` is out of range, or the settings break a rule.
    """
    made = make_experiments(result.rig, "all", result.registry)
    experiment = next((e for e in made if isinstance(e, Progression) and e.label in result.observed), None)
    if experiment is None:
        raise InputError("a prediction needs a fit with a progression", "none", "add one to the rig and fit again")
    rng = np.random.default_rng(seed)
    chosen = random_draws(result, draws, rng)
    columns = read_settings(Path(settings), result.registry[experiment.kind], READING)
    _check_settings(experiment.table, columns, Path(settings))
    constants = {**result.fixed, "g": result.rig.g.value}
    thetas = zip(*chosen.values(), strict=True)
    values = [experiment.local({**constants, **dict(zip(chosen, theta, strict=True))}) for theta in thetas]
    rows, time = experiment.settings_of(columns)
    trials = 1e3 * experiment.new_trials(values, rows, rng)
    lower, median, upper = np.quantile(trials, [0.025, 0.5, 0.975], axis=0)
    table = pd.DataFrame(
        {
            "distance [mm]": median,
            "distance_lower [mm]": lower,
            "distance_upper [mm]": upper,
            "mean_velocity [mm/s]": median / time,
        }
    )
    label = "predicted, 95 % band of a new trial"
    return Prediction(table, experiment.speed_panels(rows, median / time, (lower / time, upper / time), label))


def _check_settings(fitted: Table, columns: dict[str, Column], path: Path) -> None:
    """Require the drive columns of the fitted progression."""
    drive = {"duty", "P_on", "P_d", "current"}
    wanted, given = drive & set(fitted.columns), drive & set(columns)
    if wanted != given:
        raise InputError(
            f"the settings must have the drive columns of {fitted.label}: {' '.join(sorted(wanted)) or 'none'}",
            " ".join(sorted(given)) or "none",
            "add or remove columns",
            path,
            1,
            1,
        )


# importance: Importance weights: evidence of a model by bridge sampling (Meng & Wong 1996), and Pareto smoothing.
#
# A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry, *Pareto smoothed importance sampling*, J. Machine Learning
# Research
# 25 (72), 2024. J. Zhang, M. A. Stephens, *A new and efficient estimation method for the generalized Pareto
# distribution*,
# Technometrics 51, 2009, 316.


#: Parts of the draws: the draws of one part give a posterior sample, those of the next one meet it.
PARTS = 4
#: Steps of the iteration, which converges within a few.
STEPS = 100
#: Importance weights with a larger Pareto shape are not reliable.
LARGEST_SHAPE = 0.7
#: Fewest weights in a tail to which a shape can be fitted.
FEWEST_IN_TAIL = 5


def log_evidence(log_weight: PerPoint, rng: np.random.Generator) -> tuple[float, float]:
    """Log of the mean weight of independent draws of a proposal, and its standard error.

    The posterior sample is an independence Metropolis–Hastings chain over the draws of one part.

    Parameters
    ----------
    log_weight : log of posterior density, without normalisation, over proposal density; -inf outside the posterior

    Returns
    -------
    NaN where a quarter of the draws has none inside the posterior.
    """
    parts = np.array_split(log_weight, PARTS)
    if not all(np.any(np.isfinite(part)) for part in parts):
        return np.nan, np.nan
    found = [_bridge(_posterior_sample(parts[k - 1], rng), parts[k]) for k in range(PARTS)]
    return float(np.mean(found)), float(np.std(found, ddof=1) / np.sqrt(PARTS))


def _posterior_sample(log_weight: PerPoint, rng: np.random.Generator) -> PerPoint:
    """Log-weights along a chain that is offered the draws inside the posterior in their order."""
    offers = log_weight[np.isfinite(log_weight)]
    state, chain = offers[0], np.empty_like(offers)
    for i, threshold in enumerate(np.log(rng.uniform(size=len(offers)))):
        state = offers[i] if threshold < offers[i] - state else state
        chain[i] = state
    return chain


def _bridge(posterior: PerPoint, proposal: PerPoint) -> float:
    """Log-evidence from log-weights at draws of the posterior and of the proposal."""
    size = effective_size(proposal)
    first, second = np.log([size, len(proposal)]) - np.log(size + len(proposal))
    found = float(np.max(proposal))
    for _ in range(STEPS):
        above = proposal - np.logaddexp(first + proposal, second + found)
        below = -np.logaddexp(first + posterior, second + found)
        found = float(_log_mean(above) - _log_mean(below))
    return found


def _log_mean(logarithm: PerPoint) -> float:
    return float(np.logaddexp.reduce(logarithm) - np.log(len(logarithm)))


def smoothed_weights(log_weight: PerPoint, relative: float = 1.0) -> tuple[PerPoint, float]:
    """Normalised log-weights with a smoothed upper tail, and the Pareto shape of that tail; inf where it has no tail.

    Parameters
    ----------
    relative : effective size of the sample over the number of its weights; the tail is shorter where it is larger
    """
    x = log_weight - np.max(log_weight)
    order = np.argsort(x, kind="stable")
    size = int(np.ceil(min(0.2 * len(x), 3.0 * np.sqrt(len(x) / relative))))
    cutoff = max(x[order[-size - 1]], np.log(np.finfo(float).tiny))
    tail = order[x[order] > cutoff]
    shape = np.inf
    if len(tail) >= FEWEST_IN_TAIL:
        shape, scale = _pareto(np.exp(x[tail]) - np.exp(cutoff))
        places = (np.arange(len(tail)) + 0.5) / len(tail)
        x[tail] = np.minimum(np.log(np.exp(cutoff) + stats.genpareto.ppf(places, shape, scale=scale)), 0.0)
    return x - np.logaddexp.reduce(x), float(shape)


def _pareto(x: PerPoint) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution from its ascending sample, the shape drawn towards 0.5."""
    n = len(x)
    count = 30 + int(np.sqrt(n))
    b = (1.0 - np.sqrt(count / (np.arange(count) + 0.5))) / (3.0 * x[int(n / 4 + 0.5) - 1]) + 1.0 / x[-1]
    k = np.mean(np.log1p(-b[:, None] * x), axis=1)
    density = n * (np.log(-b / k) - k - 1.0)
    mean = float(np.sum(b * np.exp(density - np.logaddexp.reduce(density))))
    shape = float(np.mean(np.log1p(-mean * x)))
    return (n * shape + 5.0) / (n + 10.0), -shape / mean


# leave out: Expected log predictive density of settings left out, by Pareto-smoothed importance sampling (PSIS-LOO).
#
# Draws of a density near the posterior are weighted by the posterior: of the emulated posterior where there is one,
# else independent draws of the sampler's adapted proposal. Division by the density of the readings of a setting,
# given the parameters and all other readings, leaves the setting out. (A. Vehtari, A. Gelman, J. Gabry, *Practical
# Bayesian model evaluation using leave-one-out cross-validation and WAIC*, Statistics and Computing 27, 2017,
# 1413.)


#: Draws of a proposal; draws of an emulated posterior, fewer because their weights vary less.
PROPOSED_DRAWS, EMULATED_DRAWS = 4096, 2048
#: Largest number of adaptations of the proposal without a setting, each from the one before.
ADAPTATIONS = 3
#: Weight that draws without a density may hold.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class WeightedDraws:
    """Draws of a density near a posterior.

    Attributes
    ----------
    target, fit : posterior, and the point fit that the adaptation began with
    drawn_from : the adapted proposal, or the emulated posterior
    log_weight : (n, blocks) log of posterior over the density drawn from, each block of parameters; -inf outside
    log_normalisation : (2, blocks) log of the integral of the density drawn from, and its standard error; 0 for a proposal
    block : block of each parameter by name
    inside, values : indices (m,) of the draws inside the posterior, and their values by name
    """

    target: LogPosterior
    fit: PointFit
    drawn_from: BlockProposal | Emulation
    log_weight: np.ndarray
    log_normalisation: np.ndarray
    block: Mapping[str, int]
    inside: np.ndarray
    values: list[dict[str, float]]

    def of(self, e: Progression) -> PerPoint:
        """Log-weights of the block that ``e`` depends on."""
        return self.log_weight[
            self.inside, next(self.block[row.name] for row in e.parameters if row.name in self.block)
        ]


@dataclass(frozen=True)
class LeftOut:
    """One setting left out.

    Attributes
    ----------
    density : log predictive density of its readings given all others
    shape : Pareto shape of the weights
    log_weight : (m,) of ``draws``, smoothed, normalised
    """

    density: float
    shape: float
    log_weight: np.ndarray
    draws: WeightedDraws


def weighted_draws(
    target: LogPosterior,
    fit: PointFit,
    seed: int,
    first: BlockProposal | None = None,
    known: ExactMotions | None = None,
) -> WeightedDraws:
    """Draws of a density near ``target``.

    Parameters
    ----------
    first : proposal that is adapted to a similar posterior; default: the adaptation begins with the Laplace approximation
    known : exact motions near the posterior, where it can be emulated
    """
    marginal, random = MarginalPosterior(target, fit), np.random.RandomState(seed)
    if marginal.can_be_emulated:
        laplace, large = laplace_proposal(marginal)
        drawn_from = emulation(marginal, first or laplace, large, random, known)
        v = drawn_from.draw(EMULATED_DRAWS, random)
        log_weight = marginal.parts(v) - drawn_from.target.parts(v)
        log_normalisation = _log_normalisation(drawn_from, random)
    else:
        drawn_from = adapted_proposal(marginal, random, first)
        v, density = _known_draws(drawn_from, random)
        log_weight, log_normalisation = marginal.parts(v) - density, np.zeros((2, len(marginal.blocks)))
    inside = np.flatnonzero(np.all(np.isfinite(log_weight), axis=1))
    u, _ = marginal.restore(v[inside], seed)
    located = np.flatnonzero(~target.integrated)
    label = {target.names[i]: k for k, block in enumerate(marginal.blocks) for i in located[block]}
    values = [target.mapping(theta) for theta in target.theta(u)]
    return WeightedDraws(target, fit, drawn_from, log_weight, log_normalisation, label, inside, values)


def _known_draws(proposal: BlockProposal, random: Random) -> tuple[np.ndarray, np.ndarray]:
    """Draws (w, d) and their log-densities (w, blocks); +inf where a block has overflowed, at another place."""
    v, known = proposal.draw_inside(random, PROPOSED_DRAWS)
    return v, np.where(known, proposal.log_density(v), np.inf)


def _log_normalisation(emulated: Emulation, random: Random) -> np.ndarray:
    """(2, blocks) log-evidence of an emulated posterior and its standard error."""
    v, density = _known_draws(emulated.proposal, random)
    rng = np.random.default_rng(random.randint(2**31))
    return np.array([log_evidence(block, rng) for block in (emulated.target.parts(v) - density).T]).T


def leave_settings_out(e: Progression, draws: WeightedDraws) -> list[LeftOut]:
    """Leave out every setting of ``e`` in turn."""
    density = e.densities_of_settings([e.local(values) for values in draws.values])
    return [_left_out(draws.of(e), one, draws, -1.0) for one in density.T]


def leave_setting_out(draws: WeightedDraws, e: Progression, setting: int, seed: int) -> LeftOut:
    """Leave out one setting of ``e`` by draws of the posterior without it.

    The density drawn from is adapted further, up to ``ADAPTATIONS`` times, while the shape is too large.
    """
    target, (first, known) = draws.target, _without(draws, e, setting)
    experiments = [e.without(setting) if each is e else each for each in target.experiments]
    smaller = LogPosterior(target.rig, experiments)
    tried = list[LeftOut]()
    while len(tried) < ADAPTATIONS and not any(one.shape <= LARGEST_SHAPE for one in tried):
        left = weighted_draws(smaller, draws.fit, seed, first, known)
        density = e.densities_of_settings([e.local(values) for values in left.values])[:, setting]
        tried.append(_left_out(left.of(e), density, left, 0.0))
        first, known = _adapted(left.drawn_from)
    return min(tried, key=lambda one: one.shape)


def _adapted(drawn_from: BlockProposal | Emulation) -> tuple[BlockProposal, ExactMotions | None]:
    """What the next adaptation begins with."""
    return (drawn_from.proposal, drawn_from.known) if isinstance(drawn_from, Emulation) else (drawn_from, None)


def _without(draws: WeightedDraws, e: Progression, setting: int) -> tuple[BlockProposal, ExactMotions | None]:
    """What the adaptation to the posterior without one setting begins with."""
    first, known = _adapted(draws.drawn_from)
    if known is None:
        return first, None
    pairs = zip(trials_of(draws.target), known.motions, strict=True)
    return first, ExactMotions(known.v, [e.motions_without(own, setting) if one is e else own for one, own in pairs])


def _left_out(log_weight: np.ndarray, density: np.ndarray, draws: WeightedDraws, power: float) -> LeftOut:
    """Multiply the weights by ``density`` to a power, and smooth them.

    A draw without a density lies far outside the posterior and has weight 0. Where such draws hold weight before, the
    shape is infinite: the density of the setting is not known.
    """
    known, smoothed = np.isfinite(density), np.full(len(density), -np.inf)
    if not np.any(known):
        return LeftOut(-np.inf, np.inf, smoothed, draws)
    smoothed[known], shape = smoothed_weights(log_weight[known] + power * density[known])
    lost = np.logaddexp.reduce(log_weight[~known]) - np.logaddexp.reduce(log_weight) if not np.all(known) else -np.inf
    return LeftOut(
        float(np.logaddexp.reduce(smoothed[known] + density[known])),
        shape if lost < np.log(NEGLIGIBLE) else np.inf,
        smoothed,
        draws,
    )


# predictions: Predicted mean velocities of settings that were left out of the fit, beside the measured ones.


#: Smallest mean velocity whose direction counts, mm/s.
SLOW = 0.5


def left_out_predictions(e: Progression, left_out: Sequence[LeftOut], seed: int) -> pd.DataFrame:
    """Compare every setting with its prediction by all other settings.

    Returns
    -------
    DataFrame with a row per setting: ``measured [mm/s]``, the mean of its trials; ``predicted [mm/s]``, the median of a
    new trial in a new session; ``lower [mm/s]`` and ``upper [mm/s]``, its central 95 %; ``trials``, ``inside``, the
    number of its trials and of those in that interval; ``score [mm/s]``, the mean interval score of its trials
    (Gneiting & Raftery 2007); ``shape``, the Pareto shape of the weights.
    """
    rng = np.random.default_rng(seed)
    trials = dict[int, np.ndarray]()
    for draws in dict.fromkeys(one.draws for one in left_out):
        own = [k for k, one in enumerate(left_out) if one.draws is draws]
        drawn = e.new_trials([e.local(values) for values in draws.values], e.settings[own], rng)
        trials.update(zip(own, drawn.T, strict=True))
    rows = list[dict[str, float]]()
    for k, one in enumerate(left_out):
        speed = 1e3 / e.time[k]
        used = np.isfinite(one.log_weight)
        drawn, weights = speed * trials[k][used], np.exp(one.log_weight[used])
        lower, median, upper = (
            np.quantile(drawn, [0.025, 0.5, 0.975], weights=weights, method="inverted_cdf")
            if used.any()
            else np.full(3, np.nan)
        )
        measured = speed * e.distance[e.setting[:, k] > 0.0]
        beyond = np.maximum(lower - measured, 0.0) + np.maximum(measured - upper, 0.0)
        rows.append(
            {
                "measured [mm/s]": float(np.mean(measured)),
                "predicted [mm/s]": median,
                "lower [mm/s]": lower,
                "upper [mm/s]": upper,
                "trials": len(measured),
                "inside": int(np.sum(beyond == 0.0)),
                "score [mm/s]": float(upper - lower + 2.0 / 0.05 * np.mean(beyond)),
                "shape": one.shape,
            }
        )
    return pd.DataFrame(rows, index=pd.Index(e.setting_names(), name=e.label))


def predictions_text(table: pd.DataFrame) -> str:
    """Number of settings whose direction is right, and share of trials in the band."""
    measured, predicted = (table[f"{name} [mm/s]"].to_numpy() for name in ("measured", "predicted"))
    moving = np.abs(measured) > SLOW
    right = np.sum(np.sign(measured[moving]) == np.sign(predicted[moving]))
    inside, trials = (int(np.sum(table[name].to_numpy())) for name in ("inside", "trials"))
    return (
        f"Each setting is predicted by all others: the direction is right in {right} of "
        f"{counted(int(np.sum(moving)), 'setting')} above {SLOW:g} mm/s, and the 95 % band holds {inside} of "
        f"{counted(trials, 'trial')}."
    )
