"""Coordinates w of the proposals of a block of parameters, and the priors of terms that may be absent.

Most parameters are proposed in u, the logarithm of a positive parameter. Two terms that replace each other, as viscous
and dry damping do, lie on a line in theta, which is bent in u: they are proposed in theta.

A term that the readings hardly show may be absent. The tail of its u towards minus infinity is as long as that of its
prior, so that some proposals draw this u from its prior.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import log_ndtr, ndtr, ndtri

from capsule_id.inference.fit.curvature import Vector

#: Smallest sd of u of a parameter that may be proposed in theta, and of one that may be absent. Below these sds u and
#: theta are in proportion, and the readings exclude zero.
BENT, WEAK = 0.05, 0.2
#: Largest numbers of such parameters of a block.
MOST_BENT, MOST_WEAK = 6, 5
#: Draws from a prior end this far above the largest u of a sample, in sds of u.
MARGIN = 0.5


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of a block of d parameters.

    Attributes
    ----------
    linear : (d,) whether w is theta; else it is u
    weak : indices of the parameters that may be absent
    centre, width : (d,) of the normal priors of u; used for ``weak`` only
    upper : (d,) largest u drawn from these priors
    """

    linear: Bool[np.ndarray, " d"]
    weak: tuple[int, ...]
    centre: Vector
    width: Vector
    upper: Vector

    def w(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return np.where(self.linear, np.exp(np.where(self.linear, u, 0.0)), u)

    def u(self, w: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """NaN where theta is not positive."""
        positive = self.linear & (w > 0.0)
        logarithm = np.where(positive, np.log(np.where(positive, w, 1.0)), np.nan)
        return np.where(self.linear, logarithm, w)

    def prior_density(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Log-densities of the priors, which end at ``upper``."""
        z, highest = (u - self.centre) / self.width, (self.upper - self.centre) / self.width
        density = -0.5 * z**2 - np.log(self.width * np.sqrt(2.0 * np.pi)) - log_ndtr(highest)
        return np.where(z <= highest, density, -np.inf)

    def draw_prior(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]:
        """u of every parameter from its prior."""
        share = ndtr((self.upper - self.centre) / self.width)
        return self.centre + self.width * ndtri(rng.uniform(size=(size, len(self.centre))) * share)


def logarithmic(dimension: int) -> Coordinates:
    """w = u, and no parameter that may be absent."""
    zero = np.zeros(dimension)
    return Coordinates(np.zeros(dimension, dtype=bool), (), zero, zero + 1.0, zero)


def coordinates_of(sample: Float[np.ndarray, "n d"], prior: Float[np.ndarray, "2 d"]) -> Coordinates:
    """Coordinates in which a ``sample`` of u is closest to normal: largest likelihood of a normal density (Box & Cox).

    Parameters
    ----------
    prior : centre and width of the normal prior of u; NaN for a parameter with another prior
    """
    sd, normal = np.std(sample, axis=0), np.all(np.isfinite(prior), axis=0)
    by_sd = sorted(np.flatnonzero(normal), key=lambda i: -sd[i])
    bent = [i for i in by_sd if sd[i] > BENT][:MOST_BENT]
    both = np.concatenate([sample, np.exp(sample[:, bent] - np.max(sample[:, bent], axis=0))], axis=1)
    covariance, best = np.atleast_2d(np.cov(both.T)), (-np.inf, np.zeros(len(sd), dtype=bool))
    for chosen in product((False, True), repeat=len(bent)):
        index = np.arange(len(sd))
        index[bent] = np.where(chosen, len(sd) + np.arange(len(bent)), bent)
        stretch = np.sum((np.mean(sample, axis=0) - np.max(sample, axis=0))[bent], where=np.array(chosen, dtype=bool))
        likelihood = stretch - 0.5 * np.linalg.slogdet(covariance[np.ix_(index, index)])[1]
        if likelihood > best[0]:
            best = likelihood, index >= len(sd)
    weak = tuple(int(i) for i in by_sd if sd[i] > WEAK)[:MOST_WEAK]
    centre, width = np.where(normal, prior, [[0.0], [1.0]])
    return Coordinates(best[1], weak, centre, width, np.max(sample, axis=0) + MARGIN * sd)
