"""Ensemble moves, and a pilot run that measures which of them mixes fastest."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np

#: Degrees of freedom of the independence proposal: tails heavier than the posterior's keep its weights bounded.
DEGREES_OF_FREEDOM = 8.0
#: The independence proposal is wider than the pilot's sample by this factor.
INFLATION = 1.1
PILOT_STEPS = 150
#: Part of the block steps that have the full length of the difference, and the log-spread of the others' length.
JUMPS, LENGTH_SPREAD = 0.2, 0.3

BatchedLogDensity = Callable[[np.ndarray], np.ndarray]
Moves = list[tuple[Any, float]]


@dataclass(frozen=True)
class StudentProposal:
    """Independence Metropolis–Hastings: every walker proposes from one multivariate Student density.

    The density is fixed before the recorded chain starts, so detailed balance holds; as half of a mixture with an
    ensemble move it takes long steps where the posterior is near its Gaussian approximation and costs little elsewhere.
    """

    mean: np.ndarray
    root: np.ndarray

    def log_density(self, u: np.ndarray) -> np.ndarray:
        """(w,) up to a constant, u (w, d)."""
        z = np.linalg.solve(self.root, (u - self.mean).T)
        d = len(self.mean)
        return -0.5 * (DEGREES_OF_FREEDOM + d) * np.log1p(np.sum(z**2, axis=0) / DEGREES_OF_FREEDOM)

    def draw(self, rng: np.random.RandomState, size: int) -> np.ndarray:
        """(size, d)."""
        z = rng.standard_normal((size, len(self.mean)))
        scale = np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, size))
        return self.mean + (scale[:, None] * z) @ self.root.T

    def __call__(self, coords: np.ndarray, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """emcee's proposal: new coordinates and log q(old) - log q(new)."""
        new = self.draw(rng, len(coords))
        return new, self.log_density(coords) - self.log_density(new)


class BlockEvolution(emcee.moves.RedBlueMove):
    """Differential evolution (ter Braak 2006) of some coordinates only, the others held.

    In all d dimensions a step that fits the bulk seldom fits a curved tail, and a walker that has strayed there stays;
    in the few dimensions of the block that bends, steps are larger and are accepted. One step in ``JUMPS`` has the full
    length of the difference.
    """

    def __init__(self, block: np.ndarray) -> None:
        super().__init__()
        self.block = block

    def get_proposal(
        self, sample: np.ndarray, complement: list[np.ndarray], random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """emcee's proposal: symmetric, so the log factors are 0."""
        others, walkers = np.concatenate(complement), len(sample)
        first = random.randint(len(others), size=walkers)
        second = (first + 1 + random.randint(len(others) - 1, size=walkers)) % len(others)
        length = 2.38 / np.sqrt(2.0 * len(self.block)) * np.exp(LENGTH_SPREAD * random.standard_normal(walkers))
        length = np.where(random.random_sample(walkers) < JUMPS, 1.0, length)
        proposed = sample.copy()
        proposed[:, self.block] += length[:, None] * (others[first] - others[second])[:, self.block]
        return proposed, np.zeros(walkers)


def differential_evolution() -> Moves:
    """Differential evolution with one snooker step in ten (ter Braak & Vrugt 2008)."""
    return [(emcee.moves.DEMove(), 0.9), (emcee.moves.DESnookerMove(), 0.1)]


def candidates(sample: np.ndarray, block: np.ndarray) -> Mapping[str, Moves]:
    """The moves that the pilot compares.

    Parameters
    ----------
    sample : (m, d) from the posterior, shapes the independence proposal
    block : indices of the slowest parameter and of those that share an experiment with it
    """
    root = np.sqrt(INFLATION) * np.linalg.cholesky(np.atleast_2d(np.cov(sample.T)))
    independence = emcee.moves.MHMove(StudentProposal(np.mean(sample, axis=0), root))
    return {
        "independence + block evolution": [(independence, 0.4), (BlockEvolution(block), 0.6)],
        "independence + differential evolution": [(independence, 0.6), (emcee.moves.DEMove(), 0.4)],
        "differential evolution + snooker": differential_evolution(),
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
