"""Ensemble moves, and the candidates among which a pilot run chooses by measured autocorrelation time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
from scipy.special import logsumexp

#: Degrees of freedom of the block proposal, and the mixture of widths that it draws from: a scatter known from four
#: trials gives its mean tails like Student's t with three degrees of freedom.
DEGREES_OF_FREEDOM = 4.0
WIDTHS, WEIGHTS = np.array([1.0, 2.0, 4.0]), np.array([0.6, 0.25, 0.15])

Moves = list[tuple[Any, float]]


@dataclass(frozen=True)
class BlockProposal:
    """Independence Metropolis–Hastings on one block of parameters, chosen at random for each walker.

    Blocks are parameters that the posterior ties together; each has its own mixture of Student densities, shaped by
    the pilot's sample and fixed before the recorded chain starts, so that detailed balance holds.

    Attributes
    ----------
    blocks : indices of the parameters of each block
    mean : (d,)
    roots : per block, a root of its covariance
    """

    blocks: Sequence[np.ndarray]
    mean: np.ndarray
    roots: Sequence[np.ndarray]

    def log_density(self, block: int, u: np.ndarray) -> np.ndarray:
        """(w,) up to a constant; u (w, d_block)."""
        z = np.linalg.solve(self.roots[block], (u - self.mean[self.blocks[block]]).T)
        d, square = len(z), np.sum(z**2, axis=0)
        parts = [
            np.log(weight)
            - d * np.log(width)
            - 0.5 * (DEGREES_OF_FREEDOM + d) * np.log1p(square / width**2 / DEGREES_OF_FREEDOM)
            for width, weight in zip(WIDTHS, WEIGHTS, strict=True)
        ]
        return np.asarray(logsumexp(parts, axis=0))

    def draw(self, block: int, rng: np.random.RandomState, size: int) -> np.ndarray:
        """(size, d_block)."""
        z = rng.standard_normal((size, len(self.blocks[block])))
        scale = rng.choice(WIDTHS, p=WEIGHTS, size=size)
        scale = scale * np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, size))
        return self.mean[self.blocks[block]] + (scale[:, None] * z) @ self.roots[block].T

    def __call__(self, coords: np.ndarray, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """emcee's proposal: new coordinates (w, d) and log q(old) - log q(new), (w,)."""
        new, factors = coords.copy(), np.zeros(len(coords))
        sizes = np.array([len(block) for block in self.blocks])
        # A block of more parameters is harder to move: it gets its turn more often.
        chosen = rng.choice(len(sizes), p=sizes / np.sum(sizes), size=len(coords))
        for i, block in enumerate(self.blocks):
            walkers = np.flatnonzero(chosen == i)
            old = coords[np.ix_(walkers, block)]
            proposed = self.draw(i, rng, len(walkers))
            new[np.ix_(walkers, block)] = proposed
            factors[walkers] = self.log_density(i, old) - self.log_density(i, proposed)
        return new, factors


def differential_evolution() -> Moves:
    """Differential evolution with one snooker step in ten (ter Braak & Vrugt 2008)."""
    return [(emcee.moves.DEMove(), 0.9), (emcee.moves.DESnookerMove(), 0.1)]


def candidates(sample: np.ndarray, blocks: Sequence[np.ndarray]) -> Mapping[str, Moves]:
    """The moves that the pilot compares.

    Parameters
    ----------
    sample : (m, d) of the pilot's burnt-in ensemble: it shapes the block proposal
    blocks : see ``LogPosterior.blocks``
    """
    roots = [np.linalg.cholesky(np.atleast_2d(np.cov(sample[:, block].T))) for block in blocks]
    independence = emcee.moves.MHMove(BlockProposal(blocks, np.median(sample, axis=0), roots))
    return {
        "block independence + differential evolution": [(independence, 0.8), (emcee.moves.DEMove(), 0.2)],
        "differential evolution + snooker": differential_evolution(),
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
