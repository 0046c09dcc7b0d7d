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


#: Modes after which a run is given up: its last states are NaN. An event that is found twice repeats for ever.
MOST_MODES = 2000
Mode = tuple[bool, bool, int, int]  # contact, back contact, direction of sliding (0: stuck), switches so far


class Capsule:
    """The equations in one mode; q: every parameter of the capsule, and reaction."""

    def __init__(self, q: Values, force: Callable[[float, int], float], rod: Any) -> None:
        self.q, self.force, self.rod = q, force, rod
        self.N = (q["m1"] + q["m2"]) * q["g"] * np.cos(q["slope"]) + q["N0"]
        self.pull = q["g"] * np.sin(q["slope"])

    def resistance(self, speed: float, sigma: int) -> float:
        """Friction of a sliding capsule, N."""
        q, mu = self.q, self.q["mu"] if sigma > 0 else self.q["mu_back"]
        return self.N * mu * (q["ratio"] + (1.0 - q["ratio"]) * np.exp(-speed / q["v_s"])) + q["viscous"] * speed

    def forces(self, t: float, y: np.ndarray, mode: Mode) -> tuple[float, float]:
        """(force on the rod, force on the capsule without friction), N."""
        q, (contact, back, _, on) = self.q, mode
        r, w = y[0] - y[2], y[1] - y[3]
        f = q["k1"] * r + q["k_cubic"] * r**3 + q["c"] * w
        f += (q["k2"] * (r - q["G"]) + q["c2"] * w) if contact else 0.0
        f += q["k2_back"] * (r + q["G_back"]) if back else 0.0
        D = self.force(t, on) if self.rod is None else 0.0
        return D - f - q["m1"] * self.pull, f - q["reaction"] * D - q["m2"] * self.pull

    def sets_off(self, A: float) -> int:
        """Direction in which a stuck capsule sets off under the force A, N; 0: it stays."""
        upper, lower = self.N * self.q["mu"], -self.N * self.q["mu_back"]
        return int(upper < A) - int(lower > A)

    def field(self, t: float, y: np.ndarray, mode: Mode) -> tuple[float, ...]:
        """dy/dt."""
        (F1, A), sigma = self.forces(t, y, mode), mode[2]
        a2 = (A - sigma * self.resistance(sigma * y[3], sigma)) / self.q["m2"] if sigma else 0.0
        return y[1], F1 / self.q["m1"] if self.rod is None else float(self.rod(t, 2)), y[3] if sigma else 0.0, a2

    def events(self, mode: Mode) -> list[Callable[[float, np.ndarray], float]]:
        """Terminal events of the gap, of the back gap, and of stick or slip."""
        q, N, sigma = self.q, self.N, mode[2]

        def gap(t: float, y: np.ndarray) -> float:
            return y[0] - y[2] - q["G"]

        def back_gap(t: float, y: np.ndarray) -> float:
            return y[0] - y[2] + q["G_back"]

        def motion(t: float, y: np.ndarray) -> float:
            A = self.forces(t, y, mode)[1]
            return sigma * y[3] if sigma else min(N * q["mu"] - A, N * q["mu_back"] + A)

        ways = (-1.0 if mode[0] else 1.0, 1.0 if mode[1] else -1.0, -1.0)
        for event, way in zip((gap, back_gap, motion), ways, strict=True):
            event.direction, event.terminal = way, True  # type: ignore[attr-defined]
        return [gap, back_gap, motion]


def simulate_general(
    q: Values,
    drive: Drive,
    times: np.ndarray,
    rtol: float = 1e-8,
    atol: float = 1e-11,
    rod: Any = None,
    max_step: float = np.inf,
    start: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
) -> tuple[np.ndarray, int]:
    """(states (n, 4) at ``times`` from ``start``, closings of the gap); q: every parameter of the capsule, and reaction.

    rod : X1 as a ``CubicSpline`` where the motion of the rod is given; its times must be in the switches
    max_step : s, short where the gaps may open and close within a step: SciPy then misses both events
    """
    force, switches = drive
    capsule = Capsule(q, force, rod)
    y, t, on, contacts = np.array(start), float(times[0]), 0, 0
    if rod is not None:
        y[0], y[1] = rod(t), rod(t, 1)
    contact, back = y[0] - y[2] >= q["G"], y[0] - y[2] <= -q["G_back"]
    sigma = capsule.sets_off(capsule.forces(t, y, (contact, back, 0, on))[1])
    out = np.full((len(times), 4), np.nan)
    out[0] = y
    for _ in range(MOST_MODES):
        if t >= times[-1]:
            break
        mode = (contact, back, sigma, on)
        end = min([s for s in switches if s > t + 1e-13] + [times[-1]])
        options = {
            "events": capsule.events(mode),
            "dense_output": True,
            "rtol": rtol,
            "atol": atol,
            "max_step": max_step,
        }
        run = solve_ivp(lambda t, y, mode=mode: capsule.field(t, y, mode), (t, end), y, "DOP853", **options)
        inside = (times > t) & (times <= run.t[-1])
        if inside.any():
            out[inside] = run.sol(times[inside]).T
        t, y = float(run.t[-1]), run.y[:, -1].copy()
        on += run.status == 0 and t < times[-1]
        if run.t_events[0].size:
            contact, contacts = not contact, contacts + (not contact)
        if run.t_events[1].size:
            back = not back
        A = capsule.forces(t, y, (contact, back, sigma, on))[1]
        if run.t_events[2].size:
            sigma, y[3] = (capsule.sets_off(A) if sigma else int(np.sign(A))), 0.0
        elif not sigma:
            sigma = capsule.sets_off(A)
    return out, contacts
