"""Chains on disk that stay readable when the process is killed at any moment.

emcee writes every draw into an HDF5 file in several steps (coordinates, random state, counter), so a process that dies
between two of them leaves a file that opens and is wrong. A resumed run therefore starts from a copy made between draws,
which carries its own digest. The file that emcee writes is never read after an interruption.
"""

import hashlib
import time
from pathlib import Path

import h5py

from capsule_id.inference.sampling.ensemble import OpenBackend

#: Seconds between two copies.
SAVE_EVERY = 5.0
_DIGEST = hashlib.sha256().digest_size


def saved_copy(store: Path) -> Path:
    """The copy of ``store`` from which an interrupted run resumes."""
    return store.with_suffix(".saved")


class ChainStore:
    """The HDF5 file that emcee writes, open as long as this is (a context), and its copy.

    Parameters
    ----------
    store : the file; it is replaced by the last copy, or removed where no copy has a valid digest
    """

    def __init__(self, store: Path) -> None:
        self._store, self._copy, self._next = store, saved_copy(store), time.monotonic() + SAVE_EVERY
        store.unlink(missing_ok=True)
        saved = self._copy.read_bytes() if self._copy.exists() else b""
        content = saved[_DIGEST:]
        if content and hashlib.sha256(content).digest() == saved[:_DIGEST]:
            store.write_bytes(content)
        self._file = h5py.File(store, "a")

    def __enter__(self) -> "ChainStore":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def backend(self, name: str) -> OpenBackend:
        """The store of one ensemble's draws."""
        return OpenBackend(self._file, name)

    def between_draws(self) -> None:
        """Copy the file, if the last copy is old enough; to be called while emcee is not writing."""
        if time.monotonic() >= self._next:
            self.save()

    def save(self) -> None:
        """Copy the file now; the copy appears by one rename."""
        self._file.flush()
        content = self._store.read_bytes()
        temporary = self._copy.with_suffix(".saved-new")
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
        temporary.replace(self._copy)
        self._next = time.monotonic() + SAVE_EVERY
