"""The capsule by SciPy alone: DOP853 with terminal events, mode by mode. Shares no code with the package."""

import numpy as np
from scipy.integrate import solve_ivp

Parameters = dict[str, float]


def _force(q: Parameters, y: np.ndarray, contact: bool) -> float:
    r = y[0] - y[2]
    return q["k1"] * r + q["c"] * (y[1] - y[3]) + (q["k2"] * (r - q["G"]) if contact else 0.0)


def simulate_scipy(
    q: Parameters, times: np.ndarray, rtol: float, atol: float, max_step: float = np.inf
) -> tuple[np.ndarray, int]:
    """(states (n, 4) from rest at ``times``, closings of the gap); q holds the parameters, P_d and Omega."""
    F_b = q["mu"] * (q["m1"] + q["m2"]) * q["g"]
    y, t, contact, sigma, contacts = np.zeros(4), float(times[0]), False, 0, 0
    out = np.full((len(times), 4), np.nan)
    out[0] = y
    while t < times[-1]:

        def field(
            t: float, y: np.ndarray, contact: bool = contact, sigma: int = sigma
        ) -> tuple[float, float, float, float]:
            f = _force(q, y, contact)
            friction = 0.5 * F_b * (1.0 + np.exp(-sigma * y[3] / q["v_s"])) * sigma
            a2 = (f - friction) / q["m2"] if sigma else 0.0
            return y[1], (q["P_d"] * np.cos(q["Omega"] * t) - f) / q["m1"], y[3] if sigma else 0.0, a2

        def gap(t: float, y: np.ndarray) -> float:
            return y[0] - y[2] - q["G"]

        def hold(t: float, y: np.ndarray, contact: bool = contact) -> float:
            return F_b - abs(_force(q, y, contact))

        def speed(t: float, y: np.ndarray) -> float:
            return y[3]

        gap.direction = -1.0 if contact else 1.0
        motion = speed if sigma else hold
        motion.direction = -float(sigma) if sigma else -1.0
        gap.terminal = motion.terminal = True
        run = solve_ivp(
            field,
            (t, times[-1]),
            y,
            "DOP853",
            dense_output=True,
            events=(gap, motion),
            rtol=rtol,
            atol=atol,
            max_step=max_step,
        )
        inside = (times > t) & (times <= run.t[-1])
        if inside.any():
            out[inside] = run.sol(times[inside]).T
        t, y = float(run.t[-1]), run.y[:, -1].copy()
        if run.status == 0:
            break
        if run.t_events[0].size:
            contact = not contact
            contacts += contact
        if run.t_events[1].size:
            f = _force(q, y, contact)
            if sigma == 0:
                sigma = int(np.sign(f))
            else:
                y[3] = 0.0
                sigma = int(np.sign(f)) if abs(f) > F_b else 0
    return out, contacts
