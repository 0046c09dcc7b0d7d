"""Where contacts begin: the load at which a rod on a capsule at rest just reaches the support spring."""

import numpy as np


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
