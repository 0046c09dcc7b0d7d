"""The general capsule by SciPy alone: DOP853 with terminal events, mode by mode. Shares no code with the package."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

Values = dict[str, float]
#: (t, on) -> D in N, and the times at which it switches; ``on`` counts the switches so far.
Drive = tuple[Callable[[float, int], float], Sequence[float]]


def pulses(q: Values, end: float) -> Drive:
    """D of pulses with a lag, phase 0: exact between switches, by recursion over them."""
    T, duty, lag = q["period"], q["duty"], q["lag"]
    switches = [t for k in range(int(end / T) + 1) for t in ((k + duty) * T, (k + 1) * T) if t < end]
    levels, begins = [q["P_off"]], [0.0, *switches]
    for i, (a, b) in enumerate(pairwise(begins)):
        u = q["P_off"] if i % 2 else q["P_on"]
        levels.append(u + (levels[-1] - u) * np.exp(-(b - a) / lag))

    def force(t: float, i: int) -> float:
        u = q["P_off"] if i % 2 else q["P_on"]
        return u + (levels[i] - u) * np.exp(-(t - begins[i]) / lag)

    return force, switches


def simulate_general(
    q: Values, drive: Drive, times: np.ndarray, rtol: float = 1e-8, atol: float = 1e-11, rod: Any = None
) -> tuple[np.ndarray, int]:
    """(states (n, 4) at ``times`` from rest, closings of the gap); q: every parameter of the capsule, and reaction.

    rod : X1 as a ``CubicSpline`` where the motion of the rod is given; its times must be in the switches
    """
    force, switches = drive
    N = (q["m1"] + q["m2"]) * q["g"] * np.cos(q["slope"]) + q["N0"]
    pull = q["g"] * np.sin(q["slope"])

    def resistance(speed: float, sigma: int) -> float:
        mu = q["mu"] if sigma > 0 else q["mu_back"]
        return N * mu * (q["ratio"] + (1.0 - q["ratio"]) * np.exp(-speed / q["v_s"])) + q["viscous"] * speed

    def forces(t: float, y: np.ndarray, mode: tuple[bool, bool, int, int]) -> tuple[float, float]:
        """(force on the rod, force on the capsule without friction), N."""
        contact, back, _, on = mode
        r, w = y[0] - y[2], y[1] - y[3]
        f = q["k1"] * r + q["k_cubic"] * r**3 + q["c"] * w
        f += (q["k2"] * (r - q["G"]) + q["c2"] * w) if contact else 0.0
        f += q["k2_back"] * (r + q["G_back"]) if back else 0.0
        D = force(t, on) if rod is None else 0.0
        return D - f - q["m1"] * pull, f - q["reaction"] * D - q["m2"] * pull

    def sets_off(A: float) -> int:
        return int(N * q["mu"] < A) - int(-N * q["mu_back"] > A)

    y, t, on, contacts = np.zeros(4), float(times[0]), 0, 0
    if rod is not None:
        y[0], y[1] = rod(t), rod(t, 1)
    contact, back = y[0] - y[2] >= q["G"], y[0] - y[2] <= -q["G_back"]
    sigma = sets_off(forces(t, y, (contact, back, 0, on))[1])
    out = np.full((len(times), 4), np.nan)
    out[0] = y
    while t < times[-1]:
        mode = (contact, back, sigma, on)
        end = min([s for s in switches if s > t + 1e-13] + [times[-1]])

        def field(t: float, y: np.ndarray, mode: tuple[bool, bool, int, int] = mode) -> tuple[float, ...]:
            F1, A = forces(t, y, mode)
            sigma = mode[2]
            a2 = (A - sigma * resistance(sigma * y[3], sigma)) / q["m2"] if sigma else 0.0
            return y[1], F1 / q["m1"] if rod is None else float(rod(t, 2)), y[3] if sigma else 0.0, a2

        def gap(t: float, y: np.ndarray) -> float:
            return y[0] - y[2] - q["G"]

        def back_gap(t: float, y: np.ndarray) -> float:
            return y[0] - y[2] + q["G_back"]

        def motion(t: float, y: np.ndarray, mode: tuple[bool, bool, int, int] = mode) -> float:
            A = forces(t, y, mode)[1]
            return mode[2] * y[3] if mode[2] else min(N * q["mu"] - A, N * q["mu_back"] + A)

        events = (gap, back_gap, motion)
        for event, way in zip(events, (-1.0 if contact else 1.0, 1.0 if back else -1.0, -1.0), strict=True):
            event.direction, event.terminal = way, True  # type: ignore[attr-defined]
        run = solve_ivp(field, (t, end), y, "DOP853", events=events, dense_output=True, rtol=rtol, atol=atol)
        inside = (times > t) & (times <= run.t[-1])
        if inside.any():
            out[inside] = run.sol(times[inside]).T
        t, y = float(run.t[-1]), run.y[:, -1].copy()
        on += run.status == 0 and t < times[-1]
        if run.t_events[0].size:
            contact, contacts = not contact, contacts + (not contact)
        if run.t_events[1].size:
            back = not back
        A = forces(t, y, (contact, back, sigma, on))[1]
        if run.t_events[2].size:
            sigma, y[3] = (sets_off(A) if sigma else int(np.sign(A))), 0.0
        elif not sigma:
            sigma = sets_off(A)
    return out, contacts
