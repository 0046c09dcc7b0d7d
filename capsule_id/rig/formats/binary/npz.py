"""Reads NumPy archives: every real numeric array is a column, or a matrix. Pickled objects are never loaded."""

import io
import zipfile
from math import prod
from pathlib import Path

import numpy as np

from capsule_id.rig.formats.binary.arrays import export_of_arrays
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.limits import complete, refuse_large


def read_npz(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the arrays of an archive by name.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"

    Raises
    ------
    InputError
        If the archive is damaged, too large, or has no numeric array.
    """
    arrays: dict[str, np.ndarray] = {}
    with complete(path, "write it again by numpy.savez"), zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        refuse_large(sum(member.file_size for member in members), path)
        for member in members:
            # ``read`` returns at most the stated size of the member.
            array = _numbers(archive.read(member))
            if array is not None:
                arrays[member.filename.removesuffix(".npy")] = array
    return export_of_arrays(arrays, path, layout)


def _numbers(content: bytes) -> np.ndarray | None:
    """The array of a member, None if it holds no real numbers."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if dtype.kind not in "fiu" or len(shape) not in (1, 2):
        return None
    if prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError(f"an array of {shape} in {len(content)} bytes")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)
