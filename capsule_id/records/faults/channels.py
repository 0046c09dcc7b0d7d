"""Finds mislabelled columns by what holds for any motion: kinematics, and the sign of the power of the drive."""

from dataclasses import dataclass

import numpy as np

from capsule_id.records.noise import noise_level

#: Shortest record for these checks, in periods of the drive.
FEWEST_PERIODS = 3.0
#: Standard errors beyond which a sign counts as wrong.
SIGN_ERRORS = 6.0


@dataclass(frozen=True)
class Phasor:
    """Complex amplitude at one frequency, in the unit of the channel, and its standard error."""

    value: complex
    sd: float


def phasor(time: np.ndarray, values: np.ndarray, Omega: float) -> Phasor:
    """Amplitude of the tone at ``Omega``, rad/s, over whole periods at the end of a record, beside a linear trend.

    Parameters
    ----------
    time, values : (n,) s, and any unit
    """
    period = 2.0 * np.pi / Omega
    whole = np.floor((time[-1] - time[0]) / period) * period
    last = time >= time[-1] - whole
    t, x = time[last], values[last]
    design = np.stack([np.cos(Omega * t), np.sin(Omega * t), np.ones_like(t), t - t[0]], axis=1)
    cosine, sine, *_ = np.linalg.lstsq(design, x)[0]
    noise = noise_level(x, 6) if len(x) > 50 else float(np.std(x))
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
