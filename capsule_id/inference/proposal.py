"""Proposal of the sampler: coordinates, maps towards a normal density, refinement by draws."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaln, log_ndtr, ndtr, ndtri

from capsule_id.inference.curvature import Matrix, Vector

# coordinates: Coordinates w of the proposals of a block of parameters, and the priors of terms that may be absent.
#
# Most parameters are proposed in u, the logarithm of a positive parameter. Two terms that replace each other, as
# viscous and dry damping do, lie on a line in theta, which is bent in u: they are proposed in theta.
#
# A term that the readings hardly show may be absent. The tail of its u towards minus infinity is as long as that of
# its prior, so that some proposals draw this u from its prior. Other parameters change with its theta, so that w
# leaves this change out.


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


# proposal: Proposals of independence steps: one density for each block of parameters, as a mixture of Student
# densities.


#: Degrees of freedom of wide and of narrow proposals, and scales of their components with the weights. Few trials give
#: heavy tails. A forced run determines many correlated parameters well: a wider proposal is almost never accepted there.
WIDE, NARROW = (6.0, (1.0, 2.0, 4.0)), (200.0, (1.0, 1.15, 1.4))
WEIGHTS = np.array([0.85, 0.1, 0.05])
#: Share of proposals that draw parameters that may be absent from their priors, and the largest number of these at once.
FROM_PRIOR, MOST_DRAWN = 0.4, 2


class Density(Protocol):
    """Proposal of one block of d parameters."""

    def log_density(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]: ...

    def draw(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]: ...


class Mixture:
    """Student densities of several scales about one centre in the coordinates w of d parameters.

    Some components draw parameters that may be absent from their priors, and the others given these.

    Parameters
    ----------
    centre, covariance : (d,) and (d, d) of w; the covariance is a squared scale
    narrow : whether the tails are light
    coordinates : by default u

    Attributes
    ----------
    weights, drawn : (k,), (k, d) of the components, and the parameters that each draws from their priors
    """

    def __init__(
        self, centre: Vector, covariance: Matrix, narrow: bool = False, coordinates: Coordinates | None = None
    ) -> None:
        self._freedom, scales = NARROW if narrow else WIDE
        self._centre, self._coordinates = centre, coordinates or logarithmic(len(centre))
        weak = self._coordinates.weak
        subsets = [subset for number in range(MOST_DRAWN + 1) for subset in combinations(weak, number)]
        shares = np.full(len(subsets), FROM_PRIOR / max(len(subsets) - 1, 1))
        shares[0] = 1.0 - np.sum(shares[1:])
        self.weights = np.outer(shares, WEIGHTS).ravel()
        self.drawn = np.repeat([np.isin(np.arange(len(centre)), own) for own in subsets], len(scales), axis=0)
        squares = np.tile(np.array(scales)[:, None, None] ** 2 * covariance, (len(subsets), 1, 1))
        pairs = [_given(square, own) for square, own in zip(squares, self.drawn, strict=True)]
        self._slopes, self._roots = (np.stack(each) for each in zip(*pairs, strict=True))
        self._inverses = np.linalg.inv(self._roots)
        freedom, d = self._freedom, np.sum(~self.drawn, axis=1)
        size = np.sum(np.log(np.diagonal(self._roots, axis1=1, axis2=2)), axis=1)
        constant = gammaln(0.5 * (freedom + d)) - gammaln(0.5 * freedom) - 0.5 * d * np.log(np.pi * freedom)
        self._power, self._constant = 0.5 * (freedom + d), np.log(self.weights) + constant - size

    def components(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "k n"]:
        """Log-densities of u under the components, weights included."""
        off = np.broadcast_to(self._coordinates.w(u) - self._centre, (len(self.weights), *u.shape))
        left = np.where(self.drawn[:, None], 0.0, off - off @ self._slopes.transpose(0, 2, 1))
        square = np.sum((left @ self._inverses.transpose(0, 2, 1)) ** 2, axis=2)
        student = self._constant[:, None] - self._power[:, None] * np.log1p(square / self._freedom)
        # log |dw/du| is u for a parameter in theta.
        jacobian = np.sum(np.where(self._coordinates.linear & ~self.drawn[:, None], u, 0.0), axis=2)
        prior = np.sum(np.where(self.drawn[:, None], self._coordinates.prior_density(u), 0.0), axis=2)
        return student + jacobian + prior

    def log_density(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return np.logaddexp.reduce(self.components(u), axis=0)

    def draw(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]:
        """Draw u; NaN where theta is not positive."""
        k = rng.choice(len(self.weights), size=size, p=self.weights)
        scale = np.sqrt(self._freedom / rng.chisquare(self._freedom, size))
        noise = scale[:, None] * rng.standard_normal((size, len(self._centre)))
        drawn, coordinates, known = self.drawn[k], self._coordinates, np.zeros_like(noise)
        if coordinates.weak:
            known = np.where(drawn, coordinates.w(coordinates.draw_prior(rng, size)) - self._centre, 0.0)
        noise = np.where(drawn, 0.0, noise)
        left = (self._slopes[k] @ known[:, :, None] + self._roots[k] @ noise[:, :, None])[:, :, 0]
        return coordinates.u(self._centre + known + left)


def _given(covariance: Matrix, drawn: Bool[np.ndarray, " d"]) -> tuple[Matrix, Matrix]:
    """Slope of the other parameters on those ``drawn``, and root of the covariance that is left; unit root for those."""
    slope, root, rest = np.zeros_like(covariance), np.eye(len(covariance)), ~drawn
    left = covariance[np.ix_(rest, rest)]
    if drawn.any():
        across = covariance[np.ix_(rest, drawn)]
        own = np.linalg.solve(covariance[np.ix_(drawn, drawn)], across.T).T
        slope[np.ix_(rest, drawn)], left = own, left - own @ across.T
    root[np.ix_(rest, rest)] = np.linalg.cholesky(left)
    return slope, root


@dataclass(frozen=True)
class BlockProposal:
    """One proposal for each block.

    Attributes
    ----------
    blocks : indices of the parameters of each block; together all parameters
    """

    blocks: Sequence[np.ndarray]
    densities: Sequence[Density]

    def log_density(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n blocks"]:
        """Log-density of the parameters of each block."""
        pairs = zip(self.blocks, self.densities, strict=True)
        return np.stack([density.log_density(u[:, block]) for block, density in pairs], axis=1)

    def draw(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]:
        """Draw u; NaN for a parameter in theta that is not positive."""
        u = np.empty((size, sum(map(len, self.blocks))))
        for block, density in zip(self.blocks, self.densities, strict=True):
            u[:, block] = density.draw(rng, size)
        return u


def block_proposal(
    blocks: Sequence[np.ndarray], centre: Vector, covariance: Matrix, narrow: Sequence[bool] | None = None
) -> BlockProposal:
    """Mixtures in u for all blocks.

    Parameters
    ----------
    centre, covariance : (d,) and (d, d), of which only the blocks are used
    narrow : for each block whether its proposals are narrow; None: all are wide
    """
    flags = narrow or [False] * len(blocks)
    pairs = zip(blocks, flags, strict=True)
    return BlockProposal(blocks, [Mixture(centre[b], covariance[np.ix_(b, b)], flag) for b, flag in pairs])
