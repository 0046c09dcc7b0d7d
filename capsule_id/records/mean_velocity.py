"""Estimates the mean velocity of the capsule, its standard error and the direction of motion."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from capsule_id.rig.filters import Record

#: Largest advance per excitation period of a standing capsule, m; ``response`` uses the same bound.
STANDING_ADVANCE = 1e-7
#: Confidence of a decision, moving or standing.
CONFIDENCE = 0.99
_MOST_HARMONICS = 24  # of the motion's frequency in the periodic part of X2
_SAMPLES_PER_UNKNOWN = 4  # at least


@dataclass(frozen=True)
class MeanVelocity:
    """Mean velocity of the capsule, m/s, its standard error, and direction "F", "B", "S", or None with the reason."""

    velocity: float
    velocity_sd: float
    direction: str | None
    reason: str = ""


def fit_mean_velocity(time: Record, x_capsule: Record, T: float, period: int | None) -> MeanVelocity:
    """Mean velocity over the record.

    With a known period n of the motion: the slope of a straight line plus harmonics of 1/(n T), by least squares; its
    standard error is that of white noise. Otherwise: the mean of the advances over successive excitation periods, with
    the standard error of their scatter.

    Direction: "F" or "B" where the 99 % interval of the advance per period lies beyond 1e-7 m, "S" where it lies
    within ±1e-7 m, else None.

    Parameters
    ----------
    time, x_capsule : (n,) s and m
    T : period of the drive, s
    period : of the motion in excitation periods; None or 0 where there is none
    """
    velocity, sd = (
        _slope_with_harmonics(time, x_capsule, period * T) if period else _mean_of_advances(time, x_capsule, T)
    )
    margin = norm.ppf(0.5 + CONFIDENCE / 2.0) * sd * T
    advance = velocity * T
    if np.isfinite(margin) and abs(advance) - margin > STANDING_ADVANCE:
        return MeanVelocity(velocity, sd, "F" if advance > 0.0 else "B")
    if np.isfinite(margin) and abs(advance) + margin < STANDING_ADVANCE:
        return MeanVelocity(velocity, sd, "S")
    reason = f"direction: advance {1e6 * advance:.3g} ± {1e6 * sd * T:.2g} um per period, standing is below 0.1 um"
    return MeanVelocity(velocity, sd, None, reason)


def _slope_with_harmonics(time: Record, values: Record, T: float) -> tuple[float, float]:
    """Slope and its standard error beside harmonics of 1/T."""
    step = (time[-1] - time[0]) / (len(time) - 1)
    most = min(_MOST_HARMONICS, int(0.5 * T / step) - 1, len(time) // (2 * _SAMPLES_PER_UNKNOWN) - 1)
    angle = 2.0 * np.pi / T * np.multiply.outer(time, np.arange(1, most + 1))
    middle = time - time.mean()
    design = np.concatenate([np.ones((len(time), 1)), middle[:, None], np.cos(angle), np.sin(angle)], axis=1)
    q, triangle = np.linalg.qr(design)
    values = values - values.mean()
    coordinates = q.T @ values
    variance = max(float(np.sum(values**2) - np.sum(coordinates**2)), 0.0) / max(len(time) - design.shape[1], 1)
    slope = np.linalg.solve(triangle.T, np.eye(design.shape[1])[1])  # the row of the pseudoinverse is q @ slope
    return float(slope @ coordinates), float(np.sqrt(variance) * np.linalg.norm(slope))


def _mean_of_advances(time: Record, values: Record, T: float) -> tuple[float, float]:
    """Mean advance over successive whole periods, per second, and its standard error."""
    count = int((time[-1] - time[0]) / T)
    if count < 1:
        return float((values[-1] - values[0]) / (time[-1] - time[0])), float("inf")
    places = np.interp(time[0] + T * np.arange(count + 1), time, values)
    sd = float(np.std(np.diff(places), ddof=1) / np.sqrt(count) / T) if count > 1 else float("inf")
    return float((places[-1] - places[0]) / (count * T)), sd
