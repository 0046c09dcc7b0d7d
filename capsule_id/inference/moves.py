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


def differential_evolution() -> Moves:
    """Differential evolution with one snooker step in ten (ter Braak & Vrugt 2008)."""
    return [(emcee.moves.DEMove(), 0.9), (emcee.moves.DESnookerMove(), 0.1)]


def candidates(sample: np.ndarray) -> Mapping[str, Moves]:
    """The moves that the pilot compares; ``sample`` (m, d) from the posterior shapes the independence proposal."""
    root = np.sqrt(INFLATION) * np.linalg.cholesky(np.atleast_2d(np.cov(sample.T)))
    independence = emcee.moves.MHMove(StudentProposal(np.mean(sample, axis=0), root))
    return {
        "independence + differential evolution": [(independence, 0.6), (emcee.moves.DEMove(), 0.4)],
        "differential evolution + snooker": differential_evolution(),
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
