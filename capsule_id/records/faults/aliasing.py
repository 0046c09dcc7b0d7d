"""Finds frequencies that a sampled oscillation cannot tell from each other.

Even sampling at f_s maps f and |f ± n f_s| to the same readings (Nyquist-Shannon). Uneven sampling tells them apart.
"""

import numpy as np

#: Multiples of the sampling rate that are tried; damping rates that are tried, per sampled period.
MULTIPLES, RATES = 5, np.geomspace(1e-3, 1.0, 13)
#: Another frequency fits as well where its sum of squares is below this multiple.
AS_WELL = 1.5


def aliases(time: np.ndarray, values: np.ndarray, frequency: float) -> np.ndarray:
    """Return (k,) other frequencies, Hz, that fit a free decay as well as ``frequency`` does.

    Parameters
    ----------
    time : (n,) s, increasing
    values : (n,) free decay
    frequency : found, Hz
    """
    rate = 1.0 / float(np.median(np.diff(time)))
    multiples = np.arange(1, MULTIPLES + 1) * rate
    candidates = np.unique(np.abs(np.concatenate([multiples - frequency, multiples + frequency])))
    found = _misfit(time, values, frequency, RATES * frequency)
    others = [_misfit(time, values, other, RATES * frequency) for other in candidates]
    return candidates[np.array(others) <= AS_WELL * found + 1e-12 * float(np.sum(values**2))]


def _misfit(time: np.ndarray, values: np.ndarray, frequency: float, rates: np.ndarray) -> float:
    """Least sum of squares of a damped tone of this frequency over the damping ``rates`` (k,), 1/s."""
    elapsed = time - time[0]
    angle = 2.0 * np.pi * frequency * elapsed
    least = np.inf
    for rate in rates:
        decay = np.exp(-rate * elapsed)
        design = np.stack([decay * np.cos(angle), decay * np.sin(angle), np.ones_like(angle)], axis=1)
        rest = values - design @ np.linalg.lstsq(design, values)[0]
        least = min(least, float(rest @ rest))
    return least
