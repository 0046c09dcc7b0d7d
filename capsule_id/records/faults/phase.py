"""Finds samples lost without a gap in the time column: jumps of an evenly sampled smooth oscillation."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from scipy import ndimage, signal

from capsule_id.records.faults.duplicates import reading_step
from capsule_id.records.noise import noise_level

#: Order of the polynomials on both sides of a sample; their length, periods, with the smallest jump, rad, that they show
#: beyond their own error. Long ones see through noise, short ones show small jumps of quiet records. A jump above LARGE
#: may be one of the slope alone.
ORDER, SIDES, LARGE = 3, ((0.25, 0.3), (0.125, 0.06)), 0.2
#: Smallest jump: standard deviations of the noise, and sampling steps.
JUMP_SDS, JUMP_STEPS = 6.0, 0.7
#: Median of the deviation under white noise: that of a Rayleigh variable.
MEDIAN = np.sqrt(2.0 * np.log(2.0))
#: The oscillation must be at least this many times the noise.
AMPLITUDE_NOISE = 4.0
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
    noisy: list[Jump] = []
    for share, smallest in SIDES:
        side = round(share * period)
        jump = _jump(values, period, side, smallest, noise, alone)
        if jump is not None and not jump.noisy:
            return jump
        noisy += [] if jump is None else [jump]
    return max(noisy, key=lambda jump: jump.size, default=None)


def _jump(values: np.ndarray, period: float, side: int, smallest: float, noise: float, alone: bool) -> Jump | None:
    """The most significant jump by polynomials over ``side`` samples."""
    if side < ORDER + 3 or len(values) < 2 * side:
        return None
    # Value and slope half a sample beyond the end of ``side`` samples, as weights of the samples.
    design = polynomial.polyvander(np.arange(side) + 0.5, ORDER)
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
    large = (deviation > JUMP_SDS) & (phase > max(smallest, JUMP_STEPS * step)) & (amplitude > AMPLITUDE_NOISE * noise)
    if alone:
        later = np.minimum(np.arange(len(deviation)) + round(GOES_ON * period), len(deviation) - 1)
        large &= amplitude[later] > AMPLITUDE_NOISE * noise
    noisy = None
    while large.any():
        worst = int(np.argmax(np.where(large, deviation, 0.0)))
        # The record may be noisier here than elsewhere.
        if deviation[worst] * noise <= JUMP_SDS * _local_noise(values[worst : worst + 2 * side]):
            noisy = noisy or Jump(worst + side, float(phase[worst]), noisy=True)
            large[max(0, worst - side) : worst + side] = False
            continue
        if not alone or not _recurs(jumps, precision, worst, period):
            return Jump(worst + side, float(phase[worst]))
        large[max(0, worst - side) : worst + side] = False
    return noisy


def _local_noise(values: np.ndarray) -> float:
    """Noise level of a few samples with a jump in their middle: the smaller one of two estimates.

    One wrong sample does not change the median of the differences. The residuals of the polynomials on both sides vary
    less by chance, and the jump does not enter them.
    """
    sides = values.reshape(2, -1).T
    place = np.arange(len(sides)) - 0.5 * (len(sides) - 1)
    squares = polynomial.polyfit(place, sides, ORDER, full=True)[1][0]
    residual = float(np.sqrt(np.sum(squares) / (2 * (len(sides) - ORDER - 1))))
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
