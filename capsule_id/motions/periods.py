"""What happens within single periods of the drive: closings of the gap, and the work of the drive.

Every period of every motion is a lane of its own, started from the state at its beginning, so that 48 periods of one
motion are computed side by side. What two periods share, an opening in one and the closing that follows in the next,
is put together afterwards.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.physics.batches import CHUNK, run_lanes
from capsule_id.physics.exact.engine import Lanes, start, step
from capsule_id.physics.exact.taylor import Motion, Rig, State, cos_sin, horner, rig_of
from capsule_id.physics.model import CapsuleParameters, Excitation, Initial

# Quadrature nodes per step for the drive's work: exact up to degree 15, where the series of velocity end at 12.
_NODE, _WEIGHT = (0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(8), (1.0, 0.0), strict=True))


class Happened(NamedTuple):
    """Of one span per lane, every leaf (L,).

    closings : closings of the gap, those after an opening shorter than ``merge`` left out
    lead : time of the first closing if no opening stands before it in the span, else inf
    opened : time of the last opening, -inf if there is none
    work : of the drive on the rod, J
    status : a ``Status`` code
    """

    closings: jax.Array
    lead: jax.Array
    opened: jax.Array
    work: jax.Array
    status: jax.Array


class Periods(NamedTuple):
    """closings (lanes, periods), int; work (lanes, periods), J; status (lanes,), the gravest of the periods."""

    closings: np.ndarray
    work: np.ndarray
    status: np.ndarray


def observe(
    p: CapsuleParameters,
    e: Excitation,
    times: np.ndarray,
    states: np.ndarray,
    merge_contacts: float,
    max_steps: int,
    width: int = CHUNK,
) -> Periods:
    """Closings and work of each period of motions whose states at the periods' ends are known.

    Parameters
    ----------
    p, e : lanes, every leaf (lanes,)
    times : (lanes, periods + 1), s, the ends of the periods
    states : (4, lanes, periods + 1), X1, Y1, X2, Y2 there; NaN where a run was given up
    merge_contacts : s; an opening shorter than this does not part two contacts
    width : lanes of one call, see ``run_lanes``
    """
    lanes, periods = times.shape[0], times.shape[1] - 1
    begin = tuple(np.nan_to_num(x[:, :-1]).ravel() for x in states)
    p, e = jax.tree.map(lambda leaf: np.repeat(leaf, periods), (p, e))
    spans = np.stack([times[:, :-1].ravel(), times[:, 1:].ravel()], axis=1)
    bound = np.full(lanes * periods, max_steps, np.int32)
    merge = np.full(lanes * periods, merge_contacts)
    happened = run_lanes(_kernel, ((p, e, (begin, merge, bound)), spans), batched=True, width=width)
    closings, lead, opened, work, status = (np.array(x).reshape(lanes, periods) for x in happened)
    last = np.full(lanes, -np.inf)
    for i in range(periods):
        closings[:, i] -= lead[:, i] - last < merge_contacts
        last = np.maximum(last, opened[:, i])
    return Periods(closings, work, status.max(axis=1))


@jax.jit
def _kernel(
    p: CapsuleParameters, e: Excitation, times: jax.Array, given: tuple[Initial, jax.Array, jax.Array]
) -> Happened:
    """What happens in times (L, 2); given: states at the beginning, merge (L,) s, bound (L,) on the steps."""
    initial, merge, bound = given
    rig, end = rig_of(p, e), times[:, 1]
    lanes = start(rig, times[:, 0], end, initial)
    never = jnp.full(end.shape, jnp.inf)
    blank = Happened(lanes.contacts, never, -never, jnp.zeros(end.shape), lanes.status)

    def one(carry: tuple[Lanes, Happened]) -> tuple[Lanes, Happened]:
        lanes, so_far = carry
        after, motion = step(rig, end, bound, lanes)
        return after, _noted(rig, lanes, after, motion, merge, so_far)

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0].active), one, (lanes, blank))[1]


def _noted(rig: Rig, before: Lanes, after: Lanes, motion: Motion, merge: jax.Array, so_far: Happened) -> Happened:
    """``so_far`` with what one step has brought; a lane that is at rest brings nothing."""
    t = after.state.t
    closed, opened = (after.mode.contact & ~before.mode.contact), (before.mode.contact & ~after.mode.contact)
    counted = closed & ~(t - so_far.opened < merge)
    first = closed & jnp.isinf(so_far.opened)
    return Happened(
        so_far.closings + counted,
        jnp.where(first, t, so_far.lead),
        jnp.where(opened, t, so_far.opened),
        so_far.work + jnp.where(before.active, _work(rig, before.state, motion, t), 0.0),
        after.status,
    )


def _work(rig: Rig, state: State, motion: Motion, t: jax.Array) -> jax.Array:
    """(L,) J: work of the drive over the step from ``state`` to the time t, by Gauss-Legendre quadrature."""
    dt = t - state.t

    def power_per_amplitude(node: jax.Array) -> jax.Array:
        since = node * dt
        s = since / motion.h
        cosine, _ = cos_sin(rig.Omega * (state.t + since) + rig.phase)
        return cosine * (horner(motion.w, s) + horner(motion.v, s))

    return dt * rig.P_d * jnp.sum(_WEIGHT[:, None] * jax.vmap(power_per_amplitude)(jnp.asarray(_NODE)), axis=0)
