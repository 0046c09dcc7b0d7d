"""Test with the whole record whether the capsule is at rest at the first sample of a run.

The first samples alone do not distinguish a slowly sliding capsule from one that is about to slip. Given the other
parameters, the later motion does.
"""

from typing import TYPE_CHECKING

import numpy as np

from capsule_id.experiments.base import ValuesBySymbol

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

#: Trial speeds of the capsule at the first sample, m/s. Logarithmic spacing resolves slow and fast sliding.
TRIAL_SPEEDS = np.concatenate([-np.geomspace(60e-3, 0.5e-3, 13), [0.0], np.geomspace(0.5e-3, 60e-3, 13)])
#: Index of zero speed in ``TRIAL_SPEEDS``.
ZERO_SPEED = 13
#: Number of Gauss–Newton steps.
GAUSS_NEWTON_STEPS = 5
#: Steps of the difference quotients, and largest Gauss–Newton steps, of x_rel, m, and of the rod's speed, m/s.
DIFFERENCE_STEPS, LARGEST_STEPS = (1e-8, 1e-6), (2e-4, 0.1)
#: Smallest increase in log-likelihood over a capsule at rest for which the capsule counts as moving.
LOG_LIKELIHOOD_RATIO = 3.0


def corrected_start(run: "ForcedRun", theta: ValuesBySymbol) -> "tuple[ForcedRun, dict[str, float]] | None":
    """Replace the kind of initial state of ``run``; also return values by name from which a fit continues.

    None: the initial state is stated, x_capsule is not recorded, or no other initial state fits better.
    """
    if not run.about.start_is_open or "x_capsule" not in run.channels:
        return None
    better = better_start(run, theta)
    if better is None:
        return None
    restarted = run.restarted(better["capsule_start"])
    # A prescribed rod has no initial speed to sample, and a capsule at rest none either.
    sampled = {row.symbol for row in restarted.parameters}
    return restarted, {f"{symbol}[{run.label}]": value for symbol, value in better.items() if symbol in sampled}


def better_start(run: "ForcedRun", theta: ValuesBySymbol) -> dict[str, float] | None:
    """Initial state, SI by symbol, that fits the whole record better than that of ``theta``; None: there is none.

    capsule_start is 0 where it does not differ significantly from rest. For every trial speed, Gauss–Newton estimates
    position and speed of the rod again, because they compensate much of the change. Other values are as in ``theta``.
    """
    moving, own = run.restarted(1.0), float(theta.get("capsule_start", 0.0))
    speeds = np.append(TRIAL_SPEEDS, own)
    rod = np.full((2, len(speeds)), [[theta["x_start"]], [theta.get("y_start", 0.0) + own]])
    offsets = np.array([[0.0, 0.0], [DIFFERENCE_STEPS[0], 0.0], [0.0, DIFFERENCE_STEPS[1]]])
    best, where = np.full(len(speeds), np.inf), rod
    for _ in range(GAUSS_NEWTON_STEPS):
        miss = np.stack([_misses(moving, theta, *one, speeds) for one in rod + offsets[..., None]])
        squares = np.sum(miss[0] ** 2, axis=1)
        better = squares < best
        best, where = np.where(better, squares, best), np.where(better, rod, where)
        slope = (miss[1:] - miss[0]) / np.array(DIFFERENCE_STEPS)[:, None, None]
        normal = np.einsum("iln,jln->lij", slope, slope)
        pull = np.einsum("iln,ln->li", slope, miss[0])
        known = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(pull).all(axis=1)
        normal, pull = np.where(known[:, None, None], normal, np.eye(2)), np.where(known[:, None], pull, 0.0)
        step = -np.einsum("lij,lj->il", np.linalg.pinv(normal), pull)
        rod = rod + np.clip(step, -np.array(LARGEST_STEPS)[:, None], np.array(LARGEST_STEPS)[:, None])
    found = int(np.argmin(best))
    if 0.5 * (best[ZERO_SPEED] - best[found]) < LOG_LIKELIHOOD_RATIO:
        found = ZERO_SPEED
    # The last speed is that of ``theta``.
    same_kind = np.sign(speeds[found]) == (np.sign(own) if run.moves else 0.0)
    if same_kind or (0.5 * (best[-1] - best[found]) < LOG_LIKELIHOOD_RATIO and speeds[found] != 0.0):
        return None
    x, Y1 = where[:, found].tolist()
    speed = float(speeds[found])
    return {"x_start": x, "y_start": Y1 - speed, "capsule_start": speed}


def _misses(run: "ForcedRun", theta: ValuesBySymbol, x: np.ndarray, Y1: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """(lanes, readings) residuals of the channels that depend on the motion, without offsets, in units of noise."""
    lanes = {name: np.full(len(x), value) for name, value in theta.items() if np.ndim(value) == 0}
    seen = run.predict({**lanes, "x_start": x, "y_start": Y1 - speeds, "capsule_start": speeds}, np)
    parts = []
    for values, model, name in zip(run.values, seen, run.channels, strict=True):
        if name != "current":
            miss = (values - model) / theta[f"noise_{name}"]
            parts.append(miss - np.mean(miss, axis=1, keepdims=True))
    return np.concatenate(parts, axis=1)
