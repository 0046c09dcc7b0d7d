"""The motion of a record: folding, period, label, mean velocity and contacts."""

from dataclasses import dataclass
from fractions import Fraction
from math import gcd
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp
from scipy.stats import norm

from capsule_id.errors import InputError
from capsule_id.records.tones import (
    Harmonic,
    fit_harmonic,
    noise_level,
    recorded_drive,
    relative_position,
    stated_gap,
    stated_Omega,
)
from capsule_id.rig.filters import Record, sampling_step
from capsule_id.rig.model import Table

# fold: Folds a periodic record onto one period; the samples of each period lie between those of the others.
#
# The sampling step rarely divides the period. Ten periods at 1 kHz then give one period at 10 kHz.


@dataclass(frozen=True)
class Local:
    """Local polynomials at (m,) places: value, rate per second, and their sd for unit noise."""

    value: Float[np.ndarray, " m"]
    rate: Float[np.ndarray, " m"]
    sd: Float[np.ndarray, " m"]
    rate_sd: Float[np.ndarray, " m"]


def local_polynomials(
    phase: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    period: float,
    places: Float[np.ndarray, " m"],
    half_width: float,
    order: int,
) -> Local:
    """Least-squares polynomials over windows of a folded record, the folded Savitzky–Golay filter.

    Parameters
    ----------
    phase : (n,) s, in [0, period)
    values : (n,)
    period : s
    places : (m,) s, where the polynomials are evaluated
    half_width : of the window, s; the window is half open and holds at least ``order`` + 1 different phases
    order : of the polynomial; with 0 the value is a mean and the rate is 0
    """
    sort = np.argsort(phase)
    axis = (phase[sort] + period * np.array([-1.0, 0.0, 1.0])[:, None]).ravel()
    y = np.tile(values[sort], 3)
    low = np.searchsorted(axis, places - half_width)
    count = np.searchsorted(axis, places + half_width) - low
    index = low[:, None] + np.arange(int(count.max()))
    inside = np.arange(index.shape[1]) < count[:, None]
    index = np.minimum(index, len(axis) - 1)
    u = np.where(inside, (axis[index] - places[:, None]) / half_width, 0.0)
    design = u[:, :, None] ** np.arange(order + 1) * inside[:, :, None]
    inverse = np.linalg.inv(np.einsum("mkp,mkq->mpq", design, design))
    weights = np.einsum("mpq,mkq->mpk", inverse, design)
    unknowns = np.einsum("mpk,mk->mp", weights, np.where(inside, y[index], 0.0))
    none = np.zeros(len(places))
    rate = unknowns[:, 1] / half_width if order else none
    rate_sd = np.sqrt(inverse[:, 1, 1]) / half_width if order else none
    return Local(unknowns[:, 0], rate, np.sqrt(inverse[:, 0, 0]), rate_sd)


def intervals_above(z: Float[np.ndarray, " n"], low: float, high: float) -> list[tuple[int, int]]:
    """Stretches of a cyclic sequence (n,) that begin above ``high`` and last until it has fallen below ``low``.

    Returns (first, length) of each, indices modulo n; a sequence that never falls below ``low`` is one stretch if it
    rises above ``high`` at all. The two levels keep noise about one level from splitting or joining stretches.
    """
    state = np.where(z > high, 1, np.where(z < low, 0, -1))
    if not (state == 1).any():
        return []
    if not (state == 0).any():
        return [(0, len(z))]
    first = int(np.flatnonzero(state == 0)[0])
    turned = np.roll(state, -first)
    # Between the levels the last state stays.
    held = turned[np.maximum.accumulate(np.where(turned >= 0, np.arange(len(z)), 0))]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], held, [0]])))
    return [((int(a) + first) % len(z), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


# repeat: Probability of each period of a recorded motion, in excitation periods, given its cycle-to-cycle scatter.
#
# record -> spline -> polynomial over every excitation period
#        -> power of the sequence of cycles at the frequencies of each period
#        -> Bayesian comparison of the periods 1 to 16 and of an aperiodic motion
#
# The coefficients y_c of cycle c are a slow drift in c, a part that repeats after n cycles, and scatter. The part has
# the frequencies j/m per cycle, m a divisor of n and j coprime to m: one level of variance for each m. The scatter is
# AR(1) in c with the standard deviation q; the noise of the sensor adds to it. Nothing is known in advance of q, of the
# levels and of the correlation: the likelihood is integrated over them. The scatter of correlated coefficients counts
# as that of fewer, independent ones (Satterthwaite). Standard deviations are relative to the rms of the motion.


LONGEST_PERIOD = 16  # excitation periods; ``response`` uses the same bound
#: Shortest record, in excitation periods, and fewest samples per excitation period.
FEWEST_PERIODS, FEWEST_SAMPLES = 4, 4
#: Shortest record of an aperiodic motion, in excitation periods: it holds every period and two more.
FEWEST_APERIODIC = LONGEST_PERIOD + 2
#: A period is decided where its probability reaches this.
DECIDED = 0.9
#: Prior probability of an aperiodic motion. That of the period n falls as n to this power.
APERIODIC_PRIOR, PERIOD_EXPONENT = 0.07, -3.0
#: Ranges of standard deviations with log-uniform priors: cycle-to-cycle scatter of period 1 and of an aperiodic motion,
#: and the part that repeats after n cycles only. A smaller part counts as a repeat. The largest scatter of period n is
#: n times smaller: scatter hides the fine bands of long periods.
PERIODIC_SCATTER, APERIODIC_SCATTER, PART = (0.003, 0.06), (0.02, 1.0), (0.003, 1.0)
#: Largest scatter of most periodic records; above it the prior falls with this power.
COMMON_SCATTER, SCATTER_EXPONENT = 0.015, 3.0
#: Largest number of bands of an aperiodic motion, visited in turn.
MOST_BANDS = 4
#: A period is decided only where noise and scatter hide no larger part of another one than this.
LARGEST_HIDDEN = 0.02
#: Correlations of the scatter of successive cycles.
CORRELATIONS = np.linspace(-0.6, 0.6, 5)
_HIGHEST_DEGREE = 16  # of the polynomial over a cycle; a high degree on few samples amplifies their noise
_STANDARD_ERRORS = 3.0  # of the power of the scatter at one frequency; a larger part is visible
_GRID = 25  # standard deviations per range
_DIFFERENCE_ORDER = 6  # of the differences for the noise level; the motion vanishes in them
_CYCLES_PER_DRIFT_TERM = 4  # of the polynomial drift, at most quadratic
_MOST_DRIFT_TERMS = 3
_DENSE = 4  # points of the spline per sample
_FEWEST_FREE_CYCLES = 3  # beyond drift and period


@dataclass(frozen=True)
class Repeat:
    """The period with its probability, or the reason why the record is inconclusive.

    period : in excitation periods; 0 if the motion is aperiodic; None if no probability reaches 0.9
    probabilities : (17,) of an aperiodic motion and of the periods 1 to 16; longer ones than half the record take the rest
    periods : length of the record in excitation periods
    scatter : rms difference of a cycle from the periodic motion beyond the noise, drift removed, m
    hidden : rms of the largest part of another period that noise and scatter hide, m
    motion : rms of x_rel about its mean without the noise, m
    noise_sd : of x_rel, m
    reason : why the record is inconclusive, or ""
    """

    period: int | None
    probabilities: np.ndarray
    periods: float
    scatter: float
    hidden: float
    motion: float
    noise_sd: float
    reason: str = ""

    @property
    def probability(self) -> float:
        """The largest of the probabilities."""
        return float(np.max(self.probabilities))


def find_period(time: Record, x_rel: Record, T: float, floor: float = 0.0) -> Repeat:
    """Smallest number n of drive periods T after which x_rel repeats within its cycle-to-cycle scatter.

    Parameters
    ----------
    time, x_rel : (n,) s, evenly spaced, and m
    T : period of the drive, s
    floor : reading error of x_rel, m, the lower bound of the noise level

    A part of another period below 0.3 % of the motion's rms counts as a repeat, and so does chaos in bands as narrow.
    Chaos and scatter of 2 to 6 % are hardly told apart: the motion is often undecided there.
    """
    step = (time[-1] - time[0]) / (len(time) - 1)
    periods = float(len(time) * step / T)
    noise_sd = max(noise_level(x_rel, _DIFFERENCE_ORDER), floor)
    motion = float(np.sqrt(max(np.var(x_rel) - noise_sd**2, 0.0)))
    reason = ""
    if periods < FEWEST_PERIODS:
        reason = f"the record holds {periods:.1f} periods of the drive, {FEWEST_PERIODS} are needed"
    elif T / step < FEWEST_SAMPLES:
        reason = f"the record holds {T / step:.1f} samples per period of the drive, {FEWEST_SAMPLES} are needed"
    elif motion <= noise_sd:
        reason = f"noise: its standard deviation is {1e6 * noise_sd:.3g} um, the motion {1e6 * motion:.3g} um"
    if reason:
        nan = float("nan")
        return Repeat(None, np.zeros(LONGEST_PERIOD + 1), periods, nan, nan, motion, noise_sd, reason)
    cycles, gain = _polynomials(time - time[0], x_rel / motion, T)
    evidence = _Evidence(cycles, gain * (noise_sd / motion) ** 2)
    probabilities = evidence.probabilities()
    best = int(np.argmax(probabilities))
    hidden = evidence.hidden(max(best, 1))
    if probabilities[best] < DECIDED:
        order = np.argsort(-probabilities)[:2]
        words = ", ".join(f"{period_word(int(i))} {probabilities[i]:.2f}" for i in order)
        reason = f"period: probabilities {words}; record more than {periods:.0f} periods of the drive"
    elif best and hidden > LARGEST_HIDDEN:
        part = f"{hidden:.1%} of the motion"
        reason = f"noise and scatter: they hide a part of another period below {part}; record more periods"
    elif 2 * best > periods:
        reason = f"repeats after {best} periods of the drive, but holds only {periods:.1f}"
    elif best == 0 and periods < FEWEST_APERIODIC:
        needed = f"{FEWEST_APERIODIC} periods of the drive are needed"
        reason = f"no repeat; the record of {periods:.1f} periods is too short for longer ones, {needed}"
    scatter = motion * evidence.scatter(max(best, 1))
    return Repeat(None if reason else best, probabilities, periods, scatter, motion * hidden, motion, noise_sd, reason)


def period_word(period: int) -> str:
    """The label of a period alone."""
    return f"P-{period}" if period else "aperiodic"


def _polynomials(time: Record, x: Record, T: float) -> tuple[Float[np.ndarray, "c k"], float]:
    """Legendre coefficients of every whole excitation period, (c, k), and the sum of their variances for unit noise.

    The sum of their squares is the mean square of x over the cycle. Where the samples lie in a cycle changes from cycle
    to cycle. The coefficients are therefore those of the cubic spline through the record, at the same dense places.
    """
    step = time[-1] / (len(time) - 1)
    whole = int((time[-1] + step) / T * (1.0 + 1e-9))
    degree = min(_HIGHEST_DEGREE, int(1.5 * np.sqrt(T / step)))
    dense = (np.arange(int(_DENSE * T / step)) + 0.5) / int(_DENSE * T / step)
    legendre = np.polynomial.legendre.legvander(2.0 * dense - 1.0, degree) * np.sqrt(2.0 * np.arange(degree + 1) + 1.0)
    places = np.minimum(T * (np.arange(whole)[:, None] + dense), time[-1])
    return CubicSpline(time, x)(places) @ np.linalg.pinv(legendre).T, (degree + 1) * step / T


@dataclass(frozen=True)
class _Level:
    """Frequencies j/m of one m, for each of the correlations (r,): power of the filtered cycles there, filter gain.

    dimensions : number of waves
    """

    power: Float[np.ndarray, " r"]
    gain: Float[np.ndarray, " r"]
    dimensions: int


class _Evidence:
    """Likelihoods of the periods given cycles (c, k) and the variance of their noise, relative to the motion."""

    def __init__(self, cycles: Float[np.ndarray, "c k"], noise: float) -> None:
        self._cycles, self._noise = cycles, noise
        self._drift_terms = int(np.clip(len(cycles) // _CYCLES_PER_DRIFT_TERM, 1, _MOST_DRIFT_TERMS))
        residuals, freedom = self._residuals(1), len(cycles) - self._drift_terms
        self._longest = min(LONGEST_PERIOD, max(freedom - _FEWEST_FREE_CYCLES, 1))
        covariance = residuals.T @ residuals / freedom
        total, square = float(np.trace(covariance)), float(np.sum(covariance**2))
        # The sample covariance of few cycles is too uneven: correct its square.
        square = max(square - total**2 / freedom, total**2 / cycles.shape[1])
        self._independent = float(np.clip(total**2 / square, 1.0, cycles.shape[1])) if total > 0.0 else 1.0

    def hidden(self, n: int) -> float:
        """Largest part of another period that the noise and the scatter of period n hide, rms."""
        variance = self._noise + self.scatter(n) ** 2
        return float(np.sqrt(variance * _STANDARD_ERRORS * np.sqrt(2.0 / self._independent) / len(self._cycles)))

    def scatter(self, n: int) -> float:
        """rms difference of a cycle from the motion of period n beyond the noise, drift removed."""
        rest = float(np.sum(self._residuals(n) ** 2)) / (len(self._cycles) - self._drift_terms - n + 1)
        return float(np.sqrt(max(rest - self._noise, 0.0)))

    def probabilities(self) -> Float[np.ndarray, " n"]:
        """(17,) posterior probabilities of an aperiodic motion and of the periods 1 to 16."""
        n = np.arange(1, LONGEST_PERIOD + 1)
        prior = (1.0 - APERIODIC_PRIOR) * n**PERIOD_EXPONENT / np.sum(n**PERIOD_EXPONENT)
        levels = [self._levels(int(k)) for k in n[: self._longest]]
        periodic = np.array([self._log_evidence(one, *_periodic_scatter(k)) for k, one in enumerate(levels, start=1)])
        bands, wide = levels[:MOST_BANDS], np.geomspace(*APERIODIC_SCATTER, _GRID)
        scattered = np.array([self._log_evidence(one, wide) for one in bands])
        aperiodic = _log_sum(scattered) + np.log(APERIODIC_PRIOR / len(bands))
        parts = [aperiodic, *(periodic + np.log(prior[: self._longest]))]
        if self._longest < LONGEST_PERIOD:  # a longer period looks like scatter of any size
            parts.append(
                self._log_evidence(levels[0], np.geomspace(*PART, _GRID)) + np.log(np.sum(prior[self._longest :]))
            )
        posterior = np.exp(np.array(parts) - _log_sum(np.array(parts)))
        found = np.zeros(LONGEST_PERIOD + 1)
        found[: self._longest + 1] = posterior[: self._longest + 1]
        return found

    def _log_evidence(
        self, levels: list[_Level], q: Float[np.ndarray, " q"], weight: Float[np.ndarray, " q"] | float = 1.0 / _GRID
    ) -> float:
        """Log-likelihood of a period with these levels, integrated over scatters q of prior ``weight`` and the rest.

        The first level is what the drift and the others leave; the last one must be present.
        """
        r = CORRELATIONS[:, None]
        variance = (1.0 + r**2) * self._noise + (1.0 - r**2) * q**2
        power = np.sum([level.power for level in levels], axis=0)[:, None]
        dimensions = sum(level.dimensions for level in levels)
        value = -0.5 * self._independent * (dimensions * np.log(variance) + power / variance)
        for level in levels[1:]:
            ratio = self._log_ratio(level, variance)
            value = value + (ratio if level is levels[-1] else np.logaddexp(0.0, ratio) - np.log(2.0))
        return float(_log_sum((value + np.log(weight)).ravel()) - np.log(len(r)))

    def _log_ratio(self, level: _Level, variance: Float[np.ndarray, "r q"]) -> Float[np.ndarray, "r q"]:
        """Log of the likelihood of a level over that of scatter alone, for each variance of the scatter."""
        part = np.geomspace(*PART, _GRID)[:, None, None]
        more = variance + level.gain[:, None] * len(self._cycles) * part**2 / level.dimensions
        terms = level.dimensions * np.log(more / variance) + level.power[:, None] * (1.0 / more - 1.0 / variance)
        return _log_sum(-0.5 * self._independent * terms) - np.log(_GRID)

    def _levels(self, n: int) -> list[_Level]:
        """What the drift and period n leave of the filtered cycles, then the levels of the divisors of n, n last."""
        last, before = self._cycles[1:], self._cycles[:-1]
        basis, divisors = self._basis(len(last), n)
        r = CORRELATIONS[:, None]
        rows, r_rows = (basis.T @ y for y in (last, before)), r[:, :, None]
        one, other = rows
        power = np.sum((one - r_rows * other) ** 2, axis=2)
        total = np.array([np.sum((last - x * before) ** 2) for x in CORRELATIONS.tolist()])
        levels, first = [], self._drift_terms
        rest = _Level(total - np.sum(power, axis=1), np.ones_like(CORRELATIONS), len(last) - basis.shape[1])
        for m, angles in divisors.items():
            number = sum(1 if 2 * j == m else 2 for j in angles)
            cosine = np.cos(2.0 * np.pi * np.array(angles) / m)
            gain = np.mean(1.0 - 2.0 * r * cosine + r**2, axis=1)
            levels.append(_Level(np.sum(power[:, first : first + number], axis=1), gain, number))
            first += number
        return [rest, *levels]

    def _basis(self, count: int, n: int) -> tuple[Float[np.ndarray, "count b"], dict[int, list[int]]]:
        """Orthonormal basis of the drift and period n over ``count`` cycles, with the j of each divisor m of n."""
        c, design = (
            np.arange(count),
            [np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, count), self._drift_terms - 1)],
        )
        divisors = {m: [j for j in range(1, m // 2 + 1) if gcd(j, m) == 1] for m in range(2, n + 1) if n % m == 0}
        for m, angles in divisors.items():
            phase = 2.0 * np.pi / m * np.multiply.outer(c, angles)
            design.append(np.cos(phase))
            if m > 2:
                design.append(np.sin(phase))
        return np.linalg.qr(np.concatenate(design, axis=1))[0], divisors

    def _residuals(self, n: int) -> Float[np.ndarray, "c k"]:
        """What the drift and period n leave of the cycles."""
        basis, _ = self._basis(len(self._cycles), n)
        return self._cycles - basis @ (basis.T @ self._cycles)


def _periodic_scatter(n: int) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    """Scatters of a motion of period n and their prior probabilities."""
    q = np.geomspace(PERIODIC_SCATTER[0], PERIODIC_SCATTER[1] / n, _GRID)
    weight = np.minimum(1.0, (COMMON_SCATTER / q) ** SCATTER_EXPONENT)
    return q, weight / np.sum(weight)


def _log_sum(logs: Float[np.ndarray, "n ..."]) -> Any:
    """Log of the sum of exponentials over the first axis; SciPy's takes ten times as long on small arrays."""
    largest = np.max(logs, axis=0)
    return largest + np.log(np.sum(np.exp(logs - largest), axis=0))


# mean velocity: Estimates the mean velocity of the capsule, its standard error and the direction of motion with its
# probability.


#: Largest advance per excitation period of a standing capsule, m; ``response`` uses the same bound.
STANDING_ADVANCE = 1e-7
#: Confidence of a decision, moving or standing.
CONFIDENCE = 0.99
_MOST_HARMONICS = 24  # of the motion's frequency in the periodic part of X2
_SAMPLES_PER_VELOCITY = 4  # at least
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
    most = min(_MOST_HARMONICS, int(0.5 * T / step) - 1, len(time) // (2 * _SAMPLES_PER_VELOCITY) - 1)
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


# contacts: Counts contacts between rod and support spring, in the acceleration of the rod and in x_rel.
#
# Acceleration. Out of contact the rod obeys a linear law, acceleration = b0 + b1 x_rel + b2 rate + b3 cos(Omega t)
# + b4 sin(Omega t). It is fitted to the samples far from contact. In contact the spring pushes the rod back, and
# the acceleration is below this law: a spike. x_rel exceeds the gap during a contact. Sensor zero and stated gap
# are known to some tens of um only. Where spikes exist, the impact line is the x_rel at which they vanish.
#
# Both are counted on the record folded onto one period of the motion, with two levels (``SPIKE_LEVELS``,
# ``CROSSING_LEVELS``, in standard errors): a contact begins above the higher and ends below the lower one. The count is
# accepted if all pairs of levels and both methods give the same number, and more than half of the single periods
# agree.


SPIKE_LEVELS = ((1.5, 4.5), (2.0, 5.0), (2.5, 6.0))
CROSSING_LEVELS = ((-1.0, 1.0), (-3.0, 1.0))
_PLACES_PER_SAMPLE = 8  # grid points per sampling step, on the folded period
_NARROW_HALF_WIDTH = 1.25  # samples, half-width of the cubic for x_rel and its rate near a contact
_NARROW_SAMPLES = 9  # samples of the folded record in the narrow window, at least about this many
_WIDE_HALF_WIDTH = 0.02  # of the excitation period, half-width for the linear law: rates with little noise
_CLEARANCE_SHARE = 0.05  # of the range of x_rel: samples this far below the gap are clear of contact,
_CLEARANCE_SDS = 5.0  # and this many sd of the stated gap below it
_CONTACT_STANDARD_ERRORS = 6.0  # standard errors; larger spikes determine the impact line
_IMPACT_LINE_SHIFTS = (-2.0, 0.0, 2.0)  # sd; crossings are counted at the impact line shifted by these
_FEWEST_CONTACT_SAMPLES = 2  # of the folded record in contact, needed for the impact line
_SAMPLES_PER_UNKNOWN = 10  # samples per unknown of the linear law
_AVERAGED_SAMPLES = 3  # samples of the moving mean in single periods; a contact lasts longer
_LINEAR_LAW_UNKNOWNS = 5  # unknowns of the linear law
_ODDS_OF_A_CYCLE = 3.0  # that a single period shows the true number of contacts


@dataclass(frozen=True)
class ImpactLine:
    """The impact line: x_rel where contacts begin and its sd, m (sensor zero included); scatter of x_rel about it."""

    value: float
    sd: float
    scatter: float


@dataclass(frozen=True)
class Contacts:
    """Contacts over one period of the motion.

    count : contacts per period of the motion, None where the evidence disagrees
    spikes : counts by ``SPIKE_LEVELS``, () without acceleration
    crossings : counts by ``CROSSING_LEVELS`` at the impact line less 2 of its sd, at it, and at it plus 2 sd
    impact_line : from the spikes; None where they are too few and the stated gap is used
    duration : of the shortest contact, s, None without contacts
    agreeing, cycles : number of single periods with the same count, and number of single periods
    reason : why the count is None, or ""
    """

    count: int | None
    spikes: tuple[int, ...]
    crossings: tuple[int, ...]
    impact_line: ImpactLine | None
    duration: float | None
    agreeing: int
    cycles: int
    reason: str = ""

    @property
    def probability(self) -> float:
        """Of the count: a single period shows the true count with the probability 3/4, and any other with 1/4."""
        return 1.0 / (1.0 + _ODDS_OF_A_CYCLE ** (self.cycles - 2 * self.agreeing))


@dataclass(frozen=True)
class Cycle:
    """A record for folding: channels (n,) SI, drive and gap. ``period``: of the motion, s. ``noise_sd``: of x_rel, m."""

    time: np.ndarray
    x_rel: np.ndarray
    acceleration: np.ndarray | None
    Omega: float
    period: float
    gap: float
    gap_sd: float
    noise_sd: float

    @property
    def phase(self) -> np.ndarray:
        """Time within the period of the motion, s."""
        return (self.time - self.time[0]) % self.period

    @property
    def step(self) -> float:
        """Sampling step, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    @property
    def places(self) -> np.ndarray:
        """Grid on the folded period, s."""
        return np.linspace(0.0, self.period, max(int(_PLACES_PER_SAMPLE * self.period / self.step), 2), endpoint=False)

    def mean(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean over one sampling step at ``places``, with a sample of every cycle, and its sd for unit noise."""
        found = local_polynomials(self.phase, values, self.period, self.places, 0.5 * self.step, 0)
        return found.value, found.sd


def find_contacts(cycle: Cycle) -> Contacts:
    """Count the contacts of a record whose motion has the period ``cycle.period``."""
    push = _shortfall(cycle)
    seen = _impact_line(cycle, push)
    line = seen or ImpactLine(cycle.gap, cycle.gap_sd, cycle.noise_sd)
    single = cycle.x_rel - line.value
    mean, sd = cycle.mean(cycle.x_rel)
    above = [(mean - line.value - shift * line.sd) / (sd * line.scatter) for shift in _IMPACT_LINE_SHIFTS]
    crossings = tuple(len(intervals_above(z, *levels)) for z in above for levels in CROSSING_LEVELS)
    if push is None:
        spikes, z, single, levels = (), above[len(above) // 2], single / cycle.noise_sd, CROSSING_LEVELS[-1]
    else:
        mean, sd = cycle.mean(push.shortfall)
        z = mean / np.hypot(sd * push.sd, cycle.mean(push.shared_sd)[0])
        spikes = tuple(len(intervals_above(z, *pair)) for pair in SPIKE_LEVELS)
        single, levels = push.shortfall / np.hypot(push.sd, push.shared_sd), SPIKE_LEVELS[1]
    stretches = intervals_above(z, *levels)
    single = np.convolve(single, np.full(_AVERAGED_SAMPLES, _AVERAGED_SAMPLES**-0.5), mode="same")
    agreeing, cycles = _agreeing_cycles(cycle, single, levels, stretches)
    counts = set(spikes + crossings)
    reason = ""
    if len(counts) > 1:
        reason = f"contacts: spikes {_counts_text(spikes)}, crossings of the gap {_counts_text(crossings)}"
    elif 2 * agreeing <= cycles:
        reason = f"contacts: {agreeing} of {cycles} single periods show the {counts.pop()} of all together"
    count = None if reason else counts.pop()
    shortest = min((length for _, length in stretches), default=0) * cycle.period / len(z)
    return Contacts(count, spikes, crossings, seen, shortest or None, agreeing, cycles, reason)


def _counts_text(counts: tuple[int, ...]) -> str:
    return "/".join(str(n) for n in counts) or "not recorded"


@dataclass(frozen=True)
class _Shortfall:
    """Linear law minus acceleration.

    shortfall : (n,) m/s^2
    sd : of its white noise, m/s^2
    shared_sd : (n,) m/s^2, from the law and the smoothed x_rel in it; neighbours and periods share this error
    """

    shortfall: np.ndarray
    sd: float
    shared_sd: np.ndarray


def _shortfall(cycle: Cycle) -> _Shortfall | None:
    """Linear law minus acceleration; None without one that varies or without enough samples clear of contact."""
    if cycle.acceleration is None or np.ptp(cycle.acceleration) == 0.0:
        return None
    wide = local_polynomials(
        cycle.phase,
        cycle.x_rel,
        cycle.period,
        cycle.phase,
        max(_NARROW_HALF_WIDTH * cycle.step, _WIDE_HALF_WIDTH * _excitation_period(cycle)),
        3,
    )
    clear = _clear_of_gap(cycle, wide.value)
    if clear.sum() < _SAMPLES_PER_UNKNOWN * _LINEAR_LAW_UNKNOWNS:
        return None
    terms = _linear_law_terms(cycle, wide.value, wide.rate)[clear]
    scale = np.linalg.norm(terms, axis=0)
    q, triangle = np.linalg.qr(terms / scale)
    law = np.linalg.solve(triangle, q.T @ cycle.acceleration[clear]) / scale
    half = max(_NARROW_HALF_WIDTH, 0.5 * _NARROW_SAMPLES * cycle.period / (len(cycle.time) * cycle.step)) * cycle.step
    near = local_polynomials(cycle.phase, cycle.x_rel, cycle.period, cycle.phase, half, 3)
    terms = _linear_law_terms(cycle, near.value, near.rate)
    shortfall = terms @ law - cycle.acceleration
    # A step that exceeds the motion clear of contact hides the noise: what is left is the rounding.
    rounding = float(np.min(np.diff(np.unique(cycle.acceleration)))) / np.sqrt(12.0)
    sd = max(float(np.std(shortfall[clear])), rounding)
    of_law = sd * np.linalg.norm(np.linalg.solve(triangle.T, (terms / scale).T), axis=0)
    of_terms = cycle.noise_sd * np.hypot(law[1] * near.sd, law[2] * near.rate_sd)
    return _Shortfall(shortfall, sd, np.hypot(of_law, of_terms))


def _excitation_period(cycle: Cycle) -> float:
    return 2.0 * np.pi / cycle.Omega


def _linear_law_terms(cycle: Cycle, x_rel: np.ndarray, rate: np.ndarray) -> np.ndarray:
    angle = cycle.Omega * cycle.time
    return np.stack([np.ones_like(angle), x_rel, rate, np.cos(angle), np.sin(angle)], axis=1)


def _clear_of_gap(cycle: Cycle, x_rel: np.ndarray) -> np.ndarray:
    """Which samples are well below the gap and have only such samples in the wide window: (n,) bool."""
    below = x_rel < cycle.gap - max(_CLEARANCE_SDS * cycle.gap_sd, _CLEARANCE_SHARE * float(np.ptp(x_rel)))
    if below.all():
        return below
    other = np.sort(cycle.phase[~below])
    other = np.concatenate([other - cycle.period, other, other + cycle.period])
    after = np.searchsorted(other, cycle.phase).clip(1, len(other) - 1)
    distance = np.minimum(cycle.phase - other[after - 1], other[after] - cycle.phase)
    return below & (distance > _WIDE_HALF_WIDTH * _excitation_period(cycle))


def _impact_line(cycle: Cycle, push: _Shortfall | None) -> ImpactLine | None:
    """The x_rel at which the spikes vanish, by regression of x_rel on them."""
    if push is None:
        return None
    (force, sd), (x_rel, _) = cycle.mean(push.shortfall), cycle.mean(cycle.x_rel)
    deep = force > _CONTACT_STANDARD_ERRORS * sd * push.sd
    # A mean across an edge of a contact is biased: drop half a sampling step on either side.
    touching = np.all(
        [np.roll(deep, shift) for shift in range(-_PLACES_PER_SAMPLE // 2, _PLACES_PER_SAMPLE // 2 + 1)], axis=0
    )
    count = touching.sum() / _PLACES_PER_SAMPLE
    if count < _FEWEST_CONTACT_SAMPLES:
        return None
    shared_sd = float(np.mean(cycle.mean(push.shared_sd)[0][touching]))
    force, x_rel, sd = force[touching], x_rel[touching], sd[touching]
    # Noise in the regressor reduces the slope: subtract its known variance.
    variance = float(np.var(force) - np.mean(sd**2) * push.sd**2)
    if variance <= 0.0:
        return None
    slope = float(np.mean((force - force.mean()) * (x_rel - x_rel.mean())) / variance)
    value = float(x_rel.mean() - slope * force.mean())
    residual = x_rel - slope * force - value
    regression_sd = np.std(residual) * np.sqrt((1.0 + force.mean() ** 2 / variance) / count)
    scatter = max(float(np.std(residual / sd)), cycle.noise_sd)
    return ImpactLine(value, float(np.hypot(regression_sd, slope * shared_sd)), scatter)


def _agreeing_cycles(
    cycle: Cycle, z: np.ndarray, levels: tuple[float, float], stretches: list[tuple[int, int]]
) -> tuple[int, int]:
    """Number of single cycles with the contact count of the folded record, and number of cycles, cut far from contacts."""
    places = len(cycle.places)
    quiet = 0
    if stretches:
        ends = [((a + n) % places, b) for (a, n), (b, _) in zip(stretches, stretches[1:] + stretches[:1], strict=True)]
        widest = max(ends, key=lambda pair: (pair[1] - pair[0]) % places)
        quiet = widest[0] + ((widest[1] - widest[0]) % places) // 2
    start = (quiet % places) / places * cycle.period
    number = np.floor((cycle.time - cycle.time[0] - start) / cycle.period).astype(int)
    last = int((cycle.time[-1] - cycle.time[0] - start) / cycle.period)
    counts = [len(intervals_above(z[number == i], *levels)) for i in range(last)]
    return sum(n == len(stretches) for n in counts), len(counts)


# label: Labels the motion of a record, P-<n>-<F|B|S>-<m> as in the paper, with its probability and the evidence.
#
# drive -> period by repeat -> mean velocity -> contacts on the folded record -> label


UNDECIDED = "undecided"


@dataclass(frozen=True)
class Evidence:
    """Evidence for a label; None where the channels for it were not recorded.

    drive : the tone of the current
    Omega : rad/s, of the current, else of x_rel, else as stated
    repeat, mean_velocity, contacts : results of the single steps
    reasons : what is missing for the whole label, () for a whole one
    """

    drive: Harmonic | None
    Omega: float
    repeat: Repeat | None
    mean_velocity: MeanVelocity | None
    contacts: Contacts | None
    reasons: tuple[str, ...]


class MeasuredMotion(NamedTuple):
    """Label, mean velocity and evidence.

    label : in the format of ``response``, its period alone ("P-1"), or "undecided" where no probability reaches 0.9
    mean_velocity : of the capsule, m/s; NaN if x_capsule was not recorded
    probability : of the label; of the most probable period where it is undecided; NaN without any
    """

    label: str
    mean_velocity: float
    evidence: Evidence
    probability: float


def measured_motion(table: Table) -> MeasuredMotion:
    """Label, mean velocity and evidence of a recorded run.

    Parameters
    ----------
    table : a ``forced_run`` of a rig; period and contacts need x_rel (or x_base and x_capsule), direction needs x_capsule

    The label describes the record, not a settled motion of the model: "P-1" means that it repeats within the scatter
    from cycle to cycle. The probability of a whole label is the product of those of period, direction and contacts.
    """
    time, columns = table["time"], table.columns
    drive = recorded_drive(table)
    Omega = drive.Omega if drive else stated_Omega(table)
    try:
        sampling_step(time)
    except InputError as error:
        reason = f"{error.rule} ({error.value})"
        return MeasuredMotion(
            UNDECIDED, float("nan"), Evidence(drive, Omega, None, None, None, (reason,)), float("nan")
        )
    relative = relative_position(table)
    if drive is None and relative:
        Omega = fit_harmonic(time, relative[0], Omega).Omega
    T = 2.0 * np.pi / Omega
    repeat = find_period(time, relative[0], T, relative[1]) if relative else None
    period = repeat.period if repeat else None
    velocity = fit_mean_velocity(time, table["x_capsule"], T, period) if "x_capsule" in columns else None
    scatter = float(np.hypot(repeat.noise_sd, repeat.scatter)) if repeat else 0.0
    contacts = None
    if period and relative and table.settings.spring is not None:
        contacts = find_contacts(_cycle(table, relative[0], Omega, period * T, scatter))
    mean_velocity = velocity.velocity if velocity else float("nan")
    label, probability, reasons = _label(repeat, velocity, contacts)
    evidence = Evidence(drive, Omega, repeat, velocity, contacts, reasons)
    return MeasuredMotion(label, mean_velocity, evidence, probability)


def _cycle(table: Table, x_rel: np.ndarray, Omega: float, period: float, noise_sd: float) -> Cycle:
    gap = stated_gap(table)
    acceleration = table["acceleration_rod"] if "acceleration_rod" in table.columns else None
    return Cycle(table["time"], x_rel, acceleration, Omega, period, gap.value, gap.sd, noise_sd)


def _label(
    repeat: Repeat | None, velocity: MeanVelocity | None, contacts: Contacts | None
) -> tuple[str, float, tuple[str, ...]]:
    """The label, its probability, and what is missing for the whole label."""
    if repeat is None:
        return UNDECIDED, float("nan"), ("x_rel was not recorded",)
    if repeat.period is None:
        return UNDECIDED, repeat.probability, (repeat.reason,)
    period = period_word(repeat.period)
    if repeat.period == 0:
        return period, repeat.probability, ()
    reasons = [part.reason for part in (velocity, contacts) if part is not None and part.reason]
    if velocity is None:
        reasons.append("x_capsule was not recorded")
    if contacts is None:
        reasons.append("spring and gap are not stated")
    if reasons or velocity is None or contacts is None or contacts.count is None:
        return period, repeat.probability, tuple(reasons)
    whole = f"{period}-{velocity.direction}-{Fraction(contacts.count, repeat.period)}"
    probability = repeat.probability * velocity.probability * contacts.probability
    if probability < DECIDED:
        return period, repeat.probability, (f"{whole} has the probability {probability:.2f}",)
    return whole, probability, ()
