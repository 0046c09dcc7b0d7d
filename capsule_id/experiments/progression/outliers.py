"""Outlying trials of a progression with ``tails = "heavy"``: which trials of a setting have the larger scatter.

Each trial has ``TIMES`` the scatter with probability ``SHARE``, independently of the others: a contaminated normal
distribution (Tukey 1960), here given that a setting has at most ``MOST`` such trials. A configuration is one choice of
the outlying trials of every setting; the densities of all configurations are added.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Float

#: Probability that a trial is outlying, and its scatter relative to that of the others.
SHARE, TIMES = 0.05, 10.0
#: Most outlying trials of a setting.
MOST = 2
#: Most trials of a setting: the number of configurations grows with their square.
MOST_TRIALS = 12


def configurations(
    setting: Float[np.ndarray, "n settings"], heavy: bool
) -> tuple[Float[np.ndarray, "configurations n"], Float[np.ndarray, "configurations settings"]]:
    """Variance of every trial relative to the usual one, and the log-probability of each configuration of a setting.

    The first configuration has no outlying trial, and is the only one where the tails are not ``heavy``. A setting with
    fewer trials than others has fewer configurations; the probability of the rest is 0.
    """
    chosen = [_choices(np.flatnonzero(own), heavy) for own in setting.T]
    number = max(map(len, chosen))
    variance, log_share = np.ones((number, len(setting))), np.full((number, len(chosen)), -np.inf)
    for b, choices in enumerate(chosen):
        size = np.array(list(map(len, choices)))
        share = np.log(SHARE) * size + np.log1p(-SHARE) * (np.sum(setting[:, b]) - size)
        log_share[: len(choices), b] = share - np.logaddexp.reduce(share)
        for k, outlying in enumerate(choices):
            variance[k, list(outlying)] = TIMES**2
    return variance, log_share


def _choices(rows: np.ndarray, heavy: bool) -> list[tuple[int, ...]]:
    """Choices of the outlying trials among ``rows`` of a setting."""
    return [own for size in range((MOST if heavy else 0) + 1) for own in combinations(rows.tolist(), size)]
