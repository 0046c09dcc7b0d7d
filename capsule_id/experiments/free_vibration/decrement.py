"""The paper's estimator of k1 and c: observed frequency and logarithmic decrement of the peaks (section 2.2)."""

import itertools
from dataclasses import dataclass

import numpy as np

from capsule_id.records.noise import noise_level

#: A peak counts while it stands out of the noise by this many standard deviations.
PEAK_NOISE_RATIO = 4.0
#: ... and by this part of the record's range, so that a noiseless tail does not count.
PEAK_RANGE_RATIO = 0.005
#: The end of a record still swings where its range is this part of the whole record's.
SWINGING_RATIO = 0.05


@dataclass(frozen=True)
class Decrement:
    """What the peaks say.

    Attributes
    ----------
    times, peaks : (p,) s and m: the extreme of every half cycle, measured from the equilibrium
    Omega_o : observed (damped) frequency, rad/s
    delta : logarithmic decrement per period
    k1, c : m1 Omega_o^2, N/m, and 2 (delta/2 pi) sqrt(k1 m1), N s/m: as the paper reads them, with their biases
        -zeta^2 and about +zeta^2/2
    """

    times: np.ndarray
    peaks: np.ndarray
    Omega_o: float
    delta: float
    k1: float
    c: float


def equilibrium(values: np.ndarray) -> float:
    """Rest position: the mean of the last fifth of the record, a whole number of its swings where it still swings.

    A record of few cycles that is cut before it comes to rest holds no whole swing in its last fifth: as much more of
    it is taken as one whole swing needs.
    """
    length = max(len(values) // 5, 4)
    while True:
        tail = values[-length:]
        crossings = np.flatnonzero(np.diff(np.signbit(tail - np.mean(tail))))
        if len(crossings) >= 3:
            last = len(crossings) - 1 - (len(crossings) - 1) % 2
            return float(np.mean(tail[crossings[0] + 1 : crossings[last] + 1]))
        if length >= len(values) or np.ptp(tail) < SWINGING_RATIO * np.ptp(values):
            return float(np.mean(tail))
        length += max(length // 4, 1)


def half_cycle_extremes(
    time: np.ndarray, guide: np.ndarray, values: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Time and signed height of the extreme of ``values`` in every half cycle of ``guide``, (p,) each.

    ``guide`` (smoothed, about its equilibrium) only says where the half cycles are. Half cycles are taken from the
    start of the record while they stand out; the first and the last may be cut by the record's ends, so an extreme on
    an end does not count.
    """
    threshold = max(PEAK_NOISE_RATIO * noise, PEAK_RANGE_RATIO * float(np.ptp(guide)))
    edges = np.concatenate([[0], np.flatnonzero(np.diff(np.signbit(guide))) + 1, [len(guide)]])
    times, peaks = [], []
    for left, right in itertools.pairwise(edges):
        if np.max(np.abs(guide[left:right])) < threshold:
            if times:
                break
            continue
        index = left + int(np.argmax(np.abs(values[left:right])))
        if 0 < index < len(values) - 1:
            times.append(time[index])
            peaks.append(values[index])
    return np.array(times), np.array(peaks)


def logarithmic_decrement(
    time: np.ndarray, values: np.ndarray, m1: float, smoothed: np.ndarray | None = None
) -> Decrement | None:
    """The paper's estimator on ``values``; None where fewer than three half cycles stand out.

    Parameters
    ----------
    time, values : (n,) s and m
    m1 : kg
    smoothed : (n,) the record after Savitzky–Golay, the guide to its half cycles (default: ``values``)
    """
    rest = equilibrium(values)
    guide = (values if smoothed is None else smoothed) - rest
    times, peaks = half_cycle_extremes(time, guide, values - rest, noise_level(values))
    if len(times) < 3:
        return None
    index = np.arange(len(times))
    Omega_o = float(np.pi / np.polyfit(index, times, 1)[0])
    delta = float(-2.0 * np.polyfit(index, np.log(np.abs(peaks)), 1)[0])
    k1 = m1 * Omega_o**2
    return Decrement(times, peaks, Omega_o, delta, k1, delta / np.pi * float(np.sqrt(k1 * m1)))
