"""Readers of binary files: HDF5, MATLAB, NumPy, Parquet, TDMS, Excel."""

import io
import logging
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.layouts import read_text
from capsule_id.rig.formats.raw import (
    LARGEST_CONTENT,
    Content,
    Export,
    Layout,
    complete,
    export_of_arrays,
    refuse_large,
    require,
    whole,
)
from capsule_id.views import counted

# arrays: Formats of named arrays: an adapter for each gives every array of real numbers with its name and unit.


Named = Iterator[tuple[str, np.ndarray | None, str]]  #: name, numbers (None: no real numbers), unit ("": not stated)


@dataclass(frozen=True)
class ArraysReader:
    """Reads the arrays of a file as columns, by name. ``missing`` of a layout may hold "NaN"; the rest does not apply.

    Attributes
    ----------
    find : the adapter: bytes and name of a file -> its arrays
    remedy : for a damaged file
    package : that reads it, where it is optional
    """

    find: Callable[[bytes, Path], Named]
    remedy: str
    package: str = ""

    def __call__(self, content: Content, path: Path, layout: Layout) -> Export:
        """The columns of a file.

        Raises
        ------
        InputError
            If the package is not installed, or the file is damaged, too large, or has no array of real numbers.
        """
        if self.package:
            require(self.package, path)
        with complete(path, self.remedy):
            found = [(name, array, unit) for name, array, unit in self.find(whole(content), path) if array is not None]
        units = {name: unit for name, _, unit in found}
        return export_of_arrays({name: array for name, array, _ in found}, path, layout, units)


# hdf5: Reads HDF5 files, among them MATLAB files of version 7.3: every real numeric data set is a column, or a matrix.
#
# pyfive reads them. It is written in Python; h5py's C library never returns from some damaged files. A file
# with links to other files is refused: only its own bytes count.


#: Fewest bytes of a chunk with its entry in the index.
SMALLEST_CHUNK = 16


def _data_sets(content: bytes, path: Path) -> Named:
    """The data sets of an HDF5 file; their names are paths such as ``group/x``."""
    import pyfive

    everything, size = list[tuple[str, Any]](), 0
    # MATLAB stores the columns of a matrix one after the other, which HDF5 sees as rows.
    by_columns = content.startswith(b"MATLAB 7.3")
    with pyfive.File(io.BytesIO(content)) as file:
        file.visititems(lambda name, found: everything.append((name, found)))
        for name, found in everything:
            if not isinstance(found, pyfive.Dataset) or found.ndim not in (1, 2):
                continue
            if getattr(found.dtype, "kind", "") not in ("f", "i", "u"):
                continue
            # MATLAB keeps texts as numbers, and the contents of cell arrays in #refs#.
            if found.attrs.get("MATLAB_class") == b"char" or name.startswith("#") or "MATLAB_empty" in found.attrs:
                continue
            size += found.size * found.dtype.itemsize
            refuse_large(size, path)
            chunks = prod(
                -(-length // step) for length, step in zip(found.shape, found.chunks or found.shape, strict=True)
            )
            if chunks > max(len(content) // SMALLEST_CHUNK, 1):  # pyfive looks for every one of them
                raise ValueError(f"{name} states {chunks} chunks in a file of {len(content)} bytes")
            array, unit = np.asarray(found[()]), found.attrs.get("units", found.attrs.get("unit"))
            yield name, array.T if by_columns else array, unit if isinstance(unit, str) else ""


read_hdf5 = ArraysReader(_data_sets, "export it again", "pyfive")


# mat: Reads MATLAB files: every real numeric variable is a column, of a matrix every column; so is a field of a struct.
#
# Files of version 7.3 are HDF5 files. The format of versions 5 to 7 is that of "MAT-File Format", The MathWorks,
# level 5. SciPy's reader ends the process by a segmentation fault on files with one changed byte, so this one
# checks every tag; the tests compare the two on intact files.


_MATRIX, _COMPRESSED = 14, 15  # types of data elements
_STRUCT = 2  # class of arrays with fields
_DEEPEST = 16  # struct in a struct
_NUMERIC_CLASSES = range(6, 16)  # of arrays: double, single, and integers of 8 to 64 bits
_COMPLEX = 0x0800  # flag of an array
#: NumPy's types by the number of the format.
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}


def read_mat(content: Content, path: Path, layout: Layout) -> Export:
    """Read the vectors of a MATLAB file by name; column 2 of a matrix ``data`` is called ``data(:,2)``.

    Fields of structs have names such as ``run.time``, or ``run(2).time`` in an array of structs.

    Parameters
    ----------
    content : the bytes of the file, or where they lie
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"; the rest does not apply

    Raises
    ------
    InputError
        If it is no MATLAB file, is damaged, or has no numeric variable.
    """
    content = whole(content)
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
        raise InputError(
            "a MATLAB file must be complete", str(error), "save it again by save(..., '-v7')", path
        ) from None


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


# npz: Reads NumPy archives: every real numeric array is a column, or a matrix. Pickled objects are never loaded.


def _members(content: bytes, path: Path) -> Named:
    """The arrays of an archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        refuse_large(sum(member.file_size for member in members), path)
        for member in members:
            # ``read`` returns at most the stated size of the member.
            yield member.filename.removesuffix(".npy"), _numbers(archive.read(member)), ""


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


read_npz = ArraysReader(_members, "write it again by numpy.savez")


# parquet: Reads Parquet files: every column of real numbers. pyarrow, the reference implementation, decodes them.


def _columns(content: bytes, path: Path) -> Named:
    """The columns of a Parquet file; empty cells are NaN."""
    import pyarrow as pa
    from pyarrow import parquet

    file = parquet.ParquetFile(pa.BufferReader(content))
    schema = file.schema_arrow
    numeric = [field.name for field in schema if pa.types.is_floating(field.type) or pa.types.is_integer(field.type)]
    # pyarrow makes room for the rows that a row group states.
    rows = [file.metadata.row_group(k).num_rows for k in range(file.metadata.num_row_groups)]
    if min(rows, default=0) < 0 or sum(rows) != file.metadata.num_rows:
        raise InputError(
            "a .parquet file must be complete",
            f"row groups of {sum(rows)} rows in a table of {file.metadata.num_rows}",
            "write it again",
            path,
        )
    refuse_large(8 * file.metadata.num_rows * len(numeric), path)
    table = file.read(columns=numeric, use_threads=False)
    yield from ((name, table.column(name).to_numpy(), "") for name in table.column_names)


read_parquet = ArraysReader(_columns, "write it again", "pyarrow")


# tdms: Reads TDMS files of LabVIEW by npTDMS: every channel of numbers, scaled, and the times of waveforms.


#: Name of the column of times of a waveform, which the file holds as an offset and an increment.
TIME = "wf_time"
#: Most scales of a channel.
MOST_SCALES = 1000
_SCALES = "NI_Number_Of_Scales"


def _channels(content: bytes, path: Path) -> Named:
    """The channels of a TDMS file by name, ``group/channel`` where two groups have a channel of that name.

    ``wf_time`` holds the times of waveforms, s, from their offset and increment; ``wf_time(<channel>)`` those of
    each channel where channels have different clocks. Without these properties there is no such column.
    """
    import nptdms
    from nptdms.log import log_manager

    log_manager.set_level(logging.CRITICAL)  # its remarks on damaged files go to standard error otherwise
    clocks: dict[str, tuple[float, float, int]] = {}
    with nptdms.TdmsFile.open(io.BytesIO(content)) as file:
        groups = file.groups()
        everything = [channel for group in groups for channel in group.channels()]
        for properties in (file.properties, *(each.properties for each in (*groups, *everything))):
            scales: Any = properties.get(_SCALES, 0)
            if not 0 <= scales <= MOST_SCALES:  # npTDMS makes a list of so many elements
                raise ValueError(f"{scales} scales of a channel")
        channels = [channel for channel in everything if channel.dtype.kind in "fiu"]
        refuse_large(8 * sum(len(channel) for channel in channels), path)
        names = [channel.name for channel in channels]
        for channel in channels:
            name = channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
            if (clock := _clock(channel)) is not None:
                clocks[name] = (*clock, len(channel))
            yield name, np.asarray(channel[:]), str(channel.properties.get("unit_string", ""))
    common = len(set(clocks.values())) == 1
    for name, (offset, increment, samples) in clocks.items():
        yield TIME if common else f"{TIME}({name})", offset + increment * np.arange(samples), "s"


def _clock(channel: Any) -> tuple[float, float] | None:
    """Offset and increment of a waveform, s; None where the file states none."""
    increment, offset = (channel.properties.get(key) for key in ("wf_increment", "wf_start_offset"))
    if not isinstance(increment, int | float) or not np.isfinite(increment) or increment <= 0.0:
        return None
    return (float(offset) if isinstance(offset, int | float) and np.isfinite(offset) else 0.0), float(increment)


read_tdms = ArraysReader(_channels, "export it again, or as text", "npTDMS")


# xlsx: Reads Excel workbooks: the first sheet with numbers, as the text table that it would be saved to.


#: Most cells of a sheet; one takes 50 bytes in the file, and a few hundred while it is read.
MOST_CELLS = 2_000_000


def read_xlsx(content: Content, path: Path, layout: Layout) -> Export:
    """Read a sheet with titles, headers and rows of units in the same way as a text export.

    Places are the row and the column of the sheet. A formula counts by the value that the workbook holds for it.

    Parameters
    ----------
    content : the bytes of the file, or where they lie
    path : its name, for error lines
    layout : as for text; ``data_from_line`` and ``data_to_line`` are rows of the sheet

    Raises
    ------
    InputError
        If openpyxl is not installed, the file is damaged or too large, or the rows of numbers are not found.
    """
    require("openpyxl", path)
    import openpyxl

    with complete(path, "save it again"):
        content = whole(content)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            refuse_large(sum(member.file_size for member in archive.infolist()), path)
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True, keep_links=False)
        sheets = (_rows(sheet, path) for sheet in book.worksheets)
        rows = next((rows for rows, numbers in sheets if numbers), [])
    width = max((k + 1 for row in rows for k, cell in enumerate(row) if cell), default=0)
    lines = ["\t".join([*row[:width], *[""] * (width - len(row)), ""]) if any(row) else "" for row in rows]
    try:
        export = read_text("\n".join(lines).encode(), path, layout)
    except InputError as error:
        raise _in_sheet(error, lines) from None

    def values(column: int) -> np.ndarray:
        try:
            return export.values(column)
        except InputError as error:
            raise _in_sheet(error, lines) from None

    return replace(export, values=values, place=lambda row, column: (*export.place(row, column)[:2], column + 1))


def _rows(sheet: Any, path: Path) -> tuple[list[list[str]], bool]:
    """The cells of a sheet as text, each in one line, and whether one of them is a number."""
    rows, cells, numbers = [], 0, False
    if not hasattr(sheet, "reset_dimensions"):  # a sheet that holds only a chart
        return rows, numbers
    sheet.reset_dimensions()  # the stated size of a sheet can be far larger than the sheet
    for row in sheet.iter_rows(values_only=True):
        cells += len(row)
        if cells > MOST_CELLS:
            raise InputError(
                f"a sheet must have at most {MOST_CELLS} cells", "more", "export the record as CSV or Parquet", path
            )
        real = [isinstance(cell, int | float) and not isinstance(cell, bool) for cell in row]
        numbers = numbers or any(real)
        texts = zip(row, real, strict=True)
        rows.append([repr(float(c)) if n else "" if c is None else " ".join(str(c).split()) for c, n in texts])
    return rows, numbers


def _in_sheet(error: InputError, lines: list[str]) -> InputError:
    """The error with the column of the sheet instead of the character of the line."""
    if error.line is None or error.line > len(lines):
        return error
    column = lines[error.line - 1][: (error.column or 1) - 1].count("\t") + 1
    return InputError(error.rule, error.value, error.remedy, error.file, error.line, column)
