"""Outlying trials of a progression with ``tails = "heavy"``: which trial of a setting has the larger scatter.

Each trial has ``TIMES`` the scatter with probability ``SHARE``, independently of the others: a contaminated normal
distribution (Tukey 1960), here given that a setting has at most one such trial. No outlying trial, or one of them: these
are the alternatives of a setting, and their densities are added.
"""

import numpy as np
from jaxtyping import Float, Int

#: Probability that a trial is outlying, and its scatter relative to that of the others.
SHARE, TIMES = 0.05, 10.0
#: Most trials of a setting: among more of them, several would be outlying.
MOST_TRIALS = 12


def alternatives(
    setting: Float[np.ndarray, "n settings"], heavy: bool
) -> tuple[Float[np.ndarray, "alternatives n"], Float[np.ndarray, " alternatives"], Int[np.ndarray, " alternatives"]]:
    """Variance of every trial relative to the usual one, log-probability within the setting, and setting of each.

    The first alternative of a setting has no outlying trial, and is the only one where the tails are not ``heavy``.
    """
    variance, log_share, of = list[np.ndarray](), list[float](), list[int]()
    for b, own in enumerate(setting.T):
        trials = np.flatnonzero(own) if heavy else np.array([], dtype=int)
        odds = np.append(1.0, np.full(len(trials), SHARE / (1.0 - SHARE)))
        log_share += np.log(odds / np.sum(odds)).tolist()
        variance += [np.ones(len(setting)), *(np.where(np.arange(len(setting)) == i, TIMES**2, 1.0) for i in trials)]
        of += [b] * (1 + len(trials))
    return np.array(variance), np.array(log_share), np.array(of)
