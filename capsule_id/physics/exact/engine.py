"""The event-driven engine: Taylor steps inside a mode, located changes of mode."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.lax import stop_gradient
from jaxtyping import Bool, Float, Int

from capsule_id.physics.batches import folded, is_traced
from capsule_id.physics.exact.taylor import (
    GAP,
    LOWER,
    NONE,
    SWITCH,
    UPPER,
    VELOCITY,
    CapsuleState,
    Constants,
    Mode,
    StepSeries,
    advance,
    constants_of,
    driven,
    first_event,
    force_rate,
    mode_at,
    motion_at,
    series,
    size,
    touching,
    trusted,
)
from capsule_id.physics.forces import DEGREE, Force, FrictionLaw, Scaled, horner, mean, sliding_friction
from capsule_id.physics.model import CapsuleParameters, Drive, Initial, Status, Trajectory, admissible

# one function: A program that XLA compiles as one function on a CPU.


#: XLA emits a call with these attributes as one function, as it does itself with loops that need little memory. Its
#: runtime dispatches the parts of all other loops one by one in every step, which takes several times as long.
ONE_FUNCTION = {"xla_cpu_small_call": "true", "inlineable": "false"}


def as_one_function(run: Callable[..., Any]) -> Callable[..., tuple[Any, jax.Array]]:
    """``run``, jitted, on a CPU as one function. It takes concrete arguments, no empty arrays, and also returns a number.

    XLA cannot emit every operation this way: scatter, sort and calls of libraries are errors.
    """

    @jax.jit
    def call(*args: Any) -> tuple[Any, jax.Array]:
        with set_xla_metadata(**dict.fromkeys(ONE_FUNCTION)):
            # XLA ends the process where such a call leaves an argument without use: each one enters the number.
            return run(*args), sum((jnp.ravel(x)[0].astype(float) for x in jax.tree.leaves(args)), jnp.zeros(()))

    @jax.jit
    def program(*args: Any) -> tuple[Any, jax.Array]:
        with set_xla_metadata(**(ONE_FUNCTION if jax.default_backend() == "cpu" else {})):
            return call(*args)

    return program


# dense output: The steps' polynomials are kept in rows, and samples are read off them window by window.
#
# rows (K, WIDTH, L): per step t0, h, r, X2 at its start and the series of w and v; starts (K, L): t0 again, inf where a
# lane took no step. Each lane has its own pointer to its next sample, since lanes advance at their own pace.


# Numbers in a row: t0, h, r, X2, and two series.
WIDTH = 4 + 2 * (DEGREE + 1)
# Samples of a lane read off at once.
WINDOW = 64
# (L, 4, n + WINDOW) X1, Y1, X2, Y2 at the times (L, n + WINDOW), padded with inf; (L,) int32, the next sample.
Samples = tuple[Float[jax.Array, "L 4 padded"], Int[jax.Array, " L"]]


def first_samples(times: Float[jax.Array, "L n"], initial: Initial, valid: Bool[jax.Array, " L"]) -> Samples:
    """No sample taken yet but the first, which is the initial state."""
    values = jnp.full((len(times), 4, times.shape[1] + WINDOW), jnp.nan)
    first = jnp.where(valid[:, None], jnp.stack([jnp.asarray(x) for x in initial], axis=1), jnp.nan)
    return values.at[:, :, 0].set(first), jnp.ones(len(times), jnp.int32)


def values_of(row: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """(X1, Y1, X2, Y2) at t from rows (WIDTH, ...)."""
    w, v = list(row[4 : 5 + DEGREE]), list(row[5 + DEGREE :])
    s = (t - row[0]) / row[1]
    r, X2 = row[2] + (t - row[0]) * mean(w, s), row[3] + (t - row[0]) * mean(v, s)
    Y2 = horner(v, s)
    return X2 + r, horner(w, s) + Y2, X2, Y2


def _row_at(starts: Float[jax.Array, "K L"], t: Float[jax.Array, "L window"]) -> Int[jax.Array, "L window"]:
    """(L, WINDOW) int32: the last row that starts at or before t (L, WINDOW), by bisection in starts (K, L)."""
    lane = jnp.arange(t.shape[0])[:, None]
    length = starts.shape[0]

    def halve(i: jax.Array, index: jax.Array) -> jax.Array:
        probe = index + (1 << (length - 1).bit_length()) // (2 << i)
        return jnp.where((probe < length) & (starts[jnp.minimum(probe, length - 1), lane] <= t), probe, index)

    return jax.lax.fori_loop(0, (length - 1).bit_length(), halve, jnp.zeros(t.shape, jnp.int32))


def read_off(
    times: Float[jax.Array, "L padded"],
    samples: Samples,
    rows: Float[jax.Array, "K width L"],
    starts: Float[jax.Array, "K L"],
    reached: Float[jax.Array, " L"],
) -> Samples:
    """Take every sample up to ``reached`` (L,) off the rows."""
    starts, reached = jax.lax.stop_gradient((starts, reached))
    L, length = times.shape
    # A row's coefficients side by side: read one lane at a time they would each cost a line of the cache.
    table = jnp.reshape(jnp.swapaxes(rows, 1, 2), (-1, WIDTH))
    slice_times = jax.vmap(lambda row, at: jax.lax.dynamic_slice(row, (at,), (WINDOW,)))
    write = jax.vmap(lambda out, x, at: jax.lax.dynamic_update_slice(out, x, (jnp.int32(0), at)))

    def pending(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        _, at = carry
        upcoming = jnp.take_along_axis(times, jnp.minimum(at, length - 1)[:, None], axis=1)[:, 0]
        return jnp.any(upcoming <= reached)

    def window(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        values, at = carry
        t = slice_times(times, at)
        covered = t <= reached[:, None]
        row = table[_row_at(starts, jax.lax.stop_gradient(t)) * L + jnp.arange(L, dtype=jnp.int32)[:, None]]
        taken = jnp.stack(values_of(jnp.moveaxis(row, -1, 0), jnp.where(covered, t, 0.0)), axis=1)
        taken = jnp.where(covered[:, None, :], taken, jnp.nan)
        return write(values, taken, at), at + jnp.sum(covered, axis=1, dtype=jnp.int32)

    return jax.lax.while_loop(pending, window, samples)


# engine: The event-driven engine: Taylor steps inside a mode, located changes of mode, a clock of its own for every
# lane.
#
#     mode_at -> [series -> trusted -> first_event -> advance -> correct -> motion_at] ... -> samples read off the rows
#
# Each lane has its own time, mode and step; one loop runs them all. Derivatives: forward mode goes through the
# loop. Step lengths and located times are held constant. At an event the state and the time get one Newton
# correction, dt = -g/g', whose value is next to nothing and whose tangent is the event's own (the saltation
# matrix). Switching times of the drive are events with g = t - t_switch.


# Steps kept before samples are read off them; a buffer of this many rows stays in the second-level cache.
ROWS = 64
# An event whose function falls slower than this, relative to the typical size of its rate, counts as grazing.
GRAZING_RATE = 1e-5

# A piece of a drive shorter than this part of the time counts as that long: time always goes on.
SHORTEST_PIECE = 1e-15

# Numbers of samples are padded to this times a power of four, of two inside of a transformation.
SHORTEST = 64


class RunState(NamedTuple):
    """Everything that a step changes, every leaf (L,): the state, its mode, and the progress of the run.

    contacts, contacts_back : closings of the gap and of the back gap
    """

    state: CapsuleState
    mode: Mode
    active: jax.Array
    status: jax.Array
    contacts: jax.Array
    events: jax.Array
    steps: jax.Array
    contacts_back: jax.Array


def correct(
    constants: Constants, mode: Mode, step: StepSeries, s: jax.Array, at: CapsuleState, kind: jax.Array
) -> tuple[CapsuleState, jax.Array]:
    """(the state on the event's surface with the event time's tangent, whether the event is grazing).

    s, at : the located time and the state there, in the mode before the event
    """
    f, rod_rate = driven(constants, at, mode)
    acceleration = (f - sliding_friction(constants.law, mode.sigma, at.v)) / constants.m2
    a2 = jnp.where(mode.sigma != 0.0, acceleration, 0.0)
    w_rate = rod_rate - a2
    level = jnp.where(kind == UPPER, -constants.F_forward, constants.F_backward)
    f_rates = [k * x for k, x in enumerate(step.f)][1:]
    braking = (jnp.abs(f) + jnp.maximum(constants.F_forward, constants.F_backward)) / constants.m2
    stops = kind == VELOCITY
    g = jnp.where(stops, at.v, f + level)
    rate = jnp.where(stops, a2, force_rate(constants, at, mode, w_rate))
    typical = jnp.where(stops, braking, size(f_rates, s) / step.h)
    for i, force in enumerate(constants.contacts):
        meets = kind == GAP + i
        g, rate = jnp.where(meets, at.gaps[i], g), jnp.where(meets, force.side * at.w, rate)
        typical = jnp.where(meets, size(step.w, s), typical)
    if at.drive:
        switch = kind == SWITCH
        g = jnp.where(switch, at.t - at.drive[-1], g)
        rate, typical = jnp.where(switch, 1.0, rate), jnp.where(switch, 1.0, typical)
    rate, a2, w_rate, before, typical = stop_gradient((rate, a2, w_rate, at, typical))
    grazing = (kind != NONE) & ~(jnp.abs(rate) > GRAZING_RATE * typical)
    dt = -g / jnp.where((kind == NONE) | grazing, jnp.inf, rate)
    following = constants.drive.following(at.drive)
    drive = tuple(jnp.where(kind == SWITCH, x, y) for x, y in zip(following, at.drive, strict=True))
    way = before.w * dt
    gaps = tuple(
        jnp.where(kind == GAP + i, 0.0, at.gaps[i] + force.side * way) for i, force in enumerate(constants.contacts)
    )
    v = jnp.where(stops, 0.0, at.v + a2 * dt)
    return CapsuleState(at.t + dt, at.r + way, at.w + w_rate * dt, at.X2 + before.v * dt, v, drive, gaps), grazing


def _mode_after(constants: Constants, mode: Mode, new: CapsuleState, kind: jax.Array) -> Mode:
    """The mode that follows an event; ``new`` is the state on its surface.

    Contacts and the capsule's motion change one at a time; a second event at the same instant follows next. Where an
    event makes the force on the capsule jump, a stuck capsule may set off at once.
    """
    contacts = tuple(
        jnp.where(kind == GAP + i, force.side * new.w > 0.0, mode.contacts[i])
        for i, force in enumerate(constants.contacts)
    )
    after = Mode(mode.sigma, contacts)
    jumps = kind >= GAP
    if constants.reaction is not None:
        jumps = jumps | (kind == SWITCH)
    moved = ((kind >= VELOCITY) & (kind <= LOWER)) | (jumps & (mode.sigma == 0.0))
    sigma = motion_at(stop_gradient(constants), stop_gradient(new), after, kind)
    return after._replace(sigma=jnp.where(moved, sigma, mode.sigma))


def take_step(
    constants: Constants, t_end: jax.Array, max_steps: jax.Array, run: RunState
) -> tuple[RunState, StepSeries]:
    """One step of every active lane."""
    state, mode, active = run.state, run.mode, run.active
    left = t_end - stop_gradient(state.t)
    switching = None
    if state.drive:
        switch = stop_gradient(state.drive[-1])
        switching = switch < t_end
        piece = switch - stop_gradient(state.t)
        left = jnp.where(switching, jnp.maximum(piece, SHORTEST_PIECE * jnp.abs(switch)), left)
        left = jnp.where(left > 0.0, left, jnp.finfo(float).tiny)
    step = series(constants, state, mode, left)
    held = stop_gradient(step)
    s, kind = first_event(stop_gradient(constants), mode, held, stop_gradient(state.gaps), trusted(held), active)
    whole = (kind == NONE) & (s >= 1.0) & held.last
    if switching is not None:
        kind = jnp.where(whole & switching, SWITCH, kind)
        whole = whole & ~switching
    at = advance(constants, state, step, s)
    new, grazing = correct(constants, mode, step, s, at, kind)
    new = new._replace(t=jnp.where(whole, t_end, new.t))
    finished = whole | ((at.t if switching is None else new.t) >= t_end)
    after = _mode_after(constants, mode, new, kind)
    steps = run.steps + active
    finite = jnp.isfinite(at.r + at.w + at.X2 + at.v)
    status = jnp.where(active & grazing, jnp.maximum(run.status, Status.GRAZING), run.status)
    status = jnp.where(active & ~finished & (steps >= max_steps), jnp.int32(Status.TOO_MANY_STEPS), status)
    status = jnp.where(active & ~finite, jnp.int32(Status.NOT_FINITE), status)  # pyright: ignore[reportArgumentType, reportCallIssue]
    moved = active & finite
    contacts, back = (
        count + (moved & touching(constants, after, side) & ~touching(constants, mode, side))
        for count, side in ((run.contacts, 1.0), (run.contacts_back, -1.0))
    )
    state, mode = jax.tree.map(lambda x, y: jnp.where(moved, x, y), (new, after), (state, mode))
    return RunState(
        state,
        mode,
        active & ~finished & (status <= Status.GRAZING),
        status,
        contacts,
        run.events + (moved & (kind != NONE)),
        steps,
        back,
    ), step


def initial_lanes(
    p: CapsuleParameters, constants: Constants, t: jax.Array, t_end: jax.Array, initial: Initial
) -> RunState:
    """Runs at t (L,), s. A gap that is zero within rounding is set to exactly zero."""
    X1, Y1, X2, Y2 = (jnp.asarray(x) for x in initial)
    rounding = 2.0 * jnp.finfo(float).eps * (jnp.abs(X1) + jnp.abs(X2))

    def without_rounding(contact: Force) -> jax.Array:
        d = contact.side * (X1 - X2) - contact.reach
        allowed = rounding + 2.0 * jnp.finfo(float).eps * jnp.abs(contact.reach)
        return jnp.where(jnp.abs(d) <= allowed, d - stop_gradient(d), d)

    gaps = tuple(map(without_rounding, constants.contacts))
    state = CapsuleState(t, X1 - X2, Y1 - Y2, X2, Y2, constants.drive.piece(t), gaps)
    given = jnp.stack([*jax.tree.leaves(state._replace(drive=state.drive[:-1])), t_end])
    valid = jnp.all(jnp.isfinite(given), axis=0) & admissible(p, constants.drive, constants.law)
    valid = valid & constants.drive.covers(t, t_end)
    zero = jnp.zeros(t.shape, jnp.int32)
    status = jnp.where(valid, jnp.int32(Status.OK), jnp.int32(Status.INVALID))
    mode = mode_at(stop_gradient(constants), stop_gradient(state))
    return RunState(state, mode, valid & (t < t_end), status, zero, zero, zero, zero)


def march(
    constants: Constants, t_end: jax.Array, max_steps: jax.Array, lanes: RunState, length: int
) -> tuple[RunState, jax.Array, jax.Array]:
    """Up to ``length`` steps: (lanes, rows (length, WIDTH, L), starts (length, L))."""
    L = t_end.shape[0]

    def more(carry: tuple[RunState, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (carry[3] < length) & jnp.any(carry[0].active)

    def one(
        carry: tuple[RunState, jax.Array, jax.Array, jax.Array],
    ) -> tuple[RunState, jax.Array, jax.Array, jax.Array]:
        lanes, rows, starts, row = carry
        after, step = take_step(constants, t_end, max_steps, lanes)
        begin = jnp.where(lanes.active, stop_gradient(lanes.state.t), jnp.inf)
        polynomial = jnp.stack([lanes.state.t, step.h, lanes.state.r, lanes.state.X2, *step.w, *step.v])
        rows = jax.lax.dynamic_update_index_in_dim(rows, polynomial, row, 0)
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
    samples, n = first_samples(times, initial, lanes.status == Status.OK), times.shape[1]
    padded = jnp.concatenate([times, jnp.full((len(times), WINDOW), jnp.inf)], axis=1)

    def stretch(carry: tuple[RunState, Samples]) -> tuple[RunState, Samples]:
        lanes, rows, starts = march(constants, t_end, max_steps, carry[0], ROWS)
        return lanes, read_off(padded, carry[1], rows, starts, lanes.state.t)

    lanes, (values, _) = jax.lax.while_loop(lambda c: jnp.any(c[0].active), stretch, (lanes, samples))
    X1, Y1, X2, Y2 = (values[:, i, :n] for i in range(4))
    counts = lanes.contacts, lanes.status, lanes.steps, lanes.events, lanes.contacts_back
    return Trajectory(times, X1, Y1, X2, Y2, *counts)


def _is_own(part: Drive | FrictionLaw | Force) -> bool:
    """Whether a drive, law or force, and every law inside it, is one of this package."""
    own = type(part).__module__.startswith("capsule_id.")
    return own and (not isinstance(part, Scaled) or _is_own(part.law))


_run = jax.jit(folded(run))
_run_single = as_one_function(run)


@partial(jax.jit, static_argnums=1)
def _without_padding(t: Trajectory, n: int) -> Trajectory:
    """The first n samples. One program: a slice outside of programs takes a tenth of the time of a run each."""
    return replace(t, **{name: getattr(t, name)[:, :n] for name in ("times", "X1", "Y1", "X2", "Y2")})


def kernel(
    max_steps: int, p: CapsuleParameters, e: Drive, law: FrictionLaw, initial: Initial, times: jax.Array
) -> Trajectory:
    """The engine on lanes.

    Times are padded to one of few lengths, so that a new number of samples is seldom a new program, and records of a fit
    that differ little in length are traced once together.
    """
    L, n = times.shape
    bound, t_end = np.full(L, max_steps, np.int32), times[:, -1]
    traced = is_traced((p, e, law, initial, times))
    # A program of a fit runs often, and padding by more than twice the samples costs up to 40 % of its time.
    length = next(size for k in range(64) if (size := SHORTEST * (2 if traced else 4) ** k) >= n)
    padded = (jnp if traced else np).concatenate([times, np.full((L, length - n), np.inf)], axis=1)
    # The samples of several lanes are scattered; a law, drive or force of the user may hold any operation.
    single = L == 1 and not traced and all(map(_is_own, (e, law, *(p.forces or ()))))
    given = p, e, law, initial, padded, t_end, bound
    t = _run_single(*given)[0] if single else _run(*given)
    return t if n == length else _without_padding(t, n)
