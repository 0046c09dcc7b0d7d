"""Integration of linear nuisances of a Gaussian likelihood in closed form.

Model, in units of the noise: y = A b + e, e ~ N(0, I), b ~ N(0, I) (the prior's widths are absorbed in A). Then
y ~ N(0, I + A A'), and only the moments y'y, A'y, A'A are needed (matrix inversion and determinant lemmas).
"""

from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

#: sd of the normal prior of a linear nuisance relative to the range of its record, dimensionless; wide but proper.
NUISANCE_WIDTH = 10.0
#: From this number of nuisances on their matrix is factorised in a library, not eliminated step by step.
MANY_NUISANCES = 8
#: log(2 pi), from the normalisation of a normal density.
LOG_2PI = float(np.log(2.0 * np.pi))


def marginal_log_density(yy: Any, ay: Any, aa: Any, n: int, xp: ModuleType = jnp) -> Any:
    """log N(y; 0, I + A A') from the moments, (...).

    Explicit elimination is efficient for few nuisances and works for any number of leading axes.

    Parameters
    ----------
    yy : (...) y'y
    ay : (..., p) A'y
    aa : (..., p, p) A'A
    n : length of y
    """
    if aa.shape[-1] > MANY_NUISANCES:
        root = xp.linalg.cholesky(xp.eye(aa.shape[-1]) + aa)
        half = xp.linalg.solve(root, ay[..., None])[..., 0]
        log_det = 2.0 * xp.sum(xp.log(xp.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
        return -0.5 * (n * LOG_2PI + log_det + yy - xp.sum(half**2, axis=-1))
    rest, rows, log_det = yy, xp.broadcast_to(xp.eye(aa.shape[-1]), aa.shape) + aa, 0.0
    while rows.shape[-1]:
        pivot, first = rows[..., 0, 0], rows[..., 0, 1:]
        log_det, rest = log_det + xp.log(pivot), rest - ay[..., 0] ** 2 / pivot
        ratio = first / pivot[..., None]
        ay = ay[..., 1:] - ratio * ay[..., :1]
        rows = rows[..., 1:, 1:] - ratio[..., :, None] * first[..., None, :]
    return -0.5 * (n * LOG_2PI + log_det + rest)


def conditional_mean(ay: Any, aa: Any, xp: ModuleType = jnp) -> Any:
    """Posterior mean of b given y, (p,): (I + A'A)^-1 A'y."""
    return xp.linalg.solve(xp.eye(aa.shape[-1]) + aa, ay)


def conditional_draw(ay: np.ndarray, aa: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One draw of b given y, (p,)."""
    precision = np.eye(len(aa)) + aa
    chol = np.linalg.cholesky(precision)
    return np.linalg.solve(precision, ay) + np.linalg.solve(chol.T, rng.standard_normal(len(aa)))
