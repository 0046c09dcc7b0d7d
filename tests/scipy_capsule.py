"""The capsule by SciPy alone: DOP853 with terminal events, mode by mode. Shares no code with the package."""

import numpy as np
from scipy.integrate import solve_ivp

Parameters = dict[str, float]


def _force(q: Parameters, y: np.ndarray, contact: bool) -> float:
    r = y[0] - y[2]
    own = q["k1"] * r + q.get("k1_cubic", 0.0) * r**3
    return own + q["c"] * (y[1] - y[3]) + (q["k2"] * (r - q["G"]) if contact else 0.0)


def _modes(q: Parameters, y: np.ndarray, F_b: float) -> tuple[bool, int]:
    """In contact?, and the direction in which the capsule slides (0: stuck)."""
    contact = bool(y[0] - y[2] >= q["G"])
    return contact, int(np.sign(y[3])) or _sets_off(q, _force(q, y, contact), F_b)


def _sets_off(q: Parameters, f: float, F_b: float) -> int:
    """Direction in which a stuck capsule sets off; 0: it stays."""
    return int(f > F_b) - int(f < -q.get("backward", 1.0) * F_b)


def simulate_scipy(
    q: Parameters,
    times: np.ndarray,
    rtol: float,
    atol: float,
    max_step: float = np.inf,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, int]:
    """(states (n, 4) at ``times`` from ``start`` (4,), default at rest; closings of the gap).

    q holds the parameters, P_d, Omega, possibly a phase, and departures from the paper's model: k1_cubic, N/m^3, and
    backward, the friction of backward over that of forward motion.
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
            side = q.get("backward", 1.0) if sigma < 0 else 1.0
            friction = 0.5 * side * F_b * (1.0 + np.exp(-sigma * y[3] / q["v_s"])) * sigma
            a2 = (f - friction) / q["m2"] if sigma else 0.0
            return y[1], (q["P_d"] * np.cos(q["Omega"] * t + phase) - f) / q["m1"], y[3] if sigma else 0.0, a2

        def gap(t: float, y: np.ndarray) -> float:
            return y[0] - y[2] - q["G"]

        def hold(t: float, y: np.ndarray, contact: bool = contact) -> float:
            f = _force(q, y, contact)
            return min(F_b - f, q.get("backward", 1.0) * F_b + f)

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
            sigma = _sets_off(q, f, F_b) if sigma else int(np.sign(f))
            y[3] = 0.0
    return out, contacts
