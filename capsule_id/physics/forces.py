"""The force between rod and capsule, and the acceleration of the rod; NumPy and JAX, elementwise, SI.

Sign: f is the force that the rod puts on the capsule. p has the fields of ``CapsuleParameters``; a field that is None
is absent. The leaves of p and of the drive broadcast with the state, so leaves (batch,) need a last axis of length 1
beside samples (batch, n).
"""

from typing import Any

from capsule_id.physics.batches import array_module
from capsule_id.physics.contacts import support
from capsule_id.physics.drive import Drive

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
