"""Period of the motion in excitation periods, by comparing the record with itself n periods later.

x_rel(t + n T) - x_rel(t) is noise alone where the motion has period n. The ratio of its mean square to that of the
noise is compared with 1; the noise level comes from sixth differences, which remove every motion.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from capsule_id.records.noise import noise_level
from capsule_id.rig.filters import Record

LONGEST = 16  # excitation periods; ``response`` uses the same bound
#: A repeat leaves at most this share of the motion's rms beyond the noise ...
SAME = 0.01
#: ... and a record is clean enough where a part of another period is visible from this share of the motion's rms.
VISIBLE = 0.03
#: The smallest period of motion that passes must be seen repeating over at least this many periods of the drive.
FEWEST_PERIODS = 4
FEWEST_OVERLAP = 2  # periods of the drive that a comparison rests on
_ERRORS = 5.0  # standard errors of the mean square that count as no more than noise
_EDGE = 5  # samples at the end where the spline knows one side only
_DIFFERENCES = 6  # order of the differences that no motion survives
_NOISE_VARIANCE = (
    12.0  # relative variance of that noise level squared, times the number of samples (a test measures it)
)
_KERNEL = 30  # half-length of the impulse that shows the spline's gain for noise


@dataclass(frozen=True)
class Repeat:
    """Result of the comparison.

    period : in excitation periods; 0 where nothing repeats up to 16; None where the record is not conclusive
    periods : length of the record in excitation periods
    ratios : (N,) mean square of the difference after n = 1..N periods over that of the noise
    visible : smallest visible rms of a part of another period, m (None: no comparison)
    motion : rms of x_rel about its mean, noise taken off, m
    noise_sd : of x_rel, m
    reason : why it is not conclusive, or ""
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
    floor : reading error of x_rel, m: the noise is taken to be at least this

    Rule: n repeats where the mean square of the differences exceeds that of the noise by no more than 5 of its standard
    errors, or by less than 1 % of the motion's rms. The record must hold 2n periods and at least 4, and be clean enough
    that a part of another period with 3 % of the motion's rms is visible. A smaller part, or chaos in bands as narrow,
    counts as a repeat. "Nothing repeats" needs comparisons up to n = 16, each over 2 periods or more.
    """
    step = (time[-1] - time[0]) / (len(time) - 1)
    periods = len(time) * step / T
    noise_sd = max(noise_level(x_rel, _DIFFERENCES), floor)
    motion = float(np.sqrt(max(np.var(x_rel) - noise_sd**2, 0.0)))
    spline = CubicSpline(time, x_rel)
    ratios, seen, repeats = [], [], []
    for n in range(1, min(LONGEST, int(periods - FEWEST_OVERLAP)) + 1):
        early = time[: np.searchsorted(time, time[-1] - n * T - _EDGE * step)]
        if len(early) == 0:  # a coarse record: the spline's edges are all of what is left
            break
        difference = spline(early + n * T) - x_rel[: len(early)]
        noise = noise_sd**2 * (1.0 + _noise_gain(n * T / step))
        # of the differences those n T apart share a reading (correlation of squares 1/4 either side), and the spline
        # couples neighbours: at most twice the variance of independent squares
        bound = noise * _ERRORS * np.sqrt(4.0 / len(early) + _NOISE_VARIANCE / len(x_rel))
        excess = float(np.mean(difference**2) - noise)
        ratios.append(excess / noise + 1.0 if noise > 0.0 else np.inf)
        seen.append(float(np.sqrt(bound)))
        repeats.append(bool(excess <= max(bound, (SAME * motion) ** 2)))
    return _judge(repeats, Repeat(None, float(periods), np.array(ratios), max(seen, default=None), motion, noise_sd))


def _judge(repeats: list[bool], found: Repeat) -> Repeat:
    """The period, or the reason why the record is not conclusive."""
    period, reason = None, ""
    if found.periods < FEWEST_PERIODS:
        reason = f"the record holds {found.periods:.1f} periods of the drive, {FEWEST_PERIODS} are needed"
    elif found.visible is None or found.visible > VISIBLE * found.motion:
        seen = "nothing" if found.visible is None else f"{1e6 * found.visible:.3g} um"
        reason = f"noise: a part of another period would show from {seen}, motion {1e6 * found.motion:.3g} um"
    elif any(repeats):
        n = repeats.index(True) + 1
        period = n if 2 * n <= found.periods else None
        reason = "" if period else f"repeats after {n} periods of the drive, and holds only {found.periods:.1f}"
    elif len(repeats) == LONGEST:
        period = 0
    else:
        reason = f"no repeat up to {len(repeats)} periods of the drive, and too short for more"
    return Repeat(period, found.periods, found.ratios, found.visible, found.motion, found.noise_sd, reason)


def _noise_gain(shift: float) -> float:
    """Variance of a cubic spline through unit white noise, ``shift`` samples further."""
    impulse = np.zeros(2 * _KERNEL + 1)
    impulse[_KERNEL] = 1.0
    spline = CubicSpline(np.arange(len(impulse)), impulse)
    return float(np.sum(spline(np.arange(5.0, 2.0 * _KERNEL - 5.0) + shift % 1.0) ** 2))
