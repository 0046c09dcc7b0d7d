"""Do damping and frequency of a decay stay the same while it dies away? A hint out of its peaks, no test.

A viscous decay about a linear spring has one logarithmic decrement and one frequency at every amplitude. Quadratic
damping has a decrement that falls with the amplitude, dry friction one that rises, and a frequency that drifts means a
stiffness that depends on the amplitude.
"""

import numpy as np

from capsule_id.experiments.free_vibration.decrement import Decrement
from capsule_id.views import Facts

#: A drift is reported where it exceeds this many standard errors: neighbouring peaks are not independent.
REPORTED = 5.0
#: Peaks of a parabola through fewer half cycles say nothing of its scatter.
FEWEST_HALF_CYCLES = 6
#: Peaks lower than this many noise sds are lifted by the noise.
PEAK_NOISE_RATIO = 20.0


def _drift(values: np.ndarray) -> tuple[float, float, bool]:
    """Slope per half cycle of a parabola through ``values`` (p,) at its first and last point, and whether they differ
    by more than their scatter explains."""
    index = np.arange(len(values)) - 0.5 * (len(values) - 1)
    coefficients = np.polyfit(index, values, 2)
    rest = values - np.polyval(coefficients, index)
    design = np.vander(index, 3)
    variance = float(rest @ rest) / (len(values) - 3) * np.linalg.inv(design.T @ design)[0, 0]
    first, last = np.polyval(np.polyder(coefficients), index[[0, -1]])
    return float(first), float(last), bool(abs(coefficients[0]) > REPORTED * np.sqrt(variance))


def trend(decrement: Decrement, noise: float) -> Facts:
    """What drifts while the amplitude falls, SI; empty where nothing does or too few peaks stand out.

    Parameters
    ----------
    decrement : of the smoothed record
    noise : sd, m: later peaks, once they are lower than ``PEAK_NOISE_RATIO`` of it, are left out

    Returns
    -------
    ``amplitude`` (m), and of ``decrement`` (1) and ``frequency`` (rad/s) those that drift: first and last value each.
    """
    height = np.abs(decrement.peaks)
    low = np.flatnonzero(height < PEAK_NOISE_RATIO * noise)
    count = int(low[0]) if len(low) else len(height)
    if count < FEWEST_HALF_CYCLES:
        return {}
    # Means of neighbours stand on opposite sides of the equilibrium, so an error of that drops out.
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
