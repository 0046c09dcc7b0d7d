"""Reads MATLAB files: every real numeric variable is a column, of a matrix every column; so is a field of a struct.

Files of version 7.3 are HDF5 files. The format of versions 5 to 7 is that of "MAT-File Format", The MathWorks, level 5.
SciPy's reader ends the process by a segmentation fault on files with one changed byte, so this one checks every tag; the
tests compare the two on intact files.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.binary.arrays import export_of_arrays
from capsule_id.rig.formats.binary.hdf5 import read_hdf5
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.limits import LARGEST_CONTENT, refuse_large
from capsule_id.views import counted

_MATRIX, _COMPRESSED = 14, 15  # types of data elements
_STRUCT = 2  # class of arrays with fields
_DEEPEST = 16  # struct in a struct
_NUMERIC_CLASSES = range(6, 16)  # of arrays: double, single, and integers of 8 to 64 bits
_COMPLEX = 0x0800  # flag of an array
#: NumPy's types by the number of the format.
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}


def read_mat(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the vectors of a MATLAB file by name; column 2 of a matrix ``data`` is called ``data(:,2)``.

    Fields of structs have names such as ``run.time``, or ``run(2).time`` in an array of structs.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"; the rest does not apply

    Raises
    ------
    InputError
        If it is no MATLAB file, is damaged, or has no numeric variable.
    """
    if content.startswith((b"MATLAB 7.3 MAT-file", b"\x89HDF")):
        return read_hdf5(content, path, layout)
    return export_of_arrays(_variables(content, path), path, layout)


def _variables(content: bytes, path: Path) -> dict[str, np.ndarray]:
    """The real numeric arrays by name; other variables are left out."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    try:
        if order is None:
            raise ValueError("no header of a MATLAB file")
        variables: dict[str, np.ndarray] = {}
        for kind, element in _elements(content[128:], order):
            if kind == _COMPRESSED:
                unpacked = zlib.decompressobj().decompress(element, LARGEST_CONTENT)
                kind, element = next(_elements(unpacked, order), (0, b""))
            for name, values in _arrays(kind, element, order):
                variables[name] = values
                refuse_large(sum(values.nbytes for values in variables.values()), path)
        return variables
    except InputError:
        raise
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


def _arrays(
    kind: int, element: bytes, order: str, own: str | None = None, depth: int = 0
) -> Iterator[tuple[str, np.ndarray]]:
    """Names and values of the real numeric arrays of an element: one, none, or those of the fields of a struct.

    ``own`` is the name of a field, which its element does not hold.
    """
    if kind != _MATRIX or not element:  # an empty field
        return
    parts = _elements(element, order)
    (flags,) = struct.unpack_from(order + "I", next(parts, (0, b""))[1])
    (_, sizes), (_, stated) = (next(parts, (0, b"")) for _ in range(2))
    shape = [int(size) for size in np.frombuffer(sizes, order + "i4")]
    name = stated.decode("ascii", "replace") if own is None else own
    if flags & 0xFF == _STRUCT and depth < _DEEPEST:
        yield from _fields(parts, name, int(np.prod(shape)), order, depth)
    elif flags & 0xFF in _NUMERIC_CLASSES and not flags & _COMPLEX:
        number, data = next(parts, (0, b""))
        if number not in _NUMBERS:
            raise ValueError(f"an array of type {number}")
        values = np.frombuffer(data, order + _NUMBERS[number]).astype(np.float64)
        if len(shape) == 2:
            if min(shape) < 0 or values.size != shape[0] * shape[1]:
                raise ValueError(f"{values.size} values in an array of {shape}")
            yield name, values.reshape(shape, order="F")


def _fields(
    parts: Iterator[tuple[int, bytes]], name: str, number: int, order: str, depth: int
) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of ``number`` structs ``name``: ``parts`` are the length of a field's name, all names, all fields."""
    (length,) = struct.unpack_from(order + "i", next(parts, (0, b""))[1])
    names = next(parts, (0, b""))[1]
    if length < 1:
        raise ValueError("a struct with fields without names")
    fields = [names[i : i + length].split(b"\0")[0].decode("ascii", "replace") for i in range(0, len(names), length)]
    for k in range(number if fields else 0):
        index = f"({k + 1})" if number > 1 else ""
        for field in fields:
            kind, element = next(parts, (-1, b""))
            if kind < 0:
                raise ValueError(f"a struct without some of its {counted(number * len(fields), 'field')}")
            yield from _arrays(kind, element, order, f"{name}{index}.{field}", depth + 1)
