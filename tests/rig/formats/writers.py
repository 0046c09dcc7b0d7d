"""Writes one table in every format that the package reads, by programs that are not the package's own.

LabVIEW's two formats are written here by their published layouts; the others by NumPy, SciPy, h5py, XlsxWriter, pyarrow.
"""

import gzip
import io
import struct
from collections.abc import Callable, Mapping

import h5py
import numpy as np
import pyarrow as pa
import xlsxwriter
from pyarrow import parquet
from scipy.io import savemat

#: Columns by header, (n,) each; the first one is the time.
Columns = Mapping[str, np.ndarray]


def number(value: float, decimal: str = ".") -> str:
    return repr(float(value)).replace(".", decimal)


def text_rows(columns: Columns, separator: str, decimal: str = ".") -> str:
    rows = zip(*columns.values(), strict=True)
    return "".join(separator.join(number(value, decimal) for value in row) + "\n" for row in rows)


def csv_gz(columns: Columns) -> bytes:
    return gzip.compress((",".join(columns) + "\n" + text_rows(columns, ",")).encode())


def txt(columns: Columns) -> bytes:
    return ("Run A\n\n" + ";".join(columns) + "\n" + text_rows(columns, ";", ",")).encode()


def mat_5(columns: Columns) -> bytes:
    content = io.BytesIO()
    savemat(content, dict(columns), do_compression=True)
    return content.getvalue()


def mat_73(columns: Columns) -> bytes:
    """As MATLAB writes it: a user block of 512 bytes, and every vector as a 1 × n matrix with its class."""
    content = io.BytesIO()
    with h5py.File(content, "w", userblock_size=512) as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values[None, :], compression="gzip").attrs["MATLAB_class"] = b"double"
        note = file.create_dataset("note", data=np.frombuffer(b"t\0e\0", np.uint16)[:, None])
        note.attrs["MATLAB_class"] = b"char"
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return head + content.getvalue()[len(head) :]


def hdf5(columns: Columns) -> bytes:
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, chunks=(min(500, len(values)),), compression="gzip", shuffle=True)
        file["note"] = "text"
    return content.getvalue()


def npz(columns: Columns) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, **dict(columns), note=np.array(["text"]))  # type: ignore[arg-type]
    return content.getvalue()


def parquet_file(columns: Columns) -> bytes:
    content = io.BytesIO()
    parquet.write_table(pa.table({**columns, "note": ["text"] * len(next(iter(columns.values())))}), content)
    return content.getvalue()


def xlsx(columns: Columns) -> bytes:
    content = io.BytesIO()
    with xlsxwriter.Workbook(content) as book:
        book.add_worksheet("notes").write(0, 0, "Run 1")
        sheet = book.add_worksheet("data")
        sheet.write(0, 0, "Run 1")
        sheet.write_row(2, 0, list(columns))
        for k, values in enumerate(columns.values()):
            sheet.write_column(3, k, values.tolist())
    return content.getvalue()


def lvm(columns: Columns, times: str = "One", parts: int = 1, decimal: str = ".", separator: str = "\t") -> bytes:
    """A LabVIEW measurement file; ``times`` is "No", "One" or "Multi", ``parts`` the number of segments."""
    time, channels = next(iter(columns.values())), list(columns)[1:]

    def line(*cells: str) -> str:
        return separator.join(cells) + "\n"

    text = line("LabVIEW Measurement", "") + line("Writer_Version", "2") + line("Reader_Version", "2")
    text += line("Separator", "Comma" if separator == "," else "Tab") + line("Decimal_Separator", decimal)
    text += line("Multi_Headings", "Yes" if parts > 1 else "No") + line("X_Columns", times)
    text += line("Time_Pref", "Relative") + line("***End_of_Header***", "") + line("", "")
    length = -(-len(time) // parts)
    for first in range(0, len(time), length):
        part = slice(first, first + length)
        count = str(len(time[part]))
        text += line("***Start_Special***", "Notes") + line("X_Value", "1") + line("***End_Special***", "")
        text += line("Channels", str(len(channels)), *[""] * len(channels))
        for key, word in (
            ("Samples", count),
            ("X_Dimension", "Time"),
            ("X0", number(time[first], decimal)),
            ("Delta_X", number(time[1] - time[0], decimal)),
        ):
            text += line(key, *[word] * len(channels), "")
        text += line("***End_of_Header***", *[""] * len(channels))
        pairs = [cell for name in channels for cell in ("X_Value", name)]
        text += line(*(pairs if times == "Multi" else ["X_Value", *channels]), "Comment")
        for row in zip(*(values[part] for values in columns.values()), strict=True):
            t, *readings = (number(value, decimal) for value in row)
            cells = [cell for reading in readings for cell in (t, reading)] if times == "Multi" else [t, *readings]
            text += line(*([""] if times == "No" else cells[:1]), *cells[1:])
        text += line("", "")
    return text.encode()


def tdms(columns: Columns, waveform: bool = True, parts: int = 2) -> bytes:
    """A TDMS file by NI's "TDMS File Format Internal Structure": version 2.0, ``parts`` segments, contiguous channels.

    The first channel is stored as integers with a linear scaling, the others as doubles.
    """

    def string(text: str) -> bytes:
        return struct.pack("<I", len(text.encode())) + text.encode()

    def double(name: str, value: float) -> bytes:
        return string(name) + struct.pack("<Id", 10, value)

    def whole(name: str, value: int) -> bytes:
        return string(name) + struct.pack("<II", 7, value)

    def word(name: str, value: str) -> bytes:
        return string(name) + struct.pack("<I", 32) + string(value)

    time, *channels = columns.values()
    names = list(columns)[1:]
    counts = np.rint(channels[0] / 1e-9).astype(np.int64)
    length = -(-len(time) // parts)
    content = b""
    for first in range(0, len(time), length):
        stored = [
            (4, counts[first : first + length]),
            *((10, values[first : first + length]) for values in channels[1:]),
        ]
        meta = struct.pack("<I", len(names) + 1) + string("/'run'") + struct.pack("<II", 0xFFFFFFFF, 0)
        for k, (name, (kind, values)) in enumerate(zip(names, stored, strict=True)):
            properties = [word("unit_string", name.partition(" [")[2].removesuffix("]") or "mm")]
            if waveform:
                properties += [double("wf_start_offset", time[0]), double("wf_increment", time[1] - time[0])]
            if k == 0:
                properties += [whole("NI_Number_Of_Scales", 1), word("NI_Scale[0]_Scale_Type", "Linear")]
                properties += [double("NI_Scale[0]_Linear_Slope", 1e-9)]
                properties += [double("NI_Scale[0]_Linear_Y_Intercept", 0.0)]
                properties += [
                    whole("NI_Scale[0]_Linear_Input_Source", 0xFFFFFFFF),
                    word("NI_Scaling_Status", "unscaled"),
                ]
            meta += string(f"/'run'/'{name}'") + struct.pack("<IIIQ", 20, kind, 1, len(values))
            meta += struct.pack("<I", len(properties)) + b"".join(properties)
        raw = b"".join(values.astype("<i8" if kind == 4 else "<f8").tobytes() for kind, values in stored)
        # Table of contents: metadata, new list of channels, raw data.
        content += b"TDSm" + struct.pack("<IIQQ", 2 | 4 | 8, 4713, len(meta) + len(raw), len(meta)) + meta + raw
    return content


#: Suffix -> a file of the columns, by the name of its layout.
WRITERS: Mapping[str, tuple[str, Callable[[Columns], bytes]]] = {
    "gzip": (".csv.gz", csv_gz),
    "text": (".txt", txt),
    "MATLAB 5": (".mat", mat_5),
    "MATLAB 7.3": (".mat", mat_73),
    "HDF5": (".h5", hdf5),
    "NumPy": (".npz", npz),
    "Parquet": (".parquet", parquet_file),
    "Excel": (".xlsx", xlsx),
    "LabVIEW text, one time column": (".lvm", lvm),
    "LabVIEW text, no times": (".lvm", lambda columns: lvm(columns, "No")),
    "LabVIEW text, times of each channel": (".lvm", lambda columns: lvm(columns, "Multi", separator=",")),
    "LabVIEW text, three headers, decimal commas": (".lvm", lambda columns: lvm(columns, "One", 3, ",")),
    "LabVIEW text, three headers, no times": (".lvm", lambda columns: lvm(columns, "No", 3)),
    "LabVIEW TDMS": (".tdms", tdms),
}
