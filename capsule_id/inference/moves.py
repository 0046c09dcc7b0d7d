"""Ensemble moves, and the candidates among which a pilot run chooses by measured autocorrelation time."""

from collections.abc import Mapping, Sequence
from typing import Any

import emcee
import numpy as np

#: Degrees of freedom of the block proposal, and the mixture of widths that it draws from: close to the normal density
#: of what is known well, with tails for what is known from four trials only.
DEGREES_OF_FREEDOM = 6.0
WIDTHS, WEIGHTS = np.array([1.0, 2.0, 4.0]), np.array([0.85, 0.1, 0.05])

Moves = list[tuple[Any, float]]


class BlockMove(emcee.moves.Move):
    """Independence Metropolis–Hastings, all blocks of parameters in every step, each accepted by itself.

    Between blocks the posterior is a product, and the sampler keeps its factors (emcee's blobs), so that one evaluation
    of it decides on every block. Each block has its own mixture of Student densities, fixed before the recorded chain
    starts, so that detailed balance holds.

    Parameters
    ----------
    blocks : indices of the parameters of each block, in the order of the factors
    centre : (d,)
    roots : per block, a root of its covariance
    """

    def __init__(self, blocks: Sequence[np.ndarray], centre: np.ndarray, roots: Sequence[np.ndarray]) -> None:
        self.blocks, self.centre, self.roots = blocks, centre, roots

    def log_density(self, block: int, u: np.ndarray) -> np.ndarray:
        """(w,) of the proposal, up to a constant; u (w, d_block)."""
        z = np.linalg.solve(self.roots[block], (u - self.centre[self.blocks[block]]).T)
        d, square = len(z), np.sum(z**2, axis=0)
        widths, weights = WIDTHS[:, None], WEIGHTS[:, None]
        power = -0.5 * (DEGREES_OF_FREEDOM + d)
        parts = np.log(weights / widths**d) + power * np.log1p(square / widths**2 / DEGREES_OF_FREEDOM)
        return np.logaddexp.reduce(parts, axis=0)

    def draw(self, block: int, rng: np.random.RandomState, size: int) -> np.ndarray:
        """(size, d_block)."""
        z = rng.standard_normal((size, len(self.blocks[block])))
        scale = rng.choice(WIDTHS, p=WEIGHTS, size=size)
        scale = scale * np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, size))
        return self.centre[self.blocks[block]] + (scale[:, None] * z) @ self.roots[block].T

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """emcee's step: the new state and, as acceptance, the share of blocks that moved, (w,)."""
        coords, new = state.coords, np.empty_like(state.coords)
        factors = np.empty((len(coords), len(self.blocks)))
        for i, block in enumerate(self.blocks):
            new[:, block] = self.draw(i, model.random, len(coords))
            factors[:, i] = self.log_density(i, coords[:, block]) - self.log_density(i, new[:, block])
        _, blobs = model.compute_log_prob_fn(new)
        # emcee drops the axis where there is one block only.
        old = np.asarray(state.blobs)
        old_parts, new_parts = old.reshape(factors.shape), np.reshape(blobs, factors.shape)
        accepted = np.log(model.random.uniform(size=factors.shape)) < new_parts - old_parts + factors
        moved = np.zeros(coords.shape, dtype=bool)
        for i, block in enumerate(self.blocks):
            moved[:, block] = accepted[:, i, None]
        parts = np.where(accepted, new_parts, old_parts)
        new_state = emcee.State(
            np.where(moved, new, coords), log_prob=np.sum(parts, axis=1), blobs=parts.reshape(old.shape)
        )
        return new_state, np.mean(accepted, axis=1)


def block_move(blocks: Sequence[np.ndarray], centre: np.ndarray, covariance: np.ndarray) -> Moves:
    """Blocks, with one step in ten of differential evolution, which needs no shape to be known."""
    roots = [np.linalg.cholesky(covariance[np.ix_(block, block)]) for block in blocks]
    return [(BlockMove(blocks, centre, roots), 0.9), (emcee.moves.DEMove(), 0.1)]


def candidates(sample: np.ndarray, blocks: Sequence[np.ndarray]) -> Mapping[str, Moves]:
    """The moves that the pilot compares, the most promising first.

    Parameters
    ----------
    sample : (m, d) of the pilot's burnt-in ensemble: it shapes the block proposal
    blocks : see ``MarginalPosterior.blocks``
    """
    return {
        "block independence + differential evolution": block_move(
            blocks, np.median(sample, axis=0), np.atleast_2d(np.cov(sample.T))
        ),
        # One snooker step in ten (ter Braak & Vrugt 2008).
        "differential evolution + snooker": [(emcee.moves.DEMove(), 0.9), (emcee.moves.DESnookerMove(), 0.1)],
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
