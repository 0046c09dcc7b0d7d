"""Reads MATLAB files of versions 5 to 7: every real numeric variable is a column, of a matrix every column.

The format is that of "MAT-File Format", The MathWorks, level 5. SciPy's reader ends the process by a segmentation fault
on files with one changed byte, so this one checks every tag; the tests compare the two on intact files.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.export import Export, Layout

#: Largest size of a decompressed variable, bytes.
LARGEST_VARIABLE = 1 << 30
_MATRIX, _COMPRESSED = 14, 15  # types of data elements
_NUMERIC_CLASSES = range(6, 16)  # of arrays: double, single, and integers of 8 to 64 bits
_COMPLEX = 0x0800  # flag of an array
#: NumPy's types by the number of the format.
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}


def read_mat(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the vectors of a MATLAB file by name; column 2 of a matrix ``data`` is called ``data(:,2)``.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"; the rest does not apply

    Raises
    ------
    InputError
        If it is no MATLAB file of version 5 to 7, is damaged, or has no numeric variable.
    """
    if layout.data_from_line is not None:
        remedy = "remove data_from_line"
        raise InputError("a MATLAB file has no lines", f"data_from_line = {layout.data_from_line}", remedy, path)
    columns = _vectors(_variables(content, path))
    if not columns:
        raise InputError("a MATLAB file must hold numeric vectors", "none", "save the readings as vectors", path)
    names = tuple(columns)

    def values(column: int) -> np.ndarray:
        found = columns[names[column]]
        refused = ~np.isfinite(found) & ~(np.isnan(found) & ("NaN" in layout.missing))
        if refused.any():
            row = int(np.argmax(refused))
            remedy = 'add "NaN" to missing = [...] to drop its row' if np.isnan(found[row]) else "correct the value"
            raise InputError(f"{names[column]} must be finite", f"{found[row]}", remedy, path, *place(row, column))
        return found

    def place(row: int | None, column: int) -> tuple[int, int]:
        return 1 if row is None else row + 1, column + 1

    longest = max(vector.size for vector in columns.values())
    return Export(path, (names,), len(names), np.arange(1, longest + 1), values, place)


def _variables(content: bytes, path: Path) -> dict[str, np.ndarray]:
    """The real numeric arrays by name; other variables are left out."""
    if b"MATLAB 7.3" in content[:128] or content.startswith(b"\x89HDF"):
        remedy = "save it by save(..., '-v7')"
        raise InputError("a MATLAB file must have version 5 to 7", "version 7.3", remedy, path)
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    try:
        if order is None:
            raise ValueError("no header of a MATLAB file")
        arrays = (_array(kind, element, order) for kind, element in _elements(content[128:], order))
        return dict(array for array in arrays if array is not None)
    except (ValueError, struct.error, zlib.error) as error:
        remedy = "save it again by save(..., '-v7')"
        raise InputError("a MATLAB file must be complete", str(error), remedy, path) from None


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and bytes of every data element."""
    position = 0
    while position < len(content):
        kind, size = struct.unpack_from(order + "II", content, position)
        start = position + 8
        if kind >> 16:  # a small element: type, size and at most 4 bytes in the place of the tag
            kind, size, start = kind & 0xFFFF, kind >> 16, position + 4
            position += 8
        else:
            position = start + size + (-size % 8 if kind != _COMPRESSED else 0)
        element = content[start : start + size]
        if len(element) != size:
            raise ValueError("an element is longer than the file")
        yield kind, element


def _array(kind: int, element: bytes, order: str) -> tuple[str, np.ndarray] | None:
    """Name and values of an element with a real numeric array, None for another one."""
    if kind == _COMPRESSED:
        unpacked = zlib.decompressobj().decompress(element, LARGEST_VARIABLE)
        kind, element = next(_elements(unpacked, order), (0, b""))
    if kind != _MATRIX:
        return None
    parts = _elements(element, order)
    (flags,) = struct.unpack_from(order + "I", next(parts, (0, b""))[1])
    if flags & 0xFF not in _NUMERIC_CLASSES or flags & _COMPLEX:
        return None
    sizes, name, (number, data) = (next(parts, (0, b"")) for _ in range(3))
    if number not in _NUMBERS:
        raise ValueError(f"an array of type {number}")
    shape = [int(size) for size in np.frombuffer(sizes[1], order + "i4")]
    values = np.frombuffer(data, order + _NUMBERS[number]).astype(np.float64)
    if len(shape) > 2:
        return None
    if len(shape) != 2 or min(shape) < 0 or values.size != shape[0] * shape[1]:
        raise ValueError(f"{values.size} values in an array of {shape}")
    return name[1].decode("ascii", "replace"), values.reshape(shape, order="F")


def _vectors(variables: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Every vector and every column of a matrix, by name."""
    columns = {}
    for name, matrix in variables.items():
        if matrix.size and name.isprintable():
            if 1 in matrix.shape:
                columns[name] = matrix.ravel()
            else:
                columns |= {f"{name}(:,{i + 1})": column for i, column in enumerate(matrix.T)}
    return columns
