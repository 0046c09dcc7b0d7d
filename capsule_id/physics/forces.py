"""The force between rod and capsule, and the acceleration of the rod: eq. (2); NumPy and JAX, elementwise, SI.

Sign: f is the force that the rod puts on the capsule. p has the fields m1, k1, k2, c and G. The leaves of p and of the
drive broadcast with the state, so leaves (batch,) need a last axis of length 1 beside samples (batch, n).
"""

from typing import Any

from capsule_id.physics.contacts import support
from capsule_id.physics.drive import Drive


def spring_and_damper(p: Any, r: Any, w: Any) -> Any:
    """k1 r + c w, N: what acts without contact; r = X1 - X2, w = Y1 - Y2."""
    return p.k1 * r + p.c * w


def rod_on_capsule(p: Any, r: Any, w: Any) -> Any:
    """f = k1 r + c w + [r >= G] k2 (r - G), N."""
    return spring_and_damper(p, r, w) + support(p.k2, p.G, r)


def rod_acceleration(p: Any, drive: Drive, t: Any, r: Any, w: Any) -> Any:
    """X1'' = (drive - f)/m1, m/s^2, at the times t: the reading of an accelerometer on the rod."""
    return (drive.force(t) - rod_on_capsule(p, r, w)) / p.m1
