"""Gradient and Hessian of the log-posterior by central differences of its batched values.

The sampler needs the log-posterior compiled anyway. Its Hessian by automatic differentiation needs another, far longer
compilation. Central differences with Richardson extrapolation agree with that Hessian to 1e-6 relative (tested).
Their steps are fractions of a posterior standard deviation.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from capsule_id.errors import InputError
from capsule_id.physics.batches import pool

#: d coordinates, and a matrix of them.
Vector = Float[np.ndarray, " d"]
Matrix = Float[np.ndarray, "d d"]

#: Steps of the differences in units of the scale given, and their ratio for Richardson extrapolation.
STEP, RATIO = 0.05, 2.0
#: Step of the gradient's central differences, in standard deviations. Its error is 3e-5 where the curvature changes
#: by half over one standard deviation. A log-posterior of 500 readings of 4000 sds is rounded to 1e-6, which a step of
#: 1e-3 made an error of 1e-3.
GRADIENT_STEP = 2e-2
#: Smallest sd of a parameter that can be sampled, in units in the last place of its value.
FEWEST_UNITS = 1e3
#: Rows of every batch. A fixed number needs one compilation only.
BATCH = 32


def in_batches(
    function: Callable[[np.ndarray], np.ndarray], points: Float[np.ndarray, "m d"]
) -> Float[np.ndarray, "m ..."]:
    """Evaluate ``function`` at points (m, d) in batches of exactly ``BATCH`` rows, on all cores; (m, ...)."""
    padded = np.concatenate([points, np.repeat(points[-1:], -len(points) % BATCH, axis=0)])
    chunks = [padded[i : i + BATCH] for i in range(0, len(padded), BATCH)]
    parts = list(pool().map(lambda chunk: np.asarray(function(chunk)), chunks))
    return np.concatenate(parts)[: len(points)]


def hessian(function: Callable[[np.ndarray], np.ndarray], u: Vector, scale: Vector) -> Matrix:
    """(d, d) Hessian of a log-density ((m, d) -> (m,)) at u (d,); ``scale`` (d,) is a rough sd of each parameter.

    Beside the end of its domain, such as critical damping, the density has no difference quotient. The curvature of
    ``scale`` stands there.
    """
    d = len(u)
    rows, columns = np.triu_indices(d)
    unit = np.diag(scale)
    pair, single = unit[rows] + unit[columns], unit[rows] - unit[columns]
    estimates, beyond = [], np.zeros(len(rows), dtype=bool)
    for step in (STEP, RATIO * STEP):
        offsets = step * np.concatenate([pair, -pair, single, -single])
        values = in_batches(function, np.concatenate([u + offsets, u[None]]))
        plus, minus, cross, cross_minus = np.split(values[:-1], 4)
        parts = np.stack([plus, minus, cross, cross_minus])
        # Beyond the domain the density is -inf; a NaN is a defect, and stays.
        beyond |= np.any(np.isneginf(parts), axis=0)
        plus, minus, cross, cross_minus = np.where(np.isneginf(parts), 0.0, parts)
        estimates.append((plus + minus - cross - cross_minus) / (4.0 * step**2))
    best = (RATIO**2 * estimates[0] - estimates[1]) / (RATIO**2 - 1.0)
    best = np.where(beyond, np.where(rows == columns, -1.0, 0.0), best)
    matrix = np.zeros((d, d))
    matrix[rows, columns] = best / (scale[rows] * scale[columns])
    return matrix + np.triu(matrix, 1).T


def value_and_gradient(function: Callable[[np.ndarray], np.ndarray], v: Vector) -> tuple[float, Vector]:
    """Value and (d,) gradient of ``function`` ((m, d) -> (m,)) at v (d,), in coordinates with unit standard deviation."""
    offsets = GRADIENT_STEP * np.eye(len(v))
    values = function(np.concatenate([v[None], v + offsets, v - offsets]))
    plus, minus = np.split(values[1:], 2)
    return float(values[0]), (plus - minus) / (2.0 * GRADIENT_STEP)


def jacobian(function: Callable[[np.ndarray], np.ndarray], u: Vector, step: Vector) -> Float[np.ndarray, "n d"]:
    """(n, d) Jacobian of ``function`` ((d,) -> (n,)) at u by central differences with ``step`` (d,)."""
    columns = []
    for j, h in enumerate(step):
        offset = np.zeros_like(u)
        offset[j] = h
        columns.append((function(u + offset) - function(u - offset)) / (2.0 * h))
    return np.stack(columns, axis=1)


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
