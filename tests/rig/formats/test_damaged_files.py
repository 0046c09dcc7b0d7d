"""Damaged and hostile files end in one clean error line. The files with numbers were found by a coverage-guided fuzzer."""

import gzip
import io
import random
import struct
import subprocess
import sys
import time
import tracemalloc
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from capsule_id.errors import InputError
from capsule_id.rig.formats import EXPORTS, binary
from capsule_id.rig.formats import raw as limits
from capsule_id.rig.formats.raw import Layout
from tests.rig.formats.writers import WRITERS, hdf5, lvm, mat_73, npz, parquet_file, tdms, xlsx

TIME = np.arange(6) * 0.25
COLUMNS = {"t": TIME, "x": np.round(np.cos(TIME), 3)}
LAYOUT = Layout(missing=("NaN", ""))
#: Limit in these tests; the package's own is 1 GiB.
LIMIT = 1 << 26
#: Damaged copies of each file; of those that a process of their own reads.
COPIES, APART = 60, 4


def refusal(suffix: str, content: bytes) -> InputError | None:
    """The error about a file, None if it reads."""
    try:
        export = EXPORTS[suffix](content, Path(f"f{suffix}"), LAYOUT)
        for column in range(export.width):
            export.values(column)
    except InputError as error:
        return error
    return None


def damaged(content: bytes, chance: random.Random) -> bytes:
    changed = bytearray(content[: chance.randrange(1, len(content))] if chance.random() < 0.2 else content)
    for _ in range(chance.randint(1, 4)):
        changed[chance.randrange(len(changed))] = chance.choice((0, 1, 127, 128, 255, chance.randrange(256)))
    return bytes(changed)


def read_apart(name: str) -> bool:
    """Whether a process of its own reads each file."""
    return "HDF5" in name or "MATLAB" in name


@pytest.mark.parametrize(
    ("name", "copies"),
    [
        *((name, APART if read_apart(name) else COPIES) for name in WRITERS),
        *(pytest.param(name, COPIES // 4, marks=pytest.mark.full) for name in WRITERS if read_apart(name)),
    ],
)
def test_damaged_files_read_or_end_in_one_clean_line(name: str, copies: int) -> None:
    suffix, write = WRITERS[name]
    content, chance = write(COLUMNS), random.Random(name)
    assert refusal(suffix, content) is None
    refused = 0
    for _ in range(copies):
        error = refusal(suffix, damaged(content, chance))
        refused += error is not None
        assert error is None or str(error).isprintable()
    assert refused > 0


def with_npy(header: bytes, body: bytes) -> bytes:
    """An archive with one array whose header is ``header``."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + body)
    return content.getvalue()


def bomb() -> bytes:
    """Less than 1 MB that unpacks to 128 MB, made of blocks of spaces."""
    return gzip.compress(b" " * (1 << 22), 1) * 32


def hidden_file() -> bytes:
    """An HDF5 file whose data set is in another file."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file["x"] = TIME
        file["y"] = h5py.ExternalLink("../secret.h5", "/y")
    return content.getvalue()


def workbook_with(sheet: bytes) -> bytes:
    """The workbook with the text of its sheet replaced."""
    content = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(xlsx(COLUMNS))) as old, zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, sheet if name.endswith(("sheet1.xml", "sheet2.xml")) else old.read(name))
    return content.getvalue()


def with_rows(content: bytes, rows: int) -> bytes:
    """A Parquet file of six rows whose row group states ``rows``, as a varint of Thrift."""
    size = int.from_bytes(content[-8:-4], "little")
    before, footer = content[: -8 - size], content[-8 - size : -8]
    place, number, coded = footer.rindex(b"\x16\x0c"), 2 * rows, b""
    while number > 127:
        coded, number = coded + bytes([number & 127 | 128]), number >> 7
    footer = footer[: place + 1] + coded + bytes([number]) + footer[place + 2 :]
    return before + footer + len(footer).to_bytes(4, "little") + content[-4:]


def hdf5_with(libver: str | None = None, **features: object) -> bytes:
    """An HDF5 file with the times, an empty data set, and a data set with ``features``."""
    content = io.BytesIO()
    with h5py.File(content, "w", libver=libver) as file:
        file["t"], file["empty"] = TIME, h5py.Empty("f8")
        file.create_dataset("x", **{"data": TIME, **features})
    return content.getvalue()


def other_filter() -> bytes:
    """An HDF5 file with a filter that the HDF5 library does not have: the number of lzf is changed."""
    return hdf5_with(chunks=(3,), compression="lzf").replace(struct.pack("<H", 32000), struct.pack("<H", 32001))


def saved(array: np.ndarray) -> bytes:
    content = io.BytesIO()
    savemat(content, {"x": array}, do_compression=True)
    return content.getvalue()


_SHEET = b'<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main">%s</worksheet>'
_ROWS = b"<sheetData>%s</sheetData>"
_CELL = b'<row r="1"><c r="A1"><v>1</v></c></row>'
#: Suffix, file, and a part of the error.
HOSTILE = {
    "gzip bomb": (".csv.gz", bomb, f"at most {LIMIT >> 20} MiB"),
    "pickle": (".npz", lambda: with_npy(b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", b"\x80\x04."), "numeric"),
    "array larger than its bytes": (
        ".npz",
        lambda: with_npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000,), }", bytes(80)),
        "complete",
    ),
    "link to another file": (".h5", hidden_file, "a link to another file, y"),
    "readings in another file": (".h5", lambda: hdf5_with(data=None, shape=6, dtype="f8", external="x.bin"), "in another file"),
    "a filter of another library": (".h5", other_filter, "the filter lzf, x"),
    "readings not written": (".h5", lambda: hdf5_with(data=None, shape=10**9, dtype="f8", chunks=10**6), "at most 64 MiB"),
    "latest layout of chunks": (".h5", lambda: hdf5_with("latest", chunks=(3,), maxshape=(None,)), None),
    "lzf and scale-offset": (".h5", lambda: hdf5_with(chunks=(3,), compression="lzf", scaleoffset=2), None),
    "a line": (".csv", lambda: b"1" * 50_000_000, f"1:1: a line must have at most {limits.LONGEST_LINE} bytes"),
    "a line, compressed": (".csv.gz", lambda: gzip.compress(b"1" * 50_000_000, 1), "1:1: a line must have"),
    "commas": (".csv", lambda: b"," * 50_000 + b"1\n", f"at most {limits.MOST_COLUMNS} columns"),
    "headers of 1e6 columns": (".csv", lambda: b"h," * 1_000_000, "a line must have at most"),
    "lines without numbers": (".csv", lambda: b"a\n" * 8_000_000, f"in the first {limits.MOST_TITLES} lines"),
    "zeros of NumPy": (".npz", lambda: npz({"x": np.zeros(20_000_000, np.int8)}), "at most 64 MiB"),
    "zeros of MATLAB": (".mat", lambda: saved(np.zeros(20_000_000, np.int8)), "at most 64 MiB"),
    "columns of NumPy": (".npz", lambda: npz({"x": np.zeros((3000, 3000))}), "at most 2000 columns, 3000"),
    "number of a row": (
        ".xlsx",
        lambda: workbook_with(_SHEET % (_ROWS % (_CELL + b'<row r="2000000000"><c r="A2000000000"><v>1</v></c></row>'))),
        "at most 2000000 cells",
    ),
    "one wide row below many": (
        ".xlsx",
        lambda: workbook_with(_SHEET % (_ROWS % (_CELL + b'<row r="9999"><c r="XFD9999"><v>1</v></c></row>'))),
        "at most 2000000 cells",
    ),
    "entities": (
        ".xlsx",
        lambda: workbook_with(
            b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaaaaaaaaaaaa">'
            + b"".join(b'<!ENTITY a%d "%s">' % (k, b"&a%s;" % (b"%d" % (k - 1) if k else b"") * 20) for k in range(9))
            + b"]>"
            + _SHEET % (_ROWS % b'<row r="1"><c r="A1" t="str"><v>&a8;</v></c></row>')
        ),
        "complete",
    ),
    "2. more rows stated than written": (
        ".xlsx",
        lambda: workbook_with(_SHEET % (b'<dimension ref="A1:XFD1048576"/>' + _ROWS % b"")),
        "rows of numbers",
    ),
    "1. control characters in a header": (".lvm", lambda: lvm(COLUMNS).replace(b"\tx\t", b"\t\x01\t"), None),
    "1. other channels": (".lvm", lambda: lvm(COLUMNS, parts=2).replace(b"\tx\t", b"\t\x01\t", 1), "same columns"),
    "7. rows that are comments alone": (
        ".lvm",
        lambda: b"LabVIEW Measurement\t\n" + 2 * b"***End_of_Header***\t\n" + b"X_Value\tx\tComment\n#3,0\t025\t0,35\n\t\n",
        "a cell must be a number",
    ),
    "3. scales of a channel": (
        ".tdms",
        lambda: tdms(COLUMNS).replace(b"Scales\x07\0\0\0\x01\0\0\0", b"Scales\x07\0\0\0\xff\xff\xff\x7f"),
        "2147483647 scales",
    ),
    "4. rows of a row group": (
        ".parquet",
        lambda: with_rows(parquet_file(COLUMNS), 88157910655),
        "row groups of 88157910655 rows in a table of 6",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_time(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LARGEST_CONTENT", LIMIT)
    suffix, write, part = HOSTILE[name]
    content = write()
    tracemalloc.start()
    began = time.process_time()
    error = refusal(suffix, content)
    assert time.process_time() - began < 5.0
    assert tracemalloc.get_traced_memory()[1] < 400e6
    tracemalloc.stop()
    if part is None:
        assert error is None
    else:
        assert part in str(error)
        assert str(error).isprintable()


def test_the_process_that_reads_a_binary_file_imports_little() -> None:
    """It starts for every file: with ``scipy.signal`` it takes five times as long."""
    code = "import sys, capsule_id.rig.formats.binary; sys.exit('scipy.signal' in sys.modules or 'jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_packed_readings_of_hdf5_are_unpacked(tmp_path: Path) -> None:
    """By the CF conventions. Before: 100 times too large, and the fill value was a reading."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file["x"] = np.array([250, -100, -9999, 5], np.int16)
        file["x"].attrs.update({"scale_factor": 0.01, "add_offset": 1.0, "_FillValue": np.int16(-9999), "units": "mm"})
        file["plain"] = np.array([1, 2, 3, -9999], np.int16)
    export = EXPORTS[".h5"](content.getvalue(), tmp_path / "f.h5", LAYOUT)
    names = export.headers[0]
    np.testing.assert_allclose(export.values(names.index("x")), [3.5, 0.0, np.nan, 1.05])
    np.testing.assert_allclose(export.values(names.index("plain")), [1.0, 2.0, 3.0, -9999.0])


def test_only_numbers_of_an_archive_are_columns() -> None:
    """Texts, objects and MATLAB's characters are no columns."""
    for suffix, content in ((".npz", npz(COLUMNS)), (".mat", mat_73(COLUMNS)), (".h5", hdf5(COLUMNS))):
        assert EXPORTS[suffix](content, Path(f"f{suffix}"), LAYOUT).headers[0] == ("t", "x")


@pytest.mark.parametrize("code", ["while True: pass", "import os; os.abort()", "x = bytearray(1 << 40)"])
def test_a_library_that_never_returns_or_ends_its_process_is_stopped(
    code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = subprocess.Popen
    monkeypatch.setattr(binary, "LONGEST_READING", 1)
    monkeypatch.setattr(binary, "LONGEST_START", 0)
    monkeypatch.setattr(subprocess, "Popen", lambda words, **options: start([*words[:3], code, *words[4:]], **options))
    error = refusal(".h5", hdf5(COLUMNS))
    assert "more than 1 s, or ends the library that reads it" in str(error)


SERVE = "import time; from capsule_id.rig.formats import binary; binary.LONGEST_READING = 1; {}; binary.serve()"


@pytest.mark.parametrize(
    ("planted", "fault"),
    [
        ("time.sleep(2)", None),
        (
            "binary._read_data_sets = lambda *_: (0 for zero in iter(int, 1) if zero)",
            "more than 1 s, or ends the library that reads it",
        ),
        ("binary._read_data_sets = lambda *_: iter([bytearray(1 << 33)])", "MemoryError"),
    ],
)
def test_limits_of_the_process_that_reads(planted: str, fault: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow start is no fault of the file; the time and the memory of the reading have limits."""
    start, code = subprocess.Popen, SERVE.format(planted)
    monkeypatch.setattr(binary, "LONGEST_READING", 1)
    monkeypatch.setattr(subprocess, "Popen", lambda words, **options: start([*words[:3], code, *words[4:]], **options))
    if fault is None:
        assert EXPORTS[".h5"](hdf5(COLUMNS), Path("f.h5"), LAYOUT).headers[0] == ("t", "x")
    else:
        began = time.perf_counter()
        assert fault in str(refusal(".h5", hdf5(COLUMNS)))
        assert time.perf_counter() - began < 0.5 * binary.LONGEST_START
