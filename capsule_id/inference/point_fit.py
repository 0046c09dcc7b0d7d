"""Maximum of the joint log-posterior from several starts.

Least squares first (it finds the basin, with the scatters held at their starting values), then quasi-Newton on the
joint log-posterior, scatters included, in coordinates whitened by the curvature at the best least-squares end.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from capsule_id.inference.least_squares import covariance, least_squares
from capsule_id.inference.log_posterior import LogPosterior
from capsule_id.inference.result import PointFit

STARTS = 5
#: Ends count as the same where they differ by less than this many posterior standard deviations.
AGREEMENT = 0.05
#: Of a quasi-Newton step, in posterior standard deviations, and of the log-posterior.
TOLERANCE = 1e-6
MAX_STEPS = 400
LEAST_SQUARES_TOLERANCE = 1e-8


def point_fit(target: LogPosterior, seed: int, number_of_starts: int = STARTS) -> PointFit:
    """Fit from ``number_of_starts`` dispersed starts, none of them the truth or on a bound (there are no bounds).

    Parameters
    ----------
    seed : of the dispersal
    """
    starts = dispersed_starts(target, seed, number_of_starts)
    location = np.array([row.physical or not row.positive or row.symbol == "amplitude" for row in target.parameters])
    centre = starts[0].copy()

    def held(v: Any) -> Any:
        return target.residuals(jnp.asarray(centre).at[np.flatnonzero(location)].set(v))

    rough = least_squares(held, starts[:, location], tolerance=LEAST_SQUARES_TOLERANCE)
    ends = starts.copy()
    ends[:, location] = np.where(np.isfinite(rough.x), rough.x, starts[:, location])
    curvature = jax.jit(jax.hessian(lambda u: -target(u)))
    whitening = _root_of_inverse(np.asarray(curvature(ends[rough.best])))
    u, value, result = _polish(target, jnp.asarray(ends), jnp.asarray(whitening))
    u, value = np.asarray(u), np.asarray(value)
    stalled = np.asarray(result != optx.RESULTS.successful) | ~np.isfinite(value)
    best = int(np.argmax(np.where(np.isfinite(value), value, -np.inf)))
    root = _root_of_inverse(np.asarray(curvature(u[best])))
    spread = np.sqrt(np.sum(root**2, axis=1))
    agree = bool(np.all(np.abs(u - u[best]) < AGREEMENT * spread))
    theta = target.theta(u[best])
    return PointFit(
        names=target.names,
        u=u[best],
        values=dict(zip(target.names, (float(v) for v in theta), strict=True)),
        covariance=root @ root.T,
        standard_errors=_standard_errors(target, u[best], theta),
        starts=starts,
        ends=u,
        log_posterior=value,
        agree=agree,
        stalled=stalled,
    )


def dispersed_starts(target: LogPosterior, seed: int, number: int) -> np.ndarray:
    """(number, d) in u: the proposed centre, then normal draws about it with each parameter's own spread."""
    proposed = [target.starts()[name] for name in target.names]
    centre = target.unconstrain(np.array([start.centre for start in proposed]))
    spread = np.array([start.spread for start in proposed])
    z = np.random.default_rng(seed).standard_normal((number, target.dimension))
    # The first start is the paper's estimate itself; the others leave it by at least a third of their spread.
    z = np.where(np.abs(z) < 1.0 / 3.0, np.copysign(1.0 / 3.0, z), z)
    z[0] = 0.0
    return centre + spread * z


@partial(eqx.filter_jit)
def _polish(target: LogPosterior, ends: jax.Array, whitening: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
    """BFGS from every end, (s, d): maxima (s, d), log-posterior (s,), result codes (s,)."""

    def one(end: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        solution = optx.minimise(
            lambda v, _: -target(end + whitening @ v),
            optx.BFGS(rtol=TOLERANCE, atol=TOLERANCE),
            jnp.zeros(end.shape),
            max_steps=MAX_STEPS,
            throw=False,
        )
        u = end + whitening @ solution.value
        return u, target(u), solution.result

    return eqx.filter_vmap(one)(ends)


def _root_of_inverse(hessian: np.ndarray) -> np.ndarray:
    """R (d, d) with R R' = H^-1; directions without positive curvature get the weakest positive one instead.

    Away from the maximum H may be indefinite; it only serves as a metric there.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(hessian)), 1e-12))
    eigenvalues, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    positive = eigenvalues > 1e-8 * eigenvalues[-1]
    eigenvalues = np.where(positive, eigenvalues, np.min(eigenvalues[positive]))
    return scale[:, None] * vectors / np.sqrt(eigenvalues)


def _standard_errors(target: LogPosterior, u: np.ndarray, theta: np.ndarray) -> dict[str, float]:
    """From the Jacobian of the standardised residuals, scatters held at the fit; NaN for the scatters; SI.

    The error of a parameter sampled through its logarithm is its relative error times its value.
    """
    jacobian = np.asarray(jax.jit(jax.jacfwd(target.residuals))(u))
    physical = np.array([row.physical for row in target.parameters])
    matrix = covariance(jacobian[:, physical], np.zeros(len(jacobian)), residual_sd=1.0)
    errors = np.full(len(u), np.nan)
    errors[physical] = matrix.standard_errors * np.where(target.positive, theta, 1.0)[physical]
    return dict(zip(target.names, (float(e) for e in errors), strict=True))
