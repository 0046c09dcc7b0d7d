"""The support spring k2 behind the gap G, exact and smoothed; forces in N, lengths in m, elementwise.

The exact engine integrates the linear spring as series coefficients (``exact.taylor``) and does not call ``support``.
"""

import warnings
from typing import Any

import jax
import numpy as np

from capsule_id.physics.batches import array_module
from capsule_id.physics.smooth.steps import Array, smooth_ramp

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
