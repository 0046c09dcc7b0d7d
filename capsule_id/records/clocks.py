"""Clocks of two loggers: offset and drift of one against the other, from a signal that both record.

    t = offset + (1 + drift) t',    b(t') = gain a(t) + constant + noise

a and b are the common signal by the two loggers, t and t' their times. Least squares over offset, drift, gain and
constant; a is a cubic spline through the record with more samples per second, without its noise. The covariance is that
of Newey and West (Econometrica 55, 703 (1987)), which admits residuals that are correlated over a few samples.

A periodic signal leaves the offset open by whole periods: of equally good offsets the smallest one counts.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Num
from scipy.interpolate import CubicSpline
from scipy.signal import correlate

from capsule_id.errors import InputError
from capsule_id.rig.filters import Record

#: Samples of the other logger, or their times.
OtherRecord = Num[np.ndarray, " m"]

#: Fewest samples that the two records must share in time.
FEWEST_COMMON = 50
#: Share of the variance of the common signal that the fit must explain.
LEAST_EXPLAINED = 0.5
#: A component of the spectrum counts as signal above this many times the mean power of the noise.
ABOVE_NOISE = 8.0
#: A sample counts where the slope of the signal exceeds this many times the sd of its noise.
STEEP = 4.0
#: Peaks of the correlation above this fraction of the largest one are tried; a fit counts as good as the best one if it
#: leaves at most this many times its variance unexplained.
LARGE, AS_GOOD = 0.5, 1.5
_MOST_STARTS, _SAMPLES_OF_A_TRIAL = 8, 3000
#: Most points of the grid on which a first offset is searched.
_GRID = 1 << 18
_STEPS, _CONVERGED = 50, 1e-3  # most steps of Gauss and Newton; smallest step that matters, in standard errors


@dataclass(frozen=True)
class Clock:
    """The clock of a logger against that of another one: t = ``offset`` + (1 + ``drift``) t'.

    Attributes
    ----------
    offset, offset_sd : s
    drift, drift_sd : pure numbers; 1e-6 is 1 ppm
    explained : share of the variance of the common signal that the fit explains
    """

    offset: float
    drift: float
    offset_sd: float
    drift_sd: float
    explained: float


def estimate_clock(time: Record, values: Record, other_time: OtherRecord, other_values: OtherRecord) -> Clock:
    """The clock of the other logger against the first one, from a signal that both record.

    Parameters
    ----------
    time, values : (n,) s, increasing, and the signal by the first logger, any unit
    other_time, other_values : (m,) the same by the other one; gain, zero and unit may differ

    Raises
    ------
    InputError
        If the records share too few samples, or the signals are not the same.
    """
    if len(time) / np.ptp(time) < len(other_time) / np.ptp(other_time):
        # The spline needs the denser record. t' = (t - offset) / (1 + drift).
        swapped = estimate_clock(other_time, other_values, time, values)
        factor = 1.0 / (1.0 + swapped.drift)
        return Clock(
            -swapped.offset * factor,
            factor - 1.0,
            swapped.offset_sd * factor,
            swapped.drift_sd * factor**2,
            swapped.explained,
        )
    reference = _Reference.of(time, values)
    centre = float(np.mean(other_time))
    # The offset at the centre of the other record is nearly independent of the drift.
    few = max(1, len(other_time) // _SAMPLES_OF_A_TRIAL)
    starts = _offsets(reference.spline.x, reference.spline(reference.spline.x), other_time, other_values)
    trials = [_least_squares(reference, other_time[::few], other_values[::few], first) for first in starts]
    tried = [fit for fit in trials if fit is not None]
    best = max((fit.explained for fit in tried), default=0.0)
    chosen = next((fit for fit in tried if 1.0 - fit.explained <= AS_GOOD * (1.0 - best)), None)
    fit = None if chosen is None else _least_squares(reference, other_time, other_values, chosen.shift, chosen.drift)
    if fit is None or fit.explained < LEAST_EXPLAINED:
        rule = f"two loggers must record the same signal for {FEWEST_COMMON} samples; it explains {LEAST_EXPLAINED:.0%} or more"
        raise InputError(rule, f"{best:.0%}", "name a signal that both files hold, such as a trigger")
    to_origin = np.array([1.0, -centre])
    return Clock(
        fit.shift - centre * fit.drift,
        fit.drift,
        float(np.sqrt(to_origin @ fit.covariance @ to_origin)),
        float(np.sqrt(fit.covariance[1, 1])),
        fit.explained,
    )


@dataclass(frozen=True)
class _Reference:
    """The common signal by the denser logger, without the components of its spectrum that noise alone explains.

    The slope of a noisy spline would otherwise look like information on the clock.

    Attributes
    ----------
    noise : sd of the noise of a sample
    slope_noise : sd of the noise that is left in the slope of the spline, per s
    """

    spline: CubicSpline
    noise: float
    slope_noise: float

    @classmethod
    def of(cls, time: np.ndarray, values: np.ndarray) -> "_Reference":
        even = np.linspace(time[0], time[-1], len(time))
        on_grid = np.interp(even, time, values) if np.ptp(np.diff(time)) > 1e-6 * np.median(np.diff(time)) else values
        line = np.linspace(on_grid[0], on_grid[-1], len(even))
        spectrum = np.fft.rfft(on_grid - line)
        power = np.abs(spectrum) ** 2
        floor = float(np.median(power[3 * len(power) // 4 :])) / np.log(2.0)
        kept = power >= ABOVE_NOISE * floor
        spectrum[~kept] = 0.0
        rates = 2.0 * np.pi * np.fft.rfftfreq(len(even), even[1] - even[0])
        # Noise alone keeps a component only where its power reaches the threshold.
        slope_noise = np.sqrt(2.0 * ABOVE_NOISE * floor * np.sum(rates[kept] ** 2)) / len(even)
        spline = CubicSpline(even, np.fft.irfft(spectrum, len(even)) + line)
        return cls(spline, float(np.sqrt(floor / len(even))), float(slope_noise))


def _offsets(time: np.ndarray, values: np.ndarray, other_time: np.ndarray, other_values: np.ndarray) -> list[float]:
    """Offsets with a large correlation on a common even grid, s, the smallest one first."""
    length = max(np.ptp(time), np.ptp(other_time))
    step = max(float(np.median(np.diff(other_time))), length / _GRID)
    one = np.interp(np.arange(time[0], time[-1], step), time, values - np.mean(values))
    other = np.interp(np.arange(other_time[0], other_time[-1], step), other_time, other_values - np.mean(other_values))
    products = np.abs(correlate(one, other, mode="full", method="fft"))
    peaks = 1 + np.flatnonzero((products[1:-1] >= products[:-2]) & (products[1:-1] > products[2:]))
    peaks = peaks[products[peaks] >= LARGE * np.max(products[peaks], initial=0.0)]
    peaks = peaks[np.argsort(-products[peaks], kind="stable")][:_MOST_STARTS]
    found = time[0] - other_time[0] + (peaks - (len(other) - 1)) * step
    nearest = found[np.argsort(np.abs(found), kind="stable")].tolist()
    return nearest or [float(time[0] - other_time[0])]


@dataclass(frozen=True)
class _Fit:
    """Offset at the centre of the other record, s, drift, their covariance, and the share of the variance explained."""

    shift: float
    drift: float
    covariance: np.ndarray
    explained: float


def _least_squares(
    reference: _Reference, times: np.ndarray, values: np.ndarray, shift: float, drift: float = 0.0
) -> _Fit | None:
    """The fit that begins at an offset and a drift; None where the records do not overlap.

    Samples count where the slope of the signal exceeds its noise: the others know nothing of the clock.
    """
    spline, slope = reference.spline, reference.spline.derivative()
    centre = float(np.mean(times))
    density = (len(times) - 1) / np.ptp(times) * (spline.x[1] - spline.x[0])
    covariance, explained = np.eye(2), 0.0
    for _ in range(_STEPS):
        mapped = times + shift + drift * (times - centre)
        inside = (mapped >= spline.x[0]) & (mapped <= spline.x[-1])
        if np.sum(inside) < FEWEST_COMMON:
            return None
        signal, own, rate = spline(mapped[inside]), values[inside], slope(mapped[inside])
        base = np.column_stack([signal, np.ones(len(own))])
        (gain, constant), *_ = np.linalg.lstsq(base, own, rcond=None)
        rate = np.where(np.abs(rate) > STEEP * reference.slope_noise, gain * rate, 0.0)
        design = np.column_stack([rate, rate * (times[inside] - centre), base])
        residual = own - gain * signal - constant
        step, *_ = np.linalg.lstsq(design, residual, rcond=None)
        # The noise of the reference counts as much as that of the other record, by its own number of samples.
        shared = np.linalg.pinv(design.T @ design) * (gain * reference.noise) ** 2 * density
        covariance = (_newey_west(design, residual) + shared)[:2, :2]
        explained = 1.0 - float(np.var(residual) / max(np.var(own), 1e-300))
        shift, drift = shift + float(step[0]), drift + float(step[1])
        if np.all(np.abs(step[:2]) <= _CONVERGED * np.sqrt(np.diag(covariance))):
            break
    return _Fit(shift, drift, covariance, explained)


def _newey_west(design: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Covariance of least squares with residuals that are correlated over a few samples, (p, p)."""
    scores = design * residual[:, None]
    lags = int(4 * (len(residual) / 100) ** (2 / 9)) + 1
    middle = scores.T @ scores
    for lag in range(1, lags + 1):
        product = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (lags + 1)) * (product + product.T)
    bread = np.linalg.pinv(design.T @ design)
    return bread @ middle @ bread
