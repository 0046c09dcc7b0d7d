"""Whether a capsule was at rest at the first sample of a run, told by the whole record.

A capsule that creeps at the first sample looks like one at rest that is about to set off; what it does later tells them
apart once the rest of the model is known.
"""

import numpy as np

from capsule_id.experiments.base import Theta
from capsule_id.experiments.forced_run.experiment import NOISES, ForcedRun

#: Speeds at the first sample, m/s, that are held against the record; the middle one is rest.
CREEP = np.concatenate([-np.geomspace(60e-3, 0.5e-3, 13), [0.0], np.geomspace(0.5e-3, 60e-3, 13)])
AT_REST = 13
#: Gauss–Newton steps, the difference quotients' steps and the largest steps of x_rel, m, and of the rod's speed, m/s.
STEPS, NUDGE, LARGEST = 5, (1e-8, 1e-6), (2e-4, 0.1)
#: The capsule moves where the log-likelihood is up by this much on that at rest.
GAIN = 3.0


def restarted(run: ForcedRun, speed: float) -> ForcedRun:
    """The same record with its capsule at this ``speed``, m/s, at the first sample; 0: stuck."""
    other = ForcedRun(run.table, run.rig, speed)
    other.model, other.smoothing = run.model, run.smoothing
    return other


def better_start(run: ForcedRun, theta: Theta) -> dict[str, float] | None:
    """Symbols and values, SI, of a start that fits the whole record better than that of ``theta``; None: there is none.

    capsule_start is 0 where nothing tells it from rest. For every speed of the capsule the rod's place and speed are
    found anew (Gauss–Newton), for they make up for much of it; all else is as in ``theta``.
    """
    moving, own = restarted(run, 1.0), float(theta.get("capsule_start", 0.0))
    speeds = np.append(CREEP, own)
    rod = np.full((2, len(speeds)), [[theta["x_start"]], [theta["y_start"] + own]])
    nudged = np.array([[0.0, 0.0], [NUDGE[0], 0.0], [0.0, NUDGE[1]]])
    best, where = np.full(len(speeds), np.inf), rod
    for _ in range(STEPS):
        miss = np.stack([_misses(moving, theta, *one, speeds) for one in rod + nudged[..., None]])
        squares = np.sum(miss[0] ** 2, axis=1)
        better = squares < best
        best, where = np.where(better, squares, best), np.where(better, rod, where)
        slope = (miss[1:] - miss[0]) / np.array(NUDGE)[:, None, None]
        normal = np.einsum("iln,jln->lij", slope, slope)
        pull = np.einsum("iln,ln->li", slope, miss[0])
        known = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(pull).all(axis=1)
        normal, pull = np.where(known[:, None, None], normal, np.eye(2)), np.where(known[:, None], pull, 0.0)
        step = -np.einsum("lij,lj->il", np.linalg.pinv(normal), pull)
        rod = rod + np.clip(step, -np.array(LARGEST)[:, None], np.array(LARGEST)[:, None])
    found = int(np.argmin(best))
    if 0.5 * (best[AT_REST] - best[found]) < GAIN:
        found = AT_REST
    # The last of the speeds is that of ``theta`` itself.
    same_kind = np.sign(speeds[found]) == (np.sign(own) if run.start == "moving" else 0.0)
    if same_kind or (0.5 * (best[-1] - best[found]) < GAIN and speeds[found] != 0.0):
        return None
    x, Y1 = where[:, found].tolist()
    speed = float(speeds[found])
    return {"x_start": x, "y_start": Y1 - speed, "capsule_start": speed}


def _misses(run: ForcedRun, theta: Theta, x: np.ndarray, Y1: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """(lanes, readings) of the channels that the motion moves, offsets taken off, in units of the noise."""
    lanes = {name: np.full(len(x), value) for name, value in theta.items() if np.ndim(value) == 0}
    seen = run.predict({**lanes, "x_start": x, "y_start": Y1 - speeds, "capsule_start": speeds}, np)
    parts = []
    for values, model, name in zip(run.values, seen, run.channels, strict=True):
        if name != "current":
            miss = (values - model) / theta[NOISES[name]]
            parts.append(miss - np.mean(miss, axis=1, keepdims=True))
    return np.concatenate(parts, axis=1)
