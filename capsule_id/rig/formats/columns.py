"""Columns of any length: long ones lie in a temporary file, so that the memory of a record does not grow with it.

The operating system keeps those parts of the file in memory that are in use. It removes the file with its last array.
"""

import errno
import mmap
import tempfile
from collections.abc import Callable, Iterable
from typing import IO, Any

import numpy as np

from capsule_id.errors import InputError

#: Longest column that lies in memory, and numbers of a longer one that are worked on at a time.
IN_MEMORY = 1 << 20


class Growing:
    """A column of numbers that grows block by block."""

    def __init__(self, dtype: type[np.generic] = np.float64) -> None:
        self._values, self._dtype = np.empty(0, dtype), dtype
        self._file: IO[bytes] | None = None

    def __del__(self) -> None:
        """Close the file; arrays keep their part of it."""
        if self._file is not None:
            self._file.close()

    def extend(self, more: np.ndarray) -> None:
        """Append numbers.

        Raises
        ------
        InputError
            If the directory of temporary files has no room, or too many files are open.
        """
        size = len(self._values)
        if self._file is None and size + len(more) <= IN_MEMORY:
            self._values.resize(size + len(more), refcheck=False)
            self._values[size:] = more
            return
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="capsule-id-")  # noqa: SIM115  (the column closes it)
                self._file.write(self._values.data)
            self._file.write(np.ascontiguousarray(more, self._dtype).data)
            self._file.flush()
        except OSError as error:
            raise _fault(error) from None
        self._values = self._values[:0]

    @property
    def values(self) -> np.ndarray:
        """The numbers, (n,).

        Raises
        ------
        InputError
            If too many files are open: a column in a file holds one file open as long as it is used.
        """
        if self._file is not None and not len(self._values):
            try:
                self._values = np.asarray(np.memmap(self._file, self._dtype, "r+"))
            except OSError as error:
                raise _fault(error) from None
        return self._values


def _fault(error: OSError) -> InputError:
    """The error of a temporary file that cannot be made, with its remedy."""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        rule = "each column of a long record needs an open temporary file"
        remedy = "fit fewer records at once, or raise the limit of open files: ulimit -n"
    else:
        rule, remedy = "a long record needs room for temporary files", "set TMPDIR to a directory with room"
    return InputError(rule, str(error), remedy)


def joined(parts: Iterable[np.ndarray], dtype: type[np.generic] = np.float64) -> np.ndarray:
    """Arrays put one below the other."""
    column = Growing(dtype)
    for part in parts:
        column.extend(part)
    return column.values


def in_blocks(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """``function`` of arrays (n,), element by element; of long ones block by block."""
    rows = len(arrays[0])
    if rows <= IN_MEMORY:
        return function(*arrays)
    return joined(_blocks(function, arrays, rows))


def _blocks(function: Callable[..., np.ndarray], arrays: tuple[np.ndarray, ...], rows: int) -> Iterable[np.ndarray]:
    """``function`` of each block."""
    for first in range(0, rows, IN_MEMORY):
        yield function(*(array[first : first + IN_MEMORY] for array in arrays))
        release(*arrays)


def whole_numbers(first: int, count: int) -> np.ndarray:
    """``count`` whole numbers from ``first`` on, such as lines of a file."""
    parts = range(first, first + count, IN_MEMORY)
    return joined((np.arange(part, min(part + IN_MEMORY, first + count)) for part in parts), np.int32)


def release(*arrays: np.ndarray) -> None:
    """Give back the memory of columns that lie in files; their numbers are read again where they are used."""
    for array in arrays:
        owner: Any = array
        while owner is not None and not isinstance(owner, np.memmap):
            owner = getattr(owner, "base", None)
        # A map of another mode would lose what was written to it. Windows has no MADV_DONTNEED.
        if owner is not None and owner.mode == "r+" and hasattr(mmap, "MADV_DONTNEED"):
            memory: Any = owner.base
            memory.madvise(mmap.MADV_DONTNEED)
