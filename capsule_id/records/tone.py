"""Estimates frequency, amplitude and phase of the drive from the recorded current by harmonic least squares.

    y(t) = A cos(Omega t + phase) + offset + white noise

Standard errors are those of linearised least squares. For a long record they are the Cramér–Rao bounds of a single tone
with unknown frequency: D. C. Rife, R. R. Boorstyn, IEEE Trans. Inf. Theory 20, 591 (1974).
"""

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from capsule_id.errors import InputError
from capsule_id.records.stated_settings import stated_Omega
from capsule_id.rig.filters import Record, dominant_frequency
from capsule_id.rig.model import Table

#: The stated frequency is wrong if the fitted one differs by this many standard errors and by this fraction of it.
OMEGA_STANDARD_ERRORS, OMEGA_RELATIVE_DIFFERENCE = 4.0, 1e-3
FEWEST_SAMPLES = 8  # for five unknowns, including the noise level
#: A line of the spectrum: its power relative to the highest one, and to its surroundings. Of 611 random decays with other
#: faults, two had such a line, both clipped and undamped; of 200 with hum or further modes of 5 to 20 %, 183 had one. The
#: bounds were chosen on these records.
LEAST_POWER, PROMINENT = 1e-3, 100.0
_SEARCH_HALF_WIDTH = 1.5  # about a first guess, in 1 / duration: a spectral peak is 1 wide
_SEARCH_POINTS = 25


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
    if len(time) < FEWEST_SAMPLES:
        rule = f"a tone needs at least {FEWEST_SAMPLES} samples"
        raise InputError(rule, f"{len(time)}", "record for longer or faster")
    guesses = [Omega]
    # The spectrum needs even sampling; otherwise the stated frequency is the only guess.
    with contextlib.suppress(InputError):
        strongest = 2.0 * np.pi * dominant_frequency(time, values)
        near = abs(strongest - Omega) < _search_half_width(time)
        guesses = [strongest] if near else [Omega, strongest]
    found, left = _refine(time, values, guesses[0])
    for guess in guesses[1:]:
        other, less = _refine(time, values, guess)
        # In a coarse record the stated frequency and its alias fit equally well: prefer the stated one.
        if left - less > _significant_reduction(len(time)) * less:
            found, left = other, less
    return _harmonic_at(time, values, found, Omega)


def other_tone(time: Record, values: Record) -> float | None:
    """Frequency, Hz, of a narrow line in the spectrum of an oscillation, beside its own and its multiples; None without one.

    Parameters
    ----------
    time, values : (n,) s, evenly spaced, and any unit
    """
    n, step = len(time), float(time[-1] - time[0]) / (len(time) - 1)
    power = np.abs(np.fft.rfft((values - np.mean(values)) * np.hanning(n), 4 * n)) ** 2
    f, width = np.fft.rfftfreq(4 * n, step), 2.0 / (n * step)
    own = float(f[np.argmax(np.where(f < width, 0.0, power))])
    line = np.pad((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:]), 1)
    line &= (f > 3.0 * width) & (np.abs(f - own) > 6.0 * width) & (power > LEAST_POWER * np.max(power[f >= width]))
    line &= np.abs(f / own - np.round(f / own)) * own > 0.5 * width
    for i in sorted(np.flatnonzero(line), key=lambda i: -power[i]):
        off, wide = np.abs(f - f[i]), (max(2.0 * width, 0.15 * f[i]), max(6.0 * width, 0.35 * f[i]))
        around = (np.max(power[(off >= near) & (off <= far)]) for near, far in ((2.0 * width, 6.0 * width), wide))
        if power[i] > PROMINENT * min(around):
            return float(f[i])
    return None


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
    cosine, sine, offset = np.linalg.lstsq(_tone_design(time, Omega), values)[0]
    return float(np.hypot(cosine, sine)), float(np.arctan2(-sine, cosine)), float(offset)


def _tone_design(time: Record, Omega: float) -> np.ndarray:
    return np.stack([np.cos(Omega * time), np.sin(Omega * time), np.ones_like(time)], axis=1)


def _sum_of_squares(time: Record, values: Record, Omega: float) -> float:
    """Sum of squared residuals of the best tone of this frequency."""
    design = _tone_design(time, Omega)
    try:
        unknowns = np.linalg.solve(design.T @ design, design.T @ values)
    except np.linalg.LinAlgError:  # much less than a period: the cosine is constant
        unknowns = np.linalg.lstsq(design, values)[0]
    return float(np.sum((values - design @ unknowns) ** 2))


def _significant_reduction(samples: int) -> float:
    """Reduction of the sum of squares, relative to the rest, that is as rare as ``OMEGA_STANDARD_ERRORS``."""
    freedom = samples - 4
    return float(stats.t.isf(stats.norm.sf(OMEGA_STANDARD_ERRORS), freedom) ** 2 / freedom)


def _search_half_width(time: Record) -> float:
    """Half-width of the search about a guess, rad/s."""
    return float(2.0 * np.pi * _SEARCH_HALF_WIDTH / (time[-1] - time[0]))


def _refine(time: Record, values: Record, guess: float) -> tuple[float, float]:
    """(Omega, sum of squares) of the lowest minimum near ``guess``."""
    width = _search_half_width(time)
    grid = np.linspace(max(guess - width, 0.05 * guess), guess + width, _SEARCH_POINTS)
    best = int(np.argmin([_sum_of_squares(time, values, Omega) for Omega in grid]))
    step = grid[1] - grid[0]
    bounds = (max(grid[best] - step, 0.5 * grid[0]), grid[best] + step)
    found: Any = minimize_scalar(
        lambda Omega: _sum_of_squares(time, values, Omega),
        bounds=bounds,
        method="bounded",
        options={"xatol": 1e-9 * guess},
    )
    return float(found.x), float(found.fun)


def _harmonic_at(time: Record, values: Record, Omega: float, stated: float) -> Harmonic:
    """The tone at ``Omega`` with the joint standard errors of all four unknowns."""
    amplitude, phase, offset = tone_at(time, values, Omega)
    angle = Omega * time + phase
    slope = -amplitude * np.sin(angle)
    jacobian = np.stack([np.cos(angle), slope, slope * time, np.ones_like(time)], axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    left = float(np.sum((values - amplitude * np.cos(angle) - offset) ** 2))
    noise_sd = float(np.sqrt(left / (len(time) - 4)))
    refuted = _sum_of_squares(time, values, stated) - left > _significant_reduction(len(time)) * left
    errors = noise_sd * np.sqrt(_variances(jacobian / scale)) / scale
    sd = [float(error) for error in errors]
    return Harmonic(Omega, sd[2], amplitude, sd[0], phase, sd[1], offset, noise_sd, stated, refuted)


def _variances(jacobian: np.ndarray) -> np.ndarray:
    """Diagonal of (J'J)^-1; infinite if the record is too short to separate the unknowns."""
    try:
        variances = np.diag(np.linalg.inv(jacobian.T @ jacobian))
    except np.linalg.LinAlgError:
        return np.full(jacobian.shape[1], np.inf)
    return np.where(variances > 0.0, variances, np.inf)
