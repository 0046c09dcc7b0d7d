"""Changes of mode: where on a step the first one lies, and which mode follows.

In a mode these functions must stay >= 0: the gap's (d in contact, -d out of it), that of the back gap, and, while
sliding, the velocity in the mode's direction, or, while stuck, F_forward - f and F_backward + f, f the force on the
capsule. Each is a linear combination of the series of the step, so it is a polynomial in s. What is absent is not
watched. Switching times of the drive are known: they end a step (``SWITCH``) and need no search.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from capsule_id.physics.exact.taylor import (
    CapsuleState,
    Constants,
    Mode,
    StepSeries,
    damping_of,
    force_on_capsule,
    rod_force,
    rod_rate,
    size,
    tangent_stiffness,
)
from capsule_id.physics.friction import sliding_friction
from capsule_id.physics.series import Series, horner

# Kinds of events.
NONE, GAP, VELOCITY, UPPER, LOWER, BACK, SWITCH = 0, 1, 2, 3, 4, 5, 6
# The march arrives when its next leap is this small a part of the step, or, at a root that is crossed at a definite
# rate, when a leap below SURE_LEAP agrees with Newton's to SURE_AGREEMENT: the correction in ``correct`` does the rest.
LEAP_TOLERANCE = 1e-9
SURE_LEAP, SURE_AGREEMENT = 1e-3, 1e-4
# Leaps on one step. Where they do not suffice (a root closely missed) the step ends early, with nothing lost.
MAX_LEAPS = 100
# An event is met at a fraction of the step no smaller than this, so that time always goes on; ``correct`` steps back.
SMALLEST_FRACTION = 1e-9
# Coefficients of an event function below this part of its size are rounding, where only their sign would matter.
ROUNDING_NOISE = 1e-14
# |f| within this many roundings of the break-away force counts as at the threshold; the rate of |f| then decides.
THRESHOLD_ROUNDINGS = 16.0


def _divided(p: Series, s_end: jax.Array) -> Series:
    """p over that power of s which removes the root at s = 0, where p(0) = 0 exactly, as right after an event.

    There the next coefficients, if they are mere rounding, are taken as 0 too: at an onset of slip the first rate is.
    """
    scale, zero = size(p, s_end), jnp.zeros_like(p[0])
    once = p[0] == 0.0
    twice = once & (jnp.abs(p[1]) * s_end / scale <= ROUNDING_NOISE)
    thrice = twice & (jnp.abs(p[2]) * s_end**2 / scale <= ROUNDING_NOISE)
    q = [*p, zero, zero, zero]
    return [
        jnp.where(thrice, q[k + 3], jnp.where(twice, q[k + 2], jnp.where(once, q[k + 1], q[k]))) for k in range(len(p))
    ]


class _Watched(NamedTuple):
    """An event function p, scaled to size 1, and its bend: p(0) + p'(0) s - bend s^2 <= p(s), anywhere on the step."""

    value: Series
    slope: Series
    scale: jax.Array
    p2: jax.Array
    rest: jax.Array

    def at(self, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(p, p') at s; the divisions keep XLA from evaluating them once per use."""
        return horner(self.value, s) / self.scale, horner(self.slope, s) / self.scale


def _watched(p: Series, level: jax.Array, s_end: jax.Array) -> _Watched:
    """p with p_2 - rest <= p''/2 <= p_2 + rest on 0..s_end; level is a constant that p is compared with."""
    power, rest = s_end, jnp.zeros_like(s_end)
    for k in range(3, len(p)):
        rest = rest + (0.5 * k * (k - 1)) * jnp.abs(p[k]) * power
        power = power * s_end
    scale = level + size(p)
    return _Watched(p, [k * x for k, x in enumerate(p)][1:], scale, p[2] / scale, rest / scale)


def _leap(p0: jax.Array, p1: jax.Array, bend: jax.Array) -> jax.Array:
    """First root tau >= 0 of the minorant p0 + p1 tau - bend tau^2, inf where it has none: p has no root before."""
    p0 = jnp.maximum(p0, 0.0)
    root2 = p1 * p1 + 4.0 * bend * p0
    root = jnp.sqrt(jnp.maximum(root2, 0.0))
    falling = p1 < 0.0
    tau = jnp.where(falling, 2.0 * p0, p1 + root) / jnp.where(falling, root - p1, 2.0 * bend)
    return jnp.where(jnp.where(falling, root2 >= 0.0, bend > 0.0), tau, jnp.inf)


def _sure(p0: jax.Array, p1: jax.Array, tau: jax.Array) -> jax.Array:
    """Whether the leap tau differs so little from Newton's that the root is certain and simple."""
    return jnp.abs(p0 + p1 * tau) <= SURE_AGREEMENT * p0


def first_event(
    constants: Constants, mode: Mode, step: StepSeries, b: jax.Array | None, s_end: jax.Array, active: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(s, kind): where the step ends and why; s = s_end and NONE if nothing happens before.

    Marches from the left, each leap to the root of a quadratic minorant of each event function on what is left of the
    step, so no root can be passed, double ones included. b (L,) m: the back gap at the start of the step.
    """
    sliding = mode.sigma != 0.0
    middle = 0.5 * (constants.F_forward - constants.F_backward)
    level = jnp.where(sliding, 0.0, 0.5 * (constants.F_forward + constants.F_backward))
    gaps = []
    if constants.k2 is not None:
        gaps.append((GAP, _gap([jnp.where(mode.contact, x, -x) for x in step.d], s_end)))
    if mode.back is not None and b is not None:
        gaps.append((BACK, _gap([jnp.where(mode.back, -x, x) for x in (b, *step.d[1:])], s_end)))
    speed = _divided([mode.sigma * x for x in step.v], s_end)
    # While stuck level - (f - middle) and level + (f - middle), while sliding sigma Y2, written as level + sign * p.
    force = [step.f[0] - middle, *step.f[1:]]
    other = _watched([jnp.where(sliding, a, -b) for a, b in zip(speed, force, strict=True)], level, s_end)
    base = level / other.scale

    def leap(carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        s, kind, going, leaps = carry
        p0, p1 = other.at(s)
        to_upper = _leap(base + p0, p1, other.rest - other.p2)
        to_lower = jnp.where(sliding, jnp.inf, _leap(base - p0, -p1, other.rest + other.p2))
        tau, sign = jnp.minimum(to_upper, to_lower), jnp.where(to_upper <= to_lower, 1.0, -1.0)
        sure = _sure(base + sign * p0, sign * p1, tau)
        which = jnp.where(sliding, VELOCITY, jnp.where(sign > 0.0, UPPER, LOWER))
        for gap_kind, gap in reversed(gaps):
            g0, g1 = gap.at(s)
            to_gap = _leap(g0, g1, gap.rest - gap.p2)
            is_gap, tau = to_gap <= tau, jnp.minimum(to_gap, tau)
            sure, which = jnp.where(is_gap, _sure(g0, g1, tau), sure), jnp.where(is_gap, gap_kind, which)
        arrived = tau <= jnp.where(sure, SURE_LEAP, LEAP_TOLERANCE) * s_end
        kind = jnp.where(going & arrived, which, kind)
        onward = s + tau
        return (
            jnp.where(going, jnp.minimum(onward, s_end), s),
            kind,
            going & ~arrived & (onward < s_end),
            leaps + 1,
        )

    start = (jnp.zeros_like(s_end), jnp.zeros(s_end.shape, jnp.int32), active, jnp.int32(0))
    s, kind, _, _ = jax.lax.while_loop(lambda carry: jnp.any(carry[2]) & (carry[3] < MAX_LEAPS), leap, start)
    return jnp.clip(s, SMALLEST_FRACTION * s_end, s_end), kind


def _gap(p: Series, s_end: jax.Array) -> _Watched:
    """The event function of a gap: p, without its root at the start of the step."""
    return _watched(_divided(p, s_end), jnp.zeros_like(s_end), s_end)


def motion_at(constants: Constants, state: CapsuleState, mode: Mode, kind: jax.Array) -> jax.Array:
    """(L,) sigma of the mode that follows from a state: the sign of v or, where v = 0, that of f if it breaks away.

    mode : the contacts; its sigma does not matter
    kind : (L,) the event; after UPPER or LOWER f is at the threshold of a capsule at rest, whatever rounding says

    f is the force on the capsule but for friction.
    """
    spring_force = rod_force(constants, state, mode)
    f = force_on_capsule(constants, spring_force, state.drive)
    w_rate = rod_rate(constants, spring_force, state.drive)
    f_rate = force_rate(constants, state, mode, w_rate)
    onset = (kind == UPPER) | (kind == LOWER)
    side = jnp.where(onset, jnp.where(kind == UPPER, 1.0, -1.0), jnp.sign(f))
    threshold = jnp.where(side < 0.0, constants.F_backward, constants.F_forward)
    tolerance = (_size_of_forces(constants, state, mode) + threshold) * THRESHOLD_ROUNDINGS * jnp.finfo(float).eps
    at_threshold = onset | (jnp.abs(jnp.abs(f) - threshold) <= tolerance)
    slips = jnp.where(at_threshold, side * f_rate > 0.0, jnp.abs(f) > threshold)
    # Without friction nothing ever sticks, and a force of zero leaves the direction to its rate, then to the rod's.
    free = (constants.F_forward == 0.0) & (constants.F_backward == 0.0)
    later = jnp.where(f_rate != 0.0, jnp.sign(f_rate), jnp.where(w_rate < 0.0, -1.0, 1.0))
    direction = jnp.where(free & (jnp.abs(f) <= tolerance), later, side)
    sigma = jnp.where(slips | free, direction, 0.0)
    return jnp.where(state.v != 0.0, jnp.sign(state.v), sigma)


def force_rate(constants: Constants, state: CapsuleState, mode: Mode, w_rate: jax.Array) -> jax.Array:
    """(L,) N/s: rate of the force on the capsule but for friction; w_rate (L,) m/s^2, the rate of w."""
    rate = tangent_stiffness(constants, mode, state.r) * state.w + damping_of(constants, mode.contact) * w_rate
    if constants.reaction is None:
        return rate
    return rate - constants.reaction * constants.drive.series(state.drive, jnp.ones_like(rate), 2)[1]


def _size_of_forces(constants: Constants, state: CapsuleState, mode: Mode) -> jax.Array:
    """(L,) N: sum of the magnitudes of the forces on the capsule, which its rounding scales with."""
    terms = [constants.k1 * state.r, constants.c * state.w]
    if constants.k_cubic is not None:
        terms.append(constants.k_cubic * state.r**3)
    if constants.k2 is not None:
        terms.append(jnp.where(mode.contact, constants.k2, 0.0) * state.d)
    if constants.c2 is not None:
        terms.append(constants.c2 * state.w)
    if constants.k2_back is not None and state.b is not None and mode.back is not None:
        terms.append(jnp.where(mode.back, constants.k2_back, 0.0) * state.b)
    if constants.reaction is not None:
        terms.append(constants.reaction * constants.drive.value(state.drive))
    if constants.downhill is not None:
        terms.append(constants.downhill[1])
    return sum((jnp.abs(x) for x in terms[1:]), jnp.abs(terms[0]))


def mode_at(constants: Constants, state: CapsuleState) -> Mode:
    """The mode that any state begins in: signs of d, b, v and, where they are 0, of their first rate that is not."""
    meeting = (state.d > 0.0) | ((state.d == 0.0) & (state.w > 0.0))
    if constants.k2 is None:
        meeting = jnp.zeros_like(meeting)
    leaning = None if state.b is None else (state.b < 0.0) | ((state.b == 0.0) & (state.w < 0.0))
    sigma = motion_at(constants, state, Mode(meeting, jnp.zeros_like(state.v), leaning), jnp.full(state.d.shape, NONE))
    free = Mode(jnp.zeros_like(meeting), sigma, None if leaning is None else jnp.zeros_like(leaning))
    spring_force = rod_force(constants, state, free)
    f = force_on_capsule(constants, spring_force, state.drive)
    a2 = jnp.where(sigma != 0.0, (f - sliding_friction(constants.law, sigma, state.v)) / constants.m2, 0.0)
    w_rate = rod_rate(constants, spring_force, state.drive) - a2
    touching = (state.d == 0.0) & (state.w == 0.0) & (w_rate > 0.0)
    contact = meeting if constants.k2 is None else meeting | touching
    if leaning is None or state.b is None:
        return Mode(contact, sigma)
    return Mode(contact, sigma, leaning | ((state.b == 0.0) & (state.w == 0.0) & (w_rate < 0.0)))
