"""Savitzky–Golay smoothing and derivatives, the paper's preparation of its records.

Filtered records serve the paper's estimators, figures and starting points. Likelihoods use raw records. The filter
removes most of the white noise and correlates the rest. A likelihood of independent errors would then give a noise level
and intervals that are too small.

Sources: A. Savitzky, M. J. E. Golay, Anal. Chem. 36, 1627 (1964); gain: R. W. Schafer, IEEE Signal Process. Mag. 28(4),
111 (2011).
"""

from bisect import bisect_left

import numpy as np
from jaxtyping import Float, Int, Num
from numpy.polynomial import legendre

from capsule_id.errors import InputError
from capsule_id.views import counted

#: Samples of one channel, or their times.
Record = Num[np.ndarray, " n"]

TIMING_TOLERANCE = 0.01  # largest distance from an even grid, in sampling steps, of evenly spaced samples
SMALLEST_GAIN = 0.99  # smallest gain of `choose_window` at the dominant frequency
_HAMPEL_BLOCK = 2_000_000  # readings that are sorted at a time
#: Fewest samples that show the noise, the levels and the frozen parts of a record; fewer may be single readings.
FEWEST_SAMPLES = 50
PIECE = 1 << 18  # samples that are looked at together of a record with twice as many or more
#: Fewest periods in the loudest part of a record from which its frequency is read.
FEWEST_PERIODS = 8.0
#: Largest difference of the time at which a clock starts anew from the first one, relative to the longest record.
CLOCK_START = 0.02
_ZERO_PADDING = 8  # the frequency grid of the spectrum is 8 times finer than 1 / duration


def savitzky_golay(
    time: Record, values: Record, window: float, order: int, derivative: int = 0
) -> Float[np.ndarray, " n"]:
    """Smooth a record, or differentiate it, by least-squares polynomials over a moving window.

    The first and last half windows take the values (or derivatives) of the polynomial fitted to the first and last whole
    window. Polynomials up to ``order`` therefore pass unchanged up to the edges.

    Parameters
    ----------
    time : (n,) s, evenly spaced
    values : (n,)
    window : s, rounded to the nearest odd number of samples (see ``window_samples``)
    order : of the polynomial
    derivative : 0 to smooth, 1 for the rate in values per second, ... up to ``order``

    Returns
    -------
    (n,) array

    Raises
    ------
    InputError
        If the samples are unevenly spaced, or the window holds too few or too many samples.
    """
    step = sampling_step(time)
    samples = window_samples(window, step)
    _check_window(samples, order, len(time))
    half = samples // 2
    q, triangle, rows = _least_squares(samples, order, derivative)
    weights = np.linalg.solve(triangle.T, rows[half]) @ q.T
    first, last = (np.linalg.solve(triangle, q.T @ part) for part in (values[:samples], values[-samples:]))
    parts = (rows[:half] @ first, np.correlate(values, weights, mode="valid"), rows[half + 1 :] @ last)
    return np.concatenate(parts) / (max(half, 1) * step) ** derivative


def loudest_part(values: Record) -> slice:
    """The part of ``PIECE`` samples with the largest variance; the whole record where it has no more samples."""
    last = len(values) - PIECE
    if last <= 0:
        return slice(0, len(values))
    first = max((*range(0, last, PIECE), last), key=lambda k: float(np.var(values[k : k + PIECE])))
    return slice(first, first + PIECE)


def thinned(values: Record) -> Num[np.ndarray, " m"]:
    """Samples at equal distances of a long record, one to two pieces; a short record itself."""
    return values if len(values) < 2 * PIECE else values[:: len(values) // PIECE]


def clock_starts(time: Record) -> Int[np.ndarray, " k"]:
    """Rows at which the clock of successive records starts anew; () where times are out of order instead.

    A clock that falls to another time than the first one was set, or the parts are out of order.
    """
    falls = 1 + np.flatnonzero(np.diff(time) < 0.0)
    anew = np.abs(time[falls] - time[0]) <= CLOCK_START * np.ptp(time)
    return falls if len(falls) * FEWEST_PERIODS < len(time) and anew.all() else falls[:0]


def median_step(time: Record) -> float:
    """The median of the steps, s."""
    return float(np.median(np.diff(time)))


def rounded(instant: float, time: Record, more: int = 0) -> float:
    """An instant with as many digits, s, as the steps of the times have, and ``more``."""
    return float(np.round(instant, max(0, int(np.ceil(-np.log10(median_step(time))))) + more))


def largest_offset(time: Record, step: float) -> float:
    """Largest distance of the times from an even grid with ``step`` that begins at the first one, s."""
    return float(np.max(np.abs(time - time[0] - step * np.arange(len(time)))))


def uneven_sampling(time: Record) -> InputError | None:
    """What a filter needs and times (n,), s, increasing, lack; None for an evenly spaced record.

    No sample of one lies further than ``TIMING_TOLERANCE`` of a step from the even grid between the first and the last.
    """
    if len(time) < 2:
        return InputError("a filter needs at least 2 samples", f"{len(time)}", "give a longer record")
    step = float(time[-1] - time[0]) / (len(time) - 1)
    if largest_offset(time, step) <= TIMING_TOLERANCE * step:
        return None
    steps = np.diff(time)
    return InputError(
        "a filter needs evenly spaced samples",
        f"steps from {steps.min():g} to {steps.max():g} s",
        "resample the record evenly, or export it raw",
    )


def sampling_step(time: Record) -> float:
    """The sampling step of an evenly spaced record, s.

    Parameters
    ----------
    time : (n,) s, increasing

    Raises
    ------
    InputError
        If ``uneven_sampling`` finds a fault.
    """
    if (fault := uneven_sampling(time)) is not None:
        raise fault
    return float(time[-1] - time[0]) / (len(time) - 1)


def window_samples(window: float, step: float) -> int:
    """The odd number of samples nearest to ``window / step``, both in s."""
    return 2 * max(0, round((window / step - 1.0) / 2.0)) + 1


def filter_gain(frequency: np.ndarray | float, samples: int, order: int, derivative: int = 0) -> np.ndarray:
    """Gain of the filter away from the edges, from its coefficients: response over ideal response.

    Smoothing: the sum of c_k cos(2 pi f k). Derivative of order d: the response over (2 pi f)^d. Both are 1 at f = 0.

    Parameters
    ----------
    frequency : any shape, cycles per sample (Hz times the sampling step)
    samples : length of the window, odd
    order : of the polynomial, less than ``samples``
    derivative : 0 to ``order``

    Returns
    -------
    real array of the shape of ``frequency``: the filter is even or odd, so a phase shift is 0 or pi
    """
    frequency = np.asarray(frequency, float)
    half = samples // 2
    q, triangle, rows = _least_squares(samples, order, derivative)
    coefficients = np.linalg.solve(triangle.T, rows[half]) @ q.T / max(half, 1) ** derivative
    angle = 2.0 * np.pi * np.multiply.outer(frequency, np.arange(samples) - half)
    # the d-th derivative of cos(x) at 0 for even d, of sin(x) for odd d, is (-1)^(d//2)
    wave = np.sin(angle) if derivative % 2 else np.cos(angle)
    response = (-1) ** (derivative // 2) * (wave @ coefficients)
    ideal = (2.0 * np.pi * frequency) ** derivative
    return np.divide(response, ideal, out=np.ones_like(response), where=ideal > 0.0)


def choose_window(time: Record, values: Record, order: int) -> float:
    """The longest odd window with a gain of at least ``SMALLEST_GAIN`` at the dominant frequency, s.

    The rule is this package's own. Longer windows remove more noise and more of the motion.

    Parameters
    ----------
    time : (n,) s, evenly spaced
    values : (n,)
    order : of the polynomial

    Raises
    ------
    InputError
        As ``savitzky_golay``.
    """
    step = sampling_step(time)
    _check_window(order + 1 + order % 2, order, len(time))
    return longest_window(dominant_frequency(time, values) * step, len(time), order, SMALLEST_GAIN) * step


def longest_window(frequency: float, most: int, order: int, gain: float, derivative: int = 0) -> int:
    """Samples of the longest odd window with at least this ``gain`` at a frequency; else of the shortest one that smooths.

    Parameters
    ----------
    frequency : cycles per sample
    most : samples of the record
    order, derivative : as in ``filter_gain``
    """
    windows = range(order + 1 + order % 2, most + 1, 2)
    # The gain falls monotonically from 1 to the stop band, whose ripple is far below 1.
    too_long = bisect_left(windows, 1, 1, key=lambda samples: filter_gain(frequency, samples, order, derivative) < gain)
    return windows[too_long - 1]


def dominant_frequency(time: Record, values: Record) -> float:
    """Frequency of the highest peak of the spectrum, Hz, after removal of the linear trend; of a long record's loudest part.

    Parameters
    ----------
    time : (n,) s, evenly spaced
    values : (n,)

    Raises
    ------
    InputError
        As ``sampling_step``.
    """
    step = sampling_step(time)
    part = values[loudest_part(values)]
    frequency = _highest_peak(part, step)
    if len(part) < len(values) and frequency * step * len(part) < FEWEST_PERIODS:
        # The part is too short for a frequency so low, and the whole record has samples to spare.
        size = len(values) // PIECE + 1
        means = np.mean(values[: len(values) // size * size].reshape(-1, size), axis=1)
        frequency = _highest_peak(means, size * step)
    return frequency


def _highest_peak(values: Record, step: float) -> float:
    """Frequency of the highest peak of the spectrum, Hz, of samples at distances of ``step``, s."""
    # Its import takes four times as long as the rest of a process that reads one binary file.
    from scipy.signal import detrend

    length = _ZERO_PADDING * len(values)
    spectrum = np.abs(np.fft.rfft(detrend(values), length))
    # Below 1 / duration a peak is a remainder of the trend.
    return float(np.fft.rfftfreq(length, step)[_ZERO_PADDING + int(np.argmax(spectrum[_ZERO_PADDING:]))])


def _least_squares(samples: int, order: int, derivative: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares in Legendre polynomials of k/half, k = -half .. half.

    Returns q and triangle of the design, and the derivatives of the polynomials, (samples, order + 1).

    ``scipy.signal.savgol_coeffs`` (1.17) solves in powers of k, which loses digits without a warning. At order 3, the order
    in use, its smoothing weights are off by 2e-10 at 3001 samples and wrong from 30,001 samples (a record of 0.6 s at
    51.2 kHz); at order 5 from 1001 samples. Tests show both. Legendre polynomials keep 14 digits at every length.
    """
    half = samples // 2
    place = (np.arange(samples) - half) / max(half, 1)
    polynomials = np.eye(order + 1)
    q, triangle = np.linalg.qr(legendre.legval(place, polynomials).T)
    return q, triangle, legendre.legval(place, legendre.legder(polynomials, derivative)).T


def _check_window(samples: int, order: int, available: int) -> None:
    """Refuse a window with no more samples than ``order``, or longer than the record."""
    if samples <= order:
        raise InputError(
            "the window must hold more samples than the order",
            f"{counted(samples, 'sample')} for order {order}",
            "widen the window or lower the order",
        )
    if samples > available:
        raise InputError(
            "the window must fit into the record", f"{counted(samples, 'sample')} of {available}", "shorten the window"
        )


def hampel_outliers(values: Record, samples: int, n_sd: float) -> np.ndarray:
    """Whether each reading lies further than ``n_sd`` robust sds from the median of the window around it, (n,).

    The sd of a window is 1.4826 times the median distance of its readings from its median, and at least the smallest
    such distance in the record: a window at a steady level may hold one value only.
    Source: F. R. Hampel, J. Am. Stat. Assoc. 69, 383 (1974).

    Parameters
    ----------
    values : (n,)
    samples : length of the window, odd; at the ends the window is filled with the first or last reading
    """
    padded = np.pad(np.asarray(values, float), samples // 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, samples)
    distance, sd = np.empty(len(values)), np.empty(len(values))
    rows = max(1, _HAMPEL_BLOCK // samples)
    for first in range(0, len(values), rows):
        part = slice(first, first + rows)
        median = np.median(windows[part], axis=1)
        distance[part] = np.abs(values[part] - median)
        sd[part] = 1.4826 * np.median(np.abs(windows[part] - median[:, None]), axis=1)
    rounding = 1e-12 * np.max(np.abs(values), initial=0.0)
    return distance > n_sd * np.maximum(sd, np.min(distance[distance > rounding], initial=np.inf))
