"""Evidence of a model by bridge sampling (Meng & Wong 1996) between its posterior and the adapted proposal."""

import numpy as np
from jaxtyping import Float

from capsule_id.inference.sampling.refinement import effective_size

#: Parts of the draws: the draws of one part give a posterior sample, those of the next one meet it.
PARTS = 4
#: Steps of the iteration, which converges within a few.
STEPS = 100


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
