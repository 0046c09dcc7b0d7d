"""The support spring k2 behind the gap G, exact and smoothed; forces in N, lengths in m, elementwise.

The exact engine integrates the linear spring as series coefficients (``exact.taylor``) and does not call ``support``.
"""

from typing import Any

import jax

from capsule_id.physics.batches import array_module
from capsule_id.physics.smooth.steps import Array, smooth_ramp


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
