"""Any table × writer × locale × form of its times → ``init --from`` → ``check`` → the same readings, without an edit."""

import io
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from unicodedata import normalize

import h5py
import numpy as np
import pyarrow as pa
import pytest
import xlsxwriter
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet
from scipy.io import savemat

from capsule_id import cli
from capsule_id.api import read_rig
from capsule_id.experiments.kind import default_registry
from capsule_id.rig.units import factor_to_si
from tests.importing.published_exports import CURRENT, DRIVEN, MASSES, X
from tests.rig.formats.writers import lvm, npz, tdms

KINDS = default_registry()
#: Readings of a table of each kind, in the first unit of each; other units with their factors to it; digits behind the point.
Column = tuple[np.ndarray, Mapping[str, float]]
MM, N_, A = {"mm": 1.0, "µm": 1e3, "cm": 0.1, "m": 1e-3}, {"N": 1.0, "mN": 1e3}, {"A": 1.0, "mA": 1e3}
TABLES: Mapping[str, Mapping[str, Column]] = {
    "free_vibration": {"x_rel": (X, MM)},
    "forced_run": {"x_rel": (DRIVEN, MM), "current": (1e-3 * CURRENT, A)},
    "motor_current": {"force": (np.linspace(0.51, 4.01, 9) ** 1.01, N_), "current": (np.linspace(0.25, 2.0, 9), A)},
    "support_spring": {"deflection": (np.linspace(0.1, 2.4, 12), MM), "force": (np.linspace(1.91, 45.5, 12), N_)},
    "static_friction": {"angle": (np.array([33.1, 33.6, 33.2, 32.9, 33.8]), {"deg": 1.0, "°": 1.0})},
    "dynamic_friction": {
        "speed": (np.linspace(0.1, 0.52, 7), {"m/s": 1.0, "mm/s": 1e3}),
        "distance": (np.linspace(0.1, 0.52, 7) ** 2 * 87.3, MM),
    },
}
WORDS = {
    "en": {"time": "Time", "x_rel": "Displacement", "current": "Current", "force": "Force", "angle": "Angle",
           "speed": "Speed", "distance": "Distance", "deflection": "Deflection", "note": "Remark"},
    "de": {"time": "Zeit", "x_rel": "Weg", "current": "Strom", "force": "Kraft", "angle": "Winkel",
           "speed": "Geschwindigkeit", "distance": "Strecke", "deflection": "Federweg", "note": "Notiz"},
    "fr": {"time": "Temps", "x_rel": "Déplacement", "current": "Courant", "force": "Force", "angle": "Angle",
           "speed": "Vitesse", "distance": "Distance", "deflection": "Enfoncement", "note": "Remarque"},
}  # fmt: skip
#: Language, separator, decimal mark, mark between thousands, encoding.
LOCALES = [
    ("en", ",", ".", "", "utf-8"),
    ("en", "\t", ".", ",", "utf-8-sig"),
    ("en", " ", ".", "", "ascii"),
    ("en", ";", ".", "'", "utf-8"),
    ("de", ";", ",", ".", "cp1252"),
    ("de", "\t", ",", "", "utf-16"),
    ("de", ";", ",", "", "utf-8-sig"),
    ("fr", ";", ",", "\u202f", "utf-8"),
    ("fr", "\t", ",", "\u00a0", "cp1252"),
]
START = datetime(2024, 2, 29, 23, 59, 59, 600000)
STAMPS: Mapping[str, Callable[[datetime], str]] = {
    "ISO": lambda at: at.isoformat(timespec="microseconds"),
    "ISO, zone": lambda at: f"{at:%Y-%m-%dT%H:%M:%S.%f}"[:-3] + "+01:00",
    "clock": lambda at: f"{at:%H:%M:%S.%f}"[:-3],
    "clock, comma": lambda at: f"{at:%H:%M:%S.%f}"[:-3].replace(".", ","),
    "German": lambda at: f"{at:%d.%m.%Y %H:%M:%S.%f}"[:-3].replace(".", ",", 3).replace(",", ".", 2),
    "US": lambda at: f"{at:%m/%d/%Y %I:%M:%S.%f}"[:-3] + f" {at:%p}",
}
CLOCKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60}
BINARY = ("xlsx", "mat", "mat73", "h5", "parquet", "npz", "lvm", "tdms")


@dataclass(frozen=True)
class Case:
    """An export: ``true`` holds the readings as written, SI, and a unit of the last digit, by column."""

    file: str
    content: bytes
    kind: str
    true: Mapping[str, tuple[np.ndarray, float]]


def texts(values: np.ndarray, digits: int, decimal: str, group: str) -> list[str]:
    marks = str.maketrans({",": group, ".": decimal})
    return [f"{value:,.{digits}f}".translate(marks) for value in values]


@dataclass
class Table:
    """A table while it is drawn: columns as numbers and as texts, with names and units."""

    names: list[str]
    units: list[str]
    columns: list[np.ndarray]
    texts: list[list[str]]
    true: dict[str, tuple[np.ndarray, float]]

    def add(self, name: str, unit: str, values: np.ndarray, texts: list[str], true: np.ndarray, step: float) -> None:
        self.names, self.units, self.columns = [*self.names, name], [*self.units, unit], [*self.columns, values]
        self.texts, self.true[name] = [*self.texts, texts], (true, step)


def add_times(draw: st.DrawFn, table: Table, writer: str, mark: str, decimal: str) -> None:
    text, rate = writer not in BINARY, draw(st.sampled_from([250.0, 1000.0, 2000.0]))
    time = np.arange(1000) / rate + draw(st.sampled_from([0.0, 12.5]))
    form = draw(st.sampled_from([*CLOCKS, *(STAMPS if text and mark != " " else ())]))
    form = "clock" if mark == "," and form in ("clock, comma", "German") else form  # a comma would part the stamp
    form = "s" if writer in ("lvm", "tdms") else form
    if form in CLOCKS:
        digits = {"s": 6, "min": 8}.get(form, 3)
        values = np.round(time * CLOCKS[form], digits) if text else time * CLOCKS[form]
        written = texts(values, digits, decimal, "")
        table.add("time", form, values, written, values / CLOCKS[form], 10.0**-digits / CLOCKS[form])
    else:
        at = [STAMPS[form](START + timedelta(seconds=float(t))) for t in time]
        table.add("time", "", time, at, time, 1e-6 if form == "ISO" else 1e-3)


def add_readings(draw: st.DrawFn, table: Table, kind: str, plain: bool, decimal: str, group: str) -> None:
    for name, (values, choices) in TABLES[kind].items():
        unit = draw(st.sampled_from(list(choices)))
        factor = choices[unit]
        unit = {"µm": "um", "°": "deg"}.get(unit, unit) if plain else unit
        least = 3 - int(np.floor(np.log10(factor))) + ("time" not in table.names)
        digits = max(draw(st.integers(least, least + 2)), 0)
        readings = np.round(values * factor, digits)
        si = factor_to_si(unit, KINDS[kind].columns[name].si)
        table.add(name, unit, readings, texts(readings, digits, decimal, group), readings * si, si * 10.0**-digits)


def text_of(draw: st.DrawFn, table: Table, heads: list[str], note: str, mark: str) -> str:
    style = "{} [{}]" if mark == " " else draw(st.sampled_from(["{} [{}]", "{} ({})", "{} / {}", "row"]))
    labels = [head if style == "row" or not unit else style.format(head, unit)
              for head, unit in zip(heads, table.units, strict=True)]  # fmt: skip
    labels = [label.replace(" ", "") for label in labels] if mark == " " else labels
    notes, cells = mark != " " and draw(st.booleans()), table.texts
    if notes:  # a column of text that nobody wants
        labels, cells = [*labels, note], [*cells, [f"gut {k % 3}" for k in range(len(table.columns[0]))]]
    lines = draw(st.sampled_from([[], ["Versuch 3"], ["Lab 2", "", "operator: K."], ["#remark 1"]]))
    head = [*lines, mark.join(labels)] + [mark.join([*table.units, *[""] * notes])] * (style == "row")
    ending = draw(st.sampled_from(["\n", "\r\n"]))
    return ending.join([*head, *(mark.join(row) for row in zip(*cells, strict=True)), ""])


@st.composite
def exports(draw: st.DrawFn) -> Case:
    kind = draw(st.sampled_from(list(TABLES)))
    record = kind in ("free_vibration", "forced_run")
    writer = draw(st.sampled_from(("csv", "csv", "txt", "dat", *BINARY)))
    writer = "txt" if writer in ("lvm", "tdms") and not record else writer
    language, mark, decimal, group, encoding = draw(st.sampled_from(LOCALES))
    binary = writer in BINARY
    decimal, group = (".", "") if binary else (decimal, group)
    plain, table = binary or encoding == "ascii", Table([], [], [], [], {})
    if record:
        add_times(draw, table, writer, mark, decimal)
    add_readings(draw, table, kind, plain, decimal, group)
    heads = [WORDS[language][name] for name in table.names]
    heads = [normalize("NFKD", head).encode("ascii", "ignore").decode() for head in heads] if plain else heads
    if not binary:
        content = text_of(draw, table, heads, WORDS[language]["note"], mark).encode(encoding)
        return Case(f"Messung 3.{writer}", content, kind, table.true)
    labels = [f"{head} [{unit}]" for head, unit in zip(heads, table.units, strict=True)]
    content = WRITERS[writer](dict(zip(labels, table.columns, strict=True)))
    return Case(f"a.{'mat' if writer == 'mat73' else writer}", content, kind, table.true)


def _xlsx(columns: Mapping[str, np.ndarray]) -> bytes:
    content = io.BytesIO()
    with xlsxwriter.Workbook(content) as book:
        sheet = book.add_worksheet()
        sheet.write_row(0, 0, list(columns))
        for k, values in enumerate(columns.values()):
            sheet.write_column(1, k, values.tolist())
    return content.getvalue()


def _identifiers(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Names as MATLAB allows them: Displacement_mm, Speed_m_s."""
    bare = (name.replace(" [", "_").removesuffix("]") for name in columns)
    return dict(zip(bare, columns.values(), strict=True))


def _mat(columns: Mapping[str, np.ndarray]) -> bytes:
    content = io.BytesIO()
    savemat(content, _identifiers(columns))
    return content.getvalue()


def _h5(columns: Mapping[str, np.ndarray], matlab: bool = False) -> bytes:
    content = io.BytesIO()
    with h5py.File(content, "w", userblock_size=512 * matlab) as file:
        for name, values in (_identifiers(columns) if matlab else columns).items():
            key = name if matlab else name.split(" [")[0]
            data = file.create_dataset(key, data=values[None, :] if matlab else values)
            data.attrs["MATLAB_class" if matlab else "units"] = "double" if matlab else name.split("[")[1][:-1]
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return head + content.getvalue()[len(head) :] if matlab else content.getvalue()


def _parquet(columns: Mapping[str, np.ndarray]) -> bytes:
    content = io.BytesIO()
    parquet.write_table(pa.table(dict(columns)), content)
    return content.getvalue()


WRITERS: Mapping[str, Callable[[Mapping[str, np.ndarray]], bytes]] = {
    "xlsx": _xlsx, "mat": _mat, "mat73": lambda columns: _h5(columns, matlab=True), "h5": _h5, "parquet": _parquet,
    "npz": npz, "lvm": lvm, "tdms": tdms,
}  # fmt: skip


def holds(case: Case) -> None:
    """Enter the export by one command, and compare what is read with what was written."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / case.file).write_bytes(case.content)
        assert cli.capsule_id(["init", str(folder / "rig"), *MASSES, "--from", str(folder / case.file)]) == 0
        assert cli.capsule_id(["check", str(folder / "rig")]) == 0
        (table,) = read_rig(folder / "rig").tables
    assert table.kind == case.kind
    assert set(table.columns) == set(case.true)
    for column, (true, step) in case.true.items():
        found = table.columns[column].values
        shift = true[0] - found[0] if column == "time" else 0.0
        np.testing.assert_allclose(found + shift, true, rtol=1e-12, atol=1.001 * step + 1e-9 * (column == "time"))


@pytest.mark.parametrize("examples", [12, pytest.param(200, marks=pytest.mark.full)])
def test_what_is_written_is_read(examples: int) -> None:
    """Each example is one file."""

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(exports())
    def test(case: Case) -> None:
        holds(case)

    test()
