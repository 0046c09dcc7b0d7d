"""The paper's estimator of k1 and c by observed frequency and logarithmic decrement of the peaks (section 2.2).

The trend of damping and frequency over the amplitude is an indication, not a test. A viscous decay with a linear spring
has the same logarithmic decrement and frequency at every amplitude. As the amplitude falls, quadratic damping decreases
the decrement, and dry friction increases it. A drift of the frequency indicates a stiffness that depends on the amplitude.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from capsule_id.records.noise import noise_level
from capsule_id.views import Facts

#: Smallest peak in standard deviations of the noise.
PEAK_NOISE_RATIO = 4.0
#: Smallest peak as a fraction of the record's range, which excludes a noiseless tail. Smoothing rounds the jumps of an
#: acceleration where dry friction turns, so that small peaks remain after the rod sticks.
PEAK_RANGE_RATIO, PEAK_RANGE_RATIO_OF_JUMPS = 0.005, 0.05
#: The end of a record still oscillates where its range exceeds this fraction of the whole record's range.
SWINGING_RATIO = 0.05
#: Smallest reported drift, in standard errors; the limit is high because neighbouring peaks are correlated.
REPORTED = 5.0
#: Smallest number of peaks; fewer do not determine the scatter about a parabola.
FEWEST_HALF_CYCLES = 6
#: Smallest peak in noise standard deviations; noise biases lower peaks upwards.
TREND_NOISE_RATIO = 20.0


@dataclass(frozen=True)
class Decrement:
    """Peaks of a decay and the paper's estimates from them.

    Attributes
    ----------
    times, peaks : (p,) s and m, extremum of every half cycle relative to the equilibrium
    Omega_o : observed (damped) frequency, rad/s
    delta : logarithmic decrement per period
    k1, c : m1 Omega_o^2, N/m, and 2 (delta/2 pi) sqrt(k1 m1), N s/m: the paper's estimates, with relative biases
        -zeta^2 and about +zeta^2/2
    """

    times: np.ndarray
    peaks: np.ndarray
    Omega_o: float
    delta: float
    k1: float
    c: float

    @property
    def first_ratio(self) -> float:
        """Ratio of the first two amplitudes, at least 1; the mean of neighbouring peaks cancels the error of the rest."""
        if len(self.peaks) < 3:
            return float(np.exp(0.5 * max(self.delta, 0.0)))
        first, second, third = np.abs(self.peaks[:3])
        return max(1.0, float((first + second) / (second + third)))


def equilibrium(values: np.ndarray) -> float:
    """Rest position: mean of the last fifth of the record, over whole periods where it still oscillates.

    The last fifth of a short record may contain less than one period. The mean then covers one whole period.
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
    time: np.ndarray, guide: np.ndarray, values: np.ndarray, lowest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Time and signed value of the extremum of ``values`` in every half cycle of ``guide``, (p,) each.

    ``guide`` (smoothed, about its equilibrium) only locates the half cycles. They count from the start of the record
    until the first peak below ``lowest``. The first and the last may be incomplete, so an extremum at an end of the
    record does not count.
    """
    edges = np.concatenate([[0], np.flatnonzero(np.diff(np.signbit(guide))) + 1, [len(guide)]])
    times, peaks = [], []
    for left, right in itertools.pairwise(edges):
        if np.max(np.abs(guide[left:right])) < lowest:
            if times:
                break
            continue
        index = left + int(np.argmax(np.abs(values[left:right])))
        if 0 < index < len(values) - 1:
            times.append(time[index])
            peaks.append(values[index])
    return np.array(times), np.array(peaks)


def logarithmic_decrement(
    time: np.ndarray,
    values: np.ndarray,
    m1: float,
    smoothed: np.ndarray | None = None,
    jumps: bool = False,
) -> Decrement | None:
    """Apply the paper's estimator to ``values``; None where fewer than three half cycles exceed the limits.

    Parameters
    ----------
    time, values : (n,) s and m
    m1 : mass of the rod, kg
    smoothed : (n,) the record after Savitzky–Golay, which locates the half cycles (default: ``values``)
    jumps : whether the readings may jump where the rod turns, as an acceleration does
    """
    rest = equilibrium(values)
    guide = (values if smoothed is None else smoothed) - rest
    smallest = PEAK_RANGE_RATIO_OF_JUMPS if jumps else PEAK_RANGE_RATIO
    lowest = max(PEAK_NOISE_RATIO * noise_level(values), smallest * float(np.ptp(guide)))
    times, peaks = half_cycle_extremes(time, guide, values - rest, lowest)
    if len(times) < 3:
        return None
    index = np.arange(len(times))
    Omega_o = float(np.pi / np.polyfit(index, times, 1)[0])
    delta = float(-2.0 * np.polyfit(index, np.log(np.abs(peaks)), 1)[0])
    k1 = m1 * Omega_o**2
    return Decrement(times, peaks, Omega_o, delta, k1, delta / np.pi * float(np.sqrt(k1 * m1)))


def crossing_decrement(time: np.ndarray, values: np.ndarray, m1: float) -> Decrement:
    """Rough estimate from the first zero crossings, where there are too few peaks; a typical damping stands in.

    Beside a single crossing, half a period lies between the extremes on both sides of it; where the record begins between
    two turning points, twice the time from the crossing to the next extreme is longer.
    """
    x = values - equilibrium(values)
    # The noise of a rod at rest crosses zero too, so only swings beyond it count.
    swings = np.flatnonzero(np.abs(x) > max(PEAK_NOISE_RATIO * noise_level(values), 0.1 * np.ptp(x)))
    crossings = swings[1:][np.diff(np.signbit(x[swings]))]
    if len(crossings) > 1:
        spacing = float(np.median(np.diff(time[crossings])))
    elif len(crossings) == 1:
        crossing = int(crossings[0])
        before, after = int(np.argmax(np.abs(x[:crossing]))), crossing + int(np.argmax(np.abs(x[crossing:])))
        spacing = float(max(time[after] - time[before], 2.0 * (time[after] - time[crossing])))
    else:
        spacing = 0.5 * float(time[-1])
    omega = float(np.pi / spacing)
    k1 = m1 * omega**2
    return Decrement(np.array([0.0]), x[:1], omega, 0.6, k1, 0.2 * float(np.sqrt(k1 * m1)))


def damping_of_peaks(decrement: Decrement, m1: float, deflection: float, symbols: Sequence[str]) -> dict[str, float]:
    """Rough c, and those of F_dry and c_q in ``symbols``, from what the peaks lose; SI, none negative.

    In a half cycle of amplitude a viscous damping takes pi c a/(2 m1 omega), dry friction 2 F_dry/k1 and quadratic
    damping 4 c_q a^2/(3 m1). {} with too few peaks.

    Parameters
    ----------
    m1 : mass of the rod, kg
    deflection : x_rel, m, over the unit of the peaks
    """
    height = deflection * np.abs(decrement.peaks)
    # Neighbouring peaks lie on opposite sides of the equilibrium, so their mean cancels its error.
    size = 0.5 * (height[1:] + height[:-1])
    middle = 0.5 * (size[1:] + size[:-1])
    if len(middle) < len(symbols) + 1:
        return {}
    losses = {
        "c": 0.5 * np.pi / (m1 * decrement.Omega_o) * middle,
        "F_dry": np.full(len(middle), 2.0 / decrement.k1),
        "c_q": 4.0 / (3.0 * m1) * middle**2,
    }
    chosen = [name for name in losses if name == "c" or name in symbols]
    design = np.stack([losses[name] for name in chosen], axis=1)
    scale = np.linalg.norm(design, axis=0)
    parts = nnls(design / scale, -np.diff(size))[0] / scale
    return dict(zip(chosen, (float(part) for part in parts), strict=True))


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
    noise : noise sd, m; peaks after the first one below ``TREND_NOISE_RATIO`` times it are ignored

    Returns
    -------
    ``amplitude`` (m), and of ``decrement`` (1) and ``frequency`` (rad/s) those that drift: first and last value each.
    """
    height = np.abs(decrement.peaks)
    low = np.flatnonzero(height < TREND_NOISE_RATIO * noise)
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
