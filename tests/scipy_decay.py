"""Free decays by SciPy's DOP853 with located turning points: an independent route to the package's forward model."""

from collections.abc import Mapping
from typing import cast

import numpy as np
from scipy.integrate import OdeSolution, solve_ivp


def scipy_decay(time: np.ndarray, forces: Mapping[str, float], amplitude: float, turning_time: float) -> np.ndarray:
    """(3, n) x_rel, its rate and its acceleration, SI, at ``time`` from the turning point (positive) on.

    Half cycle by half cycle, because dry friction changes only at turning points; the rod stops where the spring cannot
    move it.
    """
    k1, c, m1 = forces["k1"], forces["c"], forces["m1"]
    F_dry, c_q, k_cubic = (forces.get(name, 0.0) for name in ("F_dry", "c_q", "k_cubic"))
    motion = np.full((3, len(time)), np.nan)
    start, x, direction = turning_time, amplitude, -1.0
    while abs(k1 * x + k_cubic * x**3) > F_dry and start < time[-1]:

        def acceleration(s: np.ndarray, direction: float = direction) -> np.ndarray:
            force = k1 * s[0] + k_cubic * s[0] ** 3 + c * s[1] + c_q * s[1] * np.abs(s[1]) + F_dry * direction
            return -force / m1

        def turning(t: float, s: np.ndarray, start: float = start, away: float = direction) -> float:
            return s[1] if t > start + 0.1 * np.sqrt(m1 / k1) else away

        turning.terminal = True  # type: ignore[attr-defined]
        part = solve_ivp(
            lambda t, s, a=acceleration: [s[1], a(s)],
            (start, start + 20.0 * np.sqrt(m1 / k1)),
            [x, 0.0],
            method="DOP853",
            rtol=1e-12,
            atol=1e-18,
            events=turning,
            dense_output=True,
        )
        inside = (time >= start) & (time <= part.t[-1])
        if inside.any():
            state = cast(OdeSolution, part.sol)(time[inside])
            motion[:, inside] = [*state, acceleration(state)]
        start, x, direction = part.t[-1], float(part.y[0, -1]), -direction
    stuck = np.isnan(motion[0])
    motion[:, stuck] = np.array([[x], [0.0], [0.0]])
    return motion
