"""Motion of the capsule by either engine."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.physics.batches import is_traced, lanes_of, run_lanes
from capsule_id.physics.drive import Drive
from capsule_id.physics.drives import RodMotion
from capsule_id.physics.exact import engine as exact
from capsule_id.physics.friction import CoulombStribeck, FrictionLaw, friction_law
from capsule_id.physics.model import MAX_STEPS, CapsuleParameters, Initial, Trajectory, pressed, without_absent
from capsule_id.physics.smooth import engine as smooth
from capsule_id.physics.smooth.engine import Smoothing


def _check_choices(model: str, semantics: str, smoothing: Smoothing | None) -> None:
    """Refuse unknown words, and what the exact model does not have."""
    if model not in ("exact", "smooth"):
        raise InputError('model must be "exact" or "smooth"', repr(model), "choose one of the two")
    if semantics not in ("stick-slip", "eq2"):
        raise InputError('semantics must be "stick-slip" or "eq2"', repr(semantics), "choose one of the two")
    if model == "exact" and semantics == "eq2":
        remedy = 'use model="smooth" for eq. (2) to the letter'
        raise InputError("the exact model has stick-slip semantics only", 'semantics="eq2"', remedy)
    if model == "exact" and smoothing is not None:
        raise InputError("the exact model has no smoothing", repr(smoothing), 'leave it out or use model="smooth"')


def _check_values(p: CapsuleParameters, e: Drive, law: FrictionLaw, times: np.ndarray) -> None:
    """Refuse lanes without a normal force, and times outside the drive."""
    carried = np.asarray(pressed(p, law))
    if isinstance(law, CoulombStribeck) and not (carried | np.isnan(law.N)).all():
        N = float(np.asarray(law.N)[~carried & ~np.isnan(law.N)][0])
        rule = "the normal force (m1 + m2) g cos(slope) + N0 must be positive"
        raise InputError(rule, f"N = {N:.3g} N", "reduce the slope, or raise N0")
    covered = np.asarray(e.covers(times[:, 0], times[:, -1]))
    if not covered.all():
        begin, end = times[~covered][0, [0, -1]]
        rule = f"the drive {type(e).__name__} must cover the run, and its own times must increase"
        raise InputError(rule, f"times from {begin:g} to {end:g} s", "shorten the run, or correct the drive")


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
