"""Density of trials by SciPy, with sums over the sessions that are integrated out."""

from collections.abc import Mapping
from itertools import product

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from capsule_id.experiments.misfit import Misfit
from capsule_id.experiments.progression.experiment import Progression


def linear_misfit(e: Progression, theta: Mapping[str, float], X2: np.ndarray) -> Misfit:
    """Misfit of the trials at the responses ``X2``, by NumPy."""
    return e.trials_of(theta, X2, np).linear(e.distance, e.sessions, theta["trial_sd"], np)


def integrated(
    trials: list[np.ndarray],
    X2: list[np.ndarray],
    variance: list[np.ndarray],
    shared: float,
    z: np.ndarray,
    relative: float | np.ndarray = 1.0,
) -> float:
    """Log-density of the ``trials`` of one setting by SciPy, each session integrated by a sum over z.

    Parameters
    ----------
    X2, variance : displacement and variance of a trial in each session at z; of one number where it is known
    shared : variance of the discrepancy
    relative : (n,) variance of each trial relative to ``variance``
    """
    y, sizes = np.concatenate(trials), [len(own) for own in trials]
    places = list(product(*(range(len(x)) for x in X2)))
    log_weight = [[-0.5 * z**2 - logsumexp(-0.5 * z**2), np.zeros(1)][len(x) == 1] for x in X2]
    density = []
    for place in places:
        at = list(enumerate(place))
        mean = np.repeat([X2[j][i] for j, i in at], sizes)
        covariance = shared + np.diag(relative * np.repeat([variance[j][i] for j, i in at], sizes))
        density.append(multivariate_normal(mean, covariance).logpdf(y) + sum(log_weight[j][i] for j, i in at))
    return float(logsumexp(density))
