"""Finds frequencies that a sampled oscillation cannot tell from each other.

Even sampling at f_s maps f and |f ± n f_s| to the same readings (Nyquist-Shannon). Uneven sampling tells them apart.
"""

import numpy as np
from scipy.optimize import minimize

#: Multiples of the sampling rate that are tried; damping rates that are tried, per sampled period.
MULTIPLES, RATES = 5, np.geomspace(1e-3, 1.0, 13)
#: Another frequency fits as well where its sum of squares is below this multiple.
AS_WELL = 1.5
#: Step of a frequency, periods over the record, and options of the search for the least misfit.
PHASE, REFINEMENT = 0.05, {"maxiter": 100}


def aliases(time: np.ndarray, values: np.ndarray, frequency: float) -> np.ndarray:
    """Return (k,) other frequencies, Hz, that fit a free decay as well as ``frequency`` does.

    Parameters
    ----------
    time : (n,) s, increasing
    values : (n,) free decay
    frequency : found, Hz
    """
    elapsed = time - time[0]

    def misfit(f: float, damping: float) -> float:
        """Sum of squares beside a tone of this frequency, Hz, with this damping rate, 1/s."""
        angle, decay = 2.0 * np.pi * f * elapsed, np.exp(-damping * elapsed)
        design = np.stack([decay * np.cos(angle), decay * np.sin(angle), np.ones_like(angle)], axis=1)
        rest = values - design @ np.linalg.lstsq(design, values)[0]
        return float(rest @ rest)

    def near(x: np.ndarray) -> float:
        return misfit(frequency + x[0] * step, damping * float(np.exp(x[1])))

    # The best of the steps leaves a misfit that hides what another frequency does not explain.
    step, damping = PHASE / elapsed[-1], min(RATES * frequency, key=lambda rate: misfit(frequency, rate))
    best = minimize(near, np.zeros(2), method="Nelder-Mead", options=REFINEMENT)
    frequency, damping = frequency + best.x[0] * step, damping * float(np.exp(best.x[1]))
    multiples = np.arange(1, MULTIPLES + 1) / float(np.median(np.diff(time)))
    candidates = np.unique(np.abs(np.concatenate([multiples - frequency, multiples + frequency])))
    # With even sampling the same damping gives the same readings.
    others = np.array([misfit(other, damping) for other in candidates])
    return candidates[others <= AS_WELL * float(best.fun) + 1e-12 * float(np.sum(values**2))]
