"""Readers of binary files: HDF5, MATLAB, NumPy, Parquet, TDMS, Excel."""

import io
import itertools
import json
import logging
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from importlib import import_module
from math import prod
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.layouts import read_text
from capsule_id.rig.formats.raw import (
    RATE_NAMES,
    READING,
    SPREAD,
    UNIT_NAMES,
    Export,
    Layout,
    Place,
    TextFile,
    complete,
    export_of_arrays,
    largest,
    refuse_large,
    require,
)
from capsule_id.rig.toml import is_number

# arrays: Formats of named arrays: an adapter for each gives every array of real numbers with its name and unit.


Named = Iterator[tuple[str, np.ndarray | None, str]]  #: name, numbers (None: no real numbers), unit ("": not stated)


def _read_arrays(
    find: Callable[[bytes, Path], Named], remedy: str, package: str, content: bytes, path: Path, layout: Layout
) -> Export:
    """The arrays of a file as columns, by name.

    Parameters
    ----------
    find : the adapter: bytes and name of a file -> its arrays
    remedy : for a damaged file
    package : that reads it, where it is optional; else ""
    content, path : bytes and name of the file
    layout : ``missing`` may hold "NaN"; the rest does not apply

    Raises
    ------
    InputError
        If the package is not installed, or the file is damaged, too large, or has no array of real numbers.
    """
    if package:
        require(package, path)
    arrays, units, readings = dict[str, np.ndarray](), dict[str, str](), 0
    with complete(path, remedy):
        for name, array, units[name] in find(content, path):
            if array is not None:
                arrays[name], readings = array, readings + array.size
                refuse_large(READING * readings, content, path)
    return export_of_arrays(arrays, path, layout, units)


# process: Reads HDF5 and MATLAB files by h5py and SciPy in a process of its own: every real numeric data set or variable is
# a column, of a matrix every column; so is a field of a struct.
#
# From some damaged files their C libraries never return, others end the process. The file is given as bytes, so that no
# other file is read.


#: Longest time to read a small file, s of the processor, bytes that a larger one has for each further second, and
#: memory of the process beyond that of the file, bytes.
LONGEST_READING, BYTES_PER_SECOND, SPARE_MEMORY = 8, 1 << 25, 1 << 29
#: Time beside that, s, in which a busy machine starts the process.
LONGEST_START = 60


def _in_process(content: bytes, path: Path) -> Named:
    """The arrays of an HDF5 file, whose names are paths such as ``group/x``, or of a MATLAB file."""
    command = [sys.executable, "-P", "-c", f"from {__name__} import serve; serve()", path.name]
    own = str(Path(__file__).parents[3])  # the package may be imported from the working folder
    paths = os.pathsep.join(dict.fromkeys([*filter(None, sys.path), own]))
    threads = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # the memory of their stacks counts
    surroundings = {**os.environ, **threads, "PYTHONPATH": paths}
    out = io.BytesIO()
    with suppress(subprocess.TimeoutExpired):  # in a session of its own Ctrl-C reaches this process alone
        done = subprocess.run(
            command,
            input=content,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=surroundings,
            start_new_session=True,
            timeout=LONGEST_START + _longest(content),
            check=False,
        )
        out = io.BytesIO(done.stdout)
    while (line := out.readline()).endswith(b"\n"):
        name, dtype, shape, unit, fault = json.loads(line)
        if fault is not None:
            raise InputError(*fault, file=path)
        if name is None:
            return
        values = out.read(size := np.dtype(dtype).itemsize * prod(shape))
        if len(values) != size:
            break
        yield name, np.frombuffer(values, dtype).reshape(shape), unit
    raise ValueError(f"reading it takes more than {_longest(content)} s, or ends the library that reads it")


def _longest(content: bytes) -> int:
    """Longest time to read a file, s."""
    return LONGEST_READING + len(content) // BYTES_PER_SECOND


def serve() -> None:
    """Read the file of standard input; write a line of JSON and the bytes of each array to standard output."""
    content, out, path = sys.stdin.buffer.read(), sys.stdout.buffer, Path(sys.argv[1])
    fault: Any = None
    try:
        with suppress(ImportError):  # Windows has no such limits; the time is limited by the process that waits alone
            resource: Any = import_module("resource")
            most = 2 * len(content) + 4 * largest(content) + SPARE_MEMORY
            longest = 1 + int(process_time()) + _longest(content)  # the start does not count
            for kind, limit in ((resource.RLIMIT_AS, most), (resource.RLIMIT_CPU, longest)):
                with suppress(ValueError, OSError):  # a lower limit holds already, or the system has none of this kind
                    resource.setrlimit(kind, (limit, limit))
        read, remedy = _read_data_sets, "export it again"
        if path.suffix.lower() == ".mat" and not content.startswith((b"MATLAB 7.3 MAT-file", b"\x89HDF")):
            read, remedy = _read_variables, "save it again by save(..., '-v7')"
        with complete(path, remedy):
            for name, array, unit in read(content, path):
                out.write(json.dumps([name, array.dtype.str, array.shape, unit, None]).encode() + b"\n")
                out.write(array.data)
    except InputError as error:
        fault = error.rule, error.value, error.remedy
    out.write(json.dumps([None, "", [], "", fault]).encode() + b"\n")
    out.flush()


def _read_data_sets(content: bytes, path: Path) -> Iterator[tuple[str, np.ndarray, str]]:
    """The real numeric data sets; empty ones are left out.

    Raises
    ------
    InputError
        Where readings lie in another file, or were never written.
    """
    import h5py

    readings = 0
    # MATLAB stores the columns of a matrix one after the other, which HDF5 sees as rows.
    by_columns = content.startswith(b"MATLAB 7.3")
    with h5py.File(io.BytesIO(content)) as file:
        links = dict[str, Any]()
        file.visititems_links(links.__setitem__)
        for name, link in links.items():
            found = file[name] if isinstance(link, h5py.HardLink) else link
            if isinstance(found, h5py.Dataset) and found.ndim > 2:
                continue
            for feature in _unreadable(found):
                raise InputError(
                    f"a {path.suffix} file must hold its readings itself, by filters of the HDF5 library",
                    f"{feature}, {name}",
                    "write the readings into this file, uncompressed or by gzip",
                )
            # MATLAB keeps texts as numbers, and the contents of cell arrays in #refs#.
            if (
                not isinstance(found, h5py.Dataset)
                or not (found.size and found.ndim <= 2 and found.dtype.kind in "fiu")
                or found.attrs.get("MATLAB_class") in (b"char", "char")
                or name.startswith("#")
                or "MATLAB_empty" in found.attrs
            ):
                continue
            readings += found.size
            refuse_large(READING * readings, content, path)
            array, unit = np.asarray(_unpacked(_written(found), found.attrs)), unit_stated(found.attrs)
            yield name, np.asarray(array.T if by_columns else array, order="C"), unit
        objects: Any = [("", file), *((k, file[k]) for k, link in links.items() if isinstance(link, h5py.HardLink))]
        for name, found in objects:
            for key in (key for key in found.attrs if key.lower() in RATE_NAMES):  # a rate that an attribute states
                value = np.asarray(found.attrs[key])
                if value.size == 1 and value.dtype.kind in "fiu":
                    yield f"{name}/{key}".lstrip("/"), value.reshape(1).astype(float), ""


#: Attributes of the CF conventions by which readings are packed, and their values where they are not stated.
_PACKED = {"scale_factor": 1.0, "add_offset": 0.0, "_FillValue": np.nan, "missing_value": np.nan}


def _unpacked(array: np.ndarray, attributes: Mapping[str, Any]) -> np.ndarray:
    """The readings that a packed array stands for: NaN at its fill values, all others scaled and moved."""
    stated = {key: np.ravel(attributes[key]) for key in _PACKED if key in attributes}
    numbers = {key: float(one[0]) for key, one in stated.items() if one.size and one.dtype.kind in "fiu"}
    if not numbers:
        return array
    scale, offset, *fills = (numbers.get(key, default) for key, default in _PACKED.items())
    return np.where(np.isin(array, fills), np.nan, array) * scale + offset


def unit_stated(attributes: Mapping[Any, Any]) -> str:
    """The unit among the attributes of a column, texts or bytes by name; "" where they state none."""
    texts = [
        [one.decode("utf-8", "replace") if isinstance(one, bytes) else one for one in pair]
        for pair in attributes.items()
    ]
    units = (unit for name, unit in texts if name.lower() in UNIT_NAMES and isinstance(unit, str) and unit.strip())
    return next(units, "")


def _unreadable(found: Any) -> Iterator[str]:
    """The features of a link or an object that keep its readings from being read."""
    import h5py

    if isinstance(found, h5py.ExternalLink):
        yield "a link to another file"
    if isinstance(found, h5py.Dataset):
        made = found.id.get_create_plist()
        filters = [made.get_filter(k) for k in range(made.get_nfilters())]
        missing = [
            name.decode("utf-8", "replace") or code for code, _, _, name in filters if not h5py.h5z.filter_avail(code)
        ]
        yield from (f"the filter {name}" for name in missing)
        yield from ["a data set in another file"] * bool(found.external)
        yield from ["a virtual data set"] * found.is_virtual


def _written(found: Any) -> np.ndarray:
    """The readings of a data set; NaN instead of the fill value where none was written."""
    array, chunks = found[()], found.chunks
    if chunks is None:
        return array if found.id.get_storage_size() else np.full(array.shape, np.nan)
    stored = found.id.get_num_chunks()
    if stored == prod(-(-length // step) for length, step in zip(array.shape, chunks, strict=True)):
        return array
    written = np.zeros(array.shape, bool)
    for k in range(stored):
        offset = found.id.get_chunk_info(k).chunk_offset
        written[tuple(slice(start, start + step) for start, step in zip(offset, chunks, strict=True))] = True
    return np.where(written, array, np.nan)


def _read_variables(content: bytes, path: Path) -> Iterator[tuple[str, np.ndarray, str]]:
    """The real numeric variables of a MATLAB file up to version 7, and the fields of structs such as ``run.time``.

    In an array of structs the second one is ``run(2)``. Files of version 7.3 are HDF5 files.
    """
    from scipy.io import loadmat

    ahead = list(loadmat(io.BytesIO(content)).items())
    while ahead:
        name, value = ahead.pop(0)
        if type(value) is not np.ndarray or name.startswith("__"):  # a sparse matrix, an object, the header
            continue
        if fields := value.dtype.names:
            structs = value.ravel(order="F")
            places = [f"({k + 1})" for k in range(len(structs))] if len(structs) > 1 else [""]
            ahead[:0] = [
                (f"{name}{place}.{field}", one[field])
                for place, one in zip(places, structs, strict=False)
                for field in fields
            ]
        elif value.dtype.kind in "fiu" and value.ndim == 2 and value.size:
            yield name, np.ascontiguousarray(value), ""


read_hdf5 = read_mat = partial(_read_arrays, _in_process, "export it again", "")


# octave: Reads the text that GNU Octave saves by default: each variable behind its name and type.


OCTAVE = b"# Created by Octave"
_VARIABLE = re.compile(
    r"^# name: (\S+)\n# type: (matrix|scalar|(?:double_)?range)\n((?:(?!# name: ).*\n)*)", re.MULTILINE
)


def _octave(content: bytes, path: Path) -> Named:
    """The real variables of a file, and the fields of its structs."""
    for name, kind, body in _VARIABLE.findall("\n".join([*TextFile(content, path).lines(), ""])):
        rows = [line.split() for line in body.split("\n") if line.strip() and not line.startswith("#")]
        values = np.array(rows, float)
        if kind.endswith("range"):
            first, last, step = values.ravel()[:3]
            refuse_large(READING * (samples := round((last - first) / step) + 1), content, path)
            values = first + step * np.arange(samples)
        yield name, values, ""


read_octave = partial(_read_arrays, _octave, "save it again by save -v7", "")


# npz: Reads NumPy archives: every real numeric array is a column, or a matrix. Pickled objects are never loaded.


def _members(content: bytes, path: Path) -> Named:
    """The arrays of an archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        refuse_large(sum(member.file_size for member in members) // 2, content, path)
        for member in members:
            # ``read`` returns at most the stated size of the member.
            yield member.filename.removesuffix(".npy"), _numbers(archive.read(member)), ""


def _numbers(content: bytes) -> np.ndarray | None:
    """The array of a member, None if it holds no real numbers."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if dtype.kind not in "fiu" or len(shape) > 2:
        return None
    if prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError(f"an array of {shape} in {len(content)} bytes")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


read_npz = partial(_read_arrays, _members, "write it again by numpy.savez", "")


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
    refuse_large(READING * file.metadata.num_rows * len(numeric), content, path)
    stamps = [field.name for field in schema if pa.types.is_timestamp(field.type)]
    table = file.read(columns=[*numeric, *stamps], use_threads=False)
    for name in table.column_names:
        column, unit = table.column(name).to_numpy(), unit_stated(schema.field(name).metadata or {})
        yield (name, _seconds(column), "s") if name in stamps else (name, column, unit)


def _seconds(stamps: np.ndarray) -> np.ndarray:
    """Seconds since the first of these dates and times of day, (n,); NaN where one is missing."""
    here = ~np.isnat(stamps)
    since = (stamps - stamps[here][:1]) / np.timedelta64(1, "ns") if here.any() else np.full(len(stamps), np.nan)
    return np.where(here, 1e-9 * since, np.nan)


read_parquet = partial(_read_arrays, _columns, "write it again", "pyarrow")


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
        channels = [channel for channel in everything if channel.dtype.kind in "fiuM"]
        refuse_large(READING * sum(len(channel) for channel in channels), content, path)
        names = [channel.name for channel in channels]
        for channel in channels:
            name = channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
            if (clock := _clock(channel)) is not None:
                clocks[name] = (*clock, len(channel))
            values, unit = np.asarray(channel[:]), unit_stated(channel.properties)
            yield (name, _seconds(values), "s") if values.dtype.kind == "M" else (name, values, unit)
    common = len(set(clocks.values())) == 1
    for name, (offset, increment, samples) in clocks.items():
        yield TIME if common else f"{TIME}({name})", offset + increment * np.arange(samples), "s"


def _clock(channel: Any) -> tuple[float, float] | None:
    """Offset and increment of a waveform, s; None where the file states none."""
    increment, offset = (channel.properties.get(key) for key in ("wf_increment", "wf_start_offset"))
    if not isinstance(increment, int | float) or not np.isfinite(increment) or increment <= 0.0:
        return None
    return (float(offset) if isinstance(offset, int | float) and np.isfinite(offset) else 0.0), float(increment)


read_tdms = partial(_read_arrays, _channels, "export it again, or as text", "npTDMS")


# xlsx: Reads Excel workbooks: the first sheet with numbers, as the text table that it would be saved to.


#: Most cells of a sheet; one takes 50 bytes in the file, and a few hundred while it is read.
MOST_CELLS = 2_000_000
#: Cells that a row without cells counts.
BLANK_ROW = 20
#: Rows of a further sheet in which a number is looked for.
SEARCHED_ROWS = 1000


def read_xlsx(content: bytes, path: Path, layout: Layout) -> Export:
    """Read a sheet with titles, headers and rows of units in the same way as a text export.

    Places are the row and the column of the sheet. A formula counts by the value that the workbook holds for it.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : as for text; ``data_from_line`` and ``data_to_line`` are rows of the sheet

    Raises
    ------
    InputError
        If openpyxl is not installed, the file is damaged or too large, or the rows of numbers are not found.
    """
    require("openpyxl", path)
    lines, sheet, others = _lines_of_book(content, path, layout.sheet)
    try:
        export = read_text("\n".join(lines).encode(), path, layout)
    except InputError as error:
        known = " or ".join(json.dumps(name, ensure_ascii=False) for name in others)
        more = f", or sheet = {known}, if that holds the readings" if others and not layout.sheet else ""
        raise _in_sheet(error, lines, more) from None

    def values(column: int) -> np.ndarray:
        try:
            return export.values(column)
        except InputError as error:
            raise _in_sheet(error, lines) from None

    def place(row: int | None, column: int) -> Place:
        return (*export.place(row, column)[:2], column + 1)

    return replace(export, values=values, place=place, sheet=sheet, others=others)


@lru_cache(maxsize=1)  # the guesses of a layout read a file several times
def _lines_of_book(content: bytes, path: Path, chosen: str | None) -> tuple[list[str], str, tuple[str, ...]]:
    """A sheet as lines of text, the cells between tabs, its name, and those of other sheets with numbers.

    ``chosen`` None: the first sheet with numbers.
    """
    import openpyxl

    with complete(path, "save it again"):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            refuse_large(sum(member.file_size for member in archive.infolist()), content, path)
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True, keep_links=False)
        if chosen is not None and chosen not in book.sheetnames:
            known = ", ".join(map(repr, book.sheetnames))
            raise InputError("sheet must be one of the workbook", repr(chosen), f"choose from {known}", path)
        name, rows, others = chosen or "", list[list[str]](), list[str]()
        for sheet in book.worksheets:
            if sheet.title == chosen or not name:
                found, numbers = _rows(sheet, path)
                if numbers or chosen:
                    name, rows = sheet.title, found
            elif hasattr(sheet, "iter_rows"):
                first = itertools.islice(sheet.iter_rows(values_only=True), SEARCHED_ROWS)
                others += [sheet.title] * any(is_number(cell) for row in first for cell in row)
    width = max((k + 1 for row in rows for k, cell in enumerate(row) if cell), default=0)
    if width * len(rows) > SPREAD * MOST_CELLS:
        raise _too_many(path)
    lines = ["\t".join([*row[:width], *[""] * (width - len(row)), ""]) if any(row) else "" for row in rows]
    return lines, name, tuple(others)


def sheets_of(content: bytes, path: Path) -> tuple[str, ...]:
    """The sheets with numbers of a workbook, where it has several; () of any other file.

    Raises
    ------
    InputError
        If openpyxl is not installed, or the file is damaged or too large.
    """
    if path.suffix.lower() != ".xlsx":
        return ()
    require("openpyxl", path)
    _, first, others = _lines_of_book(content, path, None)
    return (first, *others) if others else ()


def _too_many(path: Path) -> InputError:
    return InputError(
        f"a sheet must have at most {MOST_CELLS} cells", "more", "export the record as CSV or Parquet", path
    )


def _rows(sheet: Any, path: Path) -> tuple[list[list[str]], bool]:
    """The cells of a sheet as text, each in one line, and whether one of them is a number."""
    rows, cells, numbers = [], 0, False
    if not hasattr(sheet, "reset_dimensions"):  # a sheet that holds only a chart
        return rows, numbers
    sheet.reset_dimensions()  # the stated size of a sheet can be far larger than the sheet
    for row in sheet.iter_rows():
        cells += len(row) or BLANK_ROW  # the stated number of a row can lie far below the last one
        if cells > MOST_CELLS:
            raise _too_many(path)
        real = [is_number(cell.value) for cell in row]
        numbers = numbers or any(real)
        texts = zip(row, real, strict=True)
        rows.append(
            [_written_number(c) if n else "" if c.value is None else " ".join(str(c.value).split()) for c, n in texts]
        )
    return rows, numbers


#: Characters of a number format that are shown as they are.
_LITERAL = re.compile(r'"[^"]*"|\\.')


def _written_number(cell: Any) -> str:
    """The number of a cell as text, as the sheet shows it where that is per cent: 0.2 as 20%."""
    return f"{100.0 * cell.value:.15g}%" if "%" in _LITERAL.sub("", cell.number_format) else repr(float(cell.value))


def _in_sheet(error: InputError, lines: list[str], more: str = "") -> InputError:
    """The error with the column of the sheet instead of the character of the line, and ``more`` of a remedy."""
    if error.line is None or error.line > len(lines):
        return error
    column = lines[error.line - 1][: (error.column or 1) - 1].count("\t") + 1
    return InputError(error.rule, error.value, error.remedy + more, error.file, error.line, column)
