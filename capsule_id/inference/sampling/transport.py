"""Proposals of a bent posterior: a triangular map to coordinates that are nearly normal (Parno & Marzouk 2018).

The posterior of a robot's friction, force and lag is bent in twelve dimensions. Components of a mixture follow that badly;
a quadratic mean and a linear logarithmic scale of each coordinate, given those before it, follow it well.
"""

import numpy as np
from jaxtyping import Float

from capsule_id.inference.fit.curvature import Matrix, Vector
from capsule_id.inference.sampling.proposal import Mixture, concentric

#: Parameters of the largest block with a map: the time of its least squares grows with their fourth power.
LARGEST_MAP = 15
#: The map follows coordinates up to this many sds from their mean; beyond, it stays the same.
FARTHEST = 3.0
#: Ridge penalty of the coefficients times the effective sample size: coefficients below 0.2 sd are shrunk.
SHRINKAGE = 30.0
#: Newton steps for the scales, and the share of each step that is taken.
STEPS, SHARE = 30, 0.7


class Transported:
    """Student densities of coordinates x that a triangular map makes of d parameters u.

    With z = (u - mean) / root, x_i = (z_i - b_i . f(z_1 ... z_i-1)) exp(-g_i . h(z_1 ... z_i-1)); f holds 1, z and the products
    of two z, h holds 1 and z.

    Parameters
    ----------
    u, weights : (n, d) draws and their normalised weights, which determine the map
    """

    def __init__(self, u: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> None:
        self._mean, covariance = np.average(u, axis=0, weights=weights), np.atleast_2d(np.cov(u.T, aweights=weights))
        self._root = np.linalg.cholesky(covariance)
        z, ridge = self._z(u), SHRINKAGE * np.sum(weights**2)
        self._means, self._scales = list[Vector](), list[Vector]()
        for i in range(z.shape[1]):
            f, h = _quadratic(z[:, :i]), _linear(z[:, :i])
            self._means.append(_least_squares(f, z[:, i], weights, ridge))
            self._scales.append(_log_scale(h, z[:, i] - f @ self._means[-1], weights, ridge))
        x, _ = self._x(u)
        self._mixture: Mixture = concentric(
            np.average(x, axis=0, weights=weights), np.atleast_2d(np.cov(x.T, aweights=weights))
        )

    def _z(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return np.linalg.solve(self._root, (u - self._mean).T).T

    def _x(self, u: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
        """Coordinates x, and log |dx/du|."""
        z = self._z(u)
        x, logarithm = np.empty_like(z), np.full(len(z), -np.sum(np.log(np.diag(self._root))))
        for i, (mean, scale) in enumerate(zip(self._means, self._scales, strict=True)):
            size = _linear(z[:, :i]) @ scale
            x[:, i] = (z[:, i] - _quadratic(z[:, :i]) @ mean) * np.exp(-size)
            logarithm -= size
        return x, logarithm

    def log_density(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        x, logarithm = self._x(u)
        return self._mixture.log_density(x) + logarithm

    def draw(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]:
        x = self._mixture.draw(rng, size)
        z = np.empty_like(x)
        for i, (mean, scale) in enumerate(zip(self._means, self._scales, strict=True)):
            z[:, i] = _quadratic(z[:, :i]) @ mean + x[:, i] * np.exp(_linear(z[:, :i]) @ scale)
        return self._mean + z @ self._root.T


def _linear(z: Float[np.ndarray, "n i"]) -> Float[np.ndarray, "n k"]:
    """1 and the coordinates, which end at ``FARTHEST``."""
    return np.column_stack([np.ones(len(z)), np.clip(z, -FARTHEST, FARTHEST)])


def _quadratic(z: Float[np.ndarray, "n i"]) -> Float[np.ndarray, "n k"]:
    """1, the coordinates and their products of two."""
    first, second = np.triu_indices(z.shape[1])
    near = _linear(z)
    return np.column_stack([near, near[:, 1 + first] * near[:, 1 + second]])


def _least_squares(
    f: Float[np.ndarray, "n k"], z: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"], ridge: float
) -> Float[np.ndarray, " k"]:
    weighted = f.T * weights
    return np.linalg.solve(weighted @ f + ridge * np.eye(f.shape[1]), weighted @ z)


def _log_scale(
    h: Float[np.ndarray, "n k"], residuals: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"], ridge: float
) -> Float[np.ndarray, " k"]:
    """Coefficients of the logarithm of the sd of ``residuals``: largest likelihood of normal residuals."""
    found = np.zeros(h.shape[1])
    found[0] = 0.5 * np.log(np.sum(weights * residuals**2))
    penalty: Matrix = ridge * np.eye(len(found))
    for _ in range(STEPS):
        square = weights * residuals**2 * np.exp(-2.0 * (h @ found))
        slope = h.T @ (square - weights) - penalty @ (found - np.eye(len(found))[0] * found[0])
        found = found + SHARE * np.linalg.solve(2.0 * (h.T * square) @ h + penalty, slope)
    return found
