"""Exports written by independent programs, or by hand after their published formats, in the locales of several countries.

Each row names what wrote it. ``own`` marks a library that the package reads the format with: the others share no code
with the package. Readings are rounded to the digits that the file shows, so that they are exact.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import h5py
import nptdms
import numpy as np
import openpyxl
import pandas as pd
import pyarrow as pa
import xlsxwriter
from pyarrow import parquet
from scipy.io import savemat

RNG = np.random.default_rng(43)
M1, K1, C = 0.110, 1420.0, 1.4  # kg, N/m, N s/m
MASSES = ("--m1", "110", "0.1", "g", "--m2", "530", "1", "g")  # options of init
RATE, N = 1000.0, 1000  # Hz, samples
T = np.arange(N) / RATE
_RATE_OF_DECAY = C / (2 * M1)
#: A free decay from rest, mm.
X = 3.6 * np.exp(-_RATE_OF_DECAY * T) * np.cos(np.sqrt(K1 / M1 - _RATE_OF_DECAY**2) * T) + 0.004 * RNG.standard_normal(
    N
)
#: A driven run: relative displacement, mm, and current, mA.
DRIVEN = 1.5 * np.cos(34.56 * T) + 0.2 * np.cos(3 * 34.56 * T) + 0.004 * RNG.standard_normal(N)
CURRENT = 1800.0 * np.cos(34.56 * T + 0.3)
TILT = np.array([33.1, 33.6, 33.2, 32.9, 33.8])
SPEED, SLIDE = np.array([0.10, 0.15, 0.22, 0.31, 0.40, 0.52]), np.array([0.8, 1.9, 4.1, 8.3, 14.0, 23.6])
AMPERE = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0])
NEWTON = np.array([0.51, 1.0, 1.49, 2.02, 2.51, 2.98, 3.52, 4.01])
DEFLECTION = np.arange(11) * 0.1
SPRING = np.round(18.96 * DEFLECTION + 0.02 * RNG.standard_normal(11), 2)
START = datetime(2024, 3, 1, 12, 34, 56, 789000)
NARROW, BROAD = "\u202f", "\u00a0"  # spaces without a line break

#: Readings of one column in a unit, and one unit of the last digit written.
Truth = tuple[np.ndarray, str, float]


@dataclass(frozen=True)
class Written:
    """One export.

    Attributes
    ----------
    source : the program or the document that its form follows
    file, content : name and bytes
    kind, columns : what it holds
    own : whether the package reads the format with the same library
    """

    source: str
    file: str
    content: bytes
    kind: str
    columns: Mapping[str, Truth]
    own: bool = False


def numbers(
    values: Sequence[float] | np.ndarray, form: str = "{:.6f}", decimal: str = ".", group: str = ""
) -> list[str]:
    """Texts of the numbers; ``group`` separates thousands in ``{:,}``."""
    marks = str.maketrans({",": group, ".": decimal})
    return [form.format(value).translate(marks) for value in values]


def rows(separator: str, *columns: Sequence[str], end: str = "\n") -> str:
    return "".join(separator.join(row) + end for row in zip(*columns, strict=True))


def decay(
    source: str,
    file: str,
    content: str | bytes,
    digits: int = 4,
    unit: str = "mm",
    step: float = 1e-6,
    *,
    encoding: str = "utf-8",
    own: bool = False,
    time: tuple[np.ndarray, str] = (T, "s"),
) -> Written:
    """A free decay with ``digits`` digits behind the point in ``unit``; the last digit of the times is ``step`` s."""
    factor = {"mm": 1.0, "um": 1e3, "m": 1e-3, "cm": 0.1, "in": 1 / 25.4}[unit]
    raw = content if isinstance(content, bytes) else content.encode(encoding)
    columns = {"time": (*time, step), "x_rel": (np.round(X * factor, digits), unit, 10.0**-digits)}
    return Written(source, file, raw, "free_vibration", columns, own)


def table(
    source: str,
    file: str,
    content: str | bytes,
    kind: str,
    columns: Mapping[str, Truth],
    *,
    encoding: str = "utf-8",
    own: bool = False,
) -> Written:
    raw = content if isinstance(content, bytes) else content.encode(encoding)
    return Written(source, file, raw, kind, columns, own)


def saved(write: Callable[[io.BytesIO], object]) -> bytes:
    content = io.BytesIO()
    write(content)
    return content.getvalue()


def _tdms(stamps: bool) -> bytes:
    properties = {} if stamps else {"wf_increment": 1 / RATE, "wf_start_offset": 0.0, "wf_samples": N}
    channels = [nptdms.ChannelObject("Messung", "Weg", np.round(X, 4), {"unit_string": "mm", **properties})]
    if stamps:
        times = np.datetime64(START) + np.round(T * 1e6).astype("timedelta64[us]")
        channels.insert(0, nptdms.ChannelObject("Messung", "Zeit", times))

    def write(content: io.BytesIO) -> None:
        with nptdms.TdmsWriter(content) as file:
            file.write_segment([nptdms.RootObject({"title": "Ausschwingversuch"}), *channels])

    return saved(write)


def _book_of_dates() -> bytes:
    book = openpyxl.Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.title = "Messung"
    for row in (["Ausschwingversuch 3"], ["Bearbeiter", "K. Weiß"], [], ["Zeitstempel", "Weg [mm]"]):
        sheet.append(row)
    for t, x in zip(T, np.round(X, 4), strict=True):
        sheet.append([START + timedelta(seconds=float(t)), float(x)])
    return saved(book.save)


def _book(header: list[list[object]], *columns: np.ndarray, first: str = "Notes") -> bytes:
    def write(content: io.BytesIO) -> None:
        with xlsxwriter.Workbook(content) as book:
            book.add_worksheet(first).write(0, 0, "nothing here")
            sheet = book.add_worksheet("Data")
            for k, row in enumerate(header):
                sheet.write_row(k, 0, row)
            for k, values in enumerate(columns):
                sheet.write_column(len(header), k, values.tolist())

    return saved(write)


def _mat_73() -> bytes:
    """MATLAB's save(..., '-v7.3'): a user block of 512 bytes, vectors as 1 × n, the class beside each."""

    def write(content: io.BytesIO) -> None:
        with h5py.File(content, "w", userblock_size=512) as file:
            run = file.create_group("run")
            for name, values in (("t_s", T[None, :]), ("x_um", np.round(1e3 * X, 1)[None, :]), ("fs", [[RATE]])):
                run.create_dataset(name, data=np.asarray(values)).attrs["MATLAB_class"] = b"double"
            run.attrs["MATLAB_class"] = b"struct"

    head = b"MATLAB 7.3 MAT-file, Platform: PCWIN64, Created on: Fri Mar  1 12:34:56 2024".ljust(124) + b"\x00\x02IM"
    content = saved(write)
    return head + content[len(head) :]


def _parquet() -> bytes:
    fields = [pa.field("timestamp", pa.timestamp("ns")), pa.field("disp", pa.float64(), metadata={"unit": "mm"})]
    times = pa.array(np.datetime64(START, "ns") + np.round(T * 1e9).astype("timedelta64[ns]"))
    columns = pa.table([times, pa.array(np.round(X, 4))], pa.schema(fields))
    return saved(lambda content: parquet.write_table(columns, content))


def _octave() -> str:
    """GNU Octave 9 manual, "Simple File I/O": save -text, the default of save; each variable behind its name."""
    text = "# Created by Octave 9.2.0, Fri Mar 01 12:34:56 2024 UTC <lab@rig>\n"
    text += f"# name: fs\n# type: scalar\n{RATE:g}\n\n\n"
    for name, values in (("t_s", numbers(T, " {:.3f}")), ("x_mm", numbers(X, " {:.4f}"))):
        text += f"# name: {name}\n# type: matrix\n# rows: {N}\n# columns: 1\n" + "\n".join(values) + "\n\n\n"
    return text


def _lvm() -> str:
    """National Instruments, "Specification for the LabVIEW Measurement File (.lvm)": version 2, German decimals."""
    head = ["LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab", "Decimal_Separator\t,"]
    head += ["Multi_Headings\tYes", "X_Columns\tOne", "Time_Pref\tRelative", "Operator\tLabor", "Date\t2024/03/01"]
    head += ["Time\t12:34:56,789", "***End_of_Header***\t", "\t", "Channels\t1\t\t", f"Samples\t{N}\t\t"]
    head += ["Date\t2024/03/01\t\t", "Time\t12:34:56,789\t\t", "Y_Unit_Label\tmm\t\t", "X_Dimension\tTime\t\t"]
    head += [
        "X0\t0,0000000000000000E+0\t\t",
        "Delta_X\t0,001000\t\t",
        "***End_of_Header***\t\t\t",
        "X_Value\tWeg\tComment",
    ]
    return "\n".join(head) + "\n" + rows("\t", numbers(T, decimal=","), numbers(X, decimal=","))


EXPORTS = [
    decay("npTDMS TdmsWriter: waveform properties, unit_string", "versuch.tdms", _tdms(False), own=True),
    decay("npTDMS TdmsWriter: a channel of time stamps", "stempel.tdms", _tdms(True), own=True),
    decay("openpyxl: dates of Excel, German titles", "Messung 2.xlsx", _book_of_dates(), step=1e-3, own=True),
    decay("SciPy savemat: struct with t, x and fs", "run.mat",
          saved(lambda c: savemat(c, {"run": {"t_s": T, "x_mm": np.round(X, 4), "fs": RATE}})), own=True),
    decay("h5py after MATLAB's v7.3 layout", "run73.mat", _mat_73(), 1, "um", own=True),
    decay("pyarrow: timestamp[ns] and a unit in the field", "run.parquet", _parquet(), own=True),
    decay("xlsxwriter: title, headers, row of units, French", "essai.xlsx",
          _book([["Essai n° 3"], [], ["Temps", "Déplacement"], ["s", "mm"]], T, np.round(X, 4), first="Remarques")),
    decay("pandas to_csv: German, UTF-16 as Excel's Unicode text", "unicode.txt",
          pd.DataFrame({"Zeit [s]": T, "Weg [mm]": np.round(X, 4)}).to_csv(sep="\t", decimal=",", index=False),
          encoding="utf-16"),
    decay("pandas to_csv: an index of dates, US", "indexed.csv",
          pd.DataFrame({"displacement_mm": np.round(X, 4)},
                       index=pd.Index(pd.Timestamp(START) + pd.to_timedelta(T, unit="s"), name="timestamp")).to_csv()),
    decay("GNU Octave: save -text", "run.txt", _octave(), step=1e-3),
    decay("R write.csv2: row names, semicolons, decimal commas", "decay.csv",
          '"";"time_s";"disp_mm"\n' + rows(";", [f'"{k + 1}"' for k in range(N)], numbers(T, "{:.3f}", ","),
                                            numbers(X, "{:.4f}", ",")), step=1e-3),
    decay("LabVIEW .lvm, German decimals, Y_Unit_Label", "ausschwingen.lvm", _lvm(), 6),
    decay("phyphox wiki, export: CSV (semicolon, decimal comma)", "phyphox.csv",
          '"Time (s)";"Position (cm)"\n' + rows(";", numbers(T, "{:.9E}", ","), numbers(X / 10, "{:.5E}", ",")),
          5, "cm"),
    decay("Arduino reference, Serial.print: milliseconds and micrometres", "putty.log.txt",
          "ms,um\n" + rows(",", numbers(1e3 * T, "{:.0f}"), numbers(1e3 * X, "{:.1f}"), end="\r\n"), 1, "um", 1.0,
          time=(1e3 * T, "ms")),
    decay("Arduino IDE 2, serial monitor with time stamps", "monitor.txt",
          "12:34:56.701 -> disp_mm\n" + rows(" -> ", [f"{START + timedelta(seconds=float(t)):%H:%M:%S.%f}"[:-3] for t in T],
               numbers(X, "{:.4f}"), end="\r\n"), step=1e-3),
    decay("Tracker (Open Source Physics) help, data table with units", "track.txt",
          "mass A\t\nt (s)\tx (m)\n" + rows("\t", numbers(T, "{:.3E}"), numbers(X / 1e3, "{:.7f}")), 7, "m", 1e-3),
    decay("Logger Pro: text export, Vernier Format 2", "logger.txt",
          "Vernier Format 2\nUntitled.cmbl\n3/1/2024 12:34:56\nRun 1\nTime\tPosition\nt\tx\ns\tm\n\n"
          + rows("\t", numbers(T), numbers(X / 1e3, "{:.7f}")), 7, "m"),
    decay("Vernier Graphical Analysis: CSV with the name of the data set", "vernier.csv",
          '"Data Set 1:Time(s)","Data Set 1:Position(m)"\n' + rows(",", numbers(T), numbers(X / 1e3, "{:.7f}")), 7, "m"),
    decay("PASCO Capstone: CSV with the run behind the unit", "capstone.csv",
          '"Time (s) Run #1","Position (m) Run #1"\n' + rows(",", numbers(T, "{:.3f}"), numbers(X / 1e3, "{:.7f}")),
          7, "m", 1e-3),
    decay("PicoScope 6 User's Guide, text formats: custom probe in mm", "pico.csv",
          "Time,Channel A\n(ms),(mm)\n\n" + rows(",", numbers(1e3 * T, "{:.8f}"), numbers(X, "{:.8f}")), 8, "mm", 1e-8,
          time=(1e3 * T, "ms")),
    decay("Origin help, ASCII export: long name, units, comments", "origin.dat",
          "Time\tDisplacement\ns\tmm\n\tlaser 2\n" + rows("\t", numbers(T), numbers(X, "{:.4f}"))),
    decay("DEWESoft manual, export to text", "dewesoft.txt",
          "Data file: D:\\Data\\decay.dxd\nSetup: rig.dxs\nSample rate: 1000 S/s/ch\nStart time: 3/1/2024 12:34:56.789 PM\n"
          "Number of channels: 1\n\nTime (s)\tLaser (mm)\n" + rows("\t", numbers(T), numbers(X, "{:.4f}"))),
    decay("Excel, CSV of a German system with sep=;, Windows-1252", "excel_de.csv",
          "sep=;\nZeit (s);Auslenkung (µm)\n" + rows(";", numbers(T, "{:.3f}", ","), numbers(1e3 * X, "{:,.1f}", ",", ".")),
          1, "um", 1e-3, encoding="cp1252"),
    decay("Excel, CSV of a US system, quoted thousands", "excel_us.csv",
          "Time (s),Displacement (um)\n" + rows(",", numbers(T, "{:.3f}"), [
              f'"{text}"' if "," in text else text for text in numbers(1e3 * X, "{:,.1f}", ".", ",")]), 1, "um", 1e-3),
    decay("LibreOffice Calc, CSV of a French system, narrow spaces in thousands", "calc_fr.csv",
          "Temps (s);Déplacement (µm)\n"
          + rows(";", numbers(T, "{:.3f}", ","), numbers(1e3 * X, "{:,.1f}", ",", NARROW)), 1, "um", 1e-3),
    decay("NumPy savetxt with a header", "decay.txt",
          saved(lambda c: np.savetxt(c, np.column_stack([T, np.round(X / 25.4, 6)]), "%.6f", header="t[s] x[in]")),
          6, "in"),
    table("Keysight BenchVue, CSV with dates and a unit in the header", "benchvue.csv",
          "Sample,Date/Time,Force (N),Current (A)\n" + rows(",", [str(k) for k in range(8)], [
              f"{START + timedelta(seconds=2 * k):%m/%d/%Y %H:%M:%S.%f}"[:-3] for k in range(8)],
              numbers(NEWTON, "{:.2f}"), numbers(AMPERE, "{:.2f}")), "motor_current",
          {"force": (NEWTON, "N", 0.01), "current": (AMPERE, "A", 0.01)}),
    table("Excel, CSV of a French system, Windows-1252", "plan incliné.csv",
          "Essai;Angle (°)\r\n" + rows(";", [str(k + 1) for k in range(5)], numbers(TILT, "{:.1f}", ","), end="\r\n"),
          "static_friction", {"angle": (TILT, "deg", 0.1)}, encoding="cp1252"),
    table("xlsxwriter: pounds-force and inches, US", "spring_soft.xlsx",
          _book([["Deflection (in)", "Force (lbf)"]], np.round(DEFLECTION / 25.4, 4), np.round(SPRING / 4.448222, 3)),
          "support_spring", {"deflection": (np.round(DEFLECTION / 25.4, 4), "in", 1e-4),
                             "force": (np.round(SPRING / 4.448222, 3), "lbf", 1e-3)}),
    table("R write.table: row names, a header less than the cells", "pushes.txt",
          "speed_m/s distance_mm\n" + rows(" ", [f'"{k + 1}"' for k in range(6)], numbers(SPEED, "{:.2f}"),
                                            numbers(SLIDE, "{:.1f}")), "dynamic_friction",
          {"speed": (SPEED, "m/s", 0.01), "distance": (SLIDE, "mm", 0.1)}),
    table("pandas to_csv: a run in French, UTF-8 with a mark", "marche.csv",
          pd.DataFrame({"Temps [ms]": 1e3 * T, "x_rel [µm]": np.round(1e3 * DRIVEN, 1), "Courant [mA]": np.round(CURRENT, 1),
                        }).to_csv(sep=";", decimal=",", index=False), "forced_run",
          {"time": (1e3 * T, "ms", 1e-9), "x_rel": (np.round(1e3 * DRIVEN, 1), "um", 0.1),
           "current": (np.round(CURRENT, 1), "mA", 0.1)}, encoding="utf-8-sig"),
]  # fmt: skip


VOLTS, NO_UNIT = (
    "a reading in V needs the sensitivity of its sensor",
    "state the unit of the column, which the file does not",
)
FACTOR = 'from = "Volt", unit = "mm", scale = 0.5'


def _volts(scale: float = 2.0) -> np.ndarray:
    """The decay as a laser with 2 V per mm shows it, V."""
    return np.round(X * scale, 4)


#: Records of oscilloscopes and sound cards, in V or counts: the sensor decides what they mean. The edits that complete
#: their entries: what the error asks for, and what replaces it.
SIGNALS = [
    ("Keysight InfiniiVision User's Guide, CSV data files", "keysight.csv", "x-axis,1\nsecond,Volt\n"
     + rows(",", numbers(T, "{:+.5E}"), numbers(_volts(), "{:+.5E}")), ((VOLTS, 'from = "Volt", unit = "V"', FACTOR),)),
    ("Tektronix TBS1000 User Manual, CSV: settings beside the first rows", "tek.csv",
     rows(",", *(["Record Length", "Sample Interval", "Trigger Point", "Source", "Vertical Units", "Vertical Scale",
                  *[""] * (N - 6)], ["1.000000e+03", "1.000000e-03", "0.00e+00", "CH1", "V", "2.0e+00", *[""] * (N - 6)],
                 [""] * N, numbers(T, "{:013.9f}"), numbers(_volts(), "{:.5f}"), [""] * N)),
     ((NO_UNIT, 'from = 5, unit = "?"', FACTOR.replace('"Volt"', "5")),
      (NO_UNIT, 'from = 4, unit = "?"', 'from = 4, unit = "s"'))),
    ("Rigol DS1000Z User's Guide, CSV: samples and their increment", "rigol.csv", "X,CH1,Start,Increment,\n"
     "Sequence,Volt,0.000000e+00,1.000000e-03\n" + rows(",", [str(k) for k in range(N)], numbers(_volts(), "{:.4e}"),
                                                       [""] * N),
     ((NO_UNIT, 'from = 2, unit = "?"', FACTOR.replace('"Volt"', "2")),
      (NO_UNIT, 'from = 1, unit = "?"', 'from = 1, unit = "ms"'))),
    ("Audacity manual, Sample Data Export, linear, with header", "audacity.txt",
     "decay   1 channel (mono)\nSample Rate: 1000 Hz. Sample values on linear scale.\nLength processed: 1000 samples "
     "1.00000 seconds.\n\n" + rows("\n", numbers(X / 4, "{:.5f}")),
     ((NO_UNIT, 'from = 1, unit = "?"', 'from = 1, unit = "mm", scale = 4'),)),
]  # fmt: skip
