"""Levenberg-Marquardt by differences, for models whose residuals have kinks in the parameters.

Derivatives at a point say little about a motion that sticks a step later on its other side. Differences over a finite
step smooth the kinks, and the log-posterior of many damped steps is computed in one batch.
"""

from functools import partial

import jax
import numpy as np

from capsule_id.inference.fit.least_squares import LeastSquaresFit
from capsule_id.inference.target.compiling import COMPILE
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.interruption import stop_if_interrupted
from capsule_id.physics.batches import pool

#: Rows of a batch of residuals.
ROWS = 8
#: Step of the differences: relative, or part of the prior's sd where u is not a logarithm.
DIFFERENCE = 2e-3
#: Dampings that one batch tries, relative to the diagonal of J'J.
DAMPINGS = np.geomspace(1e-5, 1e3, 16)
#: Largest change of a logarithm in one step, and of another parameter in prior sds.
LONGEST_STEP = 0.7
#: A step that lowers the cost by less than this part of it is the last one; largest number of steps.
LEAST_DECREASE, MAX_STEPS = 3e-3, 10


def descend(target: LogPosterior, u: np.ndarray, most: int = MAX_STEPS) -> LeastSquaresFit:
    """Minimise half the squared residuals over the located parameters from u (d,) in ``most`` steps; the scatters stay."""
    located = target.located
    scale = np.where(target.positive, 1.0, target.prior_sd)[located]
    step, u = DIFFERENCE * scale, u.copy()
    steps = 0
    while steps < most:
        steps += 1
        stop_if_interrupted()
        points = np.repeat(u[None], len(located) + 1, axis=0)
        points[1:, located] += np.diag(step)
        residuals = rows_of(target, points)
        jacobian = (residuals[1:] - residuals[0]).T / step
        cost = 0.5 * float(residuals[0] @ residuals[0])
        if not (np.isfinite(jacobian).all() and np.isfinite(cost)):
            break
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ residuals[0]
        damped = normal + DAMPINGS[:, None, None] * np.diag(np.diag(normal))
        moves = -np.linalg.solve(damped, np.broadcast_to(gradient, (len(damped), len(step)))[..., None])[..., 0]
        moves /= np.maximum(1.0, np.max(np.abs(moves / scale), axis=1, keepdims=True) / LONGEST_STEP)
        trials = np.repeat(u[None], len(moves), axis=0)
        trials[:, located] += moves
        costs = 0.5 * np.sum(rows_of(target, trials) ** 2, axis=1)
        best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        if costs[best] < cost:
            u = trials[best]
        if not costs[best] < (1.0 - LEAST_DECREASE) * cost:
            break
    return LeastSquaresFit(
        x=u[located][None],
        cost=np.array([cost]),
        stalled=np.array([not np.isfinite(cost)]),
        steps=np.array([steps]),
        message=("",),
        residuals=residuals[:1],
        jacobian=jacobian[None],
    )


def rows_of(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(m, n) residuals at u (m, d)."""
    padded = np.concatenate([u, np.repeat(u[-1:], -len(u) % ROWS, axis=0)])
    first, *rest = np.split(padded, len(padded) // ROWS)
    # The first batch compiles the program that all threads then call.
    parts = [
        np.asarray(_residuals(target, first)),
        *pool().map(lambda part: np.asarray(_residuals(target, part)), rest),
    ]
    return np.concatenate(parts)[: len(u)]


@partial(jax.jit, compiler_options=COMPILE)
def _residuals(target: LogPosterior, u: jax.Array) -> jax.Array:
    return jax.vmap(target.residuals)(u)
