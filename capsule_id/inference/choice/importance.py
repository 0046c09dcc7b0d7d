"""Importance weights: evidence of a model by bridge sampling (Meng & Wong 1996), and Pareto smoothing.

A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry, *Pareto smoothed importance sampling*, J. Machine Learning Research
25 (72), 2024. J. Zhang, M. A. Stephens, *A new and efficient estimation method for the generalized Pareto distribution*,
Technometrics 51, 2009, 316.
"""

import numpy as np
from jaxtyping import Float
from scipy import stats

from capsule_id.inference.sampling.refinement import effective_size

#: Parts of the draws: the draws of one part give a posterior sample, those of the next one meet it.
PARTS = 4
#: Steps of the iteration, which converges within a few.
STEPS = 100
#: Importance weights with a larger Pareto shape are not reliable.
LARGEST_SHAPE = 0.7
#: Fewest weights in a tail to which a shape can be fitted.
FEWEST_IN_TAIL = 5


def log_evidence(log_weight: Float[np.ndarray, " m"], rng: np.random.Generator) -> tuple[float, float]:
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


def _posterior_sample(log_weight: Float[np.ndarray, " m"], rng: np.random.Generator) -> Float[np.ndarray, " m"]:
    """Log-weights along a chain that is offered the draws inside the posterior in their order."""
    offers = log_weight[np.isfinite(log_weight)]
    state, chain = offers[0], np.empty_like(offers)
    for i, threshold in enumerate(np.log(rng.uniform(size=len(offers)))):
        state = offers[i] if threshold < offers[i] - state else state
        chain[i] = state
    return chain


def _bridge(posterior: Float[np.ndarray, " n"], proposal: Float[np.ndarray, " m"]) -> float:
    """Log-evidence from log-weights at draws of the posterior and of the proposal."""
    size = effective_size(proposal)
    first, second = np.log([size, len(proposal)]) - np.log(size + len(proposal))
    found = float(np.max(proposal))
    for _ in range(STEPS):
        above = proposal - np.logaddexp(first + proposal, second + found)
        below = -np.logaddexp(first + posterior, second + found)
        found = float(_log_mean(above) - _log_mean(below))
    return found


def _log_mean(logarithm: Float[np.ndarray, " m"]) -> float:
    return float(np.logaddexp.reduce(logarithm) - np.log(len(logarithm)))


def smoothed_weights(log_weight: Float[np.ndarray, " m"]) -> tuple[Float[np.ndarray, " m"], float]:
    """Normalised log-weights with a smoothed upper tail, and the Pareto shape of that tail; inf where it has no tail."""
    x = log_weight - np.max(log_weight)
    order = np.argsort(x, kind="stable")
    size = int(np.ceil(min(0.2 * len(x), 3.0 * np.sqrt(len(x)))))
    cutoff = max(x[order[-size - 1]], np.log(np.finfo(float).tiny))
    tail = order[x[order] > cutoff]
    shape = np.inf
    if len(tail) >= FEWEST_IN_TAIL:
        shape, scale = _pareto(np.exp(x[tail]) - np.exp(cutoff))
        places = (np.arange(len(tail)) + 0.5) / len(tail)
        x[tail] = np.minimum(np.log(np.exp(cutoff) + stats.genpareto.ppf(places, shape, scale=scale)), 0.0)
    return x - np.logaddexp.reduce(x), float(shape)


def _pareto(x: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution from its ascending sample, the shape drawn towards 0.5."""
    n = len(x)
    count = 30 + int(np.sqrt(n))
    b = (1.0 - np.sqrt(count / (np.arange(count) + 0.5))) / (3.0 * x[int(n / 4 + 0.5) - 1]) + 1.0 / x[-1]
    k = np.mean(np.log1p(-b[:, None] * x), axis=1)
    density = n * (np.log(-b / k) - k - 1.0)
    mean = float(np.sum(b * np.exp(density - np.logaddexp.reduce(density))))
    shape = float(np.mean(np.log1p(-mean * x)))
    return (n * shape + 5.0) / (n + 10.0), -shape / mean
