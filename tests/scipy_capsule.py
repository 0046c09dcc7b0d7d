"""The capsule by SciPy alone: DOP853 with terminal events, mode by mode. Shares no code with the package."""

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

Parameters = dict[str, float]
Law = tuple[Callable[[float], float], Callable[[float], float]]  # resistance forward and backward, N, at a speed, m/s


def _force(q: Parameters, y: np.ndarray, contact: bool) -> float:
    r = y[0] - y[2]
    own = q["k1"] * r + q.get("k1_cubic", 0.0) * r**3
    return own + q["c"] * (y[1] - y[3]) + (q["k2"] * max(r - q["G"], 0.0) ** q.get("power", 1.0) if contact else 0.0)


def eq_1(q: Parameters) -> Law:
    """The paper's law, its backward side times q["backward"]."""

    def forward(speed: float) -> float:
        return 0.5 * q["mu"] * (q["m1"] + q["m2"]) * q["g"] * (1.0 + np.exp(-speed / q["v_s"]))

    return forward, lambda speed: q.get("backward", 1.0) * forward(speed)


def _modes(q: Parameters, y: np.ndarray, law: Law) -> tuple[bool, int]:
    """In contact?, and the direction in which the capsule slides (0: stuck)."""
    contact = bool(y[0] - y[2] >= q["G"])
    return contact, int(np.sign(y[3])) or _sets_off(_force(q, y, contact), law)


def _sets_off(f: float, law: Law) -> int:
    """Direction in which a stuck capsule sets off; 0: it stays."""
    return int(f > law[0](0.0)) - int(f < -law[1](0.0))


def simulate_scipy(
    q: Parameters,
    times: np.ndarray,
    rtol: float,
    atol: float,
    max_step: float = np.inf,
    start: np.ndarray | None = None,
    law: Law | None = None,
) -> tuple[np.ndarray, int]:
    """(states (n, 4) at ``times`` from ``start`` (4,), default at rest; closings of the gap).

    q holds the parameters, P_d, Omega, possibly a phase, and departures from the paper's model: k1_cubic, N/m^3, power,
    of the penetration, and backward, friction backward over that forward. law: another law of friction than eq. (1).
    """
    law, phase = law or eq_1(q), q.get("phase", 0.0)
    holds_forward, holds_backward = law[0](0.0), law[1](0.0)
    y, t, contacts = np.zeros(4) if start is None else start.copy(), float(times[0]), 0
    contact, sigma = _modes(q, y, law)
    out = np.full((len(times), 4), np.nan)
    out[0] = y
    while t < times[-1]:

        def field(
            t: float, y: np.ndarray, contact: bool = contact, sigma: int = sigma
        ) -> tuple[float, float, float, float]:
            f = _force(q, y, contact)
            friction = law[sigma < 0](sigma * y[3]) * sigma
            a2 = (f - friction) / q["m2"] if sigma else 0.0
            return y[1], (q["P_d"] * np.cos(q["Omega"] * t + phase) - f) / q["m1"], y[3] if sigma else 0.0, a2

        def gap(t: float, y: np.ndarray) -> float:
            return y[0] - y[2] - q["G"]

        def hold(t: float, y: np.ndarray, contact: bool = contact) -> float:
            f = _force(q, y, contact)
            return min(holds_forward - f, holds_backward + f)

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
            sigma = _sets_off(f, law) if sigma else int(np.sign(f))
            y[3] = 0.0
    return out, contacts
