"""Bias of the smoothed model against the exact one, as data."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from capsule_id.errors import InputError
from capsule_id.physics.batches import lanes_of
from capsule_id.physics.drive import Excitation
from capsule_id.physics.model import CapsuleParameters, Trajectory
from capsule_id.physics.simulation import simulate
from capsule_id.physics.smooth.engine import Smoothing

# m/s. The bar "2 % + 1e-6 m/s" reads 2 % of (|v| + this): a capsule that hardly advances is not judged by a quotient.
VELOCITY_SCALE = 5e-5


@dataclass(frozen=True)
class SmoothingBias:
    """Both models over the same periods from rest; arrays (L,), one entry per lane (L = 1 where none was given).

    exact, smooth : mean velocity of the capsule, m/s        largest : largest |X2 - exact X2| at a period's end, m
    exact_contacts, smooth_contacts : closings of the gap    usable : whether both runs are complete
    """

    smoothing: Smoothing
    periods: int
    exact: np.ndarray
    smooth: np.ndarray
    largest: np.ndarray
    exact_contacts: np.ndarray
    smooth_contacts: np.ndarray
    usable: np.ndarray

    @property
    def bias(self) -> np.ndarray:
        """(L,), m/s: smooth - exact; NaN where a run is not usable."""
        return np.where(self.usable, self.smooth - self.exact, np.nan)

    @property
    def relative(self) -> np.ndarray:
        """(L,), 1: |bias| / (|exact| + 5e-5 m/s); the certified widths stay below 0.02."""
        return np.abs(self.bias) / (np.abs(self.exact) + VELOCITY_SCALE)


def smoothing_bias(
    p: CapsuleParameters,
    e: Excitation,
    smoothing: Smoothing | None = None,
    periods: int = 10,
    semantics: Literal["stick-slip", "eq2"] = "stick-slip",
) -> SmoothingBias:
    """Bias of the smoothed model for these parameters, over ``periods`` periods from rest.

    p, e : leaves () or (batch,)        smoothing : default the certified widths

    Raises
    ------
    InputError
        Without an excitation frequency (Omega = 0 has no period), or periods < 1.
    """
    if periods < 1:
        raise InputError("the bias is measured over at least one period", f"periods = {periods}", "give 1 or more")
    smoothing = smoothing or Smoothing()
    (p, e), _, _ = lanes_of((p, e), np.zeros(1))
    Omega = np.asarray(e.Omega)
    if not np.all(Omega > 0.0):
        raise InputError("the bias is measured per period of the drive", "Omega <= 0", "give Omega > 0, in rad/s")
    times = (2.0 * np.pi / Omega)[:, None] * np.arange(periods + 1)
    exact = simulate(p, e, times)
    smooth = simulate(p, e, times, model="smooth", semantics=semantics, smoothing=smoothing)
    return SmoothingBias(
        smoothing,
        periods,
        _mean_velocity(exact),
        _mean_velocity(smooth),
        np.max(np.abs(np.asarray(smooth.X2) - np.asarray(exact.X2)), axis=1),
        np.asarray(exact.contacts),
        np.asarray(smooth.contacts),
        np.isfinite(np.asarray(exact.X2[:, -1])) & np.isfinite(np.asarray(smooth.X2[:, -1])),
    )


def _mean_velocity(t: Trajectory) -> np.ndarray:
    return np.asarray((t.X2[:, -1] - t.X2[:, 0]) / (t.times[:, -1] - t.times[:, 0]))
