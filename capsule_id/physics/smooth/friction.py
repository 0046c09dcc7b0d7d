"""The smoothed stick-slip rule, and the force gate of eq. (2) to the letter; any friction law, forces in N."""

import jax
import jax.numpy as jnp

from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.smooth.steps import Array, smooth_abs, smooth_heaviside, smooth_ramp


def breakaway(law: FrictionLaw) -> jax.Array:
    """F_b, N: the law's resistance at speed 0, the mean of both directions."""
    still = jnp.zeros(())
    return 0.5 * (law.forward(still) + law.backward(still))


def _corner(rounding: Array, F_b: Array) -> jax.Array:
    """Width of the threshold's corner, N. Without friction any width gives zero force; 1 N keeps quotients finite."""
    width = jnp.asarray(rounding * F_b)
    return jnp.where(width > 0.0, width, 1.0)


def friction_smooth(law: FrictionLaw, F_b: Array, Y2: Array, f: Array, widths: tuple[Array, Array]) -> jax.Array:
    """Smoothed stick-slip rule: a gate in velocity *and* force without creep.

    friction = x clipped softly to [-backward, forward],   x = f + sqrt(F_b^2 + f^2) Y2 / velocity.

    In the words of eq. (2): the argument |f| - F_b of its Heaviside functions is shifted by the velocity, so that a
    capsule in motion is always in the sliding branch. Where |x| is below the threshold, friction - f drags Y2 to zero
    at the rate sqrt(F_b^2 + f^2) / (m2 velocity): the capsule at rest stays at rest under every |f| below
    (1 - rounding) F_b, where a friction of the form F_s tanh(Y2 / velocity) creeps at Y2 ~ velocity f / F_b.

    At Y2 = 0: f inside the thresholds, the threshold outside; slope in Y2 there sqrt(F_b^2 + f^2) / velocity inside,
    0 outside. |Y2| >= sqrt(2) velocity (1 + rounding): exactly the law's resistance with the sign of Y2, so also at
    Y2 -> +-infinity; at f -> +-infinity with Y2 = 0 the threshold with the sign of f. Limit velocity -> 0: the exact
    rule, for every ``rounding``.

    F_b : ``breakaway(law)``, computed once per run
    widths : (velocity, m/s; rounding: the half-width of the clip's corner as a fraction of F_b)
    """
    velocity, rounding = widths
    speed = smooth_abs(Y2, velocity)
    forward, backward = law.forward(speed), law.backward(speed)
    square = F_b * F_b + f * f
    # At f = 0 without friction the root has no derivative: nothing holds the capsule, the pull is zero.
    pull = jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
    x = f + pull * Y2 / velocity
    corner = _corner(rounding, F_b)
    return x - smooth_ramp(x - forward, corner) + smooth_ramp(-x - backward, corner)


def force_gate(law: FrictionLaw, F_b: Array, f: Array, rounding: Array) -> jax.Array:
    """H2 (1 - H1) + H3 H1 of eq. (2), smoothed: 1 where |f| exceeds the threshold, 0 below, in force alone.

    With f the whole force on the capsule, contact included, H2 and H3 are one function, H(|f| - F_b).
    At f = 0 and f inside (1 - rounding) of the threshold 0, at the threshold 1/2 with slope 15 / (16 rounding F_b),
    at +-infinity 1 with slope 0. This is the gate of eq. (2) to the letter, whose limit is not the stick-slip rule.
    """
    still = jnp.zeros(())
    corner = _corner(rounding, F_b)
    return smooth_heaviside(f - law.forward(still), corner) + smooth_heaviside(-f - law.backward(still), corner)
