"""Where the fit of a forced run may start: state and drive at the first sample, read off the record itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from capsule_id.experiments.base import About
from capsule_id.records.noise import noise_level
from capsule_id.records.tone import tone_at

#: Samples of the polynomials through the start of the record: a straight line tells whether the capsule moves, a
#: parabola where the rod is and how fast.
LINE_SAMPLES, PARABOLA_SAMPLES = 4, 9
#: The capsule counts as moving where its rate at the start stands out of its standard error by this factor.
MOVING = 4.0
#: Without a current the drive's phase is that of x_rel's fundamental, ahead by the lag of a rod of this frequency, rad/s,
#: and damping ratio (the middle of the default priors): rough, and good enough for a start.
ROD_FREQUENCY, ROD_DAMPING = 115.0, 0.16


@dataclass(frozen=True)
class RunStart:
    """Read off a record, SI.

    Attributes
    ----------
    kind : "moving" where the capsule visibly moves at the first sample, else "stuck"
    x_rel, rate, capsule_rate : m, m/s, m/s at the first sample; 0 where the channel is missing
    length : size of the rod's motion, m
    amplitude : of the current, A (NaN where it is not recorded)
    phase : of the drive, rad, in (-pi, pi]
    noise : by channel
    """

    kind: Literal["stuck", "moving"]
    x_rel: float
    rate: float
    capsule_rate: float
    length: float
    amplitude: float
    phase: float
    noise: Mapping[str, float]


@dataclass(frozen=True)
class AboutRun(About):
    """What a run was made of.

    Attributes
    ----------
    record : label of the record that the run is, or is a part of
    leads : the run is a whole record, or the first part of one
    start : the kind of initial state
    start_is_open : no kind of initial state was stated
    rough : state and drive at the first sample, read off the record (the speed by the model, where that found one)
    """

    record: str = field(compare=False)
    leads: bool = field(compare=False)
    start: str = field(compare=False)
    start_is_open: bool = field(compare=False)
    rough: RunStart = field(compare=False)


def rough_start(time: np.ndarray, channels: Mapping[str, np.ndarray], Omega: float) -> RunStart:
    """Start of a run.

    Parameters
    ----------
    time : (n,) s
    channels : by column name, (n,) each, SI; at least one
    Omega : of the drive, rad/s
    """
    noise = {name: max(noise_level(y), 1e-5 * float(np.ptp(y)), 1e-12) for name, y in channels.items()}
    amplitude, phase = float("nan"), 0.0
    if "current" in channels:
        amplitude, phase, _ = tone_at(time, channels["current"], Omega)
    elif "x_rel" in channels:
        ratio = Omega / ROD_FREQUENCY
        lag = np.arctan2(2.0 * ROD_DAMPING * ratio, 1.0 - ratio**2)
        phase = _wrap(tone_at(time, channels["x_rel"], Omega)[1] + lag)
    x_rel = rate = 0.0
    if "x_rel" in channels:
        x_rel, rate = _polynomial(time, channels["x_rel"], PARABOLA_SAMPLES, 2)[0]
        length = 0.5 * float(np.ptp(channels["x_rel"]))
    elif "acceleration_rod" in channels:
        # Contacts are spikes: the quartiles are those of the flight between them.
        length = float(np.subtract(*np.quantile(channels["acceleration_rod"], [0.75, 0.25]))) / Omega**2
    elif "x_capsule" in channels:
        length = max(float(np.ptp(channels["x_capsule"])), 1e-4)
    else:
        length = 1e-3
    capsule_rate, kind = 0.0, "stuck"
    if "x_capsule" in channels:
        (_, slope), factor = _polynomial(time, channels["x_capsule"], LINE_SAMPLES, 1)
        if abs(slope) > MOVING * factor * noise["x_capsule"]:
            capsule_rate, kind = slope, "moving"
    return RunStart(kind, x_rel, rate, capsule_rate, length, amplitude, phase, noise)  # type: ignore[arg-type]


def _polynomial(time: np.ndarray, values: np.ndarray, samples: int, order: int) -> tuple[tuple[float, float], float]:
    """(value, rate) at the first sample of a polynomial through the first ``samples``, and sd of the rate per noise sd."""
    samples = min(samples, len(time))
    design = np.vander(time[:samples] - time[0], order + 1, increasing=True)
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ values[:samples]
    return (float(coefficients[0]), float(coefficients[1])), float(np.linalg.norm(inverse[1]))


def _wrap(angle: float) -> float:
    return float(np.arctan2(np.sin(angle), np.cos(angle)))
