"""The twin's forced run, written in every format by another program, is read back to rounding."""

import sys
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id.errors import InputError
from capsule_id.rig.formats import EXPORTS
from capsule_id.rig.formats.raw import NO_READING, Layout
from capsule_id.rig.model import Table
from tests.rig.formats.writers import WRITERS, lvm, mat_5, tdms, xlsx

RUN = capsule_id.read_rig(Path(__file__).parents[3] / "data").tables[-4]
#: The run in the units of its file; times as LabVIEW makes them, from a rate.
COLUMNS = {name: column.values * column.to_display for name, column in RUN.columns.items()}
UNITS = {name: column.unit for name, column in RUN.columns.items()}
#: Largest relative difference after the round trip.
ROUNDING = 1e-12


def entry(file: str, time: str | int | None, **others: int) -> str:
    """A rig whose run is read from ``file``; ``time`` names its column, ``others`` the numbers of other columns."""
    sources = {name: others.get(name, f'"{name}"') for name in COLUMNS}
    sources["time"] = f'"{time}"' if isinstance(time, str) else str(time)
    maps = [f'{name} = {{ from = {source}, unit = "{UNITS[name]}" }}' for name, source in sources.items()]
    if time is None:
        maps[0] = 'time = { rate = { value = 1666.6666666666667, unit = "Hz" } }'
    return f"""\
[rig]
name = "round-trip"
m1 = {{ value = 0.11, unit = "kg" }}
m2 = {{ value = 0.53, unit = "kg" }}
[[experiment]]
kind = "forced_run"
file = "{file}"
Omega = {{ value = 34.56, unit = "rad/s" }}
columns = {{ {", ".join(maps)} }}
"""


def read(folder: Path, file: str, content: bytes, time: str | int | None, **others: int) -> Table:
    (folder / file).write_bytes(content)
    (folder / "rig.toml").write_text(entry(file, time, **others), encoding="utf-8")
    (table,) = capsule_id.read_rig(folder).tables
    return table


def assert_same(table: Table) -> None:
    for name, column in RUN.columns.items():
        expected = column.values
        np.testing.assert_allclose(table[name], expected, rtol=ROUNDING, atol=ROUNDING * np.max(np.abs(expected)))


@pytest.mark.parametrize("name", WRITERS)
def test_round_trip(tmp_path: Path, name: str) -> None:
    suffix, write = WRITERS[name]
    time = {".lvm": "X_Value", ".tdms": "wf_time"}.get(suffix, "time")
    multi = name == "LabVIEW text, times of each channel"
    assert_same(read(tmp_path, f"run{suffix}", write(COLUMNS), 1 if multi else time))


def test_a_row_of_zeros_of_a_sheet_is_a_row() -> None:
    numbers = np.array([0.0, 1.0, 2.0, 0.0])
    export = EXPORTS[".xlsx"](xlsx({"x": numbers, "y": 3.0 * numbers}), Path("f.xlsx"), Layout())
    np.testing.assert_array_equal(export.values(1), 3.0 * numbers)
    assert export.lines.tolist() == [4, 5, 6, 7]


def test_tdms_without_waveform_properties_needs_a_rate(tmp_path: Path) -> None:
    content = tdms(COLUMNS, waveform=False)
    with pytest.raises(InputError, match="from must be a header of the file, 'wf_time'"):
        read(tmp_path, "run.tdms", content, "wf_time")
    assert_same(read(tmp_path, "run.tdms", content, None))


def test_channels_of_a_labview_file_with_different_rates_have_times_of_their_own(tmp_path: Path) -> None:
    text = lvm(COLUMNS, "No").decode()
    rates = next(line for line in text.split("\n") if line.startswith("Delta_X"))
    changed = text.replace(rates, rates.replace("0.0006", "0.0012", 1))
    assert changed != text
    with pytest.raises(InputError, match="a header must be unique"):
        read(tmp_path, "run.lvm", changed.encode(), "X_Value")
    table = read(tmp_path, "run.lvm", changed.encode(), 1)
    np.testing.assert_allclose(table["time"], 2.0 * RUN["time"], rtol=ROUNDING)


def test_a_channel_of_a_labview_file_that_ends_early_has_no_missing_readings(tmp_path: Path) -> None:
    """Its cells are blank there; a blank cell between two readings is a missing one."""
    lines = lvm(COLUMNS, "Multi").decode().split("\n")
    rows = [k for k, line in enumerate(lines) if line[:1].isdigit()]
    for k in [*rows[len(rows) // 2 :], rows[3]]:
        lines[k] = "\t".join(cell if column < 2 else "" for column, cell in enumerate(lines[k].split("\t")))
    export = EXPORTS[".lvm"]("\n".join(lines).encode(), Path("f.lvm"), Layout(missing=NO_READING))
    assert [len(export.values(column)) for column in (0, 1, 3)] == [len(rows), len(rows), len(rows) // 2]
    assert np.flatnonzero(np.isnan(export.values(3))).tolist() == [3]


@pytest.mark.parametrize(
    ("fault", "repaired", "rule"),
    [
        ("***End_of_Header***", "***End_of_Header***", None),
        ("X_Columns\tNo\n", "X_Columns\tOne\n", "columns must have equal lengths"),
        ("Delta_X\t", "Delta_Y\t", "must state X0 and a positive Delta_X"),
        ("\tcurrent\t", "\tstrom\t", "must be a header"),
        (
            "***End_of_Header***",
            "***End***",
            "must have a header that ends with .*, rename a file of plain columns",
        ),
    ],
)
def test_faults_of_a_labview_file(tmp_path: Path, fault: str, repaired: str, rule: str | None) -> None:
    """The file without times as it is, and with one word of it changed."""
    text = lvm(COLUMNS, "No").decode().replace(fault, repaired)
    if rule is None:
        assert_same(read(tmp_path, "run.lvm", text.encode(), "X_Value"))
        return
    with pytest.raises(InputError, match=rule):
        read(tmp_path, "run.lvm", text.encode(), "X_Value")


@pytest.mark.parametrize("name", ["npTDMS", "openpyxl", "pyarrow"])
def test_a_package_that_is_not_installed_is_named(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    suffix = {"npTDMS": ".tdms", "openpyxl": ".xlsx", "pyarrow": ".parquet"}[name]
    monkeypatch.setitem(sys.modules, name.lower(), None)
    with pytest.raises(InputError, match=rf"needs the package {name}, not installed, run pip install"):
        read(tmp_path, f"run{suffix}", b"any", "time")


def test_keys_of_text_files_are_refused_elsewhere(tmp_path: Path) -> None:
    for line, key in (
        ("data_from_line = 2", "data_from_line"),
        ("data_to_line = 9", "data_to_line"),
        ('decimal = ","', "decimal"),
    ):
        (tmp_path / "run.mat").write_bytes(mat_5(COLUMNS))
        text = entry("run.mat", "time")
        (tmp_path / "rig.toml").write_text(f"{text}{line}\n", encoding="utf-8")
        with pytest.raises(InputError, match=f"a .mat file has no {key}, .* remove {key}"):
            capsule_id.read_rig(tmp_path)
