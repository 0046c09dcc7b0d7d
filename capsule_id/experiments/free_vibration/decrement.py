"""Viscous decays of any damping, and the paper's estimator of k1 and c by frequency and logarithmic decrement (section 2.2).

This module loads no JAX: the commands set its options after they have read a rig.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares, nnls

from capsule_id.records.release import shortened
from capsule_id.records.tones import SIGNIFICANT, frequency_of, length_of_motion, noise_level
from capsule_id.rig.filters import dominant_frequency

#: Largest damping ratio of a decay by half cycles. They are wrong by 3e-6 of the amplitude there, by 2e-3 at 0.9.
STRONGEST = 0.7
#: Smallest |omega^2| relative to omega_0^2: nearer to critical damping the derivative of its root loses all digits.
CRITICAL = 1e-10
#: Smallest peak as a fraction of the record's range, which excludes a noiseless tail. Smoothing rounds the jumps of an
#: acceleration where dry friction turns, so that small peaks remain after the rod sticks.
PEAK_RANGE_RATIO, PEAK_RANGE_RATIO_OF_JUMPS = 0.005, 0.05
#: A record still swings where its range, or its distance from rest, exceeds this fraction of the whole record's range.
SWINGING_RATIO = 0.05
#: Grid of the search for a viscous decay: frequencies from this many rad over the record on and their number, damping
#: ratios of all of them and of those near the peak of the spectrum, and number of its best points that are refined.
SLOWEST, WIDE_POINTS, NEAR_POINTS, REFINED = 0.3, 48, 9, 3
LIGHT_RATIOS, STRONG_RATIOS = (0.001, 0.01, 0.03, 0.1), (0.2, 0.4, 0.7, 1.0, 1.5, 3.0)
#: Limits of the damping ratio of the search, and largest one whose decrement is quoted as a rough value.
SMALLEST_RATIO, LARGEST_SEARCHED, LARGEST_RATIO = 1e-6, 30.0, 0.9
#: Unknowns of a viscous decay: k1, c, two initial conditions, offset.
UNKNOWNS = 5
#: Turning points, or crossings of the rest position, that a whole period has, both ends included.
WHOLE_PERIOD = 3
#: Samples that are searched: at least, at most on the grid, there first for a rough fit, and at most in the refinement.
FEWEST_SEARCHED, MOST_SEARCHED, MOST_ROUGH, MOST_REFINED = 16, 1000, 100, 20_000
#: Spectra with fewer periods are checked by a fit; its damping ratio beyond which a spectrum may have no peak.
FEW_PERIODS, PEAKLESS = 4.0, 0.3
#: Share of their trace that is added to normal equations, which may be singular.
SINGULAR = 1e-13


def viscous_basis(time: Any, k1: Any, c: Any, m1: Any, xp: ModuleType) -> Any:
    """(n, 2) motions of unit size at any damping: released at rest, and struck at the rest position at rate omega_0."""
    gamma, square = c / (2.0 * m1), k1 / m1
    # even and odd are exp(-gamma t) times cos(omega t) and sin(omega t)/omega: both are smooth at critical damping. Beyond
    # it omega = i root; two exponentials decay with gamma - root = omega_0^2/(gamma + root) and gamma + root.
    margin = square - gamma**2
    root = xp.sqrt(xp.maximum(xp.abs(margin), CRITICAL * square))
    fast = xp.where(margin > 0.0, 0.0, gamma + root)  # not used there, and must stay finite
    slow = xp.exp(-xp.where(margin > 0.0, 0.0, square / (gamma + root)) * time)
    envelope, angle = xp.exp(-gamma * time), root * time
    even = xp.where(margin > 0.0, envelope * xp.cos(angle), 0.5 * (slow + xp.exp(-fast * time)))
    odd = xp.where(margin > 0.0, envelope * xp.sin(angle), -0.5 * slow * xp.expm1(-2.0 * angle)) / root
    return xp.stack([even + gamma * odd, xp.sqrt(square) * odd], axis=-1)


def viscous_state(
    time: np.ndarray, theta: Mapping[str, float], parts: np.ndarray, order: int
) -> tuple[np.ndarray, np.ndarray]:
    """x_rel and its rate, (n,) each, of the viscous decay whose derivative of this ``order`` is the basis times ``parts``."""
    gamma, square = theta["c"] / (2.0 * theta["m1"]), theta["k1"] / theta["m1"]
    at_rest, struck = viscous_basis(time, theta["k1"], theta["c"], theta["m1"], np).T
    x = parts[0] * at_rest + parts[1] * struck
    rate = np.sqrt(square) * (parts[1] * at_rest - parts[0] * struck) - 2.0 * gamma * parts[1] * struck
    for _ in range(order):
        x, rate = -(rate + 2.0 * gamma * x) / square, x
    return x, rate


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

    @classmethod
    def of(
        cls, index: np.ndarray, times: np.ndarray, peaks: np.ndarray, m1: float, smallest: float = 0.0
    ) -> "Decrement":
        """The paper's estimates from the peaks with these numbers of half periods (p,), of a rod of mass ``m1``, kg.

        The decrement is that of the peaks larger than ``smallest`` times the largest one.
        """
        used = np.abs(peaks) > smallest * np.max(np.abs(peaks))
        Omega_o = float(np.pi / np.polyfit(index, times, 1)[0])
        delta = float(-2.0 * np.polyfit(index[used], np.log(np.abs(peaks[used])), 1)[0])
        k1 = m1 * Omega_o**2
        return cls(times, peaks, Omega_o, delta, k1, delta / np.pi * float(np.sqrt(k1 * m1)))

    @property
    def first_ratio(self) -> float:
        """Ratio of the first two amplitudes, at least 1; the mean of neighbouring peaks cancels the error of the rest."""
        if len(self.peaks) < WHOLE_PERIOD:
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
        if len(crossings) >= WHOLE_PERIOD:
            last = len(crossings) - 1 - (len(crossings) - 1) % 2
            return float(np.mean(tail[crossings[0] + 1 : crossings[last] + 1]))
        if length >= len(values) or np.ptp(tail) < SWINGING_RATIO * np.ptp(values):
            return float(np.mean(tail))
        length += max(length // 4, 1)


def logarithmic_decrement(
    time: np.ndarray, values: np.ndarray, m1: float, smoothed: np.ndarray, jumps: bool = False
) -> Decrement | None:
    """Apply the paper's estimator to ``values``; None where fewer than three half cycles exceed the limits.

    Half cycles count from the start of the record until the first peak below the limits. The first and the last may be
    incomplete, so an extremum at an end of the record does not count, nor does one of readings that are all 0. Three turning
    points with samples on either side take five samples.

    Parameters
    ----------
    time, values : (n,) s and m
    m1 : mass of the rod, kg
    smoothed : (n,) the record after Savitzky–Golay, which locates the half cycles
    jumps : whether the readings may jump where the rod turns, as an acceleration does
    """
    if len(values) < UNKNOWNS:
        return None
    rest = equilibrium(values)
    guide, moved = smoothed - rest, values - rest
    smallest = PEAK_RANGE_RATIO_OF_JUMPS if jumps else PEAK_RANGE_RATIO
    lowest = max(SIGNIFICANT * noise_level(values), smallest * float(np.ptp(guide)))
    edges = np.concatenate([[0], np.flatnonzero(np.diff(np.signbit(guide))) + 1, [len(guide)]])
    peaks = list[int]()
    for left, right in itertools.pairwise(edges):
        index = left + int(np.argmax(np.abs(moved[left:right])))
        low = np.max(np.abs(guide[left:right])) < lowest
        if low and peaks:
            break
        if not low and 0 < index < len(values) - 1 and moved[index] != 0.0:
            peaks.append(index)
    if len(peaks) < WHOLE_PERIOD:
        return None
    return Decrement.of(np.arange(len(peaks)), time[peaks], moved[peaks], m1)


class ViscousFit(NamedTuple):
    """Least-squares fit of one viscous decay of any damping to a record, beside an offset; see ``viscous_fit``.

    Attributes
    ----------
    gamma, square : c/(2 m1), 1/s, and k1/m1, 1/s^2
    parts : (3,) coefficients of ``viscous_basis`` and offset, unit of the readings
    left : (n,) residuals, unit of the readings
    """

    gamma: float
    square: float
    parts: np.ndarray
    left: np.ndarray

    @property
    def omega(self) -> float:
        """omega_0, rad/s."""
        return float(np.sqrt(self.square))

    @property
    def ratio(self) -> float:
        """Damping ratio."""
        return self.gamma / self.omega

    def decrement(self, m1: float) -> Decrement:
        """Values of the fit in place of the paper's; its peak is the last turning point before the record, or its start."""
        time, peak = 0.0, float(self.parts[0])
        if self.ratio < 1.0:
            omega = self.omega * float(np.sqrt(1.0 - self.ratio**2))
            # The rate is proportional to exp(-gamma t) (b omega cos(omega t) - (a omega_0 + b gamma) sin(omega t)).
            at_rest, struck = self.parts[:2]
            time = float(np.arctan2(struck * omega, at_rest * self.omega + struck * self.gamma)) / omega
            time -= np.pi / omega if time > 0.0 else 0.0
            basis = viscous_basis(np.array([-time]), self.square, -2.0 * self.gamma, 1.0, np)
            peak = float(basis[0] @ (self.parts[:2] * [1.0, -1.0]))
        ratio = min(self.ratio, LARGEST_RATIO)
        delta = 2.0 * np.pi * ratio / float(np.sqrt(1.0 - ratio**2))
        return Decrement(np.array([time]), np.array([peak]), self.omega, delta, m1 * self.square, 2.0 * m1 * self.gamma)


def viscous_fit(
    time: np.ndarray, values: np.ndarray, unknowns: int = 2, order: int = 0, rough: float = 0.0
) -> ViscousFit:
    """Fit a viscous decay of any damping to a record of displacements, velocities or accelerations.

    Its motions and the offset are linear. Frequency and damping ratio are searched on a grid, and about the highest peak
    of the spectrum where the decay is light, then refined by least squares.

    Parameters
    ----------
    time, values : (n,) s, increasing, and readings
    unknowns : that are searched. 2: a decay. 1: one exponential, which a far overdamped decay leaves of its motion. 3: a
        single stroke, after which dry friction holds the rod; the time of its stop is searched too
    order : of the derivative of x_rel that a stroke is fitted to
    rough : damping ratio of the grid below which its best point is not refined
    """
    time, size = time - time[0], float(np.std(values)) or 1.0
    rest = np.mean(values[-max(len(values) // 5, 4) :])
    end = max(2 * length_of_motion(values - rest), FEWEST_SEARCHED)
    length, step = float(time[:end][-1]), float(np.median(np.diff(time)))
    grid = np.linspace(0.0, length, len(time[:end]))
    peak = 2.0 * np.pi * dominant_frequency(grid, np.interp(grid, time[:end], values[:end]))
    near = peak + np.pi / length * np.linspace(-1.0, 1.0, NEAR_POINTS)
    wide = np.geomspace(SLOWEST / length, np.pi / step, WIDE_POINTS)
    tried = [*itertools.product(near[near > 0.0], LIGHT_RATIOS), *itertools.product(wide, STRONG_RATIOS)]

    def fitted(z: np.ndarray, part: slice) -> ViscousFit:
        omega, ratio = np.exp([*z, np.inf][:2])
        design = np.column_stack([_motions(z, time[part], unknowns, order), np.ones(len(time[part]))])
        parts = np.linalg.lstsq(design, values[part])[0]
        return ViscousFit(float(ratio * omega), float(omega**2), parts, values[part] - design @ parts)

    rougher, few, fine = (slice(0, end, -(-end // most)) for most in (MOST_ROUGH, MOST_SEARCHED, MOST_REFINED))
    strongest = LARGEST_SEARCHED if unknowns == 2 else LARGEST_RATIO
    points = np.log([[*pair, 0.9] for pair in tried if unknowns == 2 or pair[1] < LARGEST_RATIO]).T[:unknowns]
    points = np.unique(points, axis=1)
    starts = points.T
    for part in (rougher, few) if rough > 0.0 else (few,):
        # The part of each point in the sum of squares about the mean, by the normal equations.
        moved = _motions(points, time[part], unknowns, order)
        moved -= np.mean(moved, axis=1, keepdims=True)
        square, product = np.swapaxes(moved, 1, 2) @ moved, (values[part] - np.mean(values[part])) @ moved
        ridge = SINGULAR * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(square.shape[1])
        taken = np.sum(product * np.linalg.solve(square + ridge, product[..., None])[..., 0], axis=1)
        starts = points.T[np.argsort(-taken, kind="stable")[:REFINED]]
        if rough > 0.0 and np.exp(starts[0][1]) < rough:
            return fitted(starts[0], slice(None))
    low, high = np.log([[0.1 * SLOWEST / length, SMALLEST_RATIO, 0.01], [np.pi / step, strongest, 1.0]])[:, :unknowns]
    ends = [
        least_squares(lambda z: fitted(z, fine).left / size, np.clip(z, low, high), bounds=(low, high), x_scale=0.1)
        for z in starts
    ]
    return fitted(min(ends, key=lambda one: one.cost).x, slice(None))


def _motions(z: np.ndarray, t: np.ndarray, unknowns: int, order: int) -> np.ndarray:
    """(..., n, 1 or 2) of the ``unknowns`` z, (number, ...); see ``viscous_fit``."""
    omega, ratio, share = np.exp([*z, *np.full((3 - unknowns, *z.shape[1:]), np.inf)])[..., None]
    if unknowns == 1:
        return np.exp(-omega * t)[..., None]
    if unknowns == 2:
        return viscous_basis(t, omega**2, 2.0 * ratio * omega, 1.0, np)
    # Backwards in time from the stop, at a share of the half period, damping is negative.
    left = share * np.pi / (omega * np.sqrt(1.0 - ratio**2)) - t
    basis = viscous_basis(np.maximum(left, 0.0), omega**2, -2.0 * ratio * omega, 1.0, np)
    return (basis[..., :1], basis[..., 1:], basis * (left > 0.0)[..., None])[order]


def likelihood_gain(one: ViscousFit, other: ViscousFit) -> float:
    """Twice the log-likelihood of ``other`` less that of ``one``, of the same readings with white noise.

    The readings count as so many fewer as there are unknowns: both fits take up noise.
    """
    return max(len(one.left) - UNKNOWNS, 1) * float(np.log(np.sum(one.left**2) / np.sum(other.left**2)))


def swings_enough(values: np.ndarray) -> bool:
    """Whether a record passes its rest position twice, or once where it then stays there."""
    size = (values - equilibrium(values)) / np.ptp(values)
    smallest = max(SWINGING_RATIO, SIGNIFICANT * noise_level(values) / float(np.ptp(values)))
    swings = int(np.count_nonzero(np.diff(np.sign(size[np.abs(size) > smallest]))))
    stuck = np.ptp(size[-max(len(size) // 5, 4) :]) < SWINGING_RATIO
    # Where friction stops the rod, its two strokes show their duration and what each of them loses.
    return swings >= (1 if stuck else 2)


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


def decay_frequency(time: np.ndarray, values: np.ndarray, fastest: bool = False) -> float:
    """Dominant frequency of a decay, Hz; where its spectrum has no peak because of strong damping, omega_0 of a fit.

    ``fastest`` : beyond critical damping the rate of the faster exponential in the place of omega_0
    """
    frequency = frequency_of(time, values)
    if frequency * float(time[-1] - time[0]) > FEW_PERIODS or np.ptp(values) == 0.0:
        return frequency
    found = _fit_of(*(np.asarray(part, float).tobytes() for part in shortened(time, values)))
    if found.ratio <= PEAKLESS:
        return frequency
    faster = found.ratio + float(np.sqrt(found.ratio**2 - 1.0)) if fastest and found.ratio > 1.0 else 1.0
    return faster * found.omega / (2.0 * np.pi)


@lru_cache(maxsize=8)
def _fit_of(time: bytes, values: bytes) -> ViscousFit:
    """``viscous_fit`` of bytes of float64, rough where the decay is light: several checks ask for a record's frequency."""
    return viscous_fit(np.frombuffer(time), np.frombuffer(values), rough=PEAKLESS)
