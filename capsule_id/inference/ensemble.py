"""One emcee ensemble that stores its own state, and the chain on disk."""

import hashlib
import time
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from pathlib import Path
from typing import Any

import emcee
import h5py
import numpy as np

from capsule_id.console import stop_if_interrupted
from capsule_id.inference.moves import Moves, Parts
from capsule_id.output import replace_file

# ensemble: One emcee ensemble that stores its own state and advances draw by draw.
#
# emcee keeps the state of a run only in ``run_mcmc``. Saving after every draw requires iteration, and an iterated run
# must keep its own state between calls.


class Ensemble:
    """Walkers that sample one log-density with given moves.

    Parameters
    ----------
    parts : log-density of each block, and what else is kept of it; the log-density is the sum over the blocks
    state : positions of the walkers and state of their random numbers
    moves : see ``capsule_id.inference.moves``
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
    """emcee's HDF5 backend on an open file, which may be in memory; emcee's own opens a file on disk six times a step."""

    def __init__(self, file: h5py.File, name: str) -> None:
        super().__init__(file.filename, name)
        self._file = file

    def open(self, mode: str = "r") -> AbstractContextManager[h5py.File]:
        del mode
        return nullcontext(self._file)

    @property
    def initialized(self) -> bool:
        """Whether the file has draws of this ensemble; emcee asks for a file on disk."""
        return self.name in self._file

    def last_state(self) -> emcee.State | None:
        """State after the last stored draw; None if there is no draw."""
        return self.get_last_sample() if self.initialized and self.iteration else None


# chain store: Storage of chains that survives termination of the process at any moment.
#
# emcee writes every draw into an HDF5 file in several steps (coordinates, random state, counter), and HDF5 ends the
# process where the disk is full. The file is therefore in memory; its copies on disk are made between draws.


#: Time between two copies, s.
SAVE_EVERY = 5.0
#: Length of the digest of a copy, bytes.
_DIGEST = hashlib.sha256().digest_size
#: By so much the file in memory grows at a time, bytes.
_GROWTH = 2**22


class ChainStore:
    """Context manager of the HDF5 file in memory that emcee writes, and of its copy on disk.

    Parameters
    ----------
    store : the copy, from which an interrupted run resumes; one without a valid digest is discarded
    fingerprint : of the sampled density and the seed; a copy with another one is discarded
    """

    def __init__(self, store: Path, fingerprint: str) -> None:
        self._store, self._next = store, time.monotonic() + SAVE_EVERY
        saved = store.read_bytes() if store.exists() else b""
        content = saved[_DIGEST:]
        valid = content and hashlib.sha256(content).digest() == saved[:_DIGEST]
        self._file = h5py.File.in_memory(content if valid else None, block_size=_GROWTH)
        if self._file.attrs.setdefault("fingerprint", fingerprint) != fingerprint:
            self._file.close()
            self._file = h5py.File.in_memory(block_size=_GROWTH)
            self._file.attrs["fingerprint"] = fingerprint

    def __enter__(self) -> "ChainStore":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def backend(self, name: str) -> OpenBackend:
        """emcee backend for the draws of one ensemble."""
        return OpenBackend(self._file, name)

    def between_draws(self) -> None:
        """Copy the file if the last copy is old enough; call this only while emcee is not writing."""
        if time.monotonic() >= self._next:
            self.save()

    def save(self) -> None:
        """Copy the file now; a single rename makes the copy atomic.

        Raises
        ------
        OutputError
            If the disk is full; the last copy stays.
        """
        self._file.flush()
        content = self._file.id.get_file_image()
        # The copy before it, this one, and the result, which is about as large.
        replace_file(self._store, hashlib.sha256(content).digest() + content, 3 * len(content))
        self._next = time.monotonic() + SAVE_EVERY
