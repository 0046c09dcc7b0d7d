"""Ensemble moves; a pilot run chooses among them by measured autocorrelation time."""

from collections.abc import Mapping, Sequence
from typing import Any

import emcee
import numpy as np
from jaxtyping import Float

from capsule_id.inference.fit.curvature import Matrix, Vector

#: Parameters of the smallest large block: a forced run correlates all its parameters and determines them well.
LARGE = 9
#: Degrees of freedom of the proposal for small and for large blocks, and its widths with their weights. Small blocks
#: with few trials need heavy tails. In many dimensions a heavier or wider proposal is almost never accepted.
FEW, MANY = 6.0, 200.0
WIDTHS, WEIGHTS = np.array([[1.0, 2.0, 4.0], [1.0, 1.15, 1.4]]), np.array([0.85, 0.1, 0.05])
#: Smallest ratio of pilot sd to Laplace sd at which a large block's proposal is widened. Smaller ratios may be noise
#: of a short pilot.
WIDER = 1.1

#: emcee's moves with their weights.
Moves = list[tuple[Any, float]]


class BlockMove(emcee.moves.Move):
    """Independence Metropolis–Hastings of all blocks of parameters in every step, each accepted separately.

    The posterior is a product over blocks. emcee stores its factors as blobs, so that one evaluation suffices for all
    blocks. Each block has its own mixture of Student densities. The mixture is fixed before the recorded chain starts,
    so that detailed balance holds.

    Parameters
    ----------
    blocks : indices of the parameters of each block, in the order of the factors
    centre : (d,)
    covariance : (d, d), of which only the blocks are used
    """

    def __init__(self, blocks: Sequence[np.ndarray], centre: Vector, covariance: Matrix) -> None:
        self.centre = centre
        #: (d, blocks) which parameter belongs to which block.
        self.member = np.stack([np.isin(np.arange(len(centre)), block) for block in blocks], axis=1)
        self.root = np.linalg.cholesky(np.where(self.member @ self.member.T, covariance, 0.0))
        self._inverse = np.linalg.inv(self.root)
        large = np.sum(self.member, axis=0) >= LARGE
        #: (blocks,) degrees of freedom, and (3, blocks) widths.
        self.freedom, self.widths = np.where(large, MANY, FEW), WIDTHS[large.astype(int)].T

    def log_density(self, u: Float[np.ndarray, "w d"]) -> Float[np.ndarray, "w blocks"]:
        """(w, blocks) log-density of the proposals at u (w, d), up to a constant."""
        square = ((u - self.centre) @ self._inverse.T) ** 2 @ self.member
        d = np.sum(self.member, axis=0)
        parts = [
            np.log(weight) - d * np.log(width)
            - 0.5 * (self.freedom + d) * np.log1p(square / (width**2 * self.freedom))
            for width, weight in zip(self.widths, WEIGHTS, strict=True)
        ]  # fmt: skip
        return np.logaddexp.reduce(parts, axis=0)

    def draw(self, rng: np.random.RandomState, size: int) -> Float[np.ndarray, "{size} d"]:
        """Draw (size, d) proposals."""
        shape = (size, self.member.shape[1])
        scale = self.widths[rng.choice(len(WEIGHTS), p=WEIGHTS, size=shape), np.arange(shape[1])]
        scale = scale * np.sqrt(self.freedom / rng.chisquare(np.broadcast_to(self.freedom, shape)))
        return self.centre + (rng.standard_normal((size, len(self.centre))) * (scale @ self.member.T)) @ self.root.T

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Make one emcee step: return the new state and the share of accepted blocks, (w,)."""
        new = self.draw(model.random, len(state.coords))
        _, blobs = model.compute_log_prob_fn(new)
        # emcee drops the axis where there is one block only.
        old = np.asarray(state.blobs)
        factors = self.log_density(state.coords) - self.log_density(new)
        old_parts, new_parts = old.reshape(factors.shape), np.reshape(blobs, factors.shape)
        accepted = np.log(model.random.uniform(size=factors.shape)) < new_parts - old_parts + factors
        coords = np.where(accepted @ self.member.T, new, state.coords)
        parts = np.where(accepted, new_parts, old_parts)
        new_state = emcee.State(coords, log_prob=np.sum(parts, axis=1), blobs=parts.reshape(old.shape))
        return new_state, np.mean(accepted, axis=1)


def block_move(blocks: Sequence[np.ndarray], centre: Vector, covariance: Matrix) -> Moves:
    """Block moves, with one step in ten by differential evolution, which needs no covariance."""
    return [(BlockMove(blocks, centre, covariance), 0.9), (emcee.moves.DEMove(), 0.1)]


def candidates(
    sample: Float[np.ndarray, "m d"], blocks: Sequence[np.ndarray], centre: Vector, covariance: Matrix
) -> Mapping[str, Moves]:
    """Return the moves that the pilot compares, the most promising first.

    Parameters
    ----------
    sample : (m, d) of the pilot's burnt-in ensemble, for mean and covariance of small blocks
    blocks : see ``MarginalPosterior.blocks``
    centre, covariance : (d,), (d, d) Laplace approximation, for the correlations of large blocks, which a short pilot
        estimates badly; their widths come from the pilot where it finds larger ones
    """
    shape, middle = np.atleast_2d(np.cov(sample.T)), np.median(sample, axis=0)
    for block in blocks:
        if len(block) >= LARGE:
            own = covariance[np.ix_(block, block)]
            ratio = np.sqrt(np.diag(shape)[block] / np.diag(own))
            wider = np.where(ratio > WIDER, ratio, 1.0)
            middle[block], shape[np.ix_(block, block)] = centre[block], own * np.outer(wider, wider)
    return {
        "block independence + differential evolution": block_move(blocks, middle, shape),
        # One snooker step in ten (ter Braak & Vrugt 2008).
        "differential evolution + snooker": [(emcee.moves.DEMove(), 0.9), (emcee.moves.DESnookerMove(), 0.1)],
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
