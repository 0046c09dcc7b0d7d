"""Reads HDF5 files, among them MATLAB files of version 7.3: every real numeric data set is a column, or a matrix.

pyfive reads them. It is written in Python; h5py's C library never returns from some damaged files. A file
with links to other files is refused: only its own bytes count.
"""

import io
from math import prod
from pathlib import Path

import numpy as np

from capsule_id.rig.formats.binary.arrays import export_of_arrays
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.limits import complete, installed, refuse_large

#: Fewest bytes of a chunk with its entry in the index.
SMALLEST_CHUNK = 16


def read_hdf5(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the data sets of an HDF5 file; their names are paths such as ``group/x``.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"

    Raises
    ------
    InputError
        If the file is damaged, too large, or has no numeric data set.
    """
    with installed("pyfive", path):
        import pyfive

    arrays: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    # MATLAB stores the columns of a matrix one after the other, which HDF5 sees as rows.
    by_columns = content.startswith(b"MATLAB 7.3")

    def visit(name: str, found: object) -> None:
        if not isinstance(found, pyfive.Dataset) or found.ndim not in (1, 2):
            return
        if getattr(found.dtype, "kind", "") not in ("f", "i", "u"):
            return
        # MATLAB keeps texts as numbers, and the contents of cell arrays in #refs#.
        text = found.attrs.get("MATLAB_class") == b"char" or name.startswith("#") or "MATLAB_empty" in found.attrs
        if not text:
            refuse_large(found.size * found.dtype.itemsize + sum(array.nbytes for array in arrays.values()), path)
            chunks = prod(-(-size // step) for size, step in zip(found.shape, found.chunks or found.shape, strict=True))
            if chunks > max(len(content) // SMALLEST_CHUNK, 1):  # pyfive looks for every one of them
                raise ValueError(f"{name} states {chunks} chunks in a file of {len(content)} bytes")
            array = np.asarray(found[()])
            arrays[name] = array.T if by_columns else array
            unit = found.attrs.get("units", found.attrs.get("unit"))
            if isinstance(unit, str):
                units[name] = unit

    with complete(path, "export it again"), pyfive.File(io.BytesIO(content)) as file:
        file.visititems(visit)
    return export_of_arrays(arrays, path, layout, units)
