"""Ensemble moves, and the candidates among which a pilot run chooses by measured autocorrelation time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np

#: Kernels of a block proposal, one on each of so many draws of the pilot, and their degrees of freedom.
KERNELS, DEGREES_OF_FREEDOM = 256, 4.0
#: Kernels are wider than Silverman's rule by these factors, in these parts of the proposals: the wide ones reach the
#: tails that a short pilot has not seen.
WIDTHS, WEIGHTS = np.array([1.0, 2.0]), np.array([0.7, 0.3])

Moves = list[tuple[Any, float]]


@dataclass(frozen=True)
class BlockProposal:
    """Independence Metropolis–Hastings on one block of parameters, the same for all walkers of a step.

    Blocks are parameters that the posterior ties together. Each is proposed from a kernel density estimate on draws of
    the pilot, so that its shape is the posterior's; it is fixed before the recorded chain starts, so that detailed
    balance holds.

    Attributes
    ----------
    blocks : indices of the parameters of each block
    centres : per block (``KERNELS``, d_block), in units of ``roots``
    roots : per block (d_block, d_block), a root of the kernels' scale matrix
    """

    blocks: Sequence[np.ndarray]
    centres: Sequence[np.ndarray]
    roots: Sequence[np.ndarray]

    def log_density(self, block: int, z: np.ndarray) -> np.ndarray:
        """(w,) up to a constant; z (w, d_block) in units of the root."""
        d = z.shape[1]
        square = np.sum((z[:, None, :] - self.centres[block]) ** 2, axis=2)[..., None] / WIDTHS**2
        kernels = (1.0 + square / DEGREES_OF_FREEDOM) ** (-0.5 * (DEGREES_OF_FREEDOM + d))
        return np.log(np.sum(kernels @ (WEIGHTS / WIDTHS**d), axis=1))

    def draw(self, block: int, rng: np.random.RandomState, size: int) -> np.ndarray:
        """(size, d_block) in units of the root."""
        centre = self.centres[block][rng.randint(KERNELS, size=size)]
        scale = rng.choice(WIDTHS, p=WEIGHTS, size=size)
        scale = scale * np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, size))
        return centre + scale[:, None] * rng.standard_normal((size, centre.shape[1]))

    def __call__(self, coords: np.ndarray, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """emcee's proposal: new coordinates (w, d) and log q(old) - log q(new), (w,)."""
        sizes = np.array([len(block) for block in self.blocks])
        # A block of more parameters is harder to move: it gets its turn more often.
        i = int(rng.choice(len(sizes), p=sizes / np.sum(sizes)))
        new, block, root = coords.copy(), self.blocks[i], self.roots[i]
        old = np.linalg.solve(root, coords[:, block].T).T
        proposed = self.draw(i, rng, len(coords))
        new[:, block] = proposed @ root.T
        return new, self.log_density(i, old) - self.log_density(i, proposed)


def block_proposal(sample: np.ndarray, blocks: Sequence[np.ndarray]) -> BlockProposal:
    """Shape the proposal by ``sample`` (m, d): kernels on evenly spaced draws, bandwidths by Silverman's rule."""
    chosen = sample[np.linspace(0, len(sample) - 1, KERNELS).astype(int)]
    roots, centres = [], []
    for block in blocks:
        d = len(block)
        bandwidth = (4.0 / (d + 2.0) / KERNELS) ** (1.0 / (d + 4.0))
        root = bandwidth * np.linalg.cholesky(np.atleast_2d(np.cov(sample[:, block].T)))
        roots.append(root)
        centres.append(np.linalg.solve(root, chosen[:, block].T).T)
    return BlockProposal(blocks, centres, roots)


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
    independence = emcee.moves.MHMove(block_proposal(sample, blocks))
    return {
        "block independence + differential evolution": [(independence, 0.6), (emcee.moves.DEMove(), 0.4)],
        "differential evolution + snooker": differential_evolution(),
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
