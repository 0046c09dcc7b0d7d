"""Integration of linear nuisances of a Gaussian likelihood in closed form.

Model, in units of the noise: y = A b + e, e ~ N(0, I), b ~ N(0, I) (the prior's widths are absorbed in A). Then
y ~ N(0, I + A A'), and only the moments y'y, A'y, A'A are needed (matrix inversion and determinant lemmas).
"""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

#: sd of the normal prior of a linear nuisance relative to the range of its record, dimensionless; wide but proper.
NUISANCE_WIDTH = 10.0
#: From this number of nuisances on they are eliminated in a loop, not step by step.
MANY_NUISANCES = 8
#: log(2 pi), from the normalisation of a normal density.
LOG_2PI = float(np.log(2.0 * np.pi))


def marginal_log_density(yy: Any, ay: Any, aa: Any, n: Any, xp: ModuleType = jnp) -> Any:
    """log N(y; 0, I + A A') from the moments, (...).

    Explicit elimination is efficient for few nuisances and works for any number of leading axes.

    Parameters
    ----------
    yy : (...) y'y
    ay : (..., p) A'y
    aa : (..., p, p) A'A
    n : length of y, (...) or one for all
    """
    if aa.shape[-1] > MANY_NUISANCES:
        mean, log_det = _solve(ay, aa, xp)
        return -0.5 * (n * LOG_2PI + log_det + yy - xp.sum(ay * mean, axis=-1))
    rest, rows, log_det = yy, xp.broadcast_to(xp.eye(aa.shape[-1]), aa.shape) + aa, 0.0
    while rows.shape[-1]:
        pivot, first = rows[..., 0, 0], rows[..., 0, 1:]
        log_det, rest = log_det + xp.log(pivot), rest - ay[..., 0] ** 2 / pivot
        ratio = first / pivot[..., None]
        ay = ay[..., 1:] - ratio * ay[..., :1]
        rows = rows[..., 1:, 1:] - ratio[..., :, None] * first[..., None, :]
    return -0.5 * (n * LOG_2PI + log_det + rest)


def _solve(ay: Any, aa: Any, xp: ModuleType) -> tuple[Any, Any]:
    """(I + A'A)^-1 A'y (..., p) and log det (I + A'A) (...), by elimination in a loop.

    XLA's calls of LAPACK from two threads at once may wait for each other for ever (JAX 0.11, compiled loops).
    """
    size, matrix = aa.shape[-1], xp.broadcast_to(xp.eye(aa.shape[-1]), aa.shape) + aa
    if xp is np:
        return np.linalg.solve(matrix, ay[..., None])[..., 0], np.linalg.slogdet(matrix)[1]

    def eliminate(k: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        rows, log_det = carry
        row, column = (jax.lax.dynamic_index_in_dim(rows, k, axis=axis, keepdims=True) for axis in (-2, -1))
        pivot = jax.lax.dynamic_index_in_dim(row, k, axis=-1, keepdims=True)
        own = jnp.reshape(jnp.arange(size) == k, (*(1,) * (rows.ndim - 2), size, 1))
        rows = jnp.where(own, row / pivot, rows - column * (row / pivot))
        return rows, log_det + jnp.log(pivot[..., 0, 0])

    start = jnp.concatenate([matrix, ay[..., None]], axis=-1), jnp.zeros(ay.shape[:-1])
    rows, log_det = jax.lax.fori_loop(0, size, eliminate, start)
    return rows[..., -1], log_det


def conditional_mean(ay: Any, aa: Any, xp: ModuleType = jnp) -> Any:
    """Posterior mean of b given y, (p,): (I + A'A)^-1 A'y."""
    if aa.shape[-1] > MANY_NUISANCES:
        return _solve(ay, aa, xp)[0]
    return xp.linalg.solve(xp.eye(aa.shape[-1]) + aa, ay)


def conditional_draw(ay: np.ndarray, aa: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One draw of b given y, (p,)."""
    precision = np.eye(len(aa)) + aa
    chol = np.linalg.cholesky(precision)
    return np.linalg.solve(precision, ay) + np.linalg.solve(chol.T, rng.standard_normal(len(aa)))
