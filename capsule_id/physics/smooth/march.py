"""Adaptive march of lanes through a smooth field, with samples at any times; differentiated in ``march_tangents``.

    segment = a bounded number of steps, whose states are kept -> samples inside it by interpolation -> next segment

Every lane has its own time, state and step; lanes are coupled only through "is anybody still running", so a lane's
numbers do not depend on its neighbours. The memory does not grow with the length of the run.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from capsule_id.physics.model import Status
from capsule_id.physics.smooth.rosenbrock import Field, StateArray, step, step_factor

# Steps between two interpolations of samples: one or two segments hold ten periods; 64 lanes of them fill 5 MB.
STEPS_PER_SEGMENT = 2048
# A lane whose step is rejected as not finite below this fraction of its time cannot be saved by a smaller step.
_LEAST_STEP = 1e-13


class Problem(NamedTuple):
    """What a run is made of besides its inputs; every array is (L,) or ()."""

    field: Callable[..., Field]  # of a time (L,), s, or of nothing: the field on the drive's piece that holds there
    piece_end: Callable[[jax.Array], jax.Array] | None  # (L,) s -> (L,) s: the next time at which a step must end
    gaps: tuple[jax.Array, jax.Array]  # m: a closing is r - gap, or -r - back gap, turning from negative
    first: jax.Array  # s: length of the first step tried
    longest: jax.Array  # s: no step is longer (infinity: no bound)
    floors: tuple[jax.Array, jax.Array]  # m/s and m: scales below which velocity and r need no accuracy
    tolerance: jax.Array  # 1: error of a step over the scale reached so far
    valid: jax.Array  # bool: whether the lane may start


Build = Callable[[Any], Problem]  # from system, the pytree in which a run is differentiated


class MarchState(NamedTuple):
    """Where every lane stands: y is (4, L), the others (L,)."""

    t: jax.Array
    y: StateArray
    h: jax.Array
    speed: jax.Array  # largest |velocity| so far: the scale of the error in velocity
    stretch: jax.Array  # largest |r| so far: the scale of the error in r
    steps: jax.Array
    closings: tuple[jax.Array, jax.Array]  # of the gap, of the back gap
    status: jax.Array


class Record(NamedTuple):
    """Samples (X1, Y1, X2, Y2) of shape (4, L, n); per lane the closings of both gaps, the steps tried, the status."""

    samples: jax.Array
    closings: tuple[jax.Array, jax.Array]
    steps: jax.Array
    status: jax.Array


def _grown(speed: jax.Array, stretch: jax.Array, y: StateArray) -> tuple[jax.Array, jax.Array]:
    largest = jnp.maximum(jnp.abs(y[1]), jnp.abs(y[3]))
    return jnp.maximum(speed, largest), jnp.maximum(stretch, jnp.abs(y[0] - y[2]))


def initial_lanes(problem: Problem, times: jax.Array, y: StateArray) -> MarchState:
    """Lanes at times[:, 0]; ``Status.INVALID`` where something is not finite or not admissible."""
    t = times[:, 0]
    floors = [jnp.broadcast_to(floor, t.shape) for floor in problem.floors]
    speed, stretch = _grown(floors[0], floors[1], y)
    finite = jnp.all(jnp.isfinite(times), axis=1) & jnp.all(jnp.isfinite(y), axis=0)
    status = jnp.where(finite & problem.valid, Status.OK, Status.INVALID).astype(jnp.int32)
    zero = jnp.zeros(t.shape, jnp.int32)
    return MarchState(t, y, jnp.broadcast_to(problem.first, t.shape), speed, stretch, zero, (zero, zero), status)


def _advance(problem: Problem, end: jax.Array, lanes: MarchState, max_steps: int) -> MarchState:
    """Try one step in every lane that is still running."""
    t, y = lanes.t, lanes.y
    active = (t < end) & (lanes.status == Status.OK)
    h = jnp.minimum(lanes.h, problem.longest)
    target = end if problem.piece_end is None else jnp.minimum(end, problem.piece_end(t))
    # A rest shorter than a hundredth of a step is taken along, so that no sliver of a step is left at the end.
    last = h * 1.01 >= target - t
    h = jnp.where(active, jnp.where(last, target - t, h), 1.0)
    y_new, defect = step(problem.field(t + 0.5 * h), t, y, h)
    speed, stretch = _grown(lanes.speed, lanes.stretch, y_new)
    velocity_error = jnp.maximum(jnp.abs(defect[1]), jnp.abs(defect[3]))
    # max(velocity_error / speed, r_error / stretch) / tolerance, in one division.
    worse = jnp.maximum(velocity_error * stretch, jnp.abs(defect[0] - defect[2]) * speed)
    error = worse / (speed * stretch * problem.tolerance)
    h_next = h * step_factor(error)
    accepted = active & (error <= 1.0)
    r, r_new = y[0] - y[2], y_new[0] - y_new[2]
    closed = (
        accepted & (before < gap) & (after >= gap)
        for before, after, gap in zip((r, -r), (r_new, -r_new), problem.gaps, strict=True)
    )
    steps = lanes.steps + active
    t_new = jnp.where(accepted, jnp.where(last, target, t + h), t)
    hopeless = active & ~jnp.isfinite(error) & (h < _LEAST_STEP * (jnp.abs(t) + jnp.abs(end)))
    status = jnp.where(hopeless, Status.NOT_FINITE, lanes.status)
    status = jnp.where(active & (steps >= max_steps) & (t_new < end), Status.TOO_MANY_STEPS, status)
    return MarchState(
        t=t_new,
        y=jnp.where(accepted[None], y_new, y),
        h=jnp.where(active, h_next, lanes.h),
        speed=jnp.where(accepted, speed, lanes.speed),
        stretch=jnp.where(accepted, stretch, lanes.stretch),
        steps=steps,
        closings=(lanes.closings[0] + next(closed), lanes.closings[1] + next(closed)),
        status=status.astype(jnp.int32),
    )


def running(end: jax.Array, lanes: MarchState) -> jax.Array:
    """Whether any lane has to go on."""
    return jnp.any((lanes.t < end) & (lanes.status == Status.OK))


def segment(
    build: Build,
    system: Any,
    end: jax.Array,
    lanes: MarchState,
    max_steps: int,
    length: int,
) -> tuple[jax.Array, MarchState]:
    """Try up to ``length`` steps; the rows (t, X1, Y1, X2, Y2) on the way, and where the lanes then stand.

    Rows: (length + 1, 5, L), infinite past the last step tried. Every leaf of system is (L, ...). Under ``jax.vmap`` the
    new axis joins the lanes: batching the loop itself would copy all rows in every step.
    """

    # A tree that holds None cannot be batched and differentiated at once: the system goes in as its leaves.
    leaves, structure = jax.tree.flatten(system)

    @jax.custom_batching.custom_vmap
    def march(leaves: list[jax.Array], end: jax.Array, lanes: MarchState) -> tuple[jax.Array, MarchState]:
        return _segment(build(jax.tree.unflatten(structure, leaves)), end, lanes, max_steps, length)

    @march.def_vmap
    def _(size: int, batched: Any, *given: Any) -> tuple[Any, Any]:
        def whole(leaf: jax.Array, has_axis: bool) -> jax.Array:
            return leaf if has_axis else jnp.broadcast_to(leaf, (size, *leaf.shape))

        def join(leaf: jax.Array, has_axis: bool) -> jax.Array:
            leaf = jnp.moveaxis(whole(leaf, has_axis), 0, -2)
            return leaf.reshape(*leaf.shape[:-2], -1)

        def join_first(leaf: jax.Array, has_axis: bool) -> jax.Array:
            leaf = whole(leaf, has_axis)
            return leaf.reshape(-1, *leaf.shape[2:])

        def split(leaf: jax.Array) -> jax.Array:
            return jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], size, -1), -2, 0)

        # Lanes stand first in the system, whose records have samples behind them, and last in states.
        system = jax.tree.unflatten(structure, map(join_first, given[0], batched[0]))
        end, lanes = jax.tree.map(join, given[1:], tuple(batched)[1:])
        result = jax.tree.map(split, segment(build, system, end, lanes, max_steps, length))
        return result, jax.tree.map(lambda _: True, result)

    return march(leaves, end, lanes)


def _segment(
    problem: Problem, end: jax.Array, lanes: MarchState, max_steps: int, length: int
) -> tuple[jax.Array, MarchState]:
    def put(rows: jax.Array, i: jax.Array, lanes: MarchState) -> jax.Array:
        row = jnp.concatenate([lanes.t[None], lanes.y])
        return jax.lax.dynamic_update_index_in_dim(rows, row, i, 0)

    def body(carry: tuple[jax.Array, jax.Array, MarchState]) -> tuple[jax.Array, jax.Array, MarchState]:
        i, rows, lanes = carry
        lanes = _advance(problem, end, lanes, max_steps)
        return i + 1, put(rows, i + 1, lanes), lanes

    def more(carry: tuple[jax.Array, jax.Array, MarchState]) -> jax.Array:
        return (carry[0] < length) & running(end, carry[2])

    rows = put(jnp.full((length + 1, 5, *end.shape), jnp.inf), jnp.int32(0), lanes)
    _, rows, lanes = jax.lax.while_loop(more, body, (jnp.int32(0), rows, lanes))
    return rows, lanes


def _interpolate(t: jax.Array, y: jax.Array, V2: jax.Array, times: jax.Array) -> jax.Array:
    """States (4, n) of one lane at ``times`` (n,), from rows t (N,), y (N, 4) and X2' (N,), inside the finite rows.

    Positions: the cubic through both ends with their rates; velocities: its derivative. That needs no acceleration,
    which in the stiff phases of rest would be far larger than what the step has used. Where X2' is not Y2 (the gate
    of eq. (2)), their difference is interpolated linearly.
    """
    right = jnp.clip(jnp.searchsorted(t, times, side="left"), 1, t.shape[0] - 1)
    left = right - 1
    h = t[right] - t[left]
    h = jnp.where((h > 0.0) & jnp.isfinite(h), h, 1.0)
    s = (times - t[left]) / h
    w, v0, v1 = s * s * (3.0 - 2.0 * s), s * (1.0 - s) ** 2, s * s * (s - 1.0)
    d, e0, e1 = 6.0 * s * (1.0 - s) / h, (1.0 - s) * (1.0 - 3.0 * s), s * (3.0 * s - 2.0)

    def pair(X: jax.Array, V: jax.Array) -> tuple[jax.Array, jax.Array]:
        X0, V0, V1, rise = X[left], V[left], V[right], X[right] - X[left]
        return X0 + w * rise + h * (v0 * V0 + v1 * V1), d * rise + e0 * V0 + e1 * V1

    idle = y[:, 3] - V2
    X2, moving = pair(y[:, 2], V2)
    return jnp.stack([*pair(y[:, 0], y[:, 1]), X2, moving + (1.0 - s) * idle[left] + s * idle[right]])


def interpolate(field: Field, t: jax.Array, y: jax.Array, times: jax.Array) -> jax.Array:
    """States (4, L, n) at ``times`` (L, n), from rows t (N, L) and y (N, 4, L) of a march through ``field``."""
    V2 = jax.vmap(field)(t, y[:, 0] - y[:, 2], y[:, 1], y[:, 3])[1]
    # Lanes stand last in rows, first in times: rows are written by lane, times are searched by lane.
    return jax.vmap(_interpolate, in_axes=(1, 2, 1, 0), out_axes=1)(t, y, V2, times)


def inside(rows: jax.Array, lanes: MarchState, times: jax.Array) -> jax.Array:
    """Which samples (L, n) fall into the segment that led to ``lanes``."""
    return (times > rows[0, 0][:, None]) & (times <= lanes.t[:, None])


def run(build: Build, system: Any, times: jax.Array, y: StateArray, max_steps: int) -> Record:
    """March all lanes from times[:, 0] to times[:, -1]; samples after a lane's failure are NaN. No derivatives."""
    end = times[:, -1]
    problem = build(system)
    lanes = initial_lanes(problem, times, y)

    def body(carry: tuple[MarchState, jax.Array]) -> tuple[MarchState, jax.Array]:
        rows, lanes = segment(build, system, end, carry[0], max_steps, STEPS_PER_SEGMENT)
        here = inside(rows, lanes, times)[None]
        return lanes, jnp.where(here, interpolate(problem.field(), rows[:, 0], rows[:, 1:], times), carry[1])

    nothing = jnp.full((4, *times.shape), jnp.nan)
    samples = nothing.at[:, :, 0].set(jnp.where((lanes.status == Status.OK)[None], y, jnp.nan))
    lanes, samples = jax.lax.while_loop(lambda carry: running(end, carry[0]), body, (lanes, samples))
    return Record(samples, lanes.closings, lanes.steps, lanes.status)


def checkpoints(
    build: Build,
    system: Any,
    times: jax.Array,
    y: StateArray,
    max_steps: int,
    length: int,
) -> tuple[jax.Array, MarchState]:
    """The number of segments of a run, and the lanes at the start of each, (segments, L) each. No derivatives."""
    end = times[:, -1]
    lanes = initial_lanes(build(system), times, y)
    store = jax.tree.map(lambda leaf: jnp.zeros((-(-max_steps // length), *leaf.shape), leaf.dtype), lanes)

    def body(carry: tuple[jax.Array, MarchState, MarchState]) -> tuple[jax.Array, MarchState, MarchState]:
        k, lanes, store = carry
        store = jax.tree.map(lambda rows, leaf: rows.at[k].set(leaf), store, lanes)
        return k + 1, segment(build, system, end, lanes, max_steps, length)[1], store

    count, _, store = jax.lax.while_loop(lambda c: running(end, c[1]), body, (jnp.int32(0), lanes, store))
    return count, store


def replay(problem: Problem, y: StateArray, t: jax.Array, times: jax.Array) -> tuple[StateArray, jax.Array]:
    """One segment on its known grid: state at its end and samples (4, L, n); differentiable in the problem and y.

    t : (steps + 1, L), the times of the tried steps; no step where the time did not grow.
    """

    @jax.checkpoint
    def one(y: StateArray, span: tuple[jax.Array, jax.Array]) -> tuple[StateArray, StateArray]:
        t, h = span
        taken = jnp.isfinite(h) & (h > 0.0)
        h = jnp.where(taken, h, 1.0)
        y = jnp.where(taken[None], step(problem.field(t + 0.5 * h), t, y, h)[0], y)
        return y, y

    spans = (jnp.where(jnp.isfinite(t[:-1]), t[:-1], 0.0), jnp.diff(t, axis=0))
    y_end, ends = jax.lax.scan(one, y, spans)
    return y_end, interpolate(problem.field(), t, jnp.concatenate([y[None], ends]), times)
