"""Changes of mode: where on a step the first one lies, and which mode follows.

In a mode three functions must stay >= 0: the gap's (d in contact, -d out of it) and, while sliding, the velocity in the
mode's direction, or, while stuck, F_forward - f and F_backward + f. Each is a linear combination
of the series of the step, so it is a polynomial in s.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from capsule_id.physics.exact.taylor import CapsuleState, Constants, Mode, StepSeries, rod_force, size
from capsule_id.physics.friction import sliding_friction
from capsule_id.physics.series import Series, horner

# Kinds of events.
NONE, GAP, VELOCITY, UPPER, LOWER = 0, 1, 2, 3, 4
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
    constants: Constants, mode: Mode, step: StepSeries, s_end: jax.Array, active: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(s, kind): where the step ends and why; s = s_end and NONE if nothing happens before.

    Marches from the left, each leap to the root of a quadratic minorant of each event function on what is left of the
    step, so no root can be passed, double ones included.
    """
    sliding = mode.sigma != 0.0
    middle = 0.5 * (constants.F_forward - constants.F_backward)
    level = jnp.where(sliding, 0.0, 0.5 * (constants.F_forward + constants.F_backward))
    gap = _watched(_divided([jnp.where(mode.contact, x, -x) for x in step.d], s_end), jnp.zeros_like(level), s_end)
    speed = _divided([mode.sigma * x for x in step.v], s_end)
    # While stuck level - (f - middle) and level + (f - middle), while sliding sigma Y2, written as level + sign * p.
    force = [step.f[0] - middle, *step.f[1:]]
    other = _watched([jnp.where(sliding, a, -b) for a, b in zip(speed, force, strict=True)], level, s_end)
    base = level / other.scale

    def leap(carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        s, kind, going, leaps = carry
        g0, g1 = gap.at(s)
        p0, p1 = other.at(s)
        to_gap = _leap(g0, g1, gap.rest - gap.p2)
        to_upper = _leap(base + p0, p1, other.rest - other.p2)
        to_lower = jnp.where(sliding, jnp.inf, _leap(base - p0, -p1, other.rest + other.p2))
        to_motion = jnp.minimum(to_upper, to_lower)
        tau = jnp.minimum(to_gap, to_motion)
        is_gap, sign = to_gap <= to_motion, jnp.where(to_upper <= to_lower, 1.0, -1.0)
        sure = jnp.where(is_gap, _sure(g0, g1, tau), _sure(base + sign * p0, sign * p1, tau))
        arrived = tau <= jnp.where(sure, SURE_LEAP, LEAP_TOLERANCE) * s_end
        which = jnp.where(is_gap, GAP, jnp.where(sliding, VELOCITY, jnp.where(sign > 0.0, UPPER, LOWER)))
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


def motion_at(constants: Constants, state: CapsuleState, contact: jax.Array, kind: jax.Array) -> jax.Array:
    """(L,) sigma of the mode that follows from a state: the sign of v or, where v = 0, that of f if it breaks away.

    kind : (L,) the event; after UPPER or LOWER f is at the threshold of a capsule at rest, whatever rounding says
    """
    k2 = jnp.where(contact, constants.k2, 0.0)
    spring, damper, support = constants.k1 * state.r, constants.c * state.w, k2 * state.d
    f = spring + damper + support
    drive = constants.drive.value(state.drive)
    f_rate = (constants.k1 + k2) * state.w + constants.c * (drive - f) / constants.m1
    onset = (kind == UPPER) | (kind == LOWER)
    side = jnp.where(onset, jnp.where(kind == UPPER, 1.0, -1.0), jnp.sign(f))
    threshold = jnp.where(side < 0.0, constants.F_backward, constants.F_forward)
    size_of_forces = jnp.abs(spring) + jnp.abs(damper) + jnp.abs(support) + threshold
    tolerance = size_of_forces * THRESHOLD_ROUNDINGS * jnp.finfo(float).eps
    at_threshold = onset | (jnp.abs(jnp.abs(f) - threshold) <= tolerance)
    slips = jnp.where(at_threshold, side * f_rate > 0.0, jnp.abs(f) > threshold)
    # Without friction nothing ever sticks, and a force of zero leaves the direction to its rate, then to the drive's.
    free = (constants.F_forward == 0.0) & (constants.F_backward == 0.0)
    later = jnp.where(f_rate != 0.0, jnp.sign(f_rate), jnp.where(drive < 0.0, -1.0, 1.0))
    direction = jnp.where(free & (jnp.abs(f) <= tolerance), later, side)
    sigma = jnp.where(slips | free, direction, 0.0)
    return jnp.where(state.v != 0.0, jnp.sign(state.v), sigma)


def mode_at(constants: Constants, state: CapsuleState) -> Mode:
    """The mode that any state begins in: signs of d, v and, where they are 0, of their first rate that is not."""
    meeting = (state.d > 0.0) | ((state.d == 0.0) & (state.w > 0.0))
    sigma = motion_at(constants, state, meeting, jnp.full(state.d.shape, NONE))
    f = rod_force(constants, state, jnp.zeros_like(meeting))
    drive = constants.drive.value(state.drive)
    a2 = jnp.where(sigma != 0.0, (f - sliding_friction(constants.law, sigma, state.v)) / constants.m2, 0.0)
    touching = (state.d == 0.0) & (state.w == 0.0) & ((drive - f) / constants.m1 - a2 > 0.0)
    return Mode(meeting | touching, sigma)
