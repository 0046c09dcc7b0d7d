"""Smoothed Heaviside function, its integral, sign and |x|; every width is positive.

Each is a C2 step of compact support: outside its width the smoothed function *is* the exact one, and its slope and
curvature stay below 15 / (16 width) and 5 / (2 sqrt(3) width^2). All functions work elementwise.
"""

import jax
import jax.numpy as jnp

from capsule_id.precision import require_float64

require_float64()

Array = jax.Array | float


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
