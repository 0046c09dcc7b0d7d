"""The event-driven engine: Taylor steps inside a mode, located changes of mode, a clock of its own for every lane.

    mode_at -> [series -> trusted -> first_event -> advance -> correct -> motion_at] ... -> samples read off the rows

Each lane has its own time, mode and step; one loop runs them all. Derivatives: forward mode goes through the loop. Step
lengths and located times are held constant. At an event the state and the time get one Newton correction, dt = -g/g',
whose value is next to nothing and whose tangent is the event's own (the saltation matrix).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.lax import stop_gradient

from capsule_id.physics.batches import is_traced
from capsule_id.physics.drive import Drive
from capsule_id.physics.exact.dense import WIDTH, Samples, read_off, row_of, samples_at
from capsule_id.physics.exact.events import GAP, NONE, UPPER, VELOCITY, first_event, mode_at, motion_at
from capsule_id.physics.exact.taylor import (
    CapsuleState,
    Constants,
    Mode,
    StepSeries,
    advance,
    constants_of,
    rod_force,
    series,
    size,
    stiffness_of,
    trusted,
)
from capsule_id.physics.friction import FrictionLaw, sliding_friction
from capsule_id.physics.model import CapsuleParameters, Initial, Status, Trajectory, admissible
from capsule_id.precision import require_float64

require_float64()

# Steps kept before samples are read off them; a buffer of this many rows stays in the second-level cache.
ROWS = 64
# An event whose function falls slower than this, relative to the typical size of its rate, counts as grazing.
GRAZING_RATE = 1e-5

# Numbers of samples are padded to this times a power of four.
SHORTEST = 64

Kernel = Callable[[CapsuleParameters, Drive, FrictionLaw, Initial, jax.Array], Trajectory]


class RunState(NamedTuple):
    """Everything that a step changes, every leaf (L,): the state, its mode, and the progress of the run."""

    state: CapsuleState
    mode: Mode
    active: jax.Array
    status: jax.Array
    contacts: jax.Array
    events: jax.Array
    steps: jax.Array


def correct(
    constants: Constants, mode: Mode, step: StepSeries, s: jax.Array, at: CapsuleState, kind: jax.Array
) -> tuple[CapsuleState, jax.Array]:
    """(the state on the event's surface with the event time's tangent, whether the event is grazing).

    s, at : the located time and the state there, in the mode before the event
    """
    f = rod_force(constants, at, mode.contact)
    acceleration = (f - sliding_friction(constants.law, mode.sigma, at.v)) / constants.m2
    a2 = jnp.where(mode.sigma != 0.0, acceleration, 0.0)
    w_rate = (constants.drive.value(at.drive) - f) / constants.m1 - a2
    f_rate = stiffness_of(constants, mode.contact) * at.w + constants.c * w_rate
    level = jnp.where(kind == UPPER, -constants.F_forward, constants.F_backward)
    g = jnp.where(kind == GAP, at.d, jnp.where(kind == VELOCITY, at.v, f + level))
    rate = jnp.where(kind == GAP, at.w, jnp.where(kind == VELOCITY, a2, f_rate))
    f_rates = [k * x for k, x in enumerate(step.f)][1:]
    braking = (jnp.abs(f) + jnp.maximum(constants.F_forward, constants.F_backward)) / constants.m2
    onset_or_stop = jnp.where(kind == VELOCITY, braking, size(f_rates, s) / step.h)
    typical = jnp.where(kind == GAP, size(step.w, s), onset_or_stop)
    rate, a2, w_rate, before, typical = stop_gradient((rate, a2, w_rate, at, typical))
    grazing = (kind != NONE) & ~(jnp.abs(rate) > GRAZING_RATE * typical)
    dt = -g / jnp.where((kind == NONE) | grazing, jnp.inf, rate)
    return CapsuleState(
        at.t + dt,
        at.r + before.w * dt,
        jnp.where(kind == GAP, 0.0, at.d + before.w * dt),
        at.w + w_rate * dt,
        at.X2 + before.v * dt,
        jnp.where(kind == VELOCITY, 0.0, at.v + a2 * dt),
        constants.drive.shifted(at.drive, dt),
    ), grazing


def take_step(
    constants: Constants, t_end: jax.Array, max_steps: jax.Array, run: RunState
) -> tuple[RunState, StepSeries]:
    """One step of every active lane."""
    state, mode, active = run.state, run.mode, run.active
    left = t_end - stop_gradient(state.t)
    step = series(constants, state, mode, left)
    held = stop_gradient(step)
    s, kind = first_event(stop_gradient(constants), mode, held, trusted(held), active)
    at = advance(constants, state, step, s)
    new, grazing = correct(constants, mode, step, s, at, kind)
    finished = (kind == NONE) & (s >= 1.0) & held.last
    new = new._replace(t=jnp.where(finished, t_end, new.t))
    finished = finished | (at.t >= t_end)
    # The gap and the capsule's motion change mode one at a time; a second event at the same instant follows next.
    contact = jnp.where(kind == GAP, new.w > 0.0, mode.contact)
    sigma = motion_at(stop_gradient(constants), stop_gradient(new), mode.contact, kind)
    after = Mode(contact, jnp.where(kind > GAP, sigma, mode.sigma))
    steps = run.steps + active
    finite = jnp.isfinite(at.d + at.w + at.X2 + at.v)
    status = jnp.where(active & grazing, jnp.maximum(run.status, Status.GRAZING), run.status)
    status = jnp.where(active & ~finished & (steps >= max_steps), jnp.int32(Status.TOO_MANY_STEPS), status)
    status = jnp.where(active & ~finite, jnp.int32(Status.NOT_FINITE), status)
    moved = active & finite
    state, mode = jax.tree.map(lambda x, y: jnp.where(moved, x, y), (new, after), (state, mode))
    return RunState(
        state,
        mode,
        active & ~finished & (status <= Status.GRAZING),
        status,
        run.contacts + (moved & contact & ~run.mode.contact),
        run.events + (moved & (kind != NONE)),
        steps,
    ), step


def initial_lanes(
    p: CapsuleParameters, constants: Constants, t: jax.Array, t_end: jax.Array, initial: Initial
) -> RunState:
    """Runs at t (L,), s. A gap that is zero within rounding is set to exactly zero."""
    X1, Y1, X2, Y2 = (jnp.asarray(x) for x in initial)
    d = (X1 - X2) - constants.G
    rounding = 2.0 * jnp.finfo(float).eps * (jnp.abs(X1) + jnp.abs(X2) + constants.G)
    d = jnp.where(jnp.abs(d) <= rounding, d - stop_gradient(d), d)
    state = CapsuleState(t, X1 - X2, d, Y1 - Y2, X2, Y2, constants.drive.state(t))
    given = jnp.stack([*jax.tree.leaves(state), t_end])
    valid = jnp.all(jnp.isfinite(given), axis=0) & admissible(p, constants.drive, constants.law)
    zero = jnp.zeros(d.shape, jnp.int32)
    status = jnp.where(valid, jnp.int32(Status.OK), jnp.int32(Status.INVALID))
    mode = mode_at(stop_gradient(constants), stop_gradient(state))
    return RunState(state, mode, valid & (t < t_end), status, zero, zero, zero)


def march(
    constants: Constants, t_end: jax.Array, max_steps: jax.Array, lanes: RunState, length: int
) -> tuple[RunState, jax.Array, jax.Array]:
    """Up to ``length`` steps: (lanes, rows (length, WIDTH, L), starts (length, L)), see dense.py."""
    L = t_end.shape[0]

    def more(carry: tuple[RunState, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (carry[3] < length) & jnp.any(carry[0].active)

    def one(
        carry: tuple[RunState, jax.Array, jax.Array, jax.Array],
    ) -> tuple[RunState, jax.Array, jax.Array, jax.Array]:
        lanes, rows, starts, row = carry
        after, step = take_step(constants, t_end, max_steps, lanes)
        begin = jnp.where(lanes.active, stop_gradient(lanes.state.t), jnp.inf)
        rows = jax.lax.dynamic_update_index_in_dim(rows, row_of(lanes.state, step), row, 0)
        return after, rows, jax.lax.dynamic_update_index_in_dim(starts, begin, row, 0), row + 1

    blank = (jnp.zeros((length, WIDTH, L)), jnp.full((length, L), jnp.inf), jnp.int32(0))
    return jax.lax.while_loop(more, one, (lanes, *blank))[:3]


def run(
    p: CapsuleParameters,
    e: Drive,
    law: FrictionLaw,
    initial: Initial,
    times: jax.Array,
    t_end: jax.Array,
    max_steps: jax.Array,
) -> Trajectory:
    """The motion of lanes: every leaf (L,), times (L, n); times beyond t_end (L,) are not reached and stay NaN.

    Seven arguments, because the engine's inputs are unpacked.
    """
    constants, t_end = constants_of(p, e, law), stop_gradient(t_end)
    lanes = initial_lanes(p, constants, times[:, 0], t_end, initial)
    samples = samples_at(times, initial, lanes.status == Status.OK)
    n = times.shape[1]

    def stretch(carry: tuple[RunState, Samples]) -> tuple[RunState, Samples]:
        lanes, rows, starts = march(constants, t_end, max_steps, carry[0], ROWS)
        return lanes, read_off(carry[1], rows, starts, lanes.state.t)

    lanes, samples = jax.lax.while_loop(lambda c: jnp.any(c[0].active), stretch, (lanes, samples))
    X1, Y1, X2, Y2 = (samples.values[:, i, :n] for i in range(4))
    return Trajectory(times, X1, Y1, X2, Y2, lanes.contacts, lanes.status, lanes.steps, lanes.events)


_folding = custom_vmap(run)


@_folding.def_vmap
def _fold(size: int, batched: list[object], *args: object) -> tuple[Trajectory, Trajectory]:
    """Fold a new axis into the lanes: a loop inside a loop over lanes would copy its buffers at every step."""
    flat, structure = jax.tree.flatten(args)
    flags = jax.tree.leaves(batched)
    if not any(flags):
        out = run(*args)  # pyright: ignore[reportArgumentType]
        return out, jax.tree.map(lambda _: False, out)
    full = [x if flag else jnp.broadcast_to(x, (size, *x.shape)) for x, flag in zip(flat, flags, strict=True)]
    L = full[0].shape[1]
    lanes = jax.tree.unflatten(structure, [x.reshape(size * L, *x.shape[2:]) for x in full])
    out = jax.tree.map(lambda x: x.reshape(size, L, *x.shape[1:]), _folding(*lanes))
    return out, jax.tree.map(lambda _: True, out)


_run = jax.jit(_folding)


def kernel(max_steps: int) -> Kernel:
    """The engine (p, e, law, initial, times) -> Trajectory on lanes.

    Concrete times are padded to one of few lengths, so that a new number of samples is seldom a new program.
    """

    def simulate_exact(
        p: CapsuleParameters, e: Drive, law: FrictionLaw, initial: Initial, times: jax.Array
    ) -> Trajectory:
        L, n = times.shape
        bound, t_end = np.full(L, max_steps, np.int32), times[:, -1]
        if is_traced((p, e, law, initial, times)):
            return _run(p, e, law, initial, times, t_end, bound)
        length = next(size for k in range(32) if (size := SHORTEST * 4**k) >= n)
        padded = np.concatenate([times, np.full((L, length - n), np.inf)], axis=1)
        t = _run(p, e, law, initial, padded, t_end, bound)
        times, X1, Y1, X2, Y2 = (x[:, :n] for x in (t.times, t.X1, t.Y1, t.X2, t.Y2))
        return Trajectory(times, X1, Y1, X2, Y2, t.contacts, t.status, t.steps, t.events)

    return simulate_exact
