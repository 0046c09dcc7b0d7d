"""Motion of the capsule by either engine, and the bias of the smoothed one against the exact one."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.physics.batches import is_traced, lanes_of, run_lanes
from capsule_id.physics.drives import RodMotion
from capsule_id.physics.exact import engine as exact
from capsule_id.physics.forces import CoulombStribeck, FrictionLaw, friction_law
from capsule_id.physics.model import (
    MAX_STEPS,
    CapsuleParameters,
    Drive,
    Excitation,
    Initial,
    Trajectory,
    pressed,
    without_absent,
)
from capsule_id.physics.smooth import engine as smooth
from capsule_id.physics.smooth.engine import Smoothing

# m/s. The bar "2 % + 1e-6 m/s" reads 2 % of (|v| + this): a capsule that hardly advances is not judged by a quotient.
VELOCITY_SCALE = 5e-5


def _check_choices(model: str, semantics: str, smoothing: Smoothing | None) -> None:
    """Refuse unknown words, and what the exact model does not have."""
    if model not in ("exact", "smooth"):
        raise InputError('model must be "exact" or "smooth"', repr(model), "choose one of the two")
    if semantics not in ("stick-slip", "eq2"):
        raise InputError('semantics must be "stick-slip" or "eq2"', repr(semantics), "choose one of the two")
    if model == "exact" and semantics == "eq2":
        raise InputError(
            "the exact model has stick-slip semantics only",
            'semantics="eq2"',
            'use model="smooth" for eq. (2) to the letter',
        )
    if model == "exact" and smoothing is not None:
        raise InputError("the exact model has no smoothing", repr(smoothing), 'leave it out or use model="smooth"')


def _check_values(p: CapsuleParameters, e: Drive, law: FrictionLaw, times: np.ndarray) -> None:
    """Refuse lanes without a normal force, and times outside the drive."""
    carried = np.asarray(pressed(p, law))
    if isinstance(law, CoulombStribeck) and not (carried | np.isnan(law.N)).all():
        N = float(np.asarray(law.N)[~carried & ~np.isnan(law.N)][0])
        raise InputError(
            "the normal force (m1 + m2) g cos(slope) + N0 must be positive",
            f"N = {N:.3g} N",
            "reduce the slope, or raise N0",
        )
    covered = np.asarray(e.covers(times[:, 0], times[:, -1]))
    if not covered.all():
        begin, end = times[~covered][0, [0, -1]]
        raise InputError(
            f"the drive {type(e).__name__} must cover the run, and its own times must increase",
            f"times from {begin:g} to {end:g} s",
            "shorten the run, or correct the drive",
        )


def simulate(
    p: CapsuleParameters,
    e: Drive,
    times: ArrayLike,
    initial: Initial | None = None,
    model: Literal["exact", "smooth"] = "exact",
    semantics: Literal["stick-slip", "eq2"] = "stick-slip",
    smoothing: Smoothing | None = None,
    *,
    friction: FrictionLaw | None = None,
    max_steps: int = MAX_STEPS,
) -> Trajectory:
    """Motion of the capsule at the given times.

    Parameters
    ----------
    p, e : parameters and drive (``Excitation``, ``Pulses``, ``RecordedDrive``, ``RodMotion``); any leaf may carry a
        leading batch axis of one common length
    times : (n,) or (batch, n), s, increasing; times[0] is the start
    initial : (X1, Y1, X2, Y2) at times[0], each () or (batch,); default at rest at the origin. A prescribed rod
        starts from its own X1 and Y1 instead
    model : "exact" (event-driven) or "smooth" (smoothed Heavisides)
    semantics : "stick-slip", or "eq2" (eq. (2) to the letter; smooth model only, for comparison)
    smoothing : widths of the smooth model; default the certified ones
    friction : a friction law in place of eq. (1); it replaces mu, v_s and the normal force of p. Leaves () or (batch,)
    max_steps : bound on the steps of a lane, after which it is given up with ``Status.TOO_MANY_STEPS``

    The number of parameters follows the public contract. Works under ``jit`` and ``vmap`` and is differentiable in
    forward mode in every float leaf, those of ``friction`` included; the smooth model in reverse mode too. Concrete
    batches are split into chunks of lanes that run on all cores; under a transformation the batch stays whole.

    The engines, ``exact.kernel(max_steps)`` and ``smooth.kernel(smoothing, semantics, max_steps)``, return a function
    ``(p, e, law, initial, times) -> Trajectory`` of lanes: every leaf (L,), times (L, n), fields (L, n) and (L,),
    status and counters int32. Samples are NaN only in lanes whose status is not ``usable``. Bad values give a status,
    not an exception.

    Raises
    ------
    InputError
        Unknown model or semantics, "eq2" or smoothing with the exact model, leaves whose shapes do not agree, times
        that do not increase; concrete values with a normal force N <= 0, or times outside the drive.
    """
    _check_choices(model, semantics, smoothing)
    given = (*without_absent(p, e), friction, initial or (0.0, 0.0, 0.0, 0.0))
    (p, e, friction, initial), grid, batched = lanes_of(given, times)
    law = friction_law(p, friction)
    if not is_traced((p, e, law, grid)):
        _check_values(p, e, law, np.asarray(grid))
    if isinstance(e, RodMotion):
        initial = (*e.rod(grid[:, 0]), initial[2], initial[3])
    lanes = (p, e, law, initial)
    if model == "exact":
        return run_lanes(exact.kernel(max_steps), lanes, grid, batched)
    return run_lanes(smooth.kernel(smoothing, semantics, max_steps), lanes, grid, batched)


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
