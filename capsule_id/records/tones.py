"""Drive, noise level and clock of a record, by harmonic least squares."""

import contextlib
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Num
from scipy import stats
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.signal import correlate, find_peaks

from capsule_id.errors import InputError
from capsule_id.rig.filters import FEWEST_SAMPLES, PIECE, Record, dominant_frequency, loudest_part
from capsule_id.rig.model import Quantity, Table
from capsule_id.rig.schema import SHORTEST_RECORD

# stated settings: Settings of a forced run as numbers.


def stated_Omega(table: Table) -> float:
    """The frequency of the drive, rad/s, from ``Omega`` or ``f``; else the strongest one of the recorded base.

    Raises
    ------
    InputError
        If no frequency is stated and the record is sampled unevenly.
    """
    settings = table.settings
    f = settings.f if settings.Omega or settings.f else dominant_frequency(table["time"], table["x_base"])
    return settings.Omega or 2.0 * np.pi * f


def stated_gap(table: Table) -> Quantity:
    """The stated gap, m; infinite without a support spring."""
    return table.settings.gap or Quantity(float("inf"))


def relative_position(table: Table) -> tuple[np.ndarray, float] | None:
    """x_rel of a record, m, and its reading error: recorded, or x_base - x_capsule; None without either."""
    columns = table.columns
    if "x_rel" in columns:
        return table["x_rel"], columns["x_rel"].reading_sd
    if "x_base" not in columns or "x_capsule" not in columns:
        return None
    error = np.hypot(columns["x_base"].reading_sd, columns["x_capsule"].reading_sd)
    return table["x_base"] - table["x_capsule"], float(error)


def frequency_of(time: np.ndarray, values: np.ndarray) -> float:
    """Dominant frequency of the loudest part of a record that may be sampled unevenly, Hz."""
    part = loudest_part(values)
    # Times since 1970 have too few digits for an even grid.
    own = time[part] - time[part][0]
    even = np.linspace(0.0, own[-1], len(own))
    return dominant_frequency(even, np.interp(even, own, values[part]))


# noise: Estimates the noise level of a record from its differences, and finds where a decay is all noise.


#: Median of |z| for a standard normal z.
NORMAL_QUARTILE = float(stats.halfnorm.median())
#: Order of the differences that remove a well-sampled decay.
ORDER = 3
#: Levels of all detectors, in standard deviations or standard errors. A single value exceeds the first by chance once in
#: 400 times, the second once in 16,000 times, the third once in 5e8 times: no sample of a long record does.
VISIBLE, SIGNIFICANT, BEYOND_CHANCE = 3.0, 4.0, 6.0
#: Fewest samples in a period of a motion that a record can show.
FEWEST_IN_PERIOD = 4
#: A fit counts as good as the best one if it leaves at most this many times its sum of squares.
AS_GOOD = 1.5
#: Part of the energy of a decay before it is all noise.
ENERGY = 0.99


def noise_level(values: Num[np.ndarray, " n"], order: int = ORDER) -> float:
    """Standard deviation of the white noise on an evenly sampled record, by the median of its differences.

    Differencing removes a smooth motion. The median ignores contacts and stops, which take a small part of the time.
    Of a long record the middle is taken.
    The default suits a well-sampled decay; order 6 removes a forced motion too.

    Parameters
    ----------
    values : (n,), n > ``order``
    order : of the differences; those of unit white noise have the variance binomial(2 order, order)
    """
    if len(values) >= 2 * PIECE:
        values = values[(len(values) - PIECE) // 2 :][:PIECE]
    differences = np.abs(np.diff(values, order))
    return float(np.median(differences) / (NORMAL_QUARTILE * math.sqrt(math.comb(2 * order, order))))


def length_of_motion(values: Num[np.ndarray, " n"]) -> int:
    """Number of the first samples of a decay that hold most of its energy, before it is all noise."""
    energy = np.cumsum((values - np.mean(values)) ** 2)
    return min(int(np.searchsorted(energy, ENERGY * energy[-1])) + 1, len(values))


# tone: Estimates frequency, amplitude and phase of the drive from the recorded current by harmonic least squares.
#
#     y(t) = A cos(Omega t + phase) + offset + white noise
#
# Standard errors are those of linearised least squares. For a long record they are the Cramér–Rao bounds of a
# single tone with unknown frequency: D. C. Rife, R. R. Boorstyn, IEEE Trans. Inf. Theory 20, 591 (1974).


#: The stated frequency is wrong if the fitted one differs by ``SIGNIFICANT`` standard errors and by this fraction of it.
OMEGA_RELATIVE_DIFFERENCE = 1e-3
#: A line of the spectrum: its power relative to the highest one, and to its surroundings. Of 611 random decays with other
#: faults, two had such a line, both clipped and undamped; of 200 with hum or further modes of 5 to 20 %, 183 had one. The
#: bounds were chosen on these records.
LEAST_POWER, PROMINENT = 1e-3, 100.0
#: Smallest ratio of the amplitudes of hum in the halves of a record: other modes die away. Multiples of a decay's frequency
#: at which its residuals hold errors of its model, and part of it by which other residuals of its own motion are off.
LASTING, MULTIPLES, NEAR = 0.7, 5, 0.15
_SEARCH_HALF_WIDTH = 1.5  # about a first guess, in 1 / duration: a spectral peak is 1 wide
_SEARCH_POINTS = 25
#: Relative tolerance of the sum of squares and of the frequency.
TOLERANCE = 1e-10


@dataclass(frozen=True)
class Harmonic:
    """A fitted tone, SI: ``amplitude`` cos(``Omega`` t + ``phase``) + ``offset``, t the record's own time.

    ``_sd`` are standard errors; phase in (-pi, pi]; ``noise_sd`` of the residuals; ``stated_Omega`` as in the table;
    ``refuted``: the tone of the stated frequency has a sum of squares larger than noise explains.
    """

    Omega: float
    Omega_sd: float
    amplitude: float
    amplitude_sd: float
    phase: float
    phase_sd: float
    offset: float
    noise_sd: float
    stated_Omega: float
    refuted: bool

    @property
    def disagrees(self) -> bool:
        """Whether the stated frequency is wrong: off by 4 standard errors and by 0.1 %."""
        off = abs(self.Omega - self.stated_Omega)
        return self.refuted and off > OMEGA_RELATIVE_DIFFERENCE * self.stated_Omega


def recorded_drive(table: Table) -> Harmonic | None:
    """The tone of the recorded current (A), or None where the table has no current."""
    return fit_harmonic(table["time"], table["current"], stated_Omega(table)) if "current" in table.columns else None


def fit_harmonic(time: Record, values: Record, Omega: float) -> Harmonic:
    """Fit one tone. The search covers ``Omega`` and the strongest peak of the spectrum.

    Parameters
    ----------
    time : (n,) s, increasing; the spectrum is used only if it is evenly spaced
    values : (n,)
    Omega : stated, rad/s

    Raises
    ------
    InputError
        With fewer than 8 samples.
    """
    if len(time) < SHORTEST_RECORD:
        rule = f"a tone needs at least {SHORTEST_RECORD} samples"
        raise InputError(rule, f"{len(time)}", "record for longer or faster")
    guesses = [Omega]
    # The spectrum needs even sampling; otherwise the stated frequency is the only guess.
    with contextlib.suppress(InputError):
        strongest = 2.0 * np.pi * dominant_frequency(time, values)
        near = abs(strongest - Omega) < _search_half_width(time)
        guesses = [strongest] if near else [Omega, strongest]
    ends = [_refine(time, values, guess) for guess in guesses]
    freedom = len(time) - 4
    # Reduction of the sum of squares, relative to the rest, that is as rare as ``SIGNIFICANT``.
    significant = float(stats.t.isf(stats.norm.sf(SIGNIFICANT), freedom) ** 2 / freedom)
    # In a coarse record the stated frequency and its alias fit equally well: prefer the stated one.
    better = ends[0][1] - ends[-1][1] > significant * ends[-1][1]
    found, left = ends[-1] if better else ends[0]
    amplitude, phase, offset = tone_at(time, values, found)
    angle = found * time + phase
    slope = -amplitude * np.sin(angle)
    # The joint standard errors of all four unknowns.
    jacobian = np.stack([np.cos(angle), slope, slope * time, np.ones_like(time)], axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    noise_sd = float(np.sqrt(left / freedom))
    refuted = float(np.sum(_residuals(time, values, Omega) ** 2)) - left > significant * left
    sd = (noise_sd * np.sqrt(_variances(jacobian / scale)) / scale).tolist()
    return Harmonic(found, sd[2], amplitude, sd[0], phase, sd[1], offset, noise_sd, Omega, refuted)


def _spectrum(time: Record, values: Record) -> tuple[np.ndarray, np.ndarray, float]:
    """Frequencies, Hz, power of an evenly sampled record at them, and half of the width of a line, Hz."""
    n, step = len(time), float(time[-1] - time[0]) / (len(time) - 1)
    power = np.abs(np.fft.rfft((values - np.mean(values)) * np.hanning(n), 4 * n)) ** 2
    return np.fft.rfftfreq(4 * n, step), power, 2.0 / (n * step)


def other_tone(time: Record, values: Record) -> float | None:
    """Frequency, Hz, of a narrow line in the spectrum of an oscillation, beside its own and its multiples; None without one.

    Parameters
    ----------
    time, values : (n,) s, evenly spaced, and any unit
    """
    f, power, width = _spectrum(time, values)
    own = float(f[np.argmax(np.where(f < width, 0.0, power))])
    line = (
        np.pad((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:]), 1)
        & (f > 3.0 * width)
        & (np.abs(f - own) > 6.0 * width)
        & (power > LEAST_POWER * np.max(power[f >= width]))
        & (np.abs(f / own - np.round(f / own)) * own > 0.5 * width)
    )
    for i in sorted(np.flatnonzero(line), key=lambda i: -power[i]):
        off, wide = np.abs(f - f[i]), (max(2.0 * width, 0.15 * f[i]), max(6.0 * width, 0.35 * f[i]))
        around = (np.max(power[(off >= near) & (off <= far)]) for near, far in ((2.0 * width, 6.0 * width), wide))
        if power[i] > PROMINENT * min(around):
            return float(f[i])
    return None


def lasting_tone(time: Record, values: Record, own: float) -> float:
    """Frequency, Hz, of a line in the residuals of a decay that does not die away with it, as hum does; 0 without one.

    Parameters
    ----------
    time, values : (n,) s, evenly spaced, and any unit
    own : frequency of the decay, Hz, near whose first multiples the errors of its model lie
    """
    f, power, width = _spectrum(time, values)
    multiple = np.clip(np.round(f / own), 1.0, MULTIPLES)
    apart = np.where((f > width) & (np.abs(f - multiple * own) > width), power, 0.0)
    best = int(np.argmax(apart))
    off = np.abs(f - f[best])
    # Beside the empty stop band of a filtered record any of its noise stands out; beside its neighbours a tone does.
    around = power[(off > 2.0 * width) & (off < max(6.0 * width, 0.35 * f[best]))]
    if not apart[best] > PROMINENT * max(np.median(power), np.median(around)):
        return 0.0
    Omega = _refine(time, values, 2.0 * np.pi * float(f[best]))[0]
    found, half = Omega / (2.0 * np.pi), len(time) // 2
    first, second = (tone_at(time[part], values[part], Omega)[0] for part in (slice(half), slice(half, None)))
    return found if abs(found - own) > NEAR * own and LASTING * first < second < first / LASTING else 0.0


def tone_at(time: Record, values: Record, Omega: float) -> tuple[float, float, float]:
    """Least-squares tone of a known frequency: (amplitude, phase, offset) of amplitude cos(Omega t + phase) + offset.

    Parameters
    ----------
    time, values : (n,) s and any unit
    Omega : rad/s

    Returns
    -------
    amplitude and offset in the unit of ``values``, phase in rad, in (-pi, pi]
    """
    design = np.stack([np.cos(Omega * time), np.sin(Omega * time), np.ones_like(time)], axis=1)
    cosine, sine, offset = np.linalg.lstsq(design, values)[0]
    return float(np.hypot(cosine, sine)), float(np.arctan2(-sine, cosine)), float(offset)


def _residuals(time: Record, values: Record, Omega: float) -> np.ndarray:
    """Residuals (n,) of the best tone of this frequency."""
    amplitude, phase, offset = tone_at(time, values, Omega)
    return values - amplitude * np.cos(Omega * time + phase) - offset


def _search_half_width(time: Record) -> float:
    """Half-width of the search about a guess, rad/s."""
    return float(2.0 * np.pi * _SEARCH_HALF_WIDTH / (time[-1] - time[0]))


def _refine(time: Record, values: Record, guess: float) -> tuple[float, float]:
    """(Omega, sum of squares) of the lowest minimum near ``guess``."""
    width = _search_half_width(time)
    grid = np.linspace(max(guess - width, 0.05 * guess), guess + width, _SEARCH_POINTS)
    best = int(np.argmin([np.sum(_residuals(time, values, Omega) ** 2) for Omega in grid]))
    step = grid[1] - grid[0]
    bounds = (max(grid[best] - step, 0.5 * grid[0]), grid[best] + step)
    unit = float(np.std(values)) or 1.0
    found = least_squares(
        lambda own: _residuals(time, values, own[0]) / unit,
        grid[best : best + 1],
        bounds=bounds,
        x_scale=step,
        ftol=TOLERANCE,
        xtol=TOLERANCE,
    ).x[0]
    return float(found), float(np.sum(_residuals(time, values, found) ** 2))


def _variances(jacobian: np.ndarray) -> np.ndarray:
    """Diagonal of (J'J)^-1; infinite if the record is too short to separate the unknowns."""
    try:
        variances = np.diag(np.linalg.inv(jacobian.T @ jacobian))
    except np.linalg.LinAlgError:
        return np.full(jacobian.shape[1], np.inf)
    return np.where(variances > 0.0, variances, np.inf)


# clocks: Clocks of two loggers: offset and drift of one against the other, from a signal that both record.
#
#     t = offset + (1 + drift) t',    b(t') = gain a(t) + constant + noise
#
# a and b are the common signal by the two loggers, t and t' their times. Least squares over offset, drift, gain and
# constant; a is a cubic spline through the record with more samples per second, without its noise. The covariance
# is that of Newey and West (Econometrica 55, 703 (1987)), which admits residuals that are correlated over a few
# samples.
#
# A periodic signal leaves the offset open by whole periods: of equally good offsets the smallest one counts.


#: Samples of the other logger, or their times.
OtherRecord = Num[np.ndarray, " m"]

#: Fewest samples that the two records must share in time.
FEWEST_COMMON = FEWEST_SAMPLES
#: Share of the variance of the common signal that the fit must explain.
LEAST_EXPLAINED = 0.5
#: A component of the spectrum counts as signal above this many times the mean power of the noise.
ABOVE_NOISE = 8.0
#: Peaks of the correlation above this fraction of the largest one are tried.
LARGE = 0.5
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
    reference, centre = _reference(time, values), float(np.mean(other_time))
    # The offset at the centre of the other record is nearly independent of the drift.
    few = max(1, len(other_time) // _SAMPLES_OF_A_TRIAL)
    starts = _offsets(reference[0].x, reference[0](reference[0].x), other_time, other_values)
    trials = (_least_squares(reference, other_time[::few], other_values[::few], first) for first in starts)
    tried = [fit for fit in trials if fit is not None]
    best = max((explained for explained, *_ in tried), default=0.0)
    chosen = next((fit for fit in tried if 1.0 - fit[0] <= AS_GOOD * (1.0 - best)), None)
    fit = None if chosen is None else _least_squares(reference, other_time, other_values, *chosen[1:3])
    if fit is None or fit[0] < LEAST_EXPLAINED:
        rule = f"two loggers must record the same signal for {FEWEST_COMMON} samples; it explains {LEAST_EXPLAINED:.0%} or more"
        raise InputError(rule, f"{best:.0%}", "name a signal that both files hold, such as a trigger")
    explained, shift, drift, covariance = fit
    to_origin = np.array([1.0, -centre])
    sd = float(np.sqrt(to_origin @ covariance @ to_origin)), float(np.sqrt(covariance[1, 1]))
    return Clock(shift - centre * drift, drift, *sd, explained)


def _reference(time: np.ndarray, values: np.ndarray) -> tuple[CubicSpline, float, float]:
    """The common signal by the denser logger, without the components of its spectrum that noise alone explains.

    The slope of a noisy spline would otherwise look like information on the clock.

    Returns
    -------
    spline, sd of the noise of a sample, and sd of the noise that is left in the slope of the spline, per s
    """
    even = np.linspace(time[0], time[-1], len(time))
    on_grid = np.interp(even, time, values) if np.ptp(np.diff(time)) > 1e-6 * np.median(np.diff(time)) else values
    line = np.linspace(on_grid[0], on_grid[-1], len(even))
    spectrum = np.fft.rfft(on_grid - line)
    power = np.abs(spectrum) ** 2
    floor = float(np.median(power[3 * len(power) // 4 :])) / np.log(2.0)
    kept = power >= ABOVE_NOISE * floor
    rates = 2.0 * np.pi * np.fft.rfftfreq(len(even), even[1] - even[0])
    # Noise alone keeps a component only where its power reaches the threshold.
    slope_noise = np.sqrt(2.0 * ABOVE_NOISE * floor * np.sum(rates[kept] ** 2)) / len(even)
    spline = CubicSpline(even, np.fft.irfft(np.where(kept, spectrum, 0.0), len(even)) + line)
    return spline, float(np.sqrt(floor / len(even))), float(slope_noise)


def _offsets(time: np.ndarray, values: np.ndarray, other_time: np.ndarray, other_values: np.ndarray) -> list[float]:
    """Offsets with a large correlation on a common even grid, s, the smallest one first."""
    length = max(np.ptp(time), np.ptp(other_time))
    step = max(float(np.median(np.diff(other_time))), length / _GRID)
    one = np.interp(np.arange(time[0], time[-1], step), time, values - np.mean(values))
    other = np.interp(np.arange(other_time[0], other_time[-1], step), other_time, other_values - np.mean(other_values))
    products = np.abs(correlate(one, other, mode="full", method="fft"))
    peaks, _ = find_peaks(products)
    peaks = peaks[products[peaks] >= LARGE * np.max(products[peaks], initial=0.0)]
    peaks = peaks[np.argsort(-products[peaks], kind="stable")][:_MOST_STARTS]
    found = time[0] - other_time[0] + (peaks - (len(other) - 1)) * step
    nearest = found[np.argsort(np.abs(found), kind="stable")].tolist()
    return nearest or [float(time[0] - other_time[0])]


def _least_squares(
    reference: tuple[CubicSpline, float, float],
    times: np.ndarray,
    values: np.ndarray,
    shift: float,
    drift: float = 0.0,
) -> tuple[float, float, float, np.ndarray] | None:
    """The fit that begins at an offset and a drift; None where the records do not overlap.

    Samples count where the slope of the signal exceeds its noise: the others know nothing of the clock.

    Returns
    -------
    share of the variance explained, offset at the centre of the other record, s, drift, and their covariance (2, 2)
    """
    spline, noise, slope_noise = reference
    centre, slope = float(np.mean(times)), spline.derivative()
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
        rate = np.where(np.abs(rate) > SIGNIFICANT * slope_noise, gain * rate, 0.0)
        design = np.column_stack([rate, rate * (times[inside] - centre), base])
        residual = own - gain * signal - constant
        step, *_ = np.linalg.lstsq(design, residual, rcond=None)
        # The noise of the reference counts as much as that of the other record, by its own number of samples.
        shared = np.linalg.pinv(design.T @ design) * (gain * noise) ** 2 * density
        covariance = (_newey_west(design, residual) + shared)[:2, :2]
        explained = 1.0 - float(np.var(residual) / max(np.var(own), 1e-300))
        shift, drift = shift + float(step[0]), drift + float(step[1])
        if np.all(np.abs(step[:2]) <= _CONVERGED * np.sqrt(np.diag(covariance))):
            break
    return explained, shift, drift, covariance


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
