"""Curvature at the maximum: covariance from a Jacobian, gradient and Hessian by central differences."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from capsule_id.errors import InputError

# covariance: Covariance of the parameters at a minimum of least squares, from the singular values of the Jacobian.


#: Derivatives of n residuals with respect to d parameters.
Jacobian = Float[np.ndarray, "n d"]
#: n residuals.
Residuals = Float[np.ndarray, " n"]


def covariance(jacobian: Jacobian) -> Float[np.ndarray, "d d"]:
    """(JᵀJ)⁻¹ of standardised residuals from the singular values of J (n, d), units of the parameters.

    Every entry is inf where J is not finite, or where some combination of the parameters leaves the residuals unchanged:
    no standard error exists, and a pseudo-inverse would give a direction without data zero variance.

    The columns are scaled to unit length first, so that the rank does not depend on the units of the parameters.
    """
    no_answer = np.full((jacobian.shape[1], jacobian.shape[1]), np.inf)
    if not np.isfinite(jacobian).all():
        return no_answer
    _, singular, right, column_norm = column_space(jacobian)
    if len(singular) < jacobian.shape[1]:
        return no_answer
    root = right.T / singular / column_norm[:, None]
    return root @ root.T


def column_space(
    jacobian: Jacobian,
) -> tuple[
    Float[np.ndarray, "n rank"], Float[np.ndarray, " rank"], Float[np.ndarray, "rank d"], Float[np.ndarray, " d"]
]:
    """Singular vectors and values above rounding of J with unit columns, and the column norms of J."""
    column_norm = np.linalg.norm(jacobian, axis=0)
    left, singular, right = np.linalg.svd(jacobian / np.where(column_norm > 0, column_norm, 1.0), full_matrices=False)
    rank = int(np.sum(singular > singular[0] * max(jacobian.shape) * np.finfo(float).eps))
    return left[:, :rank], singular[:rank], right[:rank], column_norm


# curvature: Gradient and Hessian of the log-posterior by central differences of its batched values.
#
# The sampler needs the log-posterior compiled anyway. Its Hessian by automatic differentiation needs another, far
# longer compilation. Central differences with Richardson extrapolation agree with that Hessian to 1e-6 relative
# (tested). Their steps are fractions of a posterior standard deviation.


#: d coordinates, and a matrix of them.
Vector = Float[np.ndarray, " d"]
Matrix = Float[np.ndarray, "d d"]
#: Points, a row each; a number of each point.
Points = Float[np.ndarray, "n d"]
PerPoint = Float[np.ndarray, " n"]
#: Random numbers of the sampler.
Random = np.random.RandomState

#: Steps of the differences in units of the scale given, and their ratio for Richardson extrapolation.
STEP, RATIO = 0.05, 2.0
#: Smallest sd of a parameter that can be sampled, in units in the last place of its value.
FEWEST_UNITS = 1e3


def directions(d: int, alone: np.ndarray) -> Points:
    """Steps of differences, a row each: along every coordinate but those ``alone``, and along all of these at once."""
    rest = np.setdiff1d(np.arange(d), alone)
    together = np.sum(np.eye(d)[alone], axis=0, keepdims=True)
    return np.concatenate([np.eye(d)[rest], together]) if len(alone) else np.eye(d)


def hessian(terms: Callable[[np.ndarray], np.ndarray], u: Vector, scale: Vector, alone: np.ndarray) -> Matrix:
    """(d, d) Hessian of a log-density at u (d,); ``scale`` (d,) is a rough sd of each parameter.

    Beside the end of its domain, such as critical damping, the density has no difference quotient. The curvature of
    ``scale`` stands there.

    Parameters
    ----------
    terms : (m, d) -> (m, 1 + a), of which the density is the sum: one without the a coordinates ``alone``, then of each
    """
    d = len(u)
    rest, unit = np.setdiff1d(np.arange(d), alone), directions(d, alone) * scale
    rows, columns = np.triu_indices(len(unit))
    pair, single = unit[rows] + unit[columns], unit[rows] - unit[columns]
    estimates, beyond = [], np.zeros((len(rows), 1 + len(alone)), dtype=bool)
    for step in (STEP, RATIO * STEP):
        offsets = step * np.concatenate([pair, -pair, single, -single])
        parts = np.stack(np.split(terms(u + offsets), 4))
        # Beyond the domain the density is -inf; a NaN is a defect, and stays.
        beyond |= np.any(np.isneginf(parts), axis=0)
        plus, minus, cross, cross_minus = np.where(np.isneginf(parts), 0.0, parts)
        estimates.append((plus + minus - cross - cross_minus) / (4.0 * step**2))
    best = (RATIO**2 * estimates[0] - estimates[1]) / (RATIO**2 - 1.0)
    usual = np.where(rows == columns, -1.0, 0.0)
    sums = np.where(np.any(beyond, axis=1), usual, np.sum(best, axis=1))
    # Two directions stand for one entry, or, with all coordinates alone, for one of each of these.
    one, matrix = columns < len(rest), np.zeros((d, d))
    matrix[rest[rows[one]], rest[columns[one]]] = sums[one]
    if len(alone):
        each = np.where(beyond, usual[:, None], best)[~one, 1:]
        matrix[rest[:, None], alone], matrix[alone, alone] = each[:-1], each[-1]
    matrix /= np.outer(scale, scale)
    return np.where(np.eye(d, dtype=bool), matrix, matrix + matrix.T)


def jacobian(function: Callable[[np.ndarray], np.ndarray], u: Vector, step: Vector) -> Float[np.ndarray, "n d"]:
    """(n, d) Jacobian of ``function`` ((d,) -> (n,)) at u by central differences with ``step`` (d,)."""
    sides = [(function(u + offset), function(u - offset)) for offset in np.diag(step)]
    return np.stack([(ahead - behind) / (2.0 * h) for (ahead, behind), h in zip(sides, step, strict=True)], axis=1)


def require_width(names: Sequence[str], u: Vector, covariance: Matrix) -> None:
    """Refuse a posterior that is narrower than the digits of its parameters: it cannot be sampled.

    Raises
    ------
    InputError
        With the parameter that is known best.
    """
    units = np.sqrt(np.diag(covariance)) / np.spacing(np.abs(u))
    if not len(units) or np.min(units) > FEWEST_UNITS:
        return
    best = int(np.argmin(units))
    raise InputError(
        "readings must leave parameters uncertain by more than the rounding of numbers",
        f"{names[best]} with an sd of {units[best]:.1g} units in its last place",
        "the model follows the noise too: state simpler drift and noise in rig.toml, or leave out channels that were "
        "computed from each other; --no-sample shows the point fit",
    )
