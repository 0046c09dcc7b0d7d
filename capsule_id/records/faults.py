"""Finds faults of a record: aliasing, bursts, mislabelled channels, clipping, copies, lost samples, bad times."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial import polynomial
from scipy import ndimage, signal
from scipy.optimize import least_squares

from capsule_id.parameters import ROUNDING
from capsule_id.records.duplicates import EPSILON, reading_step
from capsule_id.records.tones import AS_GOOD, BEYOND_CHANCE, ORDER, SIGNIFICANT, noise_level
from capsule_id.rig.filters import FEWEST_SAMPLES, TIMING_TOLERANCE, largest_offset, median_step, thinned
from capsule_id.rig.schema import SHORTEST_RECORD

# aliasing: Finds frequencies that a sampled oscillation cannot tell from each other.
#
# Even sampling at f_s maps f and |f ± n f_s| to the same readings (Nyquist-Shannon). Uneven sampling tells them apart.


#: Fewest and most multiples of the sampling rate that are tried; damping rates that are tried, per sampled period.
MULTIPLES, MOST_MULTIPLES, RATES = 5, 200, np.geomspace(1e-3, 1.0, 13)
#: Steps of the time that differ less than this from the median, relative, are usual ones.
USUAL_STEP = 0.2
#: Most decimal places, and most significant digits, of rounded times. Samples that are looked at: they show as much as a
#: longer record does.
MOST_DIGITS, SAMPLES = 9, 4096
#: Step of a frequency, periods over the record, and steps about an alias; number of the aliases that are refined.
PHASE, NEAR, REFINED = 0.05, range(-5, 6), 3


def aliases(time: np.ndarray, values: np.ndarray, frequency: float, highest: float = 0.0) -> np.ndarray:
    """Return (k,) other frequencies, Hz, that fit a free decay as well as ``frequency`` does; of uneven times, best first.

    Parameters
    ----------
    time : (n,) s, increasing
    values : (n,) free decay
    frequency : found, Hz
    highest : frequency, Hz, up to which more than ``MULTIPLES`` are tried
    """
    time, values = time[:SAMPLES], values[:SAMPLES]
    (rate, even), elapsed = sampling(time), time - time[0]
    number = np.clip(int((highest + frequency) / rate) + 2, MULTIPLES, MOST_MULTIPLES)
    multiples = np.delete(np.arange(-number, number + 1), number) * rate
    if even:
        return np.unique(np.abs(multiples + frequency))

    def rest(f: float, damping: float) -> np.ndarray:
        """(n,) residuals beside a tone of this frequency, Hz, with this damping rate, 1/s."""
        angle, decay = 2.0 * np.pi * f * elapsed, np.exp(-damping * elapsed)
        design = np.stack([decay * np.cos(angle), decay * np.sin(angle), np.ones_like(angle)], axis=1)
        return values - design @ np.linalg.lstsq(design, values)[0]

    def misfit(f: float, damping: float) -> float:
        return float(np.sum(rest(f, damping) ** 2))

    def best(f: float, damping: float) -> tuple[float, float, float]:
        """Least misfit about a frequency and a damping rate, and both there."""
        found = least_squares(lambda x: rest(f + x[0] * step, damping * np.exp(x[1])) / size, np.zeros(2)).x
        f, damping = f + float(found[0]) * step, damping * float(np.exp(found[1]))
        return misfit(f, damping), f, damping

    # The best of the steps leaves a misfit that hides what another frequency does not explain.
    step, size = PHASE / elapsed[-1], float(np.std(values)) or 1.0
    least, frequency, damping = best(frequency, min(RATES * frequency, key=lambda rate: misfit(frequency, rate)))
    candidates = np.unique(np.abs(multiples + frequency))
    # The jitter of the times leaves an error of the sampling rate.
    others = np.array([min(misfit(other + k * step, damping) for k in NEAR) for other in candidates])
    candidates, others = candidates[order := np.argsort(others)], others[order]
    others[:REFINED] = [best(other, damping)[0] for other in candidates[:REFINED]]
    return candidates[others <= AS_GOOD * least + ROUNDING * float(np.sum(values**2))]


def sampling(time: np.ndarray) -> tuple[float, bool]:
    """Sampling rate of times (n,), Hz, and whether they are even but for their rounding; samples may be missing."""
    time = time[:SAMPLES]
    unit, steps = _rounding(time), np.diff(time)
    step, line, off = np.median(steps), np.zeros(2), time
    for index in (np.arange(len(time)), np.concatenate([[0.0], np.cumsum(np.round(steps / step))])):
        line = np.polyfit(index, time, 1, w=1.0 / unit)
        off = np.abs(np.polyval(line, index) - time)
        if np.all(off <= unit):
            return 1.0 / float(line[0]), True
    usual = np.mean(steps[np.abs(steps / step - 1.0) < USUAL_STEP])
    return 1.0 / float(line[0] if np.max(off) < 0.5 * step else usual), False


def _rounding(time: np.ndarray) -> np.ndarray:
    """(n,) unit of the last decimal place, or of the last significant digit, of each time, s; at least 1e-9 of the record."""
    magnitude = 10.0 ** np.floor(np.log10(np.maximum(np.abs(time), np.finfo(float).tiny)))
    unit = np.full(len(time), max(1e-9 * np.ptp(time), np.spacing(np.max(np.abs(time)))))
    for first in (np.ones(len(time)), magnitude):
        units = (first * 10.0**-k for k in range(MOST_DIGITS))
        rounded = (one for one in units if np.all(np.abs(np.round(time / one) * one - time) <= 1e-6 * one + unit))
        unit = np.maximum(unit, next(rounded, 0.0))
    return unit


# bursts: Finds stretches of a record with far more noise than the rest, as where a hand still moves the rig.


#: Windows in a period, and fewest samples of one.
WINDOWS, SHORTEST = 8, 8
#: Noise of a burst, relative to that of the middle window, and fewest windows that it fills.
LOUD, FEWEST_WINDOWS = 3.0, 3
#: Quiet windows within a burst.
GAP = 1


def noisy_stretch(values: np.ndarray, period: float, row: int) -> slice | None:
    """Return the rows of the burst of noise around ``row``; None where there is none.

    Parameters
    ----------
    values : (n,) evenly sampled oscillation
    period : samples
    """
    width = max(SHORTEST, round(period / WINDOWS))
    number = len(values) // width
    if number <= 2 * FEWEST_WINDOWS:
        return None
    differences = np.diff(values, ORDER, prepend=values[:1], append=values[-1:].repeat(ORDER - 1))
    squares = (differences[: number * width] ** 2).reshape(number, width)
    noise = np.sqrt(np.mean(squares, axis=1) / math.comb(2 * ORDER, ORDER))
    loud = np.flatnonzero(noise > LOUD * np.median(noise))
    for chain in np.split(loud, np.flatnonzero(np.diff(loud) > GAP + 1) + 1):
        if len(chain) >= FEWEST_WINDOWS and chain[0] - GAP <= row // width <= chain[-1] + GAP:
            return slice(int(chain[0]) * width, min((int(chain[-1]) + 1) * width, len(values)))
    return None


# channels: Finds mislabelled columns by what holds for any motion: kinematics, and the sign of the power of the drive.


#: Shortest record for these checks, in periods of the drive.
FEWEST_PERIODS = 3.0
#: Standard errors beyond which a sign counts as wrong.
SIGN_ERRORS = BEYOND_CHANCE
#: Admissible ratio of a recorded derivative to that of a recorded position.
OF_DERIVATIVE = 0.5, 2.0


@dataclass(frozen=True)
class Phasor:
    """Complex amplitude at one frequency, in the unit of the channel, and its standard error."""

    value: complex
    sd: float


def phasor(time: np.ndarray, values: np.ndarray, Omega: float, harmonics: Sequence[int] = (1,)) -> Phasor:
    """Amplitude of the first of the ``harmonics`` of ``Omega``, rad/s, over whole periods of that at the end of a record.

    It stands beside a linear trend and the other harmonics, which the trend would mix with it.

    Parameters
    ----------
    time, values : (n,) s, and any unit
    """
    period = 2.0 * np.pi / Omega
    whole = np.floor((time[-1] - time[0]) / period) * period
    last = time >= time[-1] - whole
    t, x = time[last], values[last]
    tones = [wave(k * Omega * t) for k in dict.fromkeys(harmonics) for wave in (np.cos, np.sin)]
    design = np.stack([*tones, np.ones_like(t), t - t[0]], axis=1)
    cosine, sine, *_ = np.linalg.lstsq(design, x)[0]
    noise = noise_level(x, 6) if len(x) >= FEWEST_SAMPLES else float(np.std(x))
    return Phasor(complex(cosine, -sine), noise * float(np.sqrt(2.0 / len(x))))


def derivative_ratio(position: Phasor, derivative: Phasor, Omega: float, order: int) -> complex:
    """Ratio of a recorded derivative to that of the recorded position; 1 where both show one motion."""
    return derivative.value / ((1j * Omega) ** order * position.value)


def drive_power(force: Phasor, position: Phasor, Omega: float) -> tuple[float, float]:
    """Mean power of ``force`` on the moving ``position`` and its standard error, in the product of their units per s.

    A drive supplies the energy that damping and friction take, so the power is positive.
    """
    power = 0.5 * float(np.real(force.value * np.conj(1j * Omega * position.value)))
    error = 0.5 * Omega * float(np.hypot(abs(force.value) * position.sd, abs(position.value) * force.sd))
    return power, error


# clipping: Finds clipped records: flat tops, samples that share exactly the largest or smallest value.


#: Fewest samples at the limit; how many times as many as at the neighbouring values.
FEWEST_CLIPPED, EXCESS = 3, 5.0
#: Number of neighbouring values. The peak of a sine that is read in steps has 3.4 times their mean number.
NEIGHBOURS = 5
#: A clipped run is so many times longer than the runs of equal readings usually are.
LONGER = 1.5
#: Readings of at least this part of a limit have its step, where there are so many.
LARGE_JUMP, FEWEST_LARGE = 0.3, 20
#: A record that begins or ends at its limit for longer than this fraction of a period is not clipped there.
LONGEST_HOLD = 0.2


@dataclass(frozen=True)
class Clipped:
    """``rows`` (k,) of the samples at ``level``, in the unit of the record; ``side`` of the limit."""

    side: Literal["upper", "lower"]
    level: float
    rows: np.ndarray


def clipped_samples(values: np.ndarray, period: float) -> list[Clipped]:
    """Return the clipped samples of a record at its upper and lower limit.

    Parameters
    ----------
    values : (n,) readings in the unit of the file
    period : of the oscillation, samples; infinite where it is unknown
    """
    found = list[Clipped]()
    # Lengths of the runs of equal readings; NaN ends the first and the last one.
    held = float(np.median(np.diff(np.flatnonzero(np.diff(values, prepend=np.nan, append=np.nan)))))
    few, limits = thinned(values), (float(np.max(values)), float(np.min(values)))
    sides: tuple[tuple[Literal["upper", "lower"], float], ...] = (("upper", 1.0), ("lower", -1.0))
    for (side, sign), limit in zip(sides, limits, strict=True) if limits[0] > limits[1] else ():
        # Readings with so many significant digits have finer steps near zero than at a limit.
        large = few[few / limit >= LARGE_JUMP] if limit else few
        step = reading_step(large if len(large) >= FEWEST_LARGE else few)
        tolerance = max(0.25 * step, EPSILON * np.max(np.abs(limits)))
        depth = sign * (limit - values)
        rows = np.flatnonzero(depth <= tolerance)
        near = np.flatnonzero((depth > tolerance) & (depth <= (NEIGHBOURS + 0.25) * step))
        if len(rows) < FEWEST_CLIPPED + EXCESS * (len(near) + _one_sided(near, rows)) / NEIGHBOURS:
            continue  # a smooth peak has as many
        runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        # A hold before the release, or the rest of an overdamped decay.
        runs = [run for run in runs if len(run) <= LONGEST_HOLD * period or 0 < run[0] <= run[-1] < len(values) - 1]
        # Noise makes single samples equal to the limit by rounding; a clipped peak gives neighbours, more than a sensor
        # does that is read several times before it has a new value.
        runs = [run for run in runs if len(run) > LONGER * held]
        if sum(map(len, runs)) >= FEWEST_CLIPPED:
            found.append(Clipped(side, limit, np.concatenate(runs)))
    return found


def _one_sided(near: np.ndarray, rows: np.ndarray) -> int:
    """Surplus of samples ``near`` the limit on one side of the peaks with samples at it, ``rows``; indices.

    A clipped peak begins and ends abruptly. A peak that sticks, or begins the record, has one gradual side.
    """
    together = np.concatenate([near, rows])
    order = np.argsort(together, kind="stable")
    surplus = 0
    for peak in np.split(order, np.flatnonzero(np.diff(together[order]) > 1) + 1):
        at_limit = np.flatnonzero(peak >= len(near))
        surplus += len(peak) - 1 - at_limit[-1] - at_limit[0] if len(at_limit) else 0
    return abs(int(surplus))


# phase: Finds samples lost without a gap in the time column: jumps of an evenly sampled smooth oscillation.


#: Order of the polynomials on both sides of a sample; their length, periods, with the smallest jump, rad, that they show
#: beyond their own error. Long ones see through noise, short ones show small jumps of quiet records. A jump above LARGE
#: may be one of the slope alone.
PHASE_ORDER, SIDES, LARGE = 3, ((0.25, 0.3), (0.125, 0.06)), 0.2
#: Smallest jump, in sampling steps.
JUMP_STEPS = 0.7
#: Median of the deviation under white noise: that of a Rayleigh variable.
MEDIAN = np.sqrt(2.0 * np.log(2.0))
#: A jump recurs where half a period away, give or take this part of a period, one of opposite sign has this part of it.
SLACK, RECURRING = 0.1, 0.5
#: Periods after a jump for which the oscillation must go on, else dry friction may have ended it before a jump recurs.
GOES_ON = 1.5


@dataclass(frozen=True)
class Jump:
    """A jump before the sample ``row``; ``size`` relative to the amplitude there.

    ``noisy``: the noise around it is so large that it may be no jump.
    """

    row: int
    size: float
    noisy: bool = False


def jump_or_noise(values: np.ndarray, period: float, alone: bool = False) -> Jump | None:
    """Return the largest jump of a smooth oscillation, else the largest one that is ``noisy``; None without both.

    Polynomials through the samples before and after a place agree in value and slope where no sample is lost.

    Parameters
    ----------
    values : (n,) evenly sampled, free oscillation or forced tone
    period : samples
    alone : leave out jumps that recur every half period with opposite sign, as those of an acceleration by dry friction
    """
    # Errors of reading in steps are correlated in a slow record, so they do not average out.
    noise = max(noise_level(values), reading_step(values))
    found = (_jump(values, period, round(share * period), smallest, noise, alone) for share, smallest in SIDES)
    jumps = list[Jump]()
    for jump in filter(None, found):
        if not jump.noisy:
            return jump
        jumps.append(jump)
    return max(jumps, key=lambda jump: jump.size, default=None)


def _jump(values: np.ndarray, period: float, side: int, smallest: float, noise: float, alone: bool) -> Jump | None:
    """The most significant jump by polynomials over ``side`` samples."""
    if side < PHASE_ORDER + 3 or len(values) < 2 * side:
        return None
    # Value and slope half a sample beyond the end of ``side`` samples, as weights of the samples.
    design = polynomial.polyvander(np.arange(side) + 0.5, PHASE_ORDER)
    value, slope = np.linalg.pinv(design)[:2]
    # By FFT where the sides are long. A constant has no effect on the jumps, and would only add rounding.
    centred = values - np.mean(values)
    after = [signal.correlate(centred, weights, "valid")[side:] for weights in (value, slope)]
    before = [signal.correlate(centred, weights[::-1], "valid")[:-side] for weights in (value, -slope)]
    jumps = np.stack([one - other for one, other in zip(after, before, strict=True)])
    weights = np.stack([np.concatenate([value, -value[::-1]]), np.concatenate([slope, slope[::-1]])])
    precision = np.linalg.inv(weights @ weights.T * max(noise, 1e-300) ** 2)
    deviation = np.sqrt(np.einsum("in,ij,jn->n", jumps, precision, jumps))
    # Coloured noise deviates everywhere, not at one place.
    excess = max(1.0, float(np.median(deviation)) / MEDIAN)
    deviation, noise = deviation / excess, noise * excess
    width = round(period)
    high, low = (f(values, width, mode="nearest") for f in (ndimage.maximum_filter1d, ndimage.minimum_filter1d))
    amplitude = 0.5 * (high - low)[side : side + len(deviation)]
    step = 2.0 * np.pi / period
    # Kinks of real records, as of a sensor's scale, are small; a small jump must show in the value.
    size = np.hypot(jumps[0], jumps[1] / step) if smallest > LARGE else np.abs(jumps[0])
    phase = size / np.maximum(amplitude, 1e-300)
    swings = amplitude > SIGNIFICANT * noise
    large = (deviation > BEYOND_CHANCE) & (phase > max(smallest, JUMP_STEPS * step)) & swings
    if alone:
        large &= swings[np.minimum(np.arange(len(deviation)) + round(GOES_ON * period), len(deviation) - 1)]
    noisy = None
    while large.any():
        worst = int(np.argmax(np.where(large, deviation, 0.0)))
        # The record may be noisier here than elsewhere.
        hidden = deviation[worst] * noise <= BEYOND_CHANCE * _local_noise(values[worst : worst + 2 * side])
        found = Jump(worst + side, float(phase[worst]), bool(hidden))
        if not hidden and not (alone and _recurs(jumps, precision, worst, period)):
            return found
        noisy = noisy or (found if hidden else None)
        large[max(0, worst - side) : worst + side] = False
    return noisy


def _local_noise(values: np.ndarray) -> float:
    """Noise level of a few samples with a jump in their middle: the smaller one of two estimates.

    One wrong sample does not change the median of the differences. The residuals of the polynomials on both sides vary
    less by chance, and the jump does not enter them.
    """
    sides = values.reshape(2, -1).T
    place = np.arange(len(sides)) - 0.5 * (len(sides) - 1)
    squares = polynomial.polyfit(place, sides, PHASE_ORDER, full=True)[1][0]
    residual = float(np.sqrt(np.sum(squares) / (2 * (len(sides) - PHASE_ORDER - 1))))
    return min(noise_level(values), residual)


def _recurs(jumps: np.ndarray, precision: np.ndarray, place: int, period: float) -> bool:
    """Whether the jump at ``place`` recurs with opposite sign half a period before or after; True where neither is known.

    Parameters
    ----------
    jumps : (2, n) of value and slope
    precision : (2, 2) inverse covariance of a jump
    """
    one = jumps[:, place] @ precision
    part = -(one @ jumps) / (one @ jumps[:, place])
    near, far = round((0.5 - SLACK) * period), round((0.5 + SLACK) * period)
    before, after = part[max(0, place - far) : max(0, place - near + 1)], part[place + near : place + far + 1]
    beside = np.concatenate([before, after])
    return beside.size == 0 or bool(np.max(beside) >= RECURRING)


# timing: Finds gaps and rounded times in the time column, and drop-outs in a channel.


#: Share of steps that must equal the sampling step before a longer one counts as a gap.
REGULAR_SHARE = 0.9
#: Largest distance of a step from a multiple of the sampling step, in sampling steps.
STEP_TOLERANCE = 0.1
#: Smallest and largest step of rounded times, in sampling steps. Rounding moves a time by half of it: times that it moves less
#: than this from the even grid count as even.
TIME_STEPS = (2.0 * TIMING_TOLERANCE, 1.01)
#: A drop-out departs from both neighbours by this fraction of the range of the other samples.
DROPOUT_RANGE = 0.5
#: In coarse steps a smooth top is a short run too. A drop-out departs by more than this many reading steps, and than this
#: many times the change of the readings beside it.
DROPOUT_STEPS, DROPOUT_CHANGES = 3.0, 2.0
#: Noise levels that count as that range where the motion is a small part of the record, and their largest share of the
#: whole range: of coarse samples the noise level shows the motion.
DROPOUT_NOISE, LARGEST_SHARE = 20.0, 0.5
#: A single value this many ranges away is a drop-out by itself.
EXTREME = 50.0
#: Most samples of one drop-out; fewest equal values of a frozen sensor.
LONGEST_DROPOUT, FROZEN = 3, 6
#: Samples from which a drop-out is compared with the noise level.
FEWEST_OF_NOISE = 20


@dataclass(frozen=True)
class Gaps:
    """Gaps after the samples ``rows`` (k,); ``lost`` (k,) samples in each by the sampling step ``step``, s."""

    rows: np.ndarray
    lost: np.ndarray
    step: float


def find_gaps(time: np.ndarray) -> Gaps | None:
    """Return gaps of an otherwise even record: steps of two or more sampling steps; None where there are none.

    Parameters
    ----------
    time : (n,) s, increasing, n > 1
    """
    step = median_step(time)
    steps = np.diff(time) / step
    multiple = np.round(steps)
    rows = np.flatnonzero((multiple >= 2) & (np.abs(steps - multiple) <= STEP_TOLERANCE * np.sqrt(multiple)))
    regular = float(np.mean(np.abs(steps - 1.0) <= STEP_TOLERANCE))
    return Gaps(rows, multiple[rows].astype(int) - 1, step) if len(rows) and regular >= REGULAR_SHARE else None


def time_rounding(time: np.ndarray) -> float | None:
    """Return the step to which the times of an even record were rounded, s; None where it is harmless.

    Parameters
    ----------
    time : (n,) s, increasing
    """
    if len(time) < SHORTEST_RECORD:
        return None
    step, written = median_step(time), reading_step(time)
    off = largest_offset(time, (time[-1] - time[0]) / (len(time) - 1))
    rounded = TIME_STEPS[0] * step <= written <= TIME_STEPS[1] * step
    # Rounding moves a time by half the written step, and the ends of the even grid by as much again.
    return written if rounded and TIMING_TOLERANCE * step < off <= TIME_STEPS[1] * written else None


def _equal_runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First indices of the runs of equal values, and the indices behind their last ones, (k,) each."""
    edges = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1, [len(values)]])
    return edges[:-1], edges[1:]


def dropouts(values: np.ndarray) -> np.ndarray:
    """Return indices of drop-outs: short runs of one exact value, far away from the samples on both sides.

    Parameters
    ----------
    values : (n,) readings of one channel
    """
    # Nine in ten samples hold no drop-out, so their range is that of the motion, or of the noise of a long rest.
    low, high = np.quantile(thinned(values), [0.05, 0.95])
    noise = DROPOUT_NOISE * noise_level(values) if len(values) > FEWEST_OF_NOISE else 0.0
    spread = max(high - low, min(noise, LARGEST_SHARE * float(np.ptp(values))))
    starts, ends = _equal_runs(values)
    inside = (starts > 0) & (ends < len(values)) & (ends - starts <= LONGEST_DROPOUT)
    starts, ends = starts[inside], ends[inside]
    before, after, own = values[starts - 1], values[ends], values[starts]
    jump = np.minimum(np.abs(own - before), np.abs(own - after))
    earlier = np.abs(values[np.maximum(starts - 2, 0)] - before)
    later = np.abs(values[np.minimum(ends + 1, len(values) - 1)] - after)
    change = np.maximum(DROPOUT_CHANGES * np.minimum(earlier, later), DROPOUT_STEPS * reading_step(values))
    far = (
        (jump > DROPOUT_RANGE * spread)
        & (np.abs(after - before) < 0.5 * jump)
        & (jump > change)
        & (np.sign(own - before) == np.sign(own - after))
    )
    starts, ends, own = starts[far], ends[far], own[far]
    # An impact is a short peak too, but its height differs each time. A drop-out repeats one value.
    levels, counts = np.unique(own, return_counts=True)
    extreme = np.maximum(low - own, own - high) > EXTREME * spread
    chosen = np.isin(own, levels[counts > 1]) | extreme | (own == 0.0)
    return np.concatenate([np.arange(0), *map(np.arange, starts[chosen], ends[chosen])])


def frozen_samples(values: np.ndarray) -> np.ndarray:
    """Return indices of samples of a frozen channel: equal values in sequence where the record otherwise never repeats.

    Runs at the limits of the record belong to clipping and to rest, and are left out.
    """
    starts, ends = _equal_runs(values)
    inside = (values[starts] < np.max(values)) & (values[starts] > np.min(values)) & (starts > 0) & (ends < len(values))
    chosen = (ends - starts >= FROZEN) & inside
    # A channel read in coarse steps, or at rest, repeats its values anyway.
    others = np.sum((ends - starts - 1)[~chosen])
    if len(values) < FEWEST_SAMPLES or others > 0.01 * len(values):
        return np.arange(0)
    return np.concatenate([np.arange(0), *map(np.arange, starts[chosen], ends[chosen])])
