"""Coordinates w of the proposals of a block of parameters, and the priors of terms that may be absent.

Most parameters are proposed in u, the logarithm of a positive parameter. Two terms that replace each other, as viscous
and dry damping do, lie on a line in theta, which is bent in u: they are proposed in theta.

A term that the readings hardly show may be absent. The tail of its u towards minus infinity is as long as that of its
prior, so that some proposals draw this u from its prior. Other parameters change with its theta, so that w leaves this
change out.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import log_ndtr, ndtr, ndtri

from capsule_id.inference.fit.curvature import Matrix, Vector

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
    shear : (d, d) change of a parameter that is not weak with the theta of one that is: w leaves it out
    """

    linear: Bool[np.ndarray, " d"]
    weak: tuple[int, ...]
    centre: Vector
    width: Vector
    upper: Vector
    shear: Matrix

    def w(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return np.where(self.linear, np.exp(np.where(self.linear, u, 0.0)), u) - self._weak_part(u)

    def u(self, w: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """NaN where theta is not positive."""
        w = w + self._weak_part(self._unsheared(w))
        return self._unsheared(w)

    def _unsheared(self, w: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """u of coordinates without the part of the weak parameters; that of a weak parameter is 0."""
        positive = self.linear & (w > 0.0)
        logarithm = np.where(positive, np.log(np.where(positive, w, 1.0)), np.nan)
        return np.where(self.linear, logarithm, w)

    def _weak_part(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Part of each parameter that changes with the theta of the weak ones; constant above ``upper``."""
        weak = list(self.weak)
        return np.exp(np.minimum(u, self.upper)[:, weak]) @ self.shear[:, weak].T

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
    return Coordinates(np.zeros(dimension, dtype=bool), (), zero, zero + 1.0, zero, np.zeros((dimension, dimension)))


def coordinates_of(sample: Float[np.ndarray, "n d"], prior: Float[np.ndarray, "2 d"]) -> Coordinates:
    """Coordinates in which a ``sample`` of u is closest to normal: largest likelihood of a normal density (Box & Cox).

    Parameters
    ----------
    prior : centre and width of the normal prior of u; NaN for a parameter with another prior
    """
    sd, normal = np.std(sample, axis=0), np.all(np.isfinite(prior), axis=0)
    by_sd = sorted(np.flatnonzero(normal), key=lambda i: -sd[i])
    bent = [i for i in by_sd if sd[i] > BENT][:MOST_BENT]
    weak = [int(i) for i in by_sd if sd[i] > WEAK][:MOST_WEAK]
    both = np.concatenate([sample, np.exp(sample[:, bent])], axis=1)
    owners = np.concatenate([np.arange(len(sd)), np.array(bent, dtype=int)])
    shear = _shear(both, sample[:, weak])
    shear[np.isin(owners, weak)] = 0.0
    sheared = both - np.exp(sample[:, weak]) @ shear.T
    scale = np.std(sheared, axis=0)
    covariance, best = np.atleast_2d(np.cov((sheared / scale).T)), (-np.inf, np.arange(len(sd)))
    for chosen in product((False, True), repeat=len(bent)):
        index = np.arange(len(sd))
        index[bent] = np.where(chosen, len(sd) + np.arange(len(bent)), bent)
        # The Jacobian of theta, on average over the sample.
        stretch = np.sum(np.mean(sample[:, bent], axis=0), where=np.array(chosen, dtype=bool))
        size = np.sum(np.log(scale[index]))
        likelihood = stretch - size - 0.5 * np.linalg.slogdet(covariance[np.ix_(index, index)])[1]
        if likelihood > best[0]:
            best = likelihood, index
    centre, width = np.where(normal, prior, [[0.0], [1.0]])
    slopes = np.zeros((len(sd), len(sd)))
    slopes[:, weak] = shear[best[1]]
    upper = np.max(sample, axis=0) + MARGIN * sd
    return Coordinates(best[1] >= len(sd), tuple(weak), centre, width, upper, slopes)


def _shear(values: Float[np.ndarray, "n k"], weak: Float[np.ndarray, "n weak"]) -> Float[np.ndarray, "k weak"]:
    """Slopes of ``values`` on exp(weak), beside their slopes on ``weak``.

    Two terms that replace each other lie on a line in theta even where the prior of one has its tail in u.
    """
    known = np.column_stack([np.exp(weak), weak, np.ones(len(weak))])
    size = np.linalg.norm(known, axis=0)
    slopes = np.linalg.lstsq(known / size, values, rcond=None)[0] / size[:, None]
    return slopes[: weak.shape[1]].T
