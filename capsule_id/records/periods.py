"""Periods of a recorded motion: folded onto one period, and the probability of each number of excitation periods."""

from dataclasses import dataclass
from math import gcd
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp, softmax

from capsule_id.parameters import LONGEST_PERIOD
from capsule_id.records.tones import FEWEST_IN_PERIOD, VISIBLE, noise_level
from capsule_id.rig.filters import Record

# fold: Folds a periodic record onto one period; the samples of each period lie between those of the others.
#
# The sampling step rarely divides the period. Ten periods at 1 kHz then give one period at 10 kHz.


def local_polynomials(
    phase: Record,
    values: Record,
    period: float,
    places: Float[np.ndarray, " m"],
    half_width: float,
    order: int,
) -> tuple[Float[np.ndarray, "q m"], Float[np.ndarray, "q m"]]:
    """Least-squares polynomials over windows of a folded record, the folded Savitzky–Golay filter.

    Returns their coefficients at the places, value and rate per second first, and the sds of these for unit noise.

    Parameters
    ----------
    phase : (n,) s, in [0, period)
    values : (n,)
    period : s
    places : (m,) s, where the polynomials are evaluated
    half_width : of the window, s; the window is half open and holds at least ``order`` + 1 different phases
    order : of the polynomial, q - 1; with 0 the value is a mean
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
    unit = half_width ** np.arange(order + 1)[:, None]
    return unknowns.T / unit, np.sqrt(np.einsum("mpp->pm", inverse)) / unit


def intervals_above(z: Record, low: float, high: float) -> list[tuple[int, int]]:
    """Stretches of a cyclic sequence (n,) that begin above ``high`` and last until it has fallen below ``low``.

    Returns (first, length) of each, indices modulo n; a sequence that never falls below ``low`` is one stretch if it
    rises above ``high`` at all. The two levels keep noise about one level from splitting or joining stretches.
    """
    state = np.where(z > high, 1, np.where(z < low, 0, -1))
    if not (state == 0).any():
        return [(0, len(z))] * bool((state == 1).any())
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


#: Shortest record, in excitation periods.
FEWEST_PERIODS = 4
#: Shortest record of an aperiodic motion, in excitation periods: it holds every period and two more.
FEWEST_APERIODIC = LONGEST_PERIOD + 2
#: A period is decided where its probability reaches this.
DECIDED = 0.9
#: Prior probability of an aperiodic motion. That of the period n falls as n to this power.
APERIODIC_PRIOR, PERIOD_EXPONENT = 0.07, -3.0
#: Ranges of standard deviations with log-uniform priors: the part that repeats after n cycles only, and the cycle-to-cycle
#: scatter of period 1 and of an aperiodic motion. A smaller part counts as a repeat, so smaller scatter is no matter. The
#: largest scatter of period n is n times smaller: scatter hides the fine bands of long periods.
PART, APERIODIC_SCATTER = (0.003, 1.0), (0.02, 1.0)
PERIODIC_SCATTER = (PART[0], 0.06)
#: Largest scatter of most periodic records; above it the prior falls with this power.
COMMON_SCATTER, SCATTER_EXPONENT = 0.015, 3.0
#: Largest number of bands of an aperiodic motion, visited in turn.
MOST_BANDS = 4
#: A period is decided only where noise and scatter hide no larger part of another one than this: it could be the scatter of
#: an aperiodic motion.
LARGEST_HIDDEN = APERIODIC_SCATTER[0]
#: Correlations of the scatter of successive cycles.
CORRELATIONS = 0.6 * np.linspace(-1.0, 1.0, 5)
_HIGHEST_DEGREE = 16  # of the polynomial over a cycle; a high degree on few samples amplifies their noise
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
    reason = first_true(
        (
            periods < FEWEST_PERIODS,
            f"the record holds {periods:.1f} periods of the drive, {FEWEST_PERIODS} are needed",
        ),
        (
            T / step < FEWEST_IN_PERIOD,
            f"the record holds {T / step:.1f} samples per period of the drive, {FEWEST_IN_PERIOD} are needed",
        ),
        (
            motion <= noise_sd,
            f"noise: its standard deviation is {1e6 * noise_sd:.3g} um, the motion {1e6 * motion:.3g} um",
        ),
    )
    if reason:
        none = np.zeros(LONGEST_PERIOD + 1)
        return Repeat(None, none, periods, float("nan"), float("nan"), motion, noise_sd, reason)
    cycles, gain = _polynomials(time - time[0], x_rel / motion, T)
    evidence = _Evidence(cycles, gain * (noise_sd / motion) ** 2)
    probabilities = evidence.probabilities()
    best = int(np.argmax(probabilities))
    hidden = evidence.hidden(max(best, 1))
    likeliest = np.argsort(-probabilities)[:2].tolist()
    words = ", ".join(f"{period_word(i)} {probabilities[i]:.2f}" for i in likeliest)
    reason = first_true(
        (
            probabilities[best] < DECIDED,
            f"period: probabilities {words}; record more than {periods:.0f} periods of the drive",
        ),
        (
            best > 0 and hidden > LARGEST_HIDDEN,
            f"noise and scatter: they hide a part of another period below {hidden:.1%} of the motion; record more periods",
        ),
        (2 * best > periods, f"repeats after {best} periods of the drive, but holds only {periods:.1f}"),
        (
            best == 0 and periods < FEWEST_APERIODIC,
            f"no repeat; the record of {periods:.1f} periods is too short for longer ones, {FEWEST_APERIODIC} periods of the "
            "drive are needed",
        ),
    )
    scatter = motion * evidence.scatter(max(best, 1))
    return Repeat(None if reason else best, probabilities, periods, scatter, motion * hidden, motion, noise_sd, reason)


def first_true(*rows: tuple[Any, str]) -> str:
    """The words of the first of ``rows`` that holds; "" where none does."""
    return next((words for holds, words in rows if holds), "")


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


#: Frequencies j/m of one m: power of the filtered cycles there and filter gain for each of the correlations, (r,), and the
#: number of waves.
Level = tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"], int]


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
        return float(np.sqrt(variance * VISIBLE * np.sqrt(2.0 / self._independent) / len(self._cycles)))

    def scatter(self, n: int) -> float:
        """rms difference of a cycle from the motion of period n beyond the noise, drift removed."""
        rest = float(np.sum(self._residuals(n) ** 2)) / (len(self._cycles) - self._drift_terms - n + 1)
        return float(np.sqrt(max(rest - self._noise, 0.0)))

    def probabilities(self) -> Record:
        """(17,) posterior probabilities of an aperiodic motion and of the periods 1 to 16."""
        n = np.arange(1, LONGEST_PERIOD + 1)
        prior = (1.0 - APERIODIC_PRIOR) * n**PERIOD_EXPONENT / np.sum(n**PERIOD_EXPONENT)
        levels = [self._levels(int(k)) for k in n[: self._longest]]
        periodic = np.array([self._log_evidence(one, *_periodic_scatter(k)) for k, one in enumerate(levels, start=1)])
        bands, wide = levels[:MOST_BANDS], np.geomspace(*APERIODIC_SCATTER, _GRID)
        scattered = np.array([self._log_evidence(one, wide) for one in bands])
        aperiodic = logsumexp(scattered) + np.log(APERIODIC_PRIOR / len(bands))
        parts = [aperiodic, *(periodic + np.log(prior[: self._longest]))]
        if self._longest < LONGEST_PERIOD:  # a longer period looks like scatter of any size
            parts.append(
                self._log_evidence(levels[0], np.geomspace(*PART, _GRID)) + np.log(np.sum(prior[self._longest :]))
            )
        return np.pad(softmax(parts)[: self._longest + 1], (0, LONGEST_PERIOD - self._longest))

    def _log_evidence(
        self, levels: list[Level], q: Float[np.ndarray, " q"], weight: Float[np.ndarray, " q"] | float = 1.0 / _GRID
    ) -> float:
        """Log-likelihood of a period with these levels, integrated over scatters q of prior ``weight`` and the rest.

        The first level is what the drift and the others leave; the last one must be present.
        """
        r = CORRELATIONS[:, None]
        variance = (1.0 + r**2) * self._noise + (1.0 - r**2) * q**2
        power = np.sum([own for own, *_ in levels], axis=0)[:, None]
        dimensions = sum(number for *_, number in levels)
        value = -0.5 * self._independent * (dimensions * np.log(variance) + power / variance)
        part = np.geomspace(*PART, _GRID)[:, None, None]
        for own, gain, number in levels[1:]:
            # The likelihood of the level over that of scatter alone, for each variance of the scatter.
            more = variance + gain[:, None] * len(self._cycles) * part**2 / number
            terms = number * np.log(more / variance) + own[:, None] * (1.0 / more - 1.0 / variance)
            ratio = logsumexp(-0.5 * self._independent * terms, axis=0) - np.log(_GRID)
            value = value + (ratio if own is levels[-1][0] else np.logaddexp(0.0, ratio) - np.log(2.0))
        return float(logsumexp(value + np.log(weight)) - np.log(len(r)))

    def _levels(self, n: int) -> list[Level]:
        """What the drift and period n leave of the filtered cycles, then the levels of the divisors of n, n last."""
        last, before = self._cycles[1:], self._cycles[:-1]
        basis, divisors = self._basis(len(last), n)
        r = CORRELATIONS[:, None]
        one, other = (basis.T @ y for y in (last, before))
        power = np.sum((one - r[:, :, None] * other) ** 2, axis=2)
        total = np.array([np.sum((last - x * before) ** 2) for x in CORRELATIONS.tolist()])
        levels, first = [], self._drift_terms
        rest = total - np.sum(power, axis=1), np.ones_like(CORRELATIONS), len(last) - basis.shape[1]
        for m, angles in divisors.items():
            number = sum(1 if 2 * j == m else 2 for j in angles)
            cosine = np.cos(2.0 * np.pi * np.array(angles) / m)
            gain = np.mean(1.0 - 2.0 * r * cosine + r**2, axis=1)
            levels.append((np.sum(power[:, first : first + number], axis=1), gain, number))
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
