"""Trend of damping and frequency over the amplitude of a decay, from its peaks; an indication, not a test.

A viscous decay with a linear spring has the same logarithmic decrement and frequency at every amplitude. As the
amplitude falls, quadratic damping decreases the decrement, and dry friction increases it. A drift of the frequency
indicates a stiffness that depends on the amplitude.
"""

import numpy as np

from capsule_id.experiments.free_vibration.decrement import Decrement
from capsule_id.views import Facts

#: Smallest reported drift, in standard errors; the limit is high because neighbouring peaks are correlated.
REPORTED = 5.0
#: Smallest number of peaks; fewer do not determine the scatter about a parabola.
FEWEST_HALF_CYCLES = 6
#: Smallest peak in noise standard deviations; noise biases lower peaks upwards.
PEAK_NOISE_RATIO = 20.0


def _drift(values: np.ndarray) -> tuple[float, float, bool]:
    """Slopes per half cycle of a parabola through ``values`` (p,) at both ends, and whether they differ.

    The difference counts where it exceeds the scatter of the values.
    """
    index = np.arange(len(values)) - 0.5 * (len(values) - 1)
    coefficients = np.polyfit(index, values, 2)
    rest = values - np.polyval(coefficients, index)
    design = np.vander(index, 3)
    variance = float(rest @ rest) / (len(values) - 3) * np.linalg.inv(design.T @ design)[0, 0]
    first, last = np.polyval(np.polyder(coefficients), index[[0, -1]])
    return float(first), float(last), bool(abs(coefficients[0]) > REPORTED * np.sqrt(variance))


def trend(decrement: Decrement, noise: float) -> Facts:
    """Report quantities that drift as the amplitude falls, SI; empty without drift or with too few peaks.

    Parameters
    ----------
    decrement : decrement of the smoothed record
    noise : noise sd, m; peaks after the first one below ``PEAK_NOISE_RATIO`` times it are ignored

    Returns
    -------
    ``amplitude`` (m), and of ``decrement`` (1) and ``frequency`` (rad/s) those that drift: first and last value each.
    """
    height = np.abs(decrement.peaks)
    low = np.flatnonzero(height < PEAK_NOISE_RATIO * noise)
    count = int(low[0]) if len(low) else len(height)
    if count < FEWEST_HALF_CYCLES:
        return {}
    # Neighbouring peaks lie on opposite sides of the equilibrium, so their mean cancels its error.
    size = 0.5 * (height[1:count] + height[: count - 1])
    middle = 0.5 * (decrement.times[1:count] + decrement.times[: count - 1])
    facts = {}
    first, last, drifts = _drift(np.log(size))
    if drifts:
        facts["decrement"] = (-2.0 * first, -2.0 * last)
    first, last, drifts = _drift(middle)
    if drifts:
        facts["frequency"] = (np.pi / first, np.pi / last)
    return {"amplitude": (float(size[0]), float(size[-1])), **facts} if facts else {}
