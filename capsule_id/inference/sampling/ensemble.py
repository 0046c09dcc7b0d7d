"""One emcee ensemble that stores its own state and advances draw by draw.

emcee keeps the state of a run only in ``run_mcmc``. Saving after every draw requires iteration, and an iterated run
must keep its own state between calls.
"""

from contextlib import AbstractContextManager, nullcontext
from copy import copy
from typing import Any

import emcee
import h5py
import numpy as np

from capsule_id.inference.sampling.moves import Moves, Parts
from capsule_id.interruption import stop_if_interrupted


class Ensemble:
    """Walkers that sample one log-density with given moves.

    Parameters
    ----------
    parts : log-density of each block, and what else is kept of it; the log-density is the sum over the blocks
    state : positions of the walkers and state of their random numbers
    moves : see ``capsule_id.inference.sampling.moves``
    backend : storage of the draws; None: in memory
    """

    def __init__(self, parts: Parts, state: emcee.State, moves: Moves, backend: Any = None) -> None:
        def log_density(v: np.ndarray) -> np.ndarray:
            """(w, 1 + blocks k): log-density, then the parts, which emcee stores as blobs for ``BlockMove``."""
            found = np.atleast_3d(parts(v))
            return np.concatenate([np.sum(found[..., 0], axis=1, keepdims=True), found.reshape(len(v), -1)], axis=1)

        walkers, dimension = state.coords.shape
        self.state = state
        # Ensembles run side by side, and emcee's moves keep numbers of the ensemble that they work for.
        own = [(copy(move), weight) for move, weight in moves]
        self._sampler = emcee.EnsembleSampler(
            walkers, dimension, log_density, vectorize=True, moves=own, backend=backend
        )

    @property
    def stored(self) -> int:
        """Number of stored draws."""
        return self._sampler.iteration

    @property
    def chain(self) -> np.ndarray:
        """(draw, walker, d) stored draws."""
        return np.asarray(self._sampler.get_chain())

    @property
    def parts(self) -> np.ndarray:
        """(draw, walker, blocks k) parts of the stored draws, in one axis."""
        blobs = np.asarray(self._sampler.get_blobs())
        return blobs.reshape(*blobs.shape[:2], -1)

    @property
    def acceptance(self) -> np.ndarray:
        """(walker,) share of accepted proposals among the stored draws."""
        return self._sampler.backend.accepted / self._sampler.iteration

    def run(self, draws: int, thin: int = 1, store: bool = True) -> "Ensemble":
        """Make ``draws`` more draws of ``thin`` steps each and return the ensemble itself."""
        if draws > 0:
            for state in self._sampler.sample(self.state, iterations=draws, thin_by=thin, store=store):
                self.state = state
                stop_if_interrupted()
        return self


def initial_state(positions: np.ndarray, random: np.random.RandomState) -> emcee.State:
    """State of walkers at ``positions`` (w, d), with the current state of ``random``."""
    return emcee.State(positions, random_state=random.get_state())


class OpenBackend(emcee.backends.HDFBackend):
    """emcee's HDF5 backend on a file that stays open; emcee's own backend opens the file six times a step."""

    def __init__(self, file: h5py.File, name: str) -> None:
        super().__init__(file.filename, name)
        self._file = file

    def open(self, mode: str = "r") -> AbstractContextManager[h5py.File]:
        del mode
        return nullcontext(self._file)

    def last_state(self) -> emcee.State | None:
        """State after the last stored draw; None if there is no draw."""
        return self.get_last_sample() if self.initialized and self.iteration else None
