"""The four forces of the capsule, each in its exact and in its smoothed form.

    spring, damper               linear: one form serves both
    support                      the one-sided spring k2 behind the gap G
    friction                     a law of sliding resistance, and the stick-slip rule that turns any law into a force

Sign: ``f`` (spring + damper + support) is what the rod puts on the capsule; ``friction`` is what holds the capsule
back, so that m2 X2'' = f - friction. Forces in N, lengths in m, velocities in m/s; all functions work elementwise.

A friction law is a class with the methods of ``FrictionLaw``: the resistance at a sliding speed, forward and backward.
The smoothed engine takes any such class (``smooth.kernel(..., friction=...)``); nothing else has to be changed.

Smoothing replaces the Heaviside function by a C2 step of compact support: outside its width the smoothed force *is*
the exact one, and its slope and curvature stay below 15 / (16 width) and 5 / (2 sqrt(3) width^2).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import jax
import jax.numpy as jnp

from capsule_id.precision import require_float64

if TYPE_CHECKING:
    from capsule_id.physics.model import CapsuleParameters

require_float64()

Array = jax.Array | float


# ------------------------------------------- smoothed Heaviside, its integral, sign and |x|; every width is positive


def _scaled(x: Array, width: Array) -> jax.Array:
    """x / width clipped to [-1, 1]."""
    return jnp.minimum(jnp.maximum(jnp.asarray(x) / width, -1.0), 1.0)


def smooth_sign(x: Array, width: Array) -> jax.Array:
    """sgn_w(x) = s (15 - 10 s^2 + 3 s^4) / 8 with s = x / width clipped to [-1, 1]; odd, C2.

    At 0: value 0, slope 15 / (8 width), curvature 0. At and beyond +-width, so at +-infinity: +-1, all derivatives 0.
    """
    s = _scaled(x, width)
    q = s * s
    return s * (1.875 + q * (0.375 * q - 1.25))


def smooth_heaviside(x: Array, width: Array) -> jax.Array:
    """H_w(x) = (1 + sgn_w(x)) / 2. At 0: 1/2, slope 15 / (16 width). At -infinity 0, at +infinity 1, slopes 0."""
    return 0.5 * (1.0 + smooth_sign(x, width))


def smooth_abs(x: Array, width: Array) -> jax.Array:
    """|x|_w = x sgn_w(x), C2. At 0: value and slope 0, curvature 15 / (4 width). Beyond +-width: |x|, slopes +-1."""
    return x * smooth_sign(x, width)


def smooth_ramp(x: Array, width: Array) -> jax.Array:
    """R_w(x), the integral of H_w from -infinity: max(x, 0) rounded off over +-width, C3.

    At 0: 5 width / 32, slope 1/2, curvature 15 / (16 width). At -infinity 0 with slope 0; at +infinity x with slope 1
    (from +-width on, to rounding). With H_w it makes a support force that has a potential: contact conserves energy.
    """
    s = _scaled(x, width)
    q = s * s
    rounded = (0.03125 * width) * (5.0 + 16.0 * s + q * (15.0 + q * (q - 5.0)))
    return rounded + jnp.maximum(x - width, 0.0)


# ---------------------------------------------------------------- rod to capsule


def spring(k1: Array, r: Array) -> Array:
    """k1 r: linear, 0 at 0, slope k1 everywhere, unbounded. Exact and smoothed form are one (paper, eq. (2))."""
    return k1 * r


def damper(c: Array, v: Array) -> Array:
    """c (Y1 - Y2): linear, 0 at 0, slope c everywhere, unbounded. Exact and smoothed form are one (paper, eq. (2))."""
    return c * v


def support(k2: Array, G: Array, r: Array) -> jax.Array:
    """H1 k2 (r - G), H1 = H(r - G) (paper, eq. (2)): 0 for r < G.

    At r = G: 0, continuous, slope jumps from 0 to k2. At r -> -infinity 0; at +infinity k2 (r - G).
    """
    return k2 * jnp.maximum(r - G, 0.0)


def support_smooth(k2: Array, G: Array, r: Array, penetration: Array) -> jax.Array:
    """k2 R_w(r - G), w = ``penetration`` (m): its slope is k2 times the smoothed Heaviside H1 of eq. (2).

    At r = G: 5 k2 w / 32, slope k2 / 2. Equal to ``support`` wherever |r - G| >= w, so at +-infinity.
    The largest deviation, 5 k2 w / 32, stands at r = G; the energy that it stores, k2 w^2 / 14, is of second order.
    """
    return k2 * smooth_ramp(r - G, penetration)


# ---------------------------------------------------------------- friction laws


class FrictionLaw(Protocol):
    """How much the ground resists sliding, N >= 0; the value at speed 0 is the break-away threshold.

    Both methods take the speed |Y2| >= 0 (m/s) and must be smooth in it.
    """

    def forward(self, speed: jax.Array) -> jax.Array:
        """Resistance when the capsule slides towards positive X2."""
        ...

    def backward(self, speed: jax.Array) -> jax.Array:
        """Resistance when the capsule slides towards negative X2."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CoulombStribeck:
    """The paper's eq. (1): F_s = mu/2 (1 + exp(-|Y2| / v_s)) N, N = (m1 + m2) g, both ways.

    At speed 0: F_b = mu N with slope -F_b / (2 v_s). At infinite speed: F_b / 2 with slope 0. mu in 1, N in N,
    v_s in m/s.
    """

    mu: Array
    N: Array
    v_s: Array

    @classmethod
    def of(cls, p: "CapsuleParameters") -> "CoulombStribeck":
        """The law with the capsule's mu, v_s and weight."""
        mu, N, v_s = (jnp.asarray(leaf) for leaf in (p.mu, (p.m1 + p.m2) * p.g, p.v_s))
        return cls(mu, N, v_s)

    def forward(self, speed: jax.Array) -> jax.Array:
        """F_s at ``speed``."""
        return 0.5 * self.mu * self.N * (1.0 + jnp.exp(-speed / self.v_s))

    def backward(self, speed: jax.Array) -> jax.Array:
        """F_s at ``speed``: the ground is the same both ways."""
        return self.forward(speed)


# ---------------------------------------------------------------- stick-slip rule


def friction(law: FrictionLaw, Y2: Array, f: Array) -> jax.Array:
    """Exact stick-slip rule: what the ground puts on the capsule, N.

    Sliding (Y2 != 0): the law's resistance with the sign of Y2, whatever f.
    At rest (Y2 = 0): f itself while -backward(0) <= f <= forward(0), so that the capsule stays; else the threshold,
    so that it sets off in the direction of f. At Y2 -> +-0 the value jumps to the threshold; at Y2 -> +-infinity and
    at f -> +-infinity it is the law's resistance.
    """
    Y2, f = jnp.asarray(Y2), jnp.asarray(f)
    speed = jnp.abs(Y2)
    forward, backward = law.forward(speed), law.backward(speed)
    sliding = jnp.where(Y2 > 0.0, forward, -backward)
    return jnp.where(Y2 == 0.0, jnp.clip(f, -backward, forward), sliding)


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
