"""The event-driven engine: Taylor steps inside a mode, located changes of mode, a clock of its own for every lane.

    mode_at -> [series -> trusted -> first_event -> advance -> met -> motion_at] ... -> samples read off the rows

Each lane has its own time, mode and step; one loop runs them all. Derivatives: forward mode goes through the loop. Step
lengths and located times are held constant; at an event the state and the time get one Newton correction, dt = -g/g',
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
from capsule_id.physics.exact.dense import WIDTH, Samples, read_off, row_of, samples_at
from capsule_id.physics.exact.events import GAP, LOWER, NONE, UPPER, VELOCITY, first_event, mode_at, motion_at
from capsule_id.physics.exact.taylor import (
    Mode,
    Motion,
    Rig,
    State,
    advance,
    cos_sin,
    friction,
    rig_of,
    series,
    size,
    spring_force,
    trusted,
)
from capsule_id.physics.model import CapsuleParameters, Excitation, Initial, Status, Trajectory
from capsule_id.precision import require_float64

require_float64()

# Steps kept before samples are read off them; a buffer of this many rows stays in the second-level cache.
ROWS = 64
# An event whose function falls slower than this, relative to the typical size of its rate, counts as grazing.
GRAZING_RATE = 1e-5

# Numbers of samples are padded to this times a power of four.
SHORTEST = 64

Kernel = Callable[[CapsuleParameters, Excitation, jax.Array, Initial], Trajectory]


class Lanes(NamedTuple):
    """Everything that a step changes, every leaf (L,): the state, its mode, and how the run stands."""

    state: State
    mode: Mode
    active: jax.Array
    status: jax.Array
    contacts: jax.Array
    events: jax.Array
    steps: jax.Array


def met(rig: Rig, mode: Mode, motion: Motion, s: jax.Array, at: State, kind: jax.Array) -> tuple[State, jax.Array]:
    """(the state on the event's surface with the event time's tangent, whether the event is grazing).

    s, at : the located time and the state there, in the mode before the event
    """
    stiffness = rig.k1 + jnp.where(mode.contact, rig.k2, 0.0)
    f = spring_force(rig, at, mode.contact)
    a2 = jnp.where(mode.sigma != 0.0, (f - friction(rig, mode.sigma, at.v)[0]) / rig.m2, 0.0)
    w_rate = (rig.P_d * at.C - f) / rig.m1 - a2
    f_rate = stiffness * at.w + rig.c * w_rate
    level = jnp.where(kind == UPPER, -rig.F_b, rig.F_b)
    g = jnp.where(kind == GAP, at.d, jnp.where(kind == VELOCITY, at.v, f + level))
    rate = jnp.where(kind == GAP, at.w, jnp.where(kind == VELOCITY, a2, f_rate))
    f_rates = [k * x for k, x in enumerate(motion.f)][1:]
    onset_or_stop = jnp.where(kind == VELOCITY, (jnp.abs(f) + rig.F_b) / rig.m2, size(f_rates, s) / motion.h)
    typical = jnp.where(kind == GAP, size(motion.w, s), onset_or_stop)
    rate, a2, w_rate, before, typical, Omega = stop_gradient((rate, a2, w_rate, at, typical, rig.Omega))
    grazing = (kind != NONE) & ~(jnp.abs(rate) > GRAZING_RATE * typical)
    dt = -g / jnp.where((kind == NONE) | grazing, jnp.inf, rate)
    return State(
        at.t + dt,
        at.r + before.w * dt,
        jnp.where(kind == GAP, 0.0, at.d + before.w * dt),
        at.w + w_rate * dt,
        at.X2 + before.v * dt,
        jnp.where(kind == VELOCITY, 0.0, at.v + a2 * dt),
        at.C - before.S * (Omega * dt),
        at.S + before.C * (Omega * dt),
    ), grazing


def step(rig: Rig, t_end: jax.Array, max_steps: jax.Array, lanes: Lanes) -> tuple[Lanes, Motion]:
    """One step of every active lane."""
    state, mode, active = lanes.state, lanes.mode, lanes.active
    left = t_end - stop_gradient(state.t)
    motion = series(rig, state, mode, left)
    held = stop_gradient(motion)
    s, kind = first_event(stop_gradient(rig), mode, held, trusted(held), active)
    at = advance(rig, state, motion, s)
    new, grazing = met(rig, mode, motion, s, at, kind)
    finished = (kind == NONE) & (s >= 1.0) & held.last
    new = new._replace(t=jnp.where(finished, t_end, new.t))
    finished = finished | (at.t >= t_end)
    # The gap and the capsule's motion change mode one at a time; what happens at the same instant is met next.
    contact = jnp.where(kind == GAP, new.w > 0.0, mode.contact)
    sigma = motion_at(stop_gradient(rig), stop_gradient(new), mode.contact, (kind == UPPER) | (kind == LOWER))
    after = Mode(contact, jnp.where(kind > GAP, sigma, mode.sigma))
    steps = lanes.steps + active
    finite = jnp.isfinite(at.d + at.w + at.X2 + at.v)
    status = jnp.where(active & grazing, jnp.maximum(lanes.status, Status.GRAZING), lanes.status)
    status = jnp.where(active & ~finished & (steps >= max_steps), jnp.int32(Status.TOO_MANY_STEPS), status)
    status = jnp.where(active & ~finite, jnp.int32(Status.NOT_FINITE), status)
    moved = active & finite
    return Lanes(
        State(*(jnp.where(moved, x, y) for x, y in zip(new, state, strict=True))),
        Mode(*(jnp.where(moved, x, y) for x, y in zip(after, mode, strict=True))),
        active & ~finished & (status <= Status.GRAZING),
        status,
        lanes.contacts + (moved & contact & ~mode.contact),
        lanes.events + (moved & (kind != NONE)),
        steps,
    ), motion


def start(rig: Rig, t: jax.Array, t_end: jax.Array, initial: Initial) -> Lanes:
    """Lanes at t (L,): an initial state that rounding alone keeps off the gap's closing point is put onto it."""
    X1, Y1, X2, Y2 = (jnp.asarray(x) for x in initial)
    d = (X1 - X2) - rig.G
    rounding = 2.0 * jnp.finfo(float).eps * (jnp.abs(X1) + jnp.abs(X2) + rig.G)
    d = jnp.where(jnp.abs(d) <= rounding, d - stop_gradient(d), d)
    state = State(t, X1 - X2, d, Y1 - Y2, X2, Y2, *cos_sin(rig.Omega * t + rig.phase))
    given = jnp.stack([*rig, *state, t_end])
    positive = (rig.m1 > 0.0) & (rig.m2 > 0.0) & (rig.v_s > 0.0)
    not_negative = jnp.all(jnp.stack([rig.k1, rig.k2, rig.c, rig.F_b, rig.G]) >= 0.0, axis=0)
    valid = jnp.all(jnp.isfinite(given), axis=0) & positive & not_negative
    zero = jnp.zeros(d.shape, jnp.int32)
    status = jnp.where(valid, jnp.int32(Status.OK), jnp.int32(Status.INVALID))
    mode = mode_at(stop_gradient(rig), stop_gradient(state))
    return Lanes(state, mode, valid & (t < t_end), status, zero, zero, zero)


def march(
    rig: Rig, t_end: jax.Array, max_steps: jax.Array, lanes: Lanes, length: int
) -> tuple[Lanes, jax.Array, jax.Array]:
    """Up to ``length`` steps: (lanes, rows (length, WIDTH, L), starts (length, L)), see dense.py."""
    L = t_end.shape[0]

    def more(carry: tuple[Lanes, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (carry[3] < length) & jnp.any(carry[0].active)

    def one(carry: tuple[Lanes, jax.Array, jax.Array, jax.Array]) -> tuple[Lanes, jax.Array, jax.Array, jax.Array]:
        lanes, rows, starts, row = carry
        after, motion = step(rig, t_end, max_steps, lanes)
        begin = jnp.where(lanes.active, stop_gradient(lanes.state.t), jnp.inf)
        rows = jax.lax.dynamic_update_index_in_dim(rows, row_of(lanes.state, motion), row, 0)
        return after, rows, jax.lax.dynamic_update_index_in_dim(starts, begin, row, 0), row + 1

    blank = (jnp.zeros((length, WIDTH, L)), jnp.full((length, L), jnp.inf), jnp.int32(0))
    return jax.lax.while_loop(more, one, (lanes, *blank))[:3]


def run(
    p: CapsuleParameters, e: Excitation, times: jax.Array, t_end: jax.Array, initial: Initial, max_steps: jax.Array
) -> Trajectory:
    """The motion of lanes: every leaf (L,), times (L, n); times beyond t_end (L,) are not reached and stay NaN."""
    rig, t_end = rig_of(p, e), stop_gradient(t_end)
    lanes = start(rig, times[:, 0], t_end, initial)
    samples = samples_at(times, initial, lanes.status == Status.OK)
    n = times.shape[1]

    def stretch(carry: tuple[Lanes, Samples]) -> tuple[Lanes, Samples]:
        lanes, rows, starts = march(rig, t_end, max_steps, carry[0], ROWS)
        return lanes, read_off(carry[1], rows, starts, lanes.state.t)

    lanes, samples = jax.lax.while_loop(lambda c: jnp.any(c[0].active), stretch, (lanes, samples))
    X1, Y1, X2, Y2 = (samples.values[:, i, :n] for i in range(4))
    return Trajectory(times, X1, Y1, X2, Y2, lanes.contacts, lanes.status, lanes.steps, lanes.events)


@custom_vmap
def _folding(
    p: CapsuleParameters, e: Excitation, times: jax.Array, t_end: jax.Array, initial: Initial, max_steps: jax.Array
) -> Trajectory:
    return run(p, e, times, t_end, initial, max_steps)


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
    """The engine (p, e, times, initial) -> Trajectory on lanes.

    Concrete times are padded to one of few lengths, so that a new number of samples is seldom a new program.
    """

    def simulate_exact(p: CapsuleParameters, e: Excitation, times: jax.Array, initial: Initial) -> Trajectory:
        L, n = times.shape
        bound, t_end = np.full(L, max_steps, np.int32), times[:, -1]
        if is_traced((p, e, times, initial)):
            return _run(p, e, times, t_end, initial, bound)
        length = next(size for k in range(32) if (size := SHORTEST * 4**k) >= n)
        padded = np.concatenate([times, np.full((L, length - n), np.inf)], axis=1)
        t = _run(p, e, padded, t_end, initial, bound)
        times, X1, Y1, X2, Y2 = (x[:, :n] for x in (t.times, t.X1, t.Y1, t.X2, t.Y2))
        return Trajectory(times, X1, Y1, X2, Y2, t.contacts, t.status, t.steps, t.events)

    return simulate_exact
