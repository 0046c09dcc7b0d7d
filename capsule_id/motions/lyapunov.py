"""The largest Lyapunov exponent, from the exact derivatives of the engine through every event.

A tangent of the Poincaré map is carried along and brought back to unit length once a period; the exponent is the mean
rate at which its logarithm grows. Coordinates: (x_rel, its rate, Y2) at the drive's phase. X2 is left out: a motion
that is shifted as a whole is the same motion; its tangent neither grows nor decays and would hide all others.
In a capsule that sticks Y2 and its tangent are 0, and the map has one dimension less.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.physics.batches import lanes_of, run_lanes
from capsule_id.physics.drive import PeriodicDrive
from capsule_id.physics.exact.engine import run
from capsule_id.physics.friction import FrictionLaw, friction_law
from capsule_id.physics.model import MAX_STEPS, CapsuleParameters, Initial, Status, without_absent

# Excitation periods in which the tangent turns into the direction that grows most, before its growth counts.
ALIGNMENT = 16
# The tangent's direction at the start; any that is not special.
DIRECTION = (0.8, -0.5, 0.33)


class Exponent(NamedTuple):
    """exponent (lanes,): largest Lyapunov exponent, 1/s; NaN where a lane failed, -inf where every tangent dies out.

    status (lanes,): the gravest ``Status`` code; ``GRAZING`` where a derivative on the way does not exist.
    """

    exponent: np.ndarray
    status: np.ndarray


def largest_exponent(
    p: CapsuleParameters,
    e: PeriodicDrive,
    initial: Initial | None = None,
    periods: int = 100,
    max_steps: int = MAX_STEPS,
    friction: FrictionLaw | None = None,
) -> Exponent:
    """Largest Lyapunov exponent of motions that start at ``initial`` (a settled state, as ``settle(...).end``).

    Parameters
    ----------
    p, e : parameters and drive; leaves () or (batch,), concrete; the period positive
    initial : (X1, Y1, X2, Y2) at the drive's phase, each () or (batch,); default at rest at the origin
    periods : excitation periods over which growth is a mean (after 16 in which the tangent aligns)
    friction : a law in place of the capsule's own, see ``simulate``

    For a periodic orbit the limit is log|largest Floquet multiplier| / (n T), which is negative where it is stable.

    Raises
    ------
    InputError
        Shapes that do not agree.
    """
    given = (*without_absent(p, e), friction, initial if initial is not None else (0.0, 0.0, 0.0, 0.0))
    (p, e, friction, (X1, Y1, X2, Y2)), _, _ = lanes_of(given, np.zeros(1))
    law = friction_law(p, friction)
    T = np.asarray(e.period)
    begin = tuple(np.nan_to_num(x) for x in (X1 - X2, Y1 - Y2, Y2))
    span = np.stack([np.zeros_like(T), T], axis=1)
    kernel = partial(_growth, np.int32(periods), np.int32(max_steps))
    growth, status = (np.asarray(x) for x in run_lanes(kernel, (p, e, law, begin), span, batched=True))
    return Exponent(np.where(status <= Status.GRAZING, growth / (periods * T), np.nan), status)


@jax.jit
def _growth(
    periods: jax.Array,
    max_steps: jax.Array,
    p: CapsuleParameters,
    e: PeriodicDrive,
    law: FrictionLaw,
    begin: tuple[jax.Array, ...],
    span: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """(logarithm of the tangent's growth over ``periods``, status), each (L,); begin: x_rel, rate, Y2, each (L,).

    Seven arguments, because the engine's inputs are unpacked.
    """
    # Lengths in m: a velocity counts as the displacement that it makes in 1/Omega.
    Omega = 2.0 * jnp.pi / jnp.asarray(e.period)
    unit = jnp.stack([jnp.ones_like(Omega), Omega, Omega])

    def period(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        x_rel, rate, Y2 = y
        bound = jnp.broadcast_to(max_steps, x_rel.shape)
        t = run(p, e, law, (x_rel, rate + Y2, jnp.zeros_like(x_rel), Y2), span, span[:, 1], bound)
        return jnp.stack([t.x_rel[:, -1], (t.Y1 - t.Y2)[:, -1], t.Y2[:, -1]]), t.status

    def one(k: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        y, tangent, total, status = carry
        y, moved, now = jax.jvp(period, (y,), (tangent * unit,), has_aux=True)
        moved = moved / unit
        length = jnp.sqrt(jnp.sum(moved**2, axis=0))
        total = total + jnp.where(k < ALIGNMENT, 0.0, jnp.log(length))
        # A tangent that has died out stays zero; its logarithm is -inf.
        moved = moved / jnp.where(length > 0.0, length, 1.0)[None]
        return y, moved, total, jnp.where(status <= Status.GRAZING, jnp.maximum(status, now), status)

    y = jnp.stack(begin)
    tangent = jnp.broadcast_to(jnp.asarray(DIRECTION)[:, None], y.shape)
    # A capsule that sticks has no tangent in velocity.
    tangent = tangent.at[2].set(jnp.where(y[2] == 0.0, 0.0, tangent[2]))
    blank = (y, tangent, jnp.zeros_like(span[:, 0]), jnp.zeros(span.shape[0], jnp.int32))
    _, _, total, status = jax.lax.fori_loop(0, ALIGNMENT + periods, one, blank)
    return total, status
