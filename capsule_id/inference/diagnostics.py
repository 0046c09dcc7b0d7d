"""Convergence of ensemble samplers. Walkers of one ensemble are not independent chains: ensembles are."""

import emcee
import numpy as np


def integrated_time(draws: np.ndarray) -> np.ndarray:
    """(ensemble, d) integrated autocorrelation time, in draws, of every ensemble: emcee's estimator.

    Parameters
    ----------
    draws : (ensemble, draw, walker, d)
    """
    return np.stack([emcee.autocorr.integrated_time(chain, tol=0, quiet=True) for chain in draws])


def split_rhat(draws: np.ndarray) -> np.ndarray:
    """(d,) split R-hat (Gelman et al., Bayesian Data Analysis, section 11.4) across independent ensembles.

    Each half of an ensemble, its walkers pooled, is one chain; ``draws`` (ensemble, draw, walker, d).
    """
    half = draws.shape[1] // 2
    halves = np.concatenate([draws[:, :half], draws[:, draws.shape[1] - half :]])
    chains = halves.reshape(len(halves), -1, draws.shape[-1])
    n = chains.shape[1]
    within = np.mean(np.var(chains, axis=1, ddof=1), axis=0)
    between = n * np.var(np.mean(chains, axis=1), axis=0, ddof=1)
    return np.sqrt(((n - 1) / n * within + between / n) / within)


def effective_sample_size(draws: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """(d,) draws divided by the integrated autocorrelation time ``tau`` (ensemble, d), summed over ensembles."""
    return np.sum(draws.shape[1] * draws.shape[2] / tau, axis=0)
