"""Storage of chains on disk that survives termination of the process at any moment.

emcee writes every draw into an HDF5 file in several steps (coordinates, random state, counter). A process killed
between two steps leaves an inconsistent file. A resumed run therefore starts from a copy made between draws, which
stores its own digest. The file that emcee writes is never read after an interruption.
"""

import hashlib
import time
from pathlib import Path

import h5py

from capsule_id.inference.sampling.ensemble import OpenBackend

#: Time between two copies, s.
SAVE_EVERY = 5.0
#: Length of the digest of a copy, bytes.
_DIGEST = hashlib.sha256().digest_size


def saved_copy(store: Path) -> Path:
    """Path of the copy of ``store`` from which an interrupted run resumes."""
    return store.with_suffix(".saved")


class ChainStore:
    """Context manager of the open HDF5 file that emcee writes, and of its copy.

    Parameters
    ----------
    store : the file; the last copy replaces it, or it is removed if no copy has a valid digest
    fingerprint : of the sampled density and the seed; a copy with another one is discarded
    """

    def __init__(self, store: Path, fingerprint: str) -> None:
        self._store, self._copy, self._next = store, saved_copy(store), time.monotonic() + SAVE_EVERY
        store.unlink(missing_ok=True)
        saved = self._copy.read_bytes() if self._copy.exists() else b""
        content = saved[_DIGEST:]
        if content and hashlib.sha256(content).digest() == saved[:_DIGEST]:
            store.write_bytes(content)
        self._file = h5py.File(store, "a")
        if self._file.attrs.setdefault("fingerprint", fingerprint) != fingerprint:
            self._file.close()
            store.unlink()
            self._file = h5py.File(store, "w")
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
        """Copy the file now; a single rename makes the copy atomic."""
        self._file.flush()
        content = self._store.read_bytes()
        temporary = self._copy.with_suffix(".saved-new")
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
        temporary.replace(self._copy)
        self._next = time.monotonic() + SAVE_EVERY
