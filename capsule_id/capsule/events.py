"""Changes of mode: where on a step the first one lies, and which mode follows.

In a mode three functions must stay >= 0: the gap's (d in contact, -d out of it) and, while sliding, the velocity in the
mode's direction, or, while stuck, F_b - f and F_b + f. All are linear in the state, so they are polynomials in s.
"""

import jax
import jax.numpy as jnp

from capsule_id.capsule.taylor import Mode, Motion, Rig, Series, State

# Kinds of events.
NONE, GAP, VELOCITY, UPPER, LOWER = 0, 1, 2, 3, 4
# The march ends when its next leap is this small a part of the step; it converges quadratically, so the root is exact.
LEAP_TOLERANCE = 1e-9
# Leaps on one step. Where they do not suffice (a root closely missed) the step ends early, with nothing lost.
MAX_LEAPS = 100
# An event is met at a fraction of the step no smaller than this, so that time always goes on.
SMALLEST_FRACTION = 1e-13
# |f| within this many roundings of F_b counts as at the threshold; the rate of |f| then decides.
THRESHOLD_ROUNDINGS = 16.0


def _divided(p: Series) -> Series:
    """p/s where p(0) = 0 exactly, as right after an event of that kind: removes the root that was just met."""
    zero = p[0] == 0.0
    return [jnp.where(zero, high, low) for low, high in zip(p, [*p[1:], jnp.zeros_like(p[0])], strict=True)]


def _bend(p: Series, s: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(p_2, R) with p_2 - R <= p''/2 <= p_2 + R on 0..s."""
    power, rest = s, jnp.zeros_like(s)
    for k in range(3, len(p)):
        rest = rest + (0.5 * k * (k - 1)) * jnp.abs(p[k]) * power
        power = power * s
    return p[2], rest


def _value_and_slope(p: Series, s: jax.Array) -> tuple[jax.Array, jax.Array]:
    value, slope = p[-1], jnp.zeros_like(s)
    for x in reversed(p[:-1]):
        slope = slope * s + value
        value = value * s + x
    return value, slope


def _leap(p0: jax.Array, p1: jax.Array, bend: jax.Array) -> jax.Array:
    """First root tau >= 0 of the minorant p0 + p1 tau - bend tau^2, inf where it has none: p has no root before."""
    p0 = jnp.maximum(p0, 0.0)
    root2 = p1 * p1 + 4.0 * bend * p0
    root = jnp.sqrt(jnp.maximum(root2, 0.0))
    falling = p1 < 0.0
    tau = jnp.where(falling, 2.0 * p0, p1 + root) / jnp.where(falling, root - p1, 2.0 * bend)
    return jnp.where(jnp.where(falling, root2 >= 0.0, bend > 0.0), tau, jnp.inf)


def first_event(
    rig: Rig, mode: Mode, motion: Motion, s_end: jax.Array, active: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(s, kind): where the step ends and why; s = s_end and NONE if nothing happens before.

    Marches from the left, each leap to the root of a quadratic minorant of each event function on what is left of the
    step, so no root can be passed, double ones included.
    """
    sliding = mode.sigma != 0.0
    gap = _divided([jnp.where(mode.contact, x, -x) for x in motion.d])
    speed = _divided([mode.sigma * x for x in motion.v])
    other = [jnp.where(sliding, a, b) for a, b in zip(speed, motion.f, strict=True)]
    gap_bend2, gap_rest = _bend(gap, s_end)
    bend2, rest = _bend(other, s_end)

    def look(s: jax.Array) -> tuple[jax.Array, jax.Array]:
        g0, g1 = _value_and_slope(gap, s)
        p0, p1 = _value_and_slope(other, s)
        to_gap = _leap(g0, g1, gap_rest - gap_bend2)
        level, sign = jnp.where(sliding, 0.0, rig.F_b), jnp.where(sliding, 1.0, -1.0)
        to_upper = _leap(level + sign * p0, sign * p1, rest - sign * bend2)
        to_lower = jnp.where(sliding, jnp.inf, _leap(rig.F_b + p0, p1, rest - bend2))
        to_motion = jnp.minimum(to_upper, to_lower)
        motion_kind = jnp.where(sliding, VELOCITY, jnp.where(to_upper <= to_lower, UPPER, LOWER))
        return jnp.minimum(to_gap, to_motion), jnp.where(to_gap <= to_motion, GAP, motion_kind)

    def more(carry: tuple[jax.Array, ...]) -> jax.Array:
        _, _, going, leaps = carry
        return jnp.any(going) & (leaps < MAX_LEAPS)

    def leap(carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        s, kind, going, leaps = carry
        tau, which = look(s)
        arrived = tau <= LEAP_TOLERANCE * s_end
        onward = s + tau
        beyond = ~(onward < s_end)
        kind = jnp.where(going & arrived, which, kind)
        s = jnp.where(going, jnp.minimum(onward, s_end), s)
        return s, kind, going & ~arrived & ~beyond, leaps + 1

    start = (jnp.zeros_like(s_end), jnp.zeros(s_end.shape, jnp.int32), active, jnp.int32(0))
    s, kind, _, _ = jax.lax.while_loop(more, leap, start)
    return jnp.clip(s, SMALLEST_FRACTION * s_end, s_end), kind


def mode_at(rig: Rig, state: State, onset: jax.Array) -> Mode:
    """The mode that follows from a state: signs of d, v and, where they are 0, of their first rate that is not.

    onset : (L,) bool, the state is at the threshold |f| = F_b of a capsule at rest whatever rounding says
    """
    k1, k2, c, F_b = rig.k1, rig.k2, rig.c, rig.F_b
    closing = (state.d == 0.0) & (state.w > 0.0)
    k2 = jnp.where((state.d > 0.0) | closing, k2, 0.0)
    r = state.d + rig.G
    f = k1 * r + c * state.w + k2 * state.d
    w_rate = (rig.P_d * state.C - f) / rig.m1
    f_rate = (k1 + k2) * state.w + c * w_rate
    rounding = jnp.finfo(float).eps * (jnp.abs(k1 * r) + jnp.abs(c * state.w) + jnp.abs(k2 * state.d) + F_b)
    tolerance, excess = THRESHOLD_ROUNDINGS * rounding, jnp.abs(f) - F_b
    at_threshold = onset | (jnp.abs(excess) <= tolerance)
    slips = jnp.where(at_threshold, f * f_rate > 0.0, excess > 0.0)
    # Without friction nothing ever sticks, and a force of zero leaves the direction to its rate, then to the drive's.
    later = jnp.where(f_rate != 0.0, jnp.sign(f_rate), jnp.where(state.C < 0.0, -1.0, 1.0))
    direction = jnp.where((F_b == 0.0) & (jnp.abs(f) <= tolerance), later, jnp.sign(f))
    sigma = jnp.where(slips | (F_b == 0.0), direction, 0.0)
    sigma = jnp.where(state.v != 0.0, jnp.sign(state.v), sigma)
    d_bend = w_rate - jnp.where(sigma != 0.0, (f - sigma * F_b) / rig.m2, 0.0)
    touching = (state.d == 0.0) & (state.w == 0.0) & (d_bend > 0.0)
    return Mode((state.d > 0.0) | closing | touching, sigma)
