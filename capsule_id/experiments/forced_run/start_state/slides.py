"""Starting values of spring, damper and friction from a record with both ends of the rod's spring.

Where the capsule slides in one direction, its equation of motion is linear in the unknowns. Integrated twice from the
start of the slide, it needs no derivative of the record:

    m2 X2 = k1 ∬(r + x0) + c ∫(r − r(0)) − sign(Y2) F t²/2 + a + b t,   r = x_base − x_capsule
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import uniform_filter1d
from scipy.optimize import nnls

#: Samples whose mean speed tells whether the capsule slides: this share of a period.
SMOOTHED = 1.0 / 30.0
#: The capsule slides where its speed exceeds this share of its largest speed. Shortest slide, samples.
SLIDING, SHORTEST_SLIDE = 0.2, 10
#: Least starting value of the damping ratio of capsule and spring.
LEAST_DAMPING = 1e-3


class Slides(NamedTuple):
    """Starting values, SI; ``extension``: of the spring where r = 0; ``speed``: mean of the sliding capsule."""

    k1: float
    c: float
    friction: float
    extension: float
    speed: float


def slides(time: np.ndarray, r: np.ndarray, X2: np.ndarray, period: float, m2: float) -> Slides | None:
    """Estimate spring, damper and constant friction from the slides of a record; None where they do not determine them.

    Parameters
    ----------
    time, r, X2 : (n,) s, m, m; r differs from the spring's extension by a constant
    period : of the motion, s
    m2 : mass of the capsule, kg
    """
    samples = max(3, round(SMOOTHED * period * len(time) / (time[-1] - time[0])))
    rate = uniform_filter1d(np.gradient(X2, time), samples)
    direction = np.where(np.abs(rate) > SLIDING * np.max(np.abs(rate)), np.sign(rate), 0.0)
    edges = np.flatnonzero(np.diff(direction)) + 1
    pieces = np.split(np.arange(len(time)), edges.tolist())
    slides = [i for i in pieces if direction[i[0]] != 0.0 and len(i) >= SHORTEST_SLIDE]
    own = [_slide(time[i], r[i], m2 * X2[i], float(direction[i[0]])) for i in slides]
    if not own:
        return None
    rows = np.concatenate(own)
    size = np.linalg.norm(rows, axis=0)
    if not np.all(size > 0.0):
        return None
    # The constant part of the extension has either sign.
    design = rows[:, [0, 1, 2, 2, 3]] * np.array([1.0, 1.0, 1.0, -1.0, 1.0]) / size[[0, 1, 2, 2, 3]]
    found = nnls(design, rows[:, 4])[0] / size[[0, 1, 2, 2, 3]]
    k1, c, force, friction = float(found[0]), float(found[1]), float(found[2] - found[3]), float(found[4])
    if not (k1 > 0.0 and friction > 0.0):
        return None
    speed = float(np.mean(np.abs(rate[direction != 0.0])))
    return Slides(k1, max(c, 2.0 * LEAST_DAMPING * float(np.sqrt(k1 * m2))), friction, force / k1, speed)


def _slide(time: np.ndarray, r: np.ndarray, momentum: np.ndarray, direction: float) -> np.ndarray:
    """(n, 5) coefficients of k1, c, k1 x0 and F, and ``momentum`` = m2 X2, of one slide, without its line in time."""
    t = time - time[0]
    once = cumulative_trapezoid(r, t, initial=0.0)
    twice = cumulative_trapezoid(once, t, initial=0.0)
    rows = np.stack([twice, once - r[0] * t, 0.5 * t**2, -0.5 * direction * t**2, momentum], axis=1)
    line = np.linalg.qr(np.stack([np.ones_like(t), t], axis=1))[0]
    return rows - line @ (line.T @ rows)
