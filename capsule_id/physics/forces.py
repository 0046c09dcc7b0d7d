"""Forces of the model but friction: support spring, primary spring and damper; exact and smoothed, elementwise, SI."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.physics.batches import array_module
from capsule_id.physics.drive import Drive
from capsule_id.precision import require_float64

# grazing: Where contacts begin: the load at which a rod on a capsule at rest just reaches the support spring.


def grazing_load(
    m1: float | np.ndarray,
    k1: float | np.ndarray,
    c: float | np.ndarray,
    G: float | np.ndarray,
    Omega: float | np.ndarray,
) -> np.ndarray:
    """P_graze = G k1 sqrt((1 - rho^2)^2 + (2 zeta rho)^2), N, with rho = Omega sqrt(m1/k1), zeta = c/(2 sqrt(k1 m1)).

    The amplitude of the settled linear motion is G at this load. It holds while the capsule rests: |f| <= F_b all the
    time. Written as G |k1 - m1 Omega^2 + i c Omega|, so that k1 = 0 is no exception.

    Parameters
    ----------
    m1, k1, c, G, Omega : kg, N/m, N s/m, m, rad/s; numbers, or arrays that broadcast
    """
    return np.asarray(G * np.hypot(k1 - m1 * np.asarray(Omega) ** 2, c * np.asarray(Omega)))


# steps: Smoothed Heaviside function, its integral, sign and |x|; every width is positive.
#
# Each is a C2 step of compact support: outside its width the smoothed function *is* the exact one, and its slope and
# curvature stay below 15 / (16 width) and 5 / (2 sqrt(3) width^2). All functions work elementwise.


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


# contacts: The support spring k2 behind the gap G, exact and smoothed; forces in N, lengths in m, elementwise.
#
# The exact engine integrates the linear spring as series coefficients (``exact.taylor``) and does not call ``support``.


#: A gap is far beyond a motion from this multiple of its largest |r| on, and from this size on, m.
FAR, FAR_GAP = 20.0, 0.1


def warn_of_far_gap(G: Any, r: Any) -> None:
    """Warn where every gap ``G``, m, is far beyond the motion ``r``, m; an infinite one means no spring."""
    gap, reach = float(np.min(G)), float(np.nanmax(np.abs(r)))
    if max(FAR * reach, FAR_GAP) < gap < np.inf:
        text = f"the gap is {1e3 * gap:.4g} mm and the largest |x_rel| {1e3 * reach:.3g} mm: no contact. Is it in m?"
        warnings.warn(text, stacklevel=3)


def support(k2: Any, G: Any, r: Any) -> Any:
    """H1 k2 (r - G), H1 = H(r - G) (paper, eq. (2)): 0 for r < G; NumPy and JAX.

    At r = G: 0, continuous, slope jumps from 0 to k2. At r -> -infinity 0; at +infinity k2 (r - G).
    """
    return k2 * array_module(k2, G, r).maximum(r - G, 0.0)


def support_smooth(k2: Array, G: Array, r: Array, penetration: Array) -> jax.Array:
    """k2 R_w(r - G), w = ``penetration`` (m): its slope is k2 times the smoothed Heaviside H1 of eq. (2).

    At r = G: 5 k2 w / 32, slope k2 / 2. Equal to ``support`` wherever |r - G| >= w, so at +-infinity.
    The largest deviation, 5 k2 w / 32, stands at r = G; the energy that it stores, k2 w^2 / 14, is of second order.
    """
    return k2 * smooth_ramp(r - G, penetration)


# forces: The force between rod and capsule, and the acceleration of the rod; NumPy and JAX, elementwise, SI.
#
# Sign: f is the force that the rod puts on the capsule. p has the fields of ``CapsuleParameters``; a field that is None
# is absent. The leaves of p and of the drive broadcast with the state, so leaves (batch,) need a last axis of length 1
# beside samples (batch, n).


#: Newton steps from the linear to the cubic equilibrium; a cubic share of one half needs five.
NEWTON_STEPS = 8


def spring_and_damper(p: Any, r: Any, w: Any) -> Any:
    """k1 r + k_cubic r^3 + c w, N: what acts without contact; r = X1 - X2, w = Y1 - Y2."""
    f = p.k1 * r + p.c * w
    return f if p.k_cubic is None else f + p.k_cubic * (r * r * r)


def rod_on_capsule(p: Any, r: Any, w: Any) -> Any:
    """The spring and damper, and both supports: N.

    f = k1 r + k_cubic r^3 + c w + [r >= G] (k2 (r - G) + c2 w) + [r <= -G_back] k2_back (r + G_back)
    """
    f = spring_and_damper(p, r, w)
    if p.k2 is not None and p.G is not None:
        f = f + support(p.k2, p.G, r)
        f = f if p.c2 is None else f + (p.c2 * w) * (r >= p.G) * (p.k2 > 0.0)
    return f if p.k2_back is None else f - support(p.k2_back, p.G_back, -r)


def downhill(p: Any, mass: Any) -> Any:
    """Weight of a mass along the slope, N, towards -X; NumPy and JAX."""
    return mass * p.g * array_module(p.slope).sin(p.slope) if p.slope is not None else 0.0


def equilibrium(p: Any) -> Any:
    """x_rel, m, of the rod at rest with the drive off and no contact: k1 r + k_cubic r^3 = -m1 g sin(slope)."""
    load = -downhill(p, p.m1)
    r = load / p.k1
    if p.k_cubic is None:
        return r
    for _ in range(NEWTON_STEPS):
        r = r - (p.k1 * r + p.k_cubic * r**3 - load) / (p.k1 + 3.0 * p.k_cubic * r**2)
    return r


def rod_acceleration(p: Any, drive: Drive, t: Any, r: Any, w: Any) -> Any:
    """X1'', m/s^2, at the times t: the reading of an accelerometer on the rod."""
    if drive.prescribed:
        return drive.force_at(t)
    return (drive.force_at(t) - rod_on_capsule(p, r, w) - downhill(p, p.m1)) / p.m1
