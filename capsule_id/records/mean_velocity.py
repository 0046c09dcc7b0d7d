"""Estimates the mean velocity of the capsule, its standard error and the direction of motion with its probability."""

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm

from capsule_id.rig.filters import Record

#: Largest advance per excitation period of a standing capsule, m; ``response`` uses the same bound.
STANDING_ADVANCE = 1e-7
#: Confidence of a decision, moving or standing.
CONFIDENCE = 0.99
_MOST_HARMONICS = 24  # of the motion's frequency in the periodic part of X2
_SAMPLES_PER_UNKNOWN = 4  # at least
_ADVANCES = 2000  # values of the advance, for the integrals of the probabilities
_ROUNDING = 1e-3  # smallest standard error of an advance, of the largest one of a standing capsule
_SIGNIFICANT = 3.0  # standard deviations of the noise's own variance; larger scatter of the advances counts


@dataclass(frozen=True)
class MeanVelocity:
    """Mean velocity of the capsule, m/s, its standard error, and direction "F", "B", "S", or None with the reason.

    ``probability`` is that of the most probable direction.
    """

    velocity: float
    velocity_sd: float
    direction: str | None
    probability: float
    reason: str = ""


def fit_mean_velocity(time: Record, x_capsule: Record, T: float, period: int | None) -> MeanVelocity:
    """Mean velocity over the record.

    With a known period n of the motion: the slope of a straight line plus harmonics of 1/(n T), by least squares. Its
    standard error is that of white noise and of the scatter of the advances beyond it. Otherwise: the mean of the
    advances over successive excitation periods, with the standard error of their scatter.

    Direction: "F" or "B" where the 99 % interval of the advance per period lies beyond 1e-7 m, "S" where it lies
    within ±1e-7 m, else None. Probability: the three directions are equally probable beforehand, and the advance of a
    moving capsule is log-uniform from 1e-7 m to the range of the record.

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
    probability = _probabilities(advance, sd * T, float(np.ptp(x_capsule)))
    if np.isfinite(margin) and abs(advance) - margin > STANDING_ADVANCE:
        word = "F" if advance > 0.0 else "B"
        return MeanVelocity(velocity, sd, word, probability[word])
    if np.isfinite(margin) and abs(advance) + margin < STANDING_ADVANCE:
        return MeanVelocity(velocity, sd, "S", probability["S"])
    reason = f"direction: advance {1e6 * advance:.3g} ± {1e6 * sd * T:.2g} um per period, standing is below 0.1 um"
    return MeanVelocity(velocity, sd, None, max(probability.values()), reason)


def _probabilities(advance: float, sd: float, largest: float) -> dict[str, float]:
    """Posterior probability of each direction, given the advance per period and its standard error, m."""
    if not np.isfinite(sd):
        return dict.fromkeys("FBS", 1.0 / 3.0)
    sd = max(sd, _ROUNDING * STANDING_ADVANCE)
    moving = np.geomspace(STANDING_ADVANCE, max(largest, 2.0 * STANDING_ADVANCE, 2.0 * abs(advance)), _ADVANCES)
    standing = np.linspace(-STANDING_ADVANCE, STANDING_ADVANCE, _ADVANCES)
    logs = {
        word: float(np.asarray(logsumexp(norm.logpdf(advance, values, np.maximum(sd, spacing)))))
        for word, values, spacing in (
            ("F", moving, np.gradient(moving)),
            ("B", -moving, np.gradient(moving)),
            ("S", standing, np.gradient(standing)),
        )
    }
    total = float(np.asarray(logsumexp(list(logs.values()))))
    return {word: float(np.exp(value - total)) for word, value in logs.items()}


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
    waves = design[:, 2:] @ np.linalg.solve(triangle, coordinates)[2:]
    scatter = _scatter_of_advances(time, values - waves, T, variance)
    return float(slope @ coordinates), float(np.hypot(np.sqrt(variance) * np.linalg.norm(slope), scatter))


def _scatter_of_advances(time: Record, places: Record, T: float, variance: float) -> float:
    """Standard error of the mean velocity by the advances per T that scatter beyond white noise; 0 without such scatter.

    variance : of the noise of ``places`` (n,), m^2
    """
    number = np.floor((time - time[0]) / T).astype(int)
    counts = np.bincount(number)
    whole = counts[:-1] > 0
    means = (np.bincount(number, places)[:-1] / np.maximum(counts[:-1], 1))[whole]
    if len(means) < 3:
        return 0.0
    advances = np.diff(means)
    noise = 2.0 * variance / float(np.mean(counts[:-1]))
    found = float(np.var(advances, ddof=1))
    if found < noise * (1.0 + _SIGNIFICANT * np.sqrt(3.0 / len(advances))):
        return 0.0
    return float(np.sqrt((found - noise) / len(advances)) / T)


def _mean_of_advances(time: Record, values: Record, T: float) -> tuple[float, float]:
    """Mean advance over successive whole periods, per second, and its standard error."""
    count = int((time[-1] - time[0]) / T)
    if count < 1:
        return float((values[-1] - values[0]) / (time[-1] - time[0])), float("inf")
    places = np.interp(time[0] + T * np.arange(count + 1), time, values)
    sd = float(np.std(np.diff(places), ddof=1) / np.sqrt(count) / T) if count > 1 else float("inf")
    return float((places[-1] - places[0]) / (count * T)), sd
