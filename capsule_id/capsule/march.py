"""Adaptive march of lanes through a smooth field, with samples at any times and derivatives in both modes.

    segment = at most SEGMENT steps, whose states are kept -> samples inside it by interpolation -> next segment

Every lane has its own time, state and step; lanes are coupled only through "is anybody still running", so a lane's
numbers do not depend on its neighbours. The memory does not grow with the length of the run.

Derivatives: of the discrete solution on its own grid. The grid (times of the accepted steps) is held fixed, each step
and the interpolation are differentiated exactly, so forward and reverse mode agree to rounding, and both agree with
the derivative of the smooth model within the solver's tolerance. Only the state at the start of each segment is
stored; both sweeps march through a segment again to recover its grid. First derivatives only.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from capsule_id.capsule.model import Status
from capsule_id.capsule.rosenbrock import Field, State, derivative, step, step_factor

# Steps between two interpolations of samples: the states of 64 lanes then fill about half of a second-level cache.
SEGMENT = 256
# A step never spans more than this angle of the drive, so that no stage pair can alias it.
_DRIVE_ANGLE = 0.5
# First step, as a fraction of the fastest time scale known before the run.
_FIRST_STEP = 0.05
# A lane whose step is rejected as not finite below this fraction of its run cannot be saved by a smaller step.
_LEAST_STEP = 1e-13


class Problem(NamedTuple):
    """What a run is made of besides its inputs; all of it depends on ``theta``, the pytree that is differentiated."""

    field: Callable[[Any], Field]
    gap: Callable[[Any], jax.Array]  # (L,), m: a closing is r - gap turning from negative to not negative
    fastest: Callable[[Any], jax.Array]  # (L,), 1/s: estimate of the fastest rate
    drive: Callable[[Any], jax.Array]  # (L,), rad/s
    floors: Callable[[Any], tuple[jax.Array, jax.Array]]  # scales below which velocity and position need no accuracy
    tolerance: Callable[[Any], jax.Array]
    valid: Callable[[Any], jax.Array]  # (L,) bool


class Lanes(NamedTuple):
    """Where every lane stands, (L,) each."""

    t: jax.Array
    y: State
    h: jax.Array
    speed: jax.Array  # largest |velocity| so far: the scale of the error in velocity
    stretch: jax.Array  # largest |r| so far: the scale of the error in r
    steps: jax.Array
    closings: jax.Array
    status: jax.Array


class Record(NamedTuple):
    """Samples y (4, L, n), and per lane closings of the gap, steps tried and status."""

    samples: jax.Array
    closings: jax.Array
    steps: jax.Array
    status: jax.Array


def _scales(lanes_speed: jax.Array, lanes_stretch: jax.Array, y: State) -> tuple[jax.Array, jax.Array]:
    speed = jnp.maximum(lanes_speed, jnp.maximum(jnp.abs(y[1]), jnp.abs(y[3])))
    return speed, jnp.maximum(lanes_stretch, jnp.abs(y[0] - y[2]))


def _start(problem: Problem, theta: Any, t: jax.Array, end: jax.Array, y: State) -> Lanes:  # noqa: ANN401
    speed, stretch = _scales(*(jnp.broadcast_to(x, t.shape) for x in problem.floors(theta)), y)
    zero = jnp.zeros(t.shape, jnp.int32)
    finite = jnp.isfinite(t) & jnp.isfinite(end) & jnp.all(jnp.isfinite(jnp.stack(y)), axis=0)
    status = jnp.where(finite & problem.valid(theta), Status.OK, Status.INVALID).astype(jnp.int32)
    h = _FIRST_STEP / problem.fastest(theta)
    return Lanes(t, y, h, speed, stretch, zero, zero, status)


def _advance(problem: Problem, theta: Any, end: jax.Array, lanes: Lanes, max_steps: int) -> Lanes:  # noqa: ANN401
    """Try one step in every lane that is still running."""
    t, y = lanes.t, lanes.y
    running = (t < end) & (lanes.status == Status.OK)
    longest = jnp.minimum(lanes.h, _DRIVE_ANGLE / jnp.maximum(problem.drive(theta), problem.fastest(theta) * 1e-9))
    # A rest shorter than a hundredth of a step is taken along, so that no sliver of a step is left at the end.
    last = longest * 1.01 >= end - t
    h = jnp.where(running, jnp.where(last, end - t, longest), 1.0)
    y_new, defect = step(problem.field(theta), t, y, h)
    speed, stretch = _scales(lanes.speed, lanes.stretch, y_new)
    velocity_error = jnp.maximum(jnp.abs(defect[1]), jnp.abs(defect[3])) / speed
    error = jnp.maximum(velocity_error, jnp.abs(defect[0] - defect[2]) / stretch) / problem.tolerance(theta)
    factor = step_factor(error)
    accepted = running & (error <= 1.0)
    h_next = jnp.where(accepted & last, jnp.maximum(lanes.h, h * factor), h * factor)
    gap = problem.gap(theta)
    closing = accepted & (y[0] - y[2] < gap) & (y_new[0] - y_new[2] >= gap)
    steps = lanes.steps + running
    hopeless = running & ~jnp.isfinite(error) & (h < _LEAST_STEP * (jnp.abs(t) + jnp.abs(end)))
    t_new = jnp.where(accepted, jnp.where(last, end, t + h), t)
    status = jnp.where(hopeless, Status.NOT_FINITE, lanes.status)
    status = jnp.where(running & (steps >= max_steps) & (t_new < end), Status.TOO_MANY_STEPS, status)
    return Lanes(
        t=t_new,
        y=_where(accepted, y_new, y),
        h=jnp.where(running, h_next, lanes.h),
        speed=jnp.where(accepted, speed, lanes.speed),
        stretch=jnp.where(accepted, stretch, lanes.stretch),
        steps=steps,
        closings=lanes.closings + closing,
        status=status.astype(jnp.int32),
    )


def _where(chosen: jax.Array, new: State, old: State) -> State:
    return tuple(jnp.where(chosen, a, b) for a, b in zip(new, old, strict=True))  # pyright: ignore[reportReturnType]


def segment(
    problem: Problem,
    theta: Any,  # noqa: ANN401
    end: jax.Array,
    lanes: Lanes,
    max_steps: int,
) -> tuple[jax.Array, Lanes]:
    """Up to SEGMENT tried steps; rows (SEGMENT + 1, 5, L) of (t, X1, Y1, X2, Y2), t = infinity past the last one."""
    rows = jnp.full((SEGMENT + 1, 5, *end.shape), jnp.inf)

    def put(rows: jax.Array, i: jax.Array, lanes: Lanes) -> jax.Array:
        return rows.at[i].set(jnp.stack([lanes.t, *lanes.y]))

    def body(carry: tuple[jax.Array, jax.Array, Lanes]) -> tuple[jax.Array, jax.Array, Lanes]:
        i, rows, lanes = carry
        lanes = _advance(problem, theta, end, lanes, max_steps)
        return i + 1, put(rows, i + 1, lanes), lanes

    def more(carry: tuple[jax.Array, jax.Array, Lanes]) -> jax.Array:
        return (carry[0] < SEGMENT) & _running(end, carry[2])

    start = (jnp.int32(0), put(rows, jnp.int32(0), lanes), lanes)
    _, rows, lanes = jax.lax.while_loop(more, body, start)
    return rows, lanes


def _running(end: jax.Array, lanes: Lanes) -> jax.Array:
    return jnp.any((lanes.t < end) & (lanes.status == Status.OK))


def _interpolate(t: jax.Array, y: jax.Array, times: jax.Array) -> jax.Array:
    """States (4, n) of one lane at ``times`` (n,), from rows t (S,) and y (S, 4), wherever t[0] < times <= last t.

    Positions: the cubic through both ends with their velocities; velocities: its derivative. That needs no
    acceleration, which in the stiff phases of rest would be far larger than what the step has used.
    """
    right = jnp.clip(jnp.searchsorted(t, times, side="left"), 1, t.shape[0] - 1)
    left = right - 1
    h = t[right] - t[left]
    h = jnp.where((h > 0.0) & jnp.isfinite(h), h, 1.0)
    s = (times - t[left]) / h
    a, b = y[left].T, y[right].T
    w, v0, v1 = s * s * (3.0 - 2.0 * s), s * (1.0 - s) ** 2, s * s * (s - 1.0)
    d, e0, e1 = 6.0 * s * (1.0 - s) / h, (1.0 - s) * (1.0 - 3.0 * s), s * (3.0 * s - 2.0)

    def pair(x: int) -> tuple[jax.Array, jax.Array]:
        rise = b[x] - a[x]
        return a[x] + w * rise + h * (v0 * a[x + 1] + v1 * b[x + 1]), d * rise + e0 * a[x + 1] + e1 * b[x + 1]

    return jnp.stack([*pair(0), *pair(2)])


_interpolate_lanes = jax.vmap(_interpolate, in_axes=(1, 2, 0), out_axes=1)


def inside(lanes: Lanes, rows: jax.Array, times: jax.Array) -> jax.Array:
    """Which samples (L, n) fall into the segment that led to ``lanes``."""
    return (times > rows[0, 0][:, None]) & (times <= lanes.t[:, None])


def _first_sample(times: jax.Array, y: State, status: jax.Array) -> jax.Array:
    """(4, L, n): the initial state at times[0] of lanes that may start, NaN elsewhere."""
    nothing = jnp.full((4, *times.shape), jnp.nan)
    return nothing.at[:, :, 0].set(jnp.where(status == Status.OK, jnp.stack(y), jnp.nan))


def run(problem: Problem, theta: Any, times: jax.Array, y: State, max_steps: int) -> Record:  # noqa: ANN401
    """March all lanes from times[:, 0] to times[:, -1]; samples after a lane's failure are NaN. No derivatives."""
    end = times[:, -1]
    lanes = _start(problem, theta, times[:, 0], end, y)

    def body(carry: tuple[Lanes, jax.Array]) -> tuple[Lanes, jax.Array]:
        rows, lanes = segment(problem, theta, end, carry[0], max_steps)
        states = _interpolate_lanes(rows[:, 0], rows[:, 1:], times)
        return lanes, jnp.where(inside(lanes, rows, times), states, carry[1])

    samples = _first_sample(times, y, lanes.status)
    lanes, samples = jax.lax.while_loop(lambda carry: _running(end, carry[0]), body, (lanes, samples))
    return Record(samples, lanes.closings, lanes.steps, lanes.status)


def checkpoints(
    problem: Problem,
    theta: Any,  # noqa: ANN401
    times: jax.Array,
    y: State,
    max_steps: int,
) -> tuple[jax.Array, Lanes]:
    """The number of segments, and the lanes at the start of each, (segments, L) each. No derivatives."""
    end = times[:, -1]
    lanes = _start(problem, theta, times[:, 0], end, y)
    most = -(-max_steps // SEGMENT)
    store = jax.tree.map(lambda leaf: jnp.zeros((most, *leaf.shape), leaf.dtype), lanes)

    def body(carry: tuple[jax.Array, Lanes, Lanes]) -> tuple[jax.Array, Lanes, Lanes]:
        k, lanes, store = carry
        store = jax.tree.map(lambda rows, leaf: rows.at[k].set(leaf), store, lanes)
        return k + 1, segment(problem, theta, end, lanes, max_steps)[1], store

    count, _, store = jax.lax.while_loop(lambda c: _running(end, c[1]), body, (jnp.int32(0), lanes, store))
    return count, store


def replay(problem: Problem, theta: Any, y: State, t: jax.Array, times: jax.Array) -> tuple[State, jax.Array]:  # noqa: ANN401
    """One segment on its known grid: state at its end and samples (4, L, n), differentiable in theta and y.

    t : (SEGMENT + 1, L), the times of the tried steps; no step where the time did not grow.
    """

    @jax.checkpoint
    def one(y: State, span: tuple[jax.Array, jax.Array]) -> tuple[State, jax.Array]:
        t, h = span
        taken = jnp.isfinite(h) & (h > 0.0)
        y = _where(taken, step(problem.field(theta), t, y, jnp.where(taken, h, 1.0))[0], y)
        return y, jnp.stack(y)

    h = jnp.diff(t, axis=0)
    y_end, rows = jax.lax.scan(one, y, (jnp.where(jnp.isfinite(t[:-1]), t[:-1], 0.0), h))
    rows = jnp.concatenate([jnp.stack(y)[None], rows])
    return y_end, _interpolate_lanes(t, rows, times)
