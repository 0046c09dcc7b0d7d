"""Finds frequencies that a sampled oscillation cannot tell from each other.

Even sampling at f_s maps f and |f ± n f_s| to the same readings (Nyquist-Shannon). Uneven sampling tells them apart.
"""

import numpy as np
from scipy.optimize import minimize

#: Multiples of the sampling rate that are tried; damping rates that are tried, per sampled period.
MULTIPLES, RATES = 5, np.geomspace(1e-3, 1.0, 13)
#: Another frequency fits as well where its sum of squares is below this multiple.
AS_WELL = 1.5
#: Steps of the time that differ less than this from the median, relative, are usual ones.
USUAL_STEP = 0.2
#: Most decimal places of rounded times.
MOST_PLACES = 9
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
    elapsed, rate = _even(time)

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
    multiples = np.arange(1, MULTIPLES + 1) * rate
    candidates = np.unique(np.abs(np.concatenate([multiples - frequency, multiples + frequency])))
    # With even sampling the same damping gives the same readings.
    others = np.array([misfit(other, damping) for other in candidates])
    return candidates[others <= AS_WELL * float(best.fun) + 1e-12 * float(np.sum(values**2))]


def _even(time: np.ndarray) -> tuple[np.ndarray, float]:
    """Times from the first one, s, and the sampling rate, Hz. Times that are even but for their rounding are taken as even."""
    elapsed, index = time - time[0], np.arange(len(time))
    line = np.polyfit(index, elapsed, 1)
    even = np.polyval(line, index)
    if np.max(np.abs(even - elapsed)) <= _rounding(time):
        return even, 1.0 / float(line[0])
    steps = np.diff(time)
    usual = np.abs(steps / np.median(steps) - 1.0) < USUAL_STEP
    return elapsed, 1.0 / float(np.mean(steps[usual]))


def _rounding(time: np.ndarray) -> float:
    """Unit of the last decimal place of the times, s; 0 where there are many places."""
    places = (k for k in range(MOST_PLACES) if np.allclose(np.round(time, k), time, rtol=0.0, atol=1e-9 * 10.0**-k))
    return next((10.0**-k for k in places), 0.0)
