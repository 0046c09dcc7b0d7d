"""The capsule by SciPy alone: DOP853 with terminal events, mode by mode. Shares no code with the package."""

import numpy as np
from scipy.integrate import solve_ivp

Parameters = dict[str, float]


def _force(q: Parameters, y: np.ndarray, contact: bool) -> float:
    r = y[0] - y[2]
    return q["k1"] * r + q["c"] * (y[1] - y[3]) + (q["k2"] * (r - q["G"]) if contact else 0.0)


def _modes(q: Parameters, y: np.ndarray, F_b: float) -> tuple[bool, int]:
    """In contact?, and the direction in which the capsule slides (0: stuck)."""
    contact = bool(y[0] - y[2] >= q["G"])
    f = _force(q, y, contact)
    return contact, int(np.sign(y[3] if y[3] != 0.0 or abs(f) <= F_b else f))


def simulate_scipy(
    q: Parameters,
    times: np.ndarray,
    rtol: float,
    atol: float,
    max_step: float = np.inf,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, int]:
    """(states (n, 4) at ``times``, closings of the gap); q holds the parameters, P_d, Omega and possibly a phase.

    start : (4,) at times[0], by default at rest
    """
    F_b, phase = q["mu"] * (q["m1"] + q["m2"]) * q["g"], q.get("phase", 0.0)
    y, t, contacts = np.zeros(4) if start is None else start.copy(), float(times[0]), 0
    contact, sigma = _modes(q, y, F_b)
    out = np.full((len(times), 4), np.nan)
    out[0] = y
    while t < times[-1]:

        def field(
            t: float, y: np.ndarray, contact: bool = contact, sigma: int = sigma
        ) -> tuple[float, float, float, float]:
            f = _force(q, y, contact)
            friction = 0.5 * F_b * (1.0 + np.exp(-sigma * y[3] / q["v_s"])) * sigma
            a2 = (f - friction) / q["m2"] if sigma else 0.0
            return y[1], (q["P_d"] * np.cos(q["Omega"] * t + phase) - f) / q["m1"], y[3] if sigma else 0.0, a2

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
        options = {"dense_output": True, "rtol": rtol, "atol": atol, "max_step": max_step}
        run = solve_ivp(field, (t, times[-1]), y, "DOP853", events=(gap, motion), **options)
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
