"""Proposals of a bent posterior: a triangular map to coordinates that are nearly normal (Parno & Marzouk 2018).

The posterior of a robot's friction, force and lag is bent in twelve dimensions. Components of a mixture follow that badly;
a quadratic mean and a linear logarithmic scale of each coordinate, given those before it, follow it well. Normal scores
come first: the logarithm of a scatter that may be zero has a long tail.
"""

from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from capsule_id.inference.fit.curvature import Matrix
from capsule_id.inference.sampling.proposal import Mixture, concentric

#: Parameters of the largest block with a map: the time of its least squares grows with their fourth power.
LARGEST_MAP = 15
#: The map follows coordinates up to this many sds from their mean; beyond, it stays the same.
FARTHEST = 3.0
#: Ridge penalty of the coefficients times the effective sample size: coefficients below 0.2 sd are shrunk.
SHRINKAGE = 30.0
#: Outermost normal score with a knot, number of knots (odd), and distance of a further knot on either side relative to it.
OUTER, KNOTS, FAR = 2.5, 11, 2.0
#: Scores of this effective number of draws or fewer are linear; of more draws, in proportion less.
SMOOTHED = 50.0
#: Newton steps for the scales, and the share of each step that is taken.
STEPS, SHARE = 30, 0.7


class Scores:
    """Normal scores of each parameter: a piecewise linear function, straight beyond its outer knots.

    Parameters
    ----------
    u, weights : (n, d) draws and their normalised weights
    """

    def __init__(self, u: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> None:
        share = min(SMOOTHED * float(np.sum(weights**2)), 1.0)
        score = np.linspace(-OUTER, OUTER, KNOTS)
        quantiles = np.stack([np.quantile(x, ndtr(score), weights=weights, method="inverted_cdf") for x in u.T])
        mean = np.average(u, axis=0, weights=weights)
        sd = np.sqrt(np.average((u - mean) ** 2, axis=0, weights=weights))
        inner = (1.0 - share) * quantiles + share * (mean[:, None] + sd[:, None] * score)
        # Beyond the outer knots lie few draws: the slope there is that between them and the median.
        beyond = (inner[:, [0, -1]] - inner[:, [KNOTS // 2]]) * FAR
        self._knots = np.concatenate([inner[:, :1] + beyond[:, :1], inner, inner[:, -1:] + beyond[:, 1:]], axis=1)
        ends = np.array([-(1.0 + FAR) * OUTER, (1.0 + FAR) * OUTER])
        self._score = np.broadcast_to(np.concatenate([ends[:1], score, ends[1:]]), self._knots.shape)

    def scores(self, u: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
        """Scores, and the log of their Jacobian."""
        found, slope = _straight(u, self._knots, self._score)
        return found, np.sum(np.log(slope), axis=1)

    def u(self, scores: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return _straight(scores, self._score, self._knots)[0]


class Transported:
    """Student densities of coordinates x that a triangular map makes of the normal scores s of d parameters u.

    With z = (s - mean) / root, x_i = (z_i - b_i . f(z_1 ... z_i-1)) exp(-g_i . h(z_1 ... z_i-1)); f holds 1, z and the products
    of two z, h holds 1 and z.

    Parameters
    ----------
    u, weights : (n, d) draws and their normalised weights, which determine the map
    """

    def __init__(self, u: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> None:
        self._scores = Scores(u, weights)
        s, _ = self._scores.scores(u)
        self._mean, covariance = np.average(s, axis=0, weights=weights), np.atleast_2d(np.cov(s.T, aweights=weights))
        self._root = np.linalg.cholesky(covariance)
        z, ridge = self._z(s), SHRINKAGE * np.sum(weights**2)
        d = z.shape[1]
        # Columns: 1, the coordinates and their products, of which a coordinate uses those before it.
        self._means, self._scales = np.zeros((1 + d + len(_pairs(d)[0]), d)), np.zeros((1 + d, d))
        self._own = [np.flatnonzero(np.concatenate([[True], np.arange(d) < i, _pairs(d)[1] < i])) for i in range(d)]
        quadratic, linear = _quadratic(z), _linear(z)
        for i, own in enumerate(self._own):
            f, h = quadratic[:, own], linear[:, : 1 + i]
            self._means[own, i] = _least_squares(f, z[:, i], weights, ridge)
            self._scales[: 1 + i, i] = _log_scale(h, z[:, i] - f @ self._means[own, i], weights, ridge)
        x, _ = self._x(u)
        self._mixture: Mixture = concentric(
            np.average(x, axis=0, weights=weights), np.atleast_2d(np.cov(x.T, aweights=weights))
        )

    def _z(self, s: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return np.linalg.solve(self._root, (s - self._mean).T).T

    def _x(self, u: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
        """Coordinates x, and log |dx/du|."""
        s, logarithm = self._scores.scores(u)
        z = self._z(s)
        size = _linear(z) @ self._scales
        x = (z - _quadratic(z) @ self._means) * np.exp(-size)
        return x, logarithm - np.sum(np.log(np.diag(self._root))) - np.sum(size, axis=1)

    def log_density(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        x, logarithm = self._x(u)
        return self._mixture.log_density(x) + logarithm

    def draw(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]:
        x = self._mixture.draw(rng, size)
        z = np.empty_like(x)
        for i, own in enumerate(self._own):
            f, h = _quadratic(z[:, :i]), _linear(z[:, :i])
            z[:, i] = f @ self._means[own, i] + x[:, i] * np.exp(h @ self._scales[: 1 + i, i])
        return self._scores.u(self._mean + z @ self._root.T)


def _straight(
    x: Float[np.ndarray, "n d"], knots: Float[np.ndarray, "d k"], values: Float[np.ndarray, "d k"]
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
    """Piecewise linear function of each coordinate that has ``values`` at ``knots``, and its slope; straight beyond them."""
    i = np.sum(x[:, :, None] > knots[None, :, 1:-1], axis=2)
    j = np.arange(x.shape[1])[None]
    slope = (np.diff(values, axis=1) / np.diff(knots, axis=1))[j, i]
    return values[j, i] + slope * (x - knots[j, i]), slope


def _linear(z: Float[np.ndarray, "n i"]) -> Float[np.ndarray, "n k"]:
    """1 and the coordinates, which end at ``FARTHEST``."""
    return np.column_stack([np.ones(len(z)), np.clip(z, -FARTHEST, FARTHEST)])


def _quadratic(z: Float[np.ndarray, "n i"]) -> Float[np.ndarray, "n k"]:
    """1, the coordinates and their products of two."""
    first, second = _pairs(z.shape[1])
    near = _linear(z)
    return np.column_stack([near, near[:, 1 + first] * near[:, 1 + second]])


@cache
def _pairs(number: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(number)


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
