"""Finds the period of the motion in excitation periods: compares the record with itself n periods later.

x_rel(t + n T) - x_rel(t) is noise alone where the motion has period n. The ratio of its mean square to that of the
noise is compared with 1. The noise level comes from sixth differences, which remove the motion.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from capsule_id.records.noise import noise_level
from capsule_id.rig.filters import Record

LONGEST_PERIOD = 16  # excitation periods; ``response`` uses the same bound
#: Largest rms of the difference beyond the noise in a repeat, relative to the motion's rms.
LARGEST_RELATIVE_DIFFERENCE = 0.01
#: A part of another period must be visible from this share of the motion's rms; otherwise the record is too noisy.
LARGEST_VISIBLE_SHARE = 0.03
#: Shortest record, in excitation periods.
FEWEST_PERIODS = 4
FEWEST_OVERLAP = 2  # excitation periods in a comparison
_STANDARD_ERRORS = 5.0  # of the mean square; a smaller excess counts as noise
_EDGE_SAMPLES = 5  # samples at the end, where the spline is one-sided
_DIFFERENCE_ORDER = 6  # of the differences for the noise level; the motion vanishes in them
_NOISE_LEVEL_VARIANCE = (
    12.0  # relative variance of the squared noise level, times the number of samples (a test measures it)
)
_KERNEL_HALF_LENGTH = 30  # samples, of the impulse response for the spline's noise gain


@dataclass(frozen=True)
class Repeat:
    """The period, or the reason why the record is inconclusive.

    period : in excitation periods; 0 if the record does not repeat within 16; None if it is inconclusive
    periods : length of the record in excitation periods
    ratios : (N,) mean square of the difference after n = 1..N periods over that of the noise
    visible : smallest visible rms of a part of another period, m (None: no comparison)
    motion : rms of x_rel about its mean without the noise, m
    noise_sd : of x_rel, m
    reason : why the record is inconclusive, or ""
    """

    period: int | None
    periods: float
    ratios: np.ndarray
    visible: float | None
    motion: float
    noise_sd: float
    reason: str = ""


def find_period(time: Record, x_rel: Record, T: float, floor: float = 0.0) -> Repeat:
    """Smallest number n of drive periods T after which x_rel repeats within its noise.

    Parameters
    ----------
    time, x_rel : (n,) s, evenly spaced, and m
    T : period of the drive, s
    floor : reading error of x_rel, m, the lower bound of the noise level

    Rule: n repeats where the mean square of the differences exceeds that of the noise by no more than 5 of its standard
    errors, or by less than 1 % of the motion's rms. The record must hold at least 2n and at least 4 periods. Its
    noise must leave a part of another period with 3 % of the motion's rms visible. A smaller part, or chaos in bands as
    narrow, counts as a repeat. Period 0 needs comparisons up to n = 16, each over at least 2 periods.
    """
    step = (time[-1] - time[0]) / (len(time) - 1)
    periods = len(time) * step / T
    noise_sd = max(noise_level(x_rel, _DIFFERENCE_ORDER), floor)
    motion = float(np.sqrt(max(np.var(x_rel) - noise_sd**2, 0.0)))
    spline = CubicSpline(time, x_rel)
    ratios, seen, repeats = [], [], []
    for n in range(1, min(LONGEST_PERIOD, int(periods - FEWEST_OVERLAP)) + 1):
        early = time[: np.searchsorted(time, time[-1] - n * T - _EDGE_SAMPLES * step)]
        if len(early) == 0:  # coarse record: only the edges of the spline are left
            break
        difference = spline(early + n * T) - x_rel[: len(early)]
        noise = noise_sd**2 * (1.0 + _noise_gain(n * T / step))
        # Differences n T apart share a reading (correlation of squares 1/4 on either side), and the spline couples
        # neighbours: at most twice the variance of independent squares.
        bound = noise * _STANDARD_ERRORS * np.sqrt(4.0 / len(early) + _NOISE_LEVEL_VARIANCE / len(x_rel))
        excess = float(np.mean(difference**2) - noise)
        ratios.append(excess / noise + 1.0 if noise > 0.0 else np.inf)
        seen.append(float(np.sqrt(bound)))
        repeats.append(bool(excess <= max(bound, (LARGEST_RELATIVE_DIFFERENCE * motion) ** 2)))
    return _with_period_or_reason(
        repeats, Repeat(None, float(periods), np.array(ratios), max(seen, default=None), motion, noise_sd)
    )


def _with_period_or_reason(repeats: list[bool], found: Repeat) -> Repeat:
    """``found`` with the period, or with the reason why the record is inconclusive."""
    period, reason = None, ""
    if found.periods < FEWEST_PERIODS:
        reason = f"the record holds {found.periods:.1f} periods of the drive, {FEWEST_PERIODS} are needed"
    elif found.visible is None or found.visible > LARGEST_VISIBLE_SHARE * found.motion:
        seen = "nothing" if found.visible is None else f"{1e6 * found.visible:.3g} um"
        reason = f"noise: a part of another period is visible from {seen}, motion {1e6 * found.motion:.3g} um"
    elif any(repeats):
        n = repeats.index(True) + 1
        period = n if 2 * n <= found.periods else None
        reason = "" if period else f"repeats after {n} periods of the drive, but holds only {found.periods:.1f}"
    elif len(repeats) == LONGEST_PERIOD:
        period = 0
    else:
        reason = f"no repeat up to {len(repeats)} periods of the drive, too short for longer periods"
    return Repeat(period, found.periods, found.ratios, found.visible, found.motion, found.noise_sd, reason)


def _noise_gain(shift: float) -> float:
    """Variance of a cubic spline through unit white noise, ``shift`` samples after a sample."""
    impulse = np.zeros(2 * _KERNEL_HALF_LENGTH + 1)
    impulse[_KERNEL_HALF_LENGTH] = 1.0
    spline = CubicSpline(np.arange(len(impulse)), impulse)
    return float(np.sum(spline(np.arange(5.0, 2.0 * _KERNEL_HALF_LENGTH - 5.0) + shift % 1.0) ** 2))
