"""Maximum of the joint log-posterior from several starts.

Least squares first (it finds the basin, with the scatters held at their starting values), then quasi-Newton on the
joint log-posterior, scatters included, in coordinates whitened by the curvature at the best least-squares end.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from capsule_id.inference.curvature import hessian, jacobian, root_of_inverse
from capsule_id.inference.least_squares import QUICK_COMPILE, covariance, least_squares
from capsule_id.inference.log_posterior import LogPosterior
from capsule_id.inference.result import PointFit

STARTS = 5
#: Ends count as the same where they differ by less than this many posterior standard deviations.
AGREEMENT = 0.05
#: Of a quasi-Newton step, in posterior standard deviations, and of the log-posterior.
TOLERANCE = 1e-6
MAX_STEPS = 400
LEAST_SQUARES_TOLERANCE = 1e-6
#: Relative step of the difference quotients of residuals: their error is then about 1e-10 relative.
DIFFERENCE = 1e-5


def point_fit(target: LogPosterior, seed: int, number_of_starts: int = STARTS) -> PointFit:
    """Fit from ``number_of_starts`` dispersed starts, none of them the truth or on a bound (there are no bounds).

    Parameters
    ----------
    seed : of the dispersal
    """
    starts = dispersed_starts(target, seed, number_of_starts)
    located = np.flatnonzero(~target.scatter)
    centre = jnp.asarray(starts[0])
    rough = least_squares(
        lambda v: target.residuals(centre.at[located].set(v)),
        starts[:, located],
        tolerance=LEAST_SQUARES_TOLERANCE,
        normal_equations=True,
    )
    ends = starts.copy()
    ends[:, located] = np.where(np.isfinite(rough.x), rough.x, starts[:, located])
    scale = _information(target, ends[rough.best]) ** -0.5
    whitening = root_of_inverse(-hessian(target.batch, ends[rough.best], scale))
    polish = _polish(target)
    u, value, converged = (np.stack(part) for part in zip(*(polish(end, whitening) for end in ends), strict=True))
    best = int(np.argmax(np.where(np.isfinite(value), value, -np.inf)))
    scale = _information(target, u[best]) ** -0.5
    root = root_of_inverse(-hessian(target.batch, u[best], scale))
    spread = np.sqrt(np.sum(root**2, axis=1))
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
        agree=bool(np.all(np.abs(u - u[best]) < AGREEMENT * spread)),
        stalled=~converged | ~np.isfinite(value),
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


def _polish(target: LogPosterior) -> Any:
    """Jitted BFGS: (end (d,), whitening (d, d)) -> maximum (d,), log-posterior there, converged.

    Compiled with few optimisations: it runs for milliseconds, and compiling it well takes seconds.
    """

    def one(end: Any, whitening: Any) -> tuple[Any, Any, Any]:
        solution = optx.minimise(
            lambda v, _: -target(end + whitening @ v),
            optx.BFGS(rtol=TOLERANCE, atol=TOLERANCE),
            jnp.zeros(end.shape),
            max_steps=MAX_STEPS,
            throw=False,
        )
        u = end + whitening @ solution.value
        return u, target(u), solution.result == optx.RESULTS.successful

    return jax.jit(one, compiler_options=QUICK_COMPILE)


def _information(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(d,) rough diagonal information: squared residual Jacobian, and 2n for the scatter of n readings."""
    jacobian = _residual_jacobian(target, u)
    count = np.zeros(target.dimension)
    for experiment in target.experiments:
        for row in experiment.parameters:
            if row.scatter:
                count[target.names.index(row.name)] += 2.0 * experiment.n
    return np.maximum(np.where(target.scatter, count, np.sum(jacobian**2, axis=0)), 1e-2)


def _residual_jacobian(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(n, d) Jacobian of the standardised residuals, scatters in the denominator included."""
    return jacobian(target.plain_residuals, u, np.full(len(u), DIFFERENCE))


def _standard_errors(target: LogPosterior, u: np.ndarray, theta: np.ndarray) -> dict[str, float]:
    """From the Jacobian of the standardised residuals, scatters held at the fit; NaN for the scatters; SI.

    The error of a parameter sampled through its logarithm is its relative error times its value.
    """
    located = ~target.scatter
    at_fit = _residual_jacobian(target, u)[:, located]
    errors = np.full(len(u), np.nan)
    matrix = covariance(at_fit, np.zeros(len(at_fit)), residual_sd=1.0)
    errors[located] = matrix.standard_errors * np.where(target.positive, theta, 1.0)[located]
    return dict(zip(target.names, (float(e) for e in errors), strict=True))
