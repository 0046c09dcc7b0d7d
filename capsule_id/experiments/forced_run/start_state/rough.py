"""Starting values of a forced run: state and drive at the first sample, estimated from the record."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from capsule_id.experiments.base import About
from capsule_id.records.noise import noise_level
from capsule_id.records.tone import tone_at

#: Number of samples of the polynomials through the start of the record. A line gives the capsule's speed, a parabola
#: position and speed of the rod.
LINE_SAMPLES, PARABOLA_SAMPLES = 4, 9
#: The capsule counts as moving where its initial speed exceeds its standard error by this factor.
MOVING = 4.0
#: Frequency, rad/s, and damping ratio of the rod at the medians of the default priors. Without a current they give the
#: lag of x_rel's fundamental behind the drive, which suffices as a starting value.
ROD_FREQUENCY, ROD_DAMPING = 115.0, 0.16


@dataclass(frozen=True)
class RunStart:
    """Starting values estimated from a record, SI.

    Attributes
    ----------
    kind : "moving" where the capsule moves significantly at the first sample, else "stuck"
    x_rel, rate, capsule_rate : m, m/s, m/s at the first sample; 0 where the channel is missing
    length : amplitude of the rod's motion, m
    amplitude : amplitude of the current, A (NaN where it is not recorded)
    phase : phase of the drive, rad, in (-pi, pi]
    noise : noise level by channel
    """

    kind: Literal["stuck", "moving"]
    x_rel: float
    rate: float
    capsule_rate: float
    length: float
    amplitude: float
    phase: float
    noise: Mapping[str, float]

    def at_rate(self, capsule_rate: float | None) -> "RunStart":
        """The same values with another speed of the capsule, m/s, 0 for stuck; None: these."""
        if capsule_rate is None:
            return self
        return replace(self, capsule_rate=capsule_rate, kind="stuck" if capsule_rate == 0.0 else "moving")


@dataclass(frozen=True)
class AboutRun(About):
    """Inputs of a run that no likelihood reads.

    Attributes
    ----------
    record : label of the whole record
    leads : whether the run is a whole record, or the first part of one
    start : kind of initial state
    start_is_open : whether no kind of initial state is stated
    rough : state and drive at the first sample, estimated from the record (the speed by the model, where available)
    """

    record: str = field(compare=False)
    leads: bool = field(compare=False)
    start: str = field(compare=False)
    start_is_open: bool = field(compare=False)
    rough: RunStart = field(compare=False)


def rough_start(time: np.ndarray, channels: Mapping[str, np.ndarray], Omega: float) -> RunStart:
    """Estimate the starting values of a run.

    Parameters
    ----------
    time : (n,) s
    channels : by column name, (n,) each, SI; at least one
    Omega : excitation frequency, rad/s
    """
    noise = {name: max(noise_level(y), 1e-5 * float(np.ptp(y)), 1e-12) for name, y in channels.items()}
    amplitude, phase = float("nan"), 0.0
    if "current" in channels:
        amplitude, phase, _ = tone_at(time, channels["current"], Omega)
    elif "x_rel" in channels:
        ratio = Omega / ROD_FREQUENCY
        lag = np.arctan2(2.0 * ROD_DAMPING * ratio, 1.0 - ratio**2)
        phase = float(np.angle(np.exp(1j * (tone_at(time, channels["x_rel"], Omega)[1] + lag))))
    x_rel = rate = 0.0
    if "x_rel" in channels:
        x_rel, rate = _polynomial(time, channels["x_rel"], PARABOLA_SAMPLES, 2)[0]
        length = 0.5 * float(np.ptp(channels["x_rel"]))
    elif "acceleration_rod" in channels:
        # Contacts are short spikes, and quartiles are robust against them.
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
    """Value and rate at the first sample, of a polynomial through ``samples`` samples; sd of the rate per noise sd."""
    samples = min(samples, len(time))
    design = np.vander(time[:samples] - time[0], order + 1, increasing=True)
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ values[:samples]
    return (float(coefficients[0]), float(coefficients[1])), float(np.linalg.norm(inverse[1]))
