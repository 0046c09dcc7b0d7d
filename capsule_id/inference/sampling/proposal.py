"""Proposals of independence steps: one density for each block of parameters, as a mixture of Student densities."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaln

from capsule_id.inference.fit.curvature import Matrix, Vector
from capsule_id.inference.sampling.coordinates import Coordinates, logarithmic

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
    """Mixture of k Student densities of the coordinates w of d parameters.

    Parameters
    ----------
    freedom : degrees of freedom
    weights, centres, covariances : (k,), (k, d), (k, d, d); the covariances are squared scales
    drawn : (k, d) parameters that a component draws from their priors; it draws the others given these
    coordinates : of all components
    """

    def __init__(
        self,
        freedom: float,
        weights: Float[np.ndarray, " k"],
        centres: Float[np.ndarray, "k d"],
        covariances: Float[np.ndarray, "k d d"],
        drawn: Bool[np.ndarray, "k d"] | None = None,
        coordinates: Coordinates | None = None,
    ) -> None:
        self.freedom, self.weights, self.centres, self.covariances = freedom, weights, centres, covariances
        self.drawn = np.zeros(centres.shape, dtype=bool) if drawn is None else drawn
        self.coordinates = coordinates or logarithmic(centres.shape[1])
        pairs = [_given(covariance, own) for covariance, own in zip(covariances, self.drawn, strict=True)]
        self._slopes, self._roots = (np.stack(each) for each in zip(*pairs, strict=True))
        self._inverses = np.linalg.inv(self._roots)
        d = np.sum(~self.drawn, axis=1)
        size = np.sum(np.log(np.diagonal(self._roots, axis1=1, axis2=2)), axis=1)
        constant = gammaln(0.5 * (freedom + d)) - gammaln(0.5 * freedom) - 0.5 * d * np.log(np.pi * freedom)
        self._power, self._constant = 0.5 * (freedom + d), np.log(weights) + constant - size

    def components(self, u: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n"]]:
        """Log-densities of u under the components, weights included; squared standardised distances from the centres."""
        off = self.coordinates.w(u) - self.centres[:, None]
        left = np.where(self.drawn[:, None], 0.0, off - off @ self._slopes.transpose(0, 2, 1))
        square = np.sum((left @ self._inverses.transpose(0, 2, 1)) ** 2, axis=2)
        student = self._constant[:, None] - self._power[:, None] * np.log1p(square / self.freedom)
        # log |dw/du| is u for a parameter in theta.
        jacobian = np.sum(np.where(self.coordinates.linear & ~self.drawn[:, None], u, 0.0), axis=2)
        prior = np.sum(np.where(self.drawn[:, None], self.coordinates.prior_density(u), 0.0), axis=2)
        return student + jacobian + prior, square

    def log_density(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return np.logaddexp.reduce(self.components(u)[0], axis=0)

    def draw(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]:
        """Draw u; NaN where theta is not positive."""
        k = rng.choice(len(self.weights), size=size, p=self.weights)
        scale = np.sqrt(self.freedom / rng.chisquare(self.freedom, size))
        noise = scale[:, None] * rng.standard_normal((size, self.centres.shape[1]))
        centre, drawn, coordinates = self.centres[k], self.drawn[k], self.coordinates
        known = np.zeros_like(centre)
        if coordinates.weak:
            known = np.where(drawn, coordinates.w(coordinates.draw_prior(rng, size)) - centre, 0.0)
        noise = np.where(drawn, 0.0, noise)
        left = (self._slopes[k] @ known[:, :, None] + self._roots[k] @ noise[:, :, None])[:, :, 0]
        return coordinates.u(centre + known + left)


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


def concentric(
    centre: Vector, covariance: Matrix, narrow: bool = False, coordinates: Coordinates | None = None
) -> Mixture:
    """Components of several scales about one ``centre``, and those that draw parameters from their priors.

    Parameters
    ----------
    centre, covariance : (d,) and (d, d) of w
    """
    freedom, scales = NARROW if narrow else WIDE
    weak = () if coordinates is None else coordinates.weak
    subsets = [subset for number in range(MOST_DRAWN + 1) for subset in combinations(weak, number)]
    drawn = np.array([np.isin(np.arange(len(centre)), subset) for subset in subsets])
    shares = np.full(len(subsets), FROM_PRIOR / max(len(subsets) - 1, 1))
    shares[0] = 1.0 - np.sum(shares[1:])
    squares = np.array(scales)[:, None, None] ** 2 * covariance
    return Mixture(
        freedom,
        np.outer(shares, WEIGHTS).ravel(),
        np.tile(centre, (len(subsets) * len(scales), 1)),
        np.tile(squares, (len(subsets), 1, 1)),
        np.repeat(drawn, len(scales), axis=0),
        coordinates,
    )


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
    """Concentric mixtures in u for all blocks.

    Parameters
    ----------
    centre, covariance : (d,) and (d, d), of which only the blocks are used
    narrow : for each block whether its proposals are narrow; None: all are wide
    """
    flags = narrow or [False] * len(blocks)
    pairs = zip(blocks, flags, strict=True)
    return BlockProposal(blocks, [concentric(centre[b], covariance[np.ix_(b, b)], flag) for b, flag in pairs])
