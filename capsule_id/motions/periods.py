"""What happens within single periods of the drive: closings of the gap, and the work of the drive.

Every period of every motion is a lane of its own, started from the state at its beginning, so that 48 periods of one
motion are computed side by side. An opening in one period and the closing that follows in the next are joined
afterwards.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.physics.batches import CHUNK, run_lanes
from capsule_id.physics.drive import Drive
from capsule_id.physics.exact.engine import RunState, initial_lanes, take_step
from capsule_id.physics.exact.taylor import CapsuleState, Constants, StepSeries, constants_of
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Initial
from capsule_id.physics.series import horner

# Quadrature nodes per step for the drive's work: exact up to degree 15, where the series of velocity end at 12.
_NODE, _WEIGHT = (0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(8), (1.0, 0.0), strict=True))


class SpanRecord(NamedTuple):
    """Contacts and work of one span per lane, every leaf (L,).

    closings : closings of the gap, those after an opening shorter than ``merge`` left out
    lead : time of the first closing if no opening stands before it in the span, else inf
    opened : time of the last opening, -inf if there is none
    work : of the drive on rod and capsule, J
    status : a ``Status`` code
    """

    closings: jax.Array
    lead: jax.Array
    opened: jax.Array
    work: jax.Array
    status: jax.Array


class PeriodRecords(NamedTuple):
    """closings (lanes, periods), int; work (lanes, periods), J; status (lanes,), the gravest of the periods."""

    closings: np.ndarray
    work: np.ndarray
    status: np.ndarray


def observe(
    p: CapsuleParameters,
    e: Drive,
    law: FrictionLaw,
    times: np.ndarray,
    states: np.ndarray,
    merge_contacts: float,
    max_steps: int,
    width: int = CHUNK,
) -> PeriodRecords:
    """Closings and work of each period of motions whose states at the periods' ends are known.

    Parameters
    ----------
    p, e, law : lanes, every leaf (lanes,); seven arguments, because the engine's inputs are unpacked
    times : (lanes, periods + 1), s, the ends of the periods
    states : (4, lanes, periods + 1), X1, Y1, X2, Y2 there; NaN where a run was given up
    merge_contacts : s; an opening shorter than this does not part two contacts
    width : lanes of one call, see ``run_lanes``
    """
    lanes, periods = times.shape[0], times.shape[1] - 1
    begin = tuple(np.nan_to_num(x[:, :-1]).ravel() for x in states)
    p, e, law = jax.tree.map(lambda leaf: np.repeat(leaf, periods), (p, e, law))
    spans = np.stack([times[:, :-1].ravel(), times[:, 1:].ravel()], axis=1)
    bound = np.full(lanes * periods, max_steps, np.int32)
    merge = np.full(lanes * periods, merge_contacts)
    spans_of_lanes = run_lanes(_kernel, (p, e, law, (begin, merge, bound)), spans, batched=True, width=width)
    closings, lead, opened, work, status = (np.array(x).reshape(lanes, periods) for x in spans_of_lanes)
    last = np.full(lanes, -np.inf)
    for i in range(periods):
        closings[:, i] -= lead[:, i] - last < merge_contacts
        last = np.maximum(last, opened[:, i])
    return PeriodRecords(closings, work, status.max(axis=1))


@jax.jit
def _kernel(
    p: CapsuleParameters,
    e: Drive,
    law: FrictionLaw,
    given: tuple[Initial, jax.Array, jax.Array],
    times: jax.Array,
) -> SpanRecord:
    """Contacts and work in times (L, 2); given: states at the beginning, merge (L,) s, bound (L,) on the steps."""
    initial, merge, bound = given
    constants, end = constants_of(p, e, law), times[:, 1]
    lanes = initial_lanes(p, constants, times[:, 0], end, initial)
    never = jnp.full(end.shape, jnp.inf)
    blank = SpanRecord(lanes.contacts, never, -never, jnp.zeros(end.shape), lanes.status)

    def one(carry: tuple[RunState, SpanRecord]) -> tuple[RunState, SpanRecord]:
        lanes, record = carry
        after, step = take_step(constants, end, bound, lanes)
        return after, _with_step(constants, lanes, after, step, merge, record)

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0].active), one, (lanes, blank))[1]


def _with_step(
    constants: Constants, before: RunState, after: RunState, step: StepSeries, merge: jax.Array, record: SpanRecord
) -> SpanRecord:
    """``record`` with one step added; a lane that has ended adds nothing."""
    t = after.state.t
    closed, opened = (after.mode.contact & ~before.mode.contact), (before.mode.contact & ~after.mode.contact)
    counted = closed & ~(t - record.opened < merge)
    first = closed & jnp.isinf(record.opened)
    return SpanRecord(
        record.closings + counted,
        jnp.where(first, t, record.lead),
        jnp.where(opened, t, record.opened),
        record.work + jnp.where(before.active, _work(constants.drive, before.state, step, t), 0.0),
        after.status,
    )


def _work(drive: Drive, state: CapsuleState, step: StepSeries, t: jax.Array) -> jax.Array:
    """(L,) J: work of the drive over the step from ``state`` to the time t, by Gauss-Legendre quadrature."""
    dt = t - state.t

    def power(node: jax.Array) -> jax.Array:
        since = node * dt
        s = since / step.h
        Y2 = horner(step.v, s)
        driven = horner(step.w, s) + Y2
        driven = driven if drive.reaction is None else driven - drive.reaction * Y2
        return drive.value(drive.advanced(state.drive, state.t + since, since)) * driven

    return dt * jnp.sum(_WEIGHT[:, None] * jax.vmap(power)(jnp.asarray(_NODE)), axis=0)
