"""Finds frequencies that a sampled oscillation cannot tell from each other.

Even sampling at f_s maps f and |f ± n f_s| to the same readings (Nyquist-Shannon). Uneven sampling tells them apart.
"""

import numpy as np
from scipy.optimize import minimize

#: Fewest and most multiples of the sampling rate that are tried; damping rates that are tried, per sampled period.
MULTIPLES, MOST_MULTIPLES, RATES = 5, 200, np.geomspace(1e-3, 1.0, 13)
#: Another frequency fits as well where its sum of squares is below this multiple.
AS_WELL = 1.5
#: Steps of the time that differ less than this from the median, relative, are usual ones.
USUAL_STEP = 0.2
#: Most decimal places, and most significant digits, of rounded times. Samples that are looked at: they show as much as a
#: longer record does.
MOST_DIGITS, SAMPLES = 9, 4096
#: Step of a frequency, periods over the record, and steps about an alias; options of the search for the least misfit, and
#: number of the aliases that it refines.
PHASE, NEAR, REFINEMENT, REFINED = 0.05, range(-5, 6), {"maxiter": 100}, 3


def aliases(time: np.ndarray, values: np.ndarray, frequency: float, highest: float = 0.0) -> np.ndarray:
    """Return (k,) other frequencies, Hz, that fit a free decay as well as ``frequency`` does; of uneven times, best first.

    Parameters
    ----------
    time : (n,) s, increasing
    values : (n,) free decay
    frequency : found, Hz
    highest : frequency, Hz, up to which more than ``MULTIPLES`` are tried
    """
    time, values = time[:SAMPLES], values[:SAMPLES]
    (rate, even), elapsed = sampling(time), time - time[0]
    number = np.clip(int((highest + frequency) / rate) + 2, MULTIPLES, MOST_MULTIPLES)
    multiples = np.arange(1, number + 1) * rate
    if even:
        return np.unique(np.abs(np.concatenate([multiples - frequency, multiples + frequency])))

    def misfit(f: float, damping: float) -> float:
        """Sum of squares beside a tone of this frequency, Hz, with this damping rate, 1/s."""
        angle, decay = 2.0 * np.pi * f * elapsed, np.exp(-damping * elapsed)
        design = np.stack([decay * np.cos(angle), decay * np.sin(angle), np.ones_like(angle)], axis=1)
        rest = values - design @ np.linalg.lstsq(design, values)[0]
        return float(rest @ rest)

    def best(f: float, damping: float) -> tuple[float, float, float]:
        """Least misfit about a frequency and a damping rate, and both there."""
        found = minimize(
            lambda x: misfit(f + x[0] * step, damping * float(np.exp(x[1]))),
            np.zeros(2),
            method="Nelder-Mead",
            options=REFINEMENT,
        )
        return float(found.fun), f + found.x[0] * step, damping * float(np.exp(found.x[1]))

    # The best of the steps leaves a misfit that hides what another frequency does not explain.
    step = PHASE / elapsed[-1]
    least, frequency, damping = best(frequency, min(RATES * frequency, key=lambda rate: misfit(frequency, rate)))
    candidates = np.unique(np.abs(np.concatenate([multiples - frequency, multiples + frequency])))
    # The jitter of the times leaves an error of the sampling rate.
    others = np.array([min(misfit(other + k * step, damping) for k in NEAR) for other in candidates])
    candidates, others = candidates[order := np.argsort(others)], others[order]
    others[:REFINED] = [best(other, damping)[0] for other in candidates[:REFINED]]
    return candidates[others <= AS_WELL * least + 1e-12 * float(np.sum(values**2))]


def sampling(time: np.ndarray) -> tuple[float, bool]:
    """Sampling rate of times (n,), Hz, and whether they are even but for their rounding; samples may be missing."""
    time = time[:SAMPLES]
    unit, steps = _rounding(time), np.diff(time)
    step, line, off = np.median(steps), np.zeros(2), time
    for index in (np.arange(len(time)), np.concatenate([[0.0], np.cumsum(np.round(steps / step))])):
        line = np.polyfit(index, time, 1, w=1.0 / unit)
        off = np.abs(np.polyval(line, index) - time)
        if np.all(off <= unit):
            return 1.0 / float(line[0]), True
    usual = np.mean(steps[np.abs(steps / step - 1.0) < USUAL_STEP])
    return 1.0 / float(line[0] if np.max(off) < 0.5 * step else usual), False


def _rounding(time: np.ndarray) -> np.ndarray:
    """(n,) unit of the last decimal place, or of the last significant digit, of each time, s; at least 1e-9 of the record."""
    magnitude = 10.0 ** np.floor(np.log10(np.maximum(np.abs(time), np.finfo(float).tiny)))
    unit = np.full(len(time), max(1e-9 * np.ptp(time), np.spacing(np.max(np.abs(time)))))
    for first in (np.ones(len(time)), magnitude):
        units = (first * 10.0**-k for k in range(MOST_DIGITS))
        rounded = (one for one in units if np.all(np.abs(np.round(time / one) * one - time) <= 1e-6 * one + unit))
        unit = np.maximum(unit, next(rounded, 0.0))
    return unit
