"""Adaptive march of lanes through a smooth field by RODAS3, with its derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from capsule_id.physics.batches import folded
from capsule_id.physics.model import Drive, Status

# rosenbrock: One step of RODAS3, the solver of the smoothed model: state, linear algebra, error estimate, step control.
#
# Why this method. The smoothed friction relaxes at the rate F_b / (m2 velocity): 8e3 to 8e5 1/s against 1e2 1/s of
# the rod, so an explicit step is limited by stability while the capsule rests. A Rosenbrock method needs no Newton
# iteration (whose stopping rule would also be differentiated), its Jacobian is exact (forward mode through the
# field), and after X1 and X2 are eliminated by hand each stage solves two equations. Measured on the reference
# cases at equal bias of the mean velocity, steps x field evaluations: RODAS3 2100 x 3, ROS2 3700 x 2, ROS4 2700 x
# 3, RODAS4 2000 x 6.


StateArray = jax.Array  # (4, L): X1, Y1, X2, Y2 of L lanes, m and m/s
# (t, r, Y1, Y2) -> (Y1', X2', Y2'): the field depends on the positions through r = X1 - X2 alone, and X1' = Y1.
Field = Callable[[jax.Array, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]

# RODAS3: order of the method, and the coefficient of the Jacobian in each stage.
_METHOD_ORDER, _GAMMA = 3, 0.5
# Step control, the usual constants: aim 10 % below the tolerance; no change beyond these factors.
_SAFETY, _SHRINK, _GROW = 0.9, 0.2, 5.0


def derivative(field: Field, t: jax.Array, y: StateArray) -> StateArray:
    """dy/dt, (4, L)."""
    Y1_rate, X2_rate, Y2_rate = field(t, y[0] - y[2], y[1], y[3])
    return jnp.stack([y[1], Y1_rate, X2_rate, Y2_rate])


def _stage_solver(
    field: Field, t: jax.Array, y: StateArray, h: jax.Array
) -> tuple[Callable[[StateArray], StateArray], StateArray]:
    """Solver of (1 / (gamma h) - J) u = b with the exact Jacobian J at (t, y), and the partial derivative in time."""
    at = (t, y[0] - y[2], y[1], y[3])
    directions = tuple(jnp.broadcast_to(row[:, None], (4, *t.shape)) for row in jnp.eye(4))
    a, q, b = jax.vmap(lambda *d: jax.jvp(field, at, d)[1])(*directions)
    (a_t, a_r, a_1, a_2), (q_t, q_r, q_1, q_2), (b_t, b_r, b_1, b_2) = a, q, b
    d = 1.0 / (_GAMMA * h)
    # u_r = u_X1 - u_X2 from its own row, then two equations for (u_Y1, u_Y2).
    r_inverse = 1.0 / (d + q_r)
    r_1, r_2 = (1.0 - q_1) * r_inverse, -q_2 * r_inverse
    m11, m12 = d - a_1 - a_r * r_1, -a_2 - a_r * r_2
    m21, m22 = -b_1 - b_r * r_1, d - b_2 - b_r * r_2
    determinant = m11 * m22 - m12 * m21

    def solve(b: StateArray) -> StateArray:
        r_0 = (b[0] - b[2]) * r_inverse
        c1, c2 = b[1] + a_r * r_0, b[3] + b_r * r_0
        u1, u2 = (m22 * c1 - m12 * c2) / determinant, (m11 * c2 - m21 * c1) / determinant
        r = r_0 + r_1 * u1 + r_2 * u2
        return jnp.stack([(b[0] + u1) / d, u1, (b[2] + q_r * r + q_1 * u1 + q_2 * u2) / d, u2])

    return solve, jnp.stack([jnp.zeros_like(t), a_t, q_t, b_t])


def step(field: Field, t: jax.Array, y: StateArray, h: jax.Array) -> tuple[StateArray, StateArray]:
    """State at t + h and its error estimate, (4, L) each.

    RODAS3 (Sandu et al. 1997, "Benchmarking stiff ODE solvers for atmospheric chemistry problems II"): four stages,
    three evaluations of the field, order 3 with an embedded method of order 2, both stiffly accurate and L-stable:
    what relaxes faster than a step is damped to nothing, not reflected.
    """
    solve, f_t = _stage_solver(field, t, y, h)
    f = derivative(field, t, y)
    per_state = h[None]
    i = 1.0 / per_state
    u1 = solve(f + 0.5 * per_state * f_t)
    u2 = solve(f + 1.5 * per_state * f_t + 4.0 * i * u1)
    y3 = y + 2.0 * u1
    u3 = solve(derivative(field, t + h, y3) + i * (u1 - u2))
    y4 = y3 + u3
    u4 = solve(derivative(field, t + h, y4) + i * (u1 - u2 - (8.0 / 3.0) * u3))
    return y4 + u4, u4


def step_factor(error: jax.Array) -> jax.Array:
    """By what the step length changes after a step of this error in units of the tolerance; not finite: shrink."""
    factor = _SAFETY * jnp.maximum(error, (_SAFETY / _GROW) ** _METHOD_ORDER) ** (-1.0 / _METHOD_ORDER)
    return jnp.where(jnp.isfinite(error), jnp.maximum(factor, _SHRINK), _SHRINK)


# march: Adaptive march of lanes through a smooth field, with samples at any times; differentiated in
# ``march_tangents``.
#
#     segment = a bounded number of steps, whose states are kept -> samples inside it by interpolation -> next segment
#
# Every lane has its own time, state and step; lanes are coupled only through "is anybody still running", so a lane's
# numbers do not depend on its neighbours. The memory does not grow with the length of the run.


# Steps between two interpolations of samples: one or two segments hold ten periods; 64 lanes of them fill 5 MB.
STEPS_PER_SEGMENT = 2048
# A lane whose step is rejected as not finite below this fraction of its time cannot be saved by a smaller step.
_LEAST_STEP = 1e-13


class Problem(NamedTuple):
    """What a run is made of besides its inputs; every array is (L,) or ()."""

    field: Callable[..., Field]  # of a time (L,), s, or of nothing: the field on the drive's piece that holds there
    drive: Drive  # the ends of its pieces end steps
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
    covered = problem.drive.covers(t, times[:, -1])
    status = jnp.where(finite & covered & problem.valid, Status.OK, Status.INVALID).astype(jnp.int32)
    zero = jnp.zeros(t.shape, jnp.int32)
    return MarchState(t, y, jnp.broadcast_to(problem.first, t.shape), speed, stretch, zero, (zero, zero), status)


def _advance(problem: Problem, end: jax.Array, lanes: MarchState, max_steps: int) -> MarchState:
    """Try one step in every lane that is still running."""
    t, y = lanes.t, lanes.y
    active = (t < end) & (lanes.status == Status.OK)
    h = jnp.minimum(lanes.h, problem.longest)
    target = jnp.minimum(end, (jnp.inf, *problem.drive.piece(t))[-1])
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

    Rows: (length + 1, 5, L), infinite past the last step tried. Every leaf of system is (L, ...).
    """

    def turned(lanes: MarchState) -> MarchState:
        return lanes._replace(y=lanes.y.T)

    def lanes_first(system: Any, end: jax.Array, lanes: MarchState) -> tuple[jax.Array, MarchState]:
        rows, lanes = _segment(build(system), end, turned(lanes), max_steps, length)
        return jnp.moveaxis(rows, -1, 0), turned(lanes)

    rows, lanes = folded(lanes_first)(system, end, turned(lanes))
    return jnp.moveaxis(rows, 0, -1), turned(lanes)


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


# march tangents: Forward and reverse mode through a march, on the grid of steps that the march itself has chosen.
#
# ``jax.custom_jvp`` states the tangent of a run; the tangent map T is linear and is handed to JAX together with its
# transpose, so that ``jax.jvp``, ``jacfwd``, ``grad`` and ``vjp`` all work and cost a loop over the steps really taken.
# (A plain while loop has no reverse mode; a bounded scan would pay for ``max_steps`` steps in every batched run.)
#
# The derivative is that of the discrete solution: the grid is held fixed, each step and the interpolation are
# differentiated exactly. So both modes agree to rounding, and both agree with the derivative of the smoothed model to
# the accuracy of the solution. The state is stored once a segment; the sweeps march through a segment again to recover
# its grid. First derivatives only.


# The sweeps hold that many states at a time, and at most that many idle steps at the end.
STEPS_PER_CHECKPOINT = 256
Tangent = tuple[Any, StateArray]  # of (system, initial state)


@jax.custom_jvp
def _first_order_only(tree: Any) -> Any:
    return tree


@_first_order_only.defjvp
def _refuse(_primals: tuple[Any], _tangents: tuple[Any]) -> Any:
    raise NotImplementedError("the smoothed model has first derivatives only: take differences of jax.grad instead")


def _tangent_maps(
    build: Build,
    inputs: tuple[Any, jax.Array, StateArray],
    max_steps: int,
) -> tuple[Callable[[Tangent], jax.Array], Callable[[jax.Array], Tangent]]:
    """The linear map from tangents of (system, initial state) to those of the samples (4, L, n), and its transpose."""
    system, times, y = inputs
    end = times[:, -1]

    def piece(
        begin: MarchState,
    ) -> tuple[Callable[[Any, StateArray], tuple[StateArray, jax.Array]], MarchState, jax.Array]:
        """The segment from ``begin`` as a function of (system, state there), its end, and which samples it holds."""
        rows, lanes = segment(build, system, end, begin, max_steps, STEPS_PER_CHECKPOINT)
        return lambda a, b: replay(build(a), b, rows[:, 0], times), lanes, inside(rows, lanes, times)

    def forward(tangent: Tangent) -> jax.Array:
        def body(carry: tuple[MarchState, StateArray, jax.Array]) -> tuple[MarchState, StateArray, jax.Array]:
            lanes, d_y, out = carry
            function, after, held = piece(lanes)
            d_y, d_samples = jax.jvp(function, (system, lanes.y), (tangent[0], d_y))[1]
            return after, d_y, jnp.where(held[None], d_samples, out)  # pyright: ignore[reportReturnType]

        first = jnp.zeros((4, *times.shape)).at[:, :, 0].set(tangent[1])
        carry = (initial_lanes(build(system), times, y), tangent[1], first)
        return jax.lax.while_loop(lambda c: running(end, c[0]), body, carry)[2]

    def backward(cotangent: jax.Array) -> Tangent:
        count, store = checkpoints(build, system, times, y, max_steps, STEPS_PER_CHECKPOINT)

        def body(carry: tuple[jax.Array, Any, StateArray]) -> tuple[jax.Array, Any, StateArray]:
            k, c_system, c_y = carry
            begin = jax.tree.map(lambda rows: rows[k - 1], store)
            function, _, held = piece(begin)
            more, c_y = jax.vjp(function, system, begin.y)[1]((c_y, jnp.where(held[None], cotangent, 0.0)))
            return k - 1, jax.tree.map(jnp.add, c_system, more), c_y

        none = jax.tree.map(jnp.zeros_like, (system, y))
        _, c_system, c_y = jax.lax.while_loop(lambda c: c[0] > 0, body, (count, *none))
        # A lane that has failed has NaN cotangents at samples that no segment holds.
        poison = jnp.where(jnp.any(jnp.isnan(cotangent), axis=(0, 2)), jnp.nan, 0.0)
        lanes_first = jax.tree.map(lambda leaf: leaf + poison.reshape(-1, *[1] * (leaf.ndim - 1)), c_system)
        return lanes_first, c_y + cotangent[:, :, 0] + poison[None]

    return forward, backward


def _apply_linear(
    forward: Callable[[Tangent], jax.Array], backward: Callable[[jax.Array], Tangent], tangent: Tangent, like: jax.Array
) -> jax.Array:
    """``forward(tangent)``, transposed by ``backward``.

    JAX's carrier of a linear map with a transpose of one's own that also batches is ``custom_linear_solve``: the
    solution of [[1, 0], [-T, 1]] (u, v) = (tangent, 0) is (tangent, T tangent). Its ``matvec`` is used only for
    derivatives of the matrix, so for second derivatives, which ``_first_order_only`` refuses; the identity stands in.
    """

    def solve(_: Callable[[Any], Any], b: tuple[Tangent, jax.Array]) -> tuple[Tangent, jax.Array]:
        return b[0], b[1] + forward(b[0])

    def transposed(_: Callable[[Any], Any], b: tuple[Tangent, jax.Array]) -> tuple[Tangent, jax.Array]:
        return jax.tree.map(jnp.add, b[0], backward(b[1])), b[1]

    leaves, structure = jax.tree.flatten((tangent, jnp.zeros_like(like)))
    # The transpose rule wants every part of the right-hand side to depend on the tangents, also those that are zero.
    # A select that never selects makes them so without spreading a NaN from one lane to the others.
    link = jnp.where(False, sum(jnp.sum(leaf) for leaf in leaves), 0.0)
    right_hand_side = jax.tree.unflatten(structure, [leaf + link for leaf in leaves])
    return jax.lax.custom_linear_solve(lambda u: u, right_hand_side, solve, transposed)[1]


def differentiable_run(build: Build, max_steps: int) -> Callable[[Any, jax.Array, StateArray], Record]:
    """``march.run`` with first derivatives in system, times and the initial state, forward and reverse mode.

    A lane that fails has NaN derivatives wherever its samples are NaN.
    """

    @jax.custom_jvp
    def function(system: Any, times: jax.Array, y: StateArray) -> Record:
        return run(build, system, times, y, max_steps)

    @function.defjvp
    def _(
        primals: tuple[Any, jax.Array, StateArray], tangents: tuple[Any, jax.Array, StateArray]
    ) -> tuple[Record, Record]:
        record = function(*primals)
        system, times, y = _first_order_only(primals)
        d_system, d_times, d_y = tangents
        samples = _first_order_only(record.samples)
        field = build(jax.tree.map(lambda leaf: leaf[:, None], system)).field()
        rate = derivative(field, times, samples)
        # A later start from the same state is the same start from a state moved back along the field.
        d_y = d_y - rate[:, :, 0] * d_times[None, :, 0]
        forward, backward = _tangent_maps(build, (system, times, y), max_steps)
        d_samples = _apply_linear(forward, backward, (d_system, d_y), samples) + rate * d_times[None]
        d_samples = d_samples * jnp.where(jnp.isfinite(samples), 1.0, jnp.nan)
        counts = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, jax.dtypes.float0), record[1:])
        return record, Record(d_samples, *counts)

    return function
