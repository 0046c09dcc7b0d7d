"""Probability of each period of a recorded motion, in excitation periods, given its cycle-to-cycle scatter.

record -> polynomial over every excitation period -> power of the sequence of cycles at the frequencies of each period
       -> Bayesian comparison of the periods 1 to 16 and of an aperiodic motion

The coefficients y_c of cycle c are a slow drift in c, a part that repeats after n cycles, and scatter. The part has
the frequencies j/m per cycle, m a divisor of n and j coprime to m: one level of variance for each m. The scatter is
AR(1) in c with the standard deviation q; the noise of the sensor adds to it. Nothing is known in advance of q, of the
levels and of the correlation: the likelihood is integrated over them. The scatter of correlated coefficients counts
as that of fewer, independent ones (Satterthwaite). Standard deviations are relative to the rms of the motion.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import gcd

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from capsule_id.records.noise import noise_level
from capsule_id.rig.filters import Record

LONGEST_PERIOD = 16  # excitation periods; ``response`` uses the same bound
#: Shortest record, in excitation periods, and fewest samples per excitation period.
FEWEST_PERIODS, FEWEST_SAMPLES = 4, 4
#: A period is decided where its probability reaches this.
DECIDED = 0.9
#: Prior probability of an aperiodic motion. That of the period n falls as n to this power.
APERIODIC_PRIOR, PERIOD_EXPONENT = 0.1, -3.0
#: Ranges of standard deviations with log-uniform priors: cycle-to-cycle scatter of period 1 and of an aperiodic motion,
#: and the part that repeats after n cycles only. A smaller part counts as a repeat. The largest scatter of period n is
#: n times smaller: scatter hides the fine bands of long periods.
PERIODIC_SCATTER, APERIODIC_SCATTER, PART = (0.003, 0.06), (0.02, 1.0), (0.003, 1.0)
#: Largest number of bands of an aperiodic motion, visited in turn.
MOST_BANDS = 4
#: A period is decided only where a smaller part of another one than this would be visible.
LARGEST_VISIBLE = 0.02
#: Correlations of the scatter of successive cycles.
CORRELATIONS = np.linspace(-0.6, 0.6, 5)
_HIGHEST_DEGREE = 16  # of the polynomial over a cycle; a high degree on few samples amplifies their noise
_STANDARD_ERRORS = 3.0  # of the power of the scatter at one frequency; a larger part is visible
_GRID = 25  # standard deviations per range
_DIFFERENCE_ORDER = 6  # of the differences for the noise level; the motion vanishes in them
_CYCLES_PER_DRIFT_TERM = 4  # of the polynomial drift, at most quadratic
_MOST_DRIFT_TERMS = 3
_FOLDED_PERIODS = 2  # excitation periods, of the longest wave that is folded
_DENSE = 4  # points of a folded wave per sample
_FEWEST_FREE_CYCLES = 3  # beyond drift and period


@dataclass(frozen=True)
class Repeat:
    """The period with its probability, or the reason why the record is inconclusive.

    period : in excitation periods; 0 if the motion is aperiodic; None if no probability reaches 0.9
    probabilities : (17,) of an aperiodic motion and of the periods 1 to 16; longer ones than half the record take the rest
    periods : length of the record in excitation periods
    scatter : rms difference of a cycle from the periodic motion beyond the noise, drift removed, m
    motion : rms of x_rel about its mean without the noise, m
    noise_sd : of x_rel, m
    reason : why the record is inconclusive, or ""
    """

    period: int | None
    probabilities: np.ndarray
    periods: float
    scatter: float
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
        return Repeat(None, np.zeros(LONGEST_PERIOD + 1), periods, float("nan"), motion, noise_sd, reason)
    cycles, gain = _polynomials(time - time[0], x_rel / motion, T)
    evidence = _Evidence(cycles, gain * (noise_sd / motion) ** 2)
    probabilities = evidence.probabilities()
    best = int(np.argmax(probabilities))
    if probabilities[best] < DECIDED:
        order = np.argsort(-probabilities)[:2]
        words = ", ".join(f"{period_word(int(i))} {probabilities[i]:.2f}" for i in order)
        reason = f"period: probabilities {words}; record more than {periods:.0f} periods of the drive"
    elif best and evidence.visible(best) > LARGEST_VISIBLE:
        visible = f"{evidence.visible(best):.1%} of the motion"
        reason = f"noise and scatter: a part of another period is visible from {visible}; record more periods"
    elif 2 * best > periods:
        reason = f"repeats after {best} periods of the drive, but holds only {periods:.1f}"
    period = None if reason else best
    return Repeat(period, probabilities, periods, motion * evidence.scatter(max(best, 1)), motion, noise_sd, reason)


def period_word(period: int) -> str:
    """The label of a period alone."""
    return f"P-{period}" if period else "aperiodic"


def _polynomials(time: Record, x: Record, T: float) -> tuple[Float[np.ndarray, "c k"], float]:
    """Legendre coefficients of every whole excitation period, (c, k), and the sum of their variances for unit noise.

    The sum of their squares is the mean square of x over the cycle. Where the samples lie in a cycle changes from cycle
    to cycle and repeats after a few of them. A contact of few samples then seems to repeat as slowly. Waves of a short
    period are therefore folded, and their coefficients are taken from the dense folded wave.
    """
    step = time[-1] / (len(time) - 1)
    whole = int((time[-1] + step) / T * (1.0 + 1e-9))
    bounds = np.searchsorted(time, T * np.arange(whole + 1) - 0.5e-9 * T)
    degree = min(_HIGHEST_DEGREE, int(1.5 * np.sqrt(T / step)))
    dense = (np.arange(int(_DENSE * T / step)) + 0.5) / int(_DENSE * T / step)
    rows = np.zeros((whole, degree + 1))
    for n in range(1, min(_FOLDED_PERIODS, whole // 2) + 1):
        places = T * (np.arange(n)[:, None] + dense).ravel()
        wave, at_samples = (_fold(time % (n * T), x, n * T, at, step) for at in (places, time % (n * T)))
        rows += (wave.reshape(n, -1) @ np.linalg.pinv(_legendre(dense, degree)).T)[np.arange(whole) % n]
        x = x - at_samples
    variance = 0.0
    for c, (low, high) in enumerate(pairwise(bounds.tolist())):
        inverse = np.linalg.pinv(_legendre(time[low:high] / T - c, degree))
        rows[c] += inverse @ x[low:high]
        variance += float(np.sum(inverse**2)) / whole
    return rows, variance


def _legendre(place: np.ndarray, degree: int) -> np.ndarray:
    """Orthonormal Legendre polynomials on [0, 1], (n, degree + 1)."""
    return np.polynomial.legendre.legvander(2.0 * place - 1.0, degree) * np.sqrt(2.0 * np.arange(degree + 1) + 1.0)


def _fold(phase: np.ndarray, values: np.ndarray, period: float, places: np.ndarray, half: float) -> np.ndarray:
    """Local straight lines through a folded record at ``places``, from running sums: quick for long records."""
    sort = np.argsort(phase)
    axis = (phase[sort] + period * np.array([-1.0, 0.0, 1.0])[:, None]).ravel()
    y = np.tile(values[sort], 3)
    low, high = np.searchsorted(axis, places - half), np.searchsorted(axis, places + half)
    sums = [np.concatenate([[0.0], np.cumsum(term)]) for term in (np.ones_like(y), axis, axis**2, y, axis * y)]
    count, u, uu, v, uv = (one[high] - one[low] for one in sums)
    count = np.maximum(count, 1.0)
    u, v = u / count, v / count
    spread = uu / count - u**2
    slope = np.where(spread > 1e-3 * half**2, (uv / count - u * v) / np.maximum(spread, 1e-12 * half**2), 0.0)
    return v + slope * (places - u)


@dataclass(frozen=True)
class _Level:
    """Frequencies j/m of one m: power of the cycles there, number of dimensions, gain of the AR(1) filter."""

    power: float
    dimensions: int
    gain: float


class _Evidence:
    """Likelihoods of the periods given cycles (c, k) and the variance of their noise, relative to the motion."""

    def __init__(self, cycles: Float[np.ndarray, "c k"], noise: float) -> None:
        self._cycles, self._noise = cycles, noise
        self._levels = lru_cache(maxsize=None)(self._project)
        self._longest = min(LONGEST_PERIOD, max(len(cycles) - self._drift_terms - _FEWEST_FREE_CYCLES, 1))
        residuals, freedom = self._levels(1, 0.0)[1], len(cycles) - self._drift_terms
        covariance = residuals.T @ residuals / freedom
        total, square = float(np.trace(covariance)), float(np.sum(covariance**2))
        # The sample covariance of few cycles is too uneven: correct its square.
        square = max(square - total**2 / freedom, total**2 / cycles.shape[1])
        self._independent = float(np.clip(total**2 / square, 1.0, cycles.shape[1])) if total > 0.0 else 1.0

    def visible(self, n: int) -> float:
        """Smallest part of another period that stands out of the noise and the scatter of period n, rms."""
        variance = self._noise + self.scatter(n) ** 2
        return float(np.sqrt(variance * _STANDARD_ERRORS * np.sqrt(2.0 / self._independent) / len(self._cycles)))

    def scatter(self, n: int) -> float:
        """rms difference of a cycle from the motion of period n beyond the noise, drift removed."""
        rest = float(np.sum(self._levels(n, 0.0)[1] ** 2)) / (len(self._cycles) - self._drift_terms - n + 1)
        return float(np.sqrt(max(rest - self._noise, 0.0)))

    @property
    def _drift_terms(self) -> int:
        return int(np.clip(len(self._cycles) // _CYCLES_PER_DRIFT_TERM, 1, _MOST_DRIFT_TERMS))

    def probabilities(self) -> Float[np.ndarray, " n"]:
        """(17,) posterior probabilities of an aperiodic motion and of the periods 1 to 16."""
        n = np.arange(1, LONGEST_PERIOD + 1)
        prior = (1.0 - APERIODIC_PRIOR) * n**PERIOD_EXPONENT / np.sum(n**PERIOD_EXPONENT)
        low, high = PERIODIC_SCATTER
        periodic = np.array([self._log_evidence(int(k), (low, high / k)) for k in n[: self._longest]])
        bands = min(self._longest, MOST_BANDS)
        scattered = np.array([self._log_evidence(int(k), APERIODIC_SCATTER) for k in n[:bands]])
        parts = [logsumexp(scattered) + np.log(APERIODIC_PRIOR / bands), *(periodic + np.log(prior[: self._longest]))]
        if self._longest < LONGEST_PERIOD:  # a longer period looks like scatter of any size
            parts.append(self._log_evidence(1, PART) + np.log(np.sum(prior[self._longest :])))
        posterior = np.exp(np.array(parts) - logsumexp(parts))
        found = np.zeros(LONGEST_PERIOD + 1)
        found[: self._longest + 1] = posterior[: self._longest + 1]
        return found

    def _log_evidence(self, n: int, scatter: tuple[float, float]) -> float:
        """Log-likelihood of period n, scatter log-uniform in the range, integrated over all that is unknown."""
        q = np.geomspace(*scatter, _GRID)
        parts = []
        for correlation in CORRELATIONS.tolist():
            levels, rest = self._levels(n, correlation)
            variance = (1.0 + correlation**2) * self._noise + (1.0 - correlation**2) * q**2
            power = float(np.sum(rest**2)) + sum(level.power for level in levels.values())
            dimensions = len(self._cycles) - 1 - self._drift_terms
            value = -0.5 * self._independent * (dimensions * np.log(variance) + power / variance)
            for m, level in levels.items():
                ratio = self._log_ratio(level, variance)
                value = value + (ratio if m == n else np.logaddexp(0.0, ratio) - np.log(2.0))
            parts.append(logsumexp(value) - np.log(_GRID))
        return float(logsumexp(parts) - np.log(len(CORRELATIONS)))

    def _log_ratio(self, level: _Level, variance: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
        """Log of the likelihood of a level over that of scatter alone, for each variance of the scatter."""
        part = np.geomspace(*PART, _GRID)[:, None]
        more = variance + level.gain * len(self._cycles) * part**2 / level.dimensions
        terms = level.dimensions * np.log(more / variance) + level.power * (1.0 / more - 1.0 / variance)
        return logsumexp(-0.5 * self._independent * terms, axis=0) - np.log(_GRID)

    def _project(self, n: int, correlation: float) -> tuple[dict[int, _Level], Float[np.ndarray, "c k"]]:
        """Levels of the divisors of n, by m, and what they and the drift leave of the filtered cycles."""
        y = self._cycles[1:] - correlation * self._cycles[:-1] if correlation else self._cycles
        c = np.arange(len(y))
        design = [np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(y)), self._drift_terms - 1)]
        members: dict[int, tuple[int, float]] = {}
        for m in (m for m in range(2, n + 1) if n % m == 0):
            angles = [2.0 * np.pi * j / m for j in range(1, m // 2 + 1) if gcd(j, m) == 1]
            waves = [wave(a * c) for a in angles for wave in ((np.cos, np.sin) if a < 3.14 else (np.cos,))]
            gain = float(np.mean([1.0 - 2.0 * correlation * np.cos(a) + correlation**2 for a in angles]))
            design.append(np.stack(waves, axis=1))
            members[m] = (len(waves), gain)
        basis = np.linalg.qr(np.concatenate(design, axis=1))[0]
        power = np.sum((basis.T @ y) ** 2, axis=1)
        levels, first = {}, self._drift_terms
        for m, (number, gain) in members.items():
            levels[m] = _Level(float(np.sum(power[first : first + number])), number, gain)
            first += number
        return levels, y - basis @ (basis.T @ y)
