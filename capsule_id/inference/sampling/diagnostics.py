"""Convergence diagnostics of ensemble samplers. Independent chains are whole ensembles, not the walkers of one."""

import emcee
import numpy as np
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import rankdata

#: Stored draws of independent ensembles.
Draws = Float[np.ndarray, "ensemble draw walker d"]

#: Summation window of autocovariances, in autocorrelation times (Sokal 1997, section 3); beyond it they are noise.
WINDOW = 5.0
#: Probabilities of the quantiles whose effective sample size is that of the tails (Vehtari et al. 2021, section 4.3).
TAILS = (0.05, 0.95)


def integrated_time(draws: Draws) -> Float[np.ndarray, "ensemble d"]:
    """(ensemble, d) integrated autocorrelation time of every ensemble, in draws, by emcee's estimator, for the ESS.

    NaN where a walker never moved (after a few draws only).
    """
    with np.errstate(invalid="ignore"):
        return np.stack([emcee.autocorr.integrated_time(chain, tol=0, quiet=True) for chain in draws])


def ensemble_time(draws: Draws) -> Float[np.ndarray, "ensemble d"]:
    """(ensemble, d) integrated autocorrelation time without emcee's bias in short chains, for the stopping rule.

    Autocovariances are about the mean of the whole ensemble and averaged over its walkers. emcee takes each walker's
    own mean, which underestimates tau by a fraction 10 tau/N: by 20 % at N = 50 tau (tested). The sum stops at the
    first lag above ``WINDOW`` tau (Sokal 1997, section 3).

    Parameters
    ----------
    draws : (ensemble, draw, walker, d)
    """
    n = draws.shape[1]
    centred = draws - np.mean(draws, axis=(1, 2), keepdims=True)
    spectrum = np.abs(np.fft.rfft(centred, n=2 * n, axis=1)) ** 2
    covariance = np.mean(np.fft.irfft(spectrum, n=2 * n, axis=1)[:, :n], axis=2) / np.arange(n, 0, -1)[:, None]
    # Draws that never change have the longest time.
    first = np.broadcast_to(covariance[:, :1], covariance.shape)
    share = np.divide(covariance, first, out=np.ones_like(covariance), where=first > 0.0)
    sums = 2.0 * np.cumsum(share, axis=1) - 1.0
    enough = np.arange(n)[:, None] >= WINDOW * sums
    enough[:, -1] = True
    return np.take_along_axis(sums, np.argmax(enough, axis=1)[:, None], axis=1)[:, 0]


def pooled_time(draws: Draws) -> Float[np.ndarray, " d"]:
    """(d,) integrated autocorrelation time of the normal scores, over the walkers of all ensembles together.

    Covariances are about the mean of all ensembles: where they disagree, the time is long. Of values themselves a single
    walker far out in a tail would decide the time.
    """
    ensembles, number, walkers, d = draws.shape
    return ensemble_time(np.moveaxis(normal_scores(draws), 0, 1).reshape(1, number, ensembles * walkers, d))[0]


def normal_scores(draws: Draws) -> Draws:
    """Normal scores of the ranks of every parameter over all ensembles (Vehtari et al. 2021, section 4.1)."""
    flat = draws.reshape(-1, draws.shape[-1])
    return ndtri((rankdata(flat, axis=0) - 0.375) / (len(flat) + 0.25)).reshape(draws.shape)


def split_rhat(draws: Draws) -> Float[np.ndarray, " d"]:
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


def effective_sample_size(draws: Draws, tau: Float[np.ndarray, "ensemble d"]) -> Float[np.ndarray, " d"]:
    """(d,) draws divided by the integrated autocorrelation time ``tau`` (ensemble, d), summed over ensembles.

    It never exceeds the number of draws, because the estimate of tau from a few draws may be 0.
    """
    return np.sum(draws.shape[1] * draws.shape[2] / np.maximum(tau, 1.0), axis=0)


def bulk_and_tail_size(draws: Draws) -> Float[np.ndarray, "2 d"]:
    """(2, d) effective sample sizes of the bulk and of the tails (Vehtari et al. 2021, sections 4.1 and 4.3).

    Bulk: of the normal scores of the ranks over all ensembles. Tails: the smaller one of the two indicators that a
    draw lies below the 5 % or the 95 % quantile. Both use ``ensemble_time``, which holds for short chains.
    """
    flat = draws.reshape(-1, draws.shape[-1])
    tails = [np.asarray(draws <= edge, dtype=float) for edge in np.quantile(flat, TAILS, axis=0)]
    bulk, *ends = (effective_sample_size(x, ensemble_time(x)) for x in (normal_scores(draws), *tails))
    return np.stack([bulk, np.min(ends, axis=0)])
