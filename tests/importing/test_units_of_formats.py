"""Units, rates and times that binary formats state beside their numbers; columns that an entry does not use."""

import io
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pytest
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet
from scipy.io import savemat

from capsule_id.importing import propose_entry
from capsule_id.rig.formats import EXPORTS
from capsule_id.rig.formats.raw import Layout
from tests.rig.formats.writers import lvm

TIME = np.arange(1500) * 1e-3
DISP = 2.0 * np.exp(-3.0 * TIME) * np.cos(2 * np.pi * 12.0 * TIME) + 2e-3 * np.random.default_rng(3).standard_normal(
    1500
)


def entry_of(folder: Path, name: str, content: bytes) -> str:
    (folder / name).write_bytes(content)
    return propose_entry(folder / name)


@pytest.mark.parametrize("times", ["No", "One", "Multi"])
def test_the_label_of_a_labview_channel(tmp_path: Path, times: str) -> None:
    """Before: the label was not read, and the unit not stated."""
    text = lvm({"t": TIME, "Disp": DISP}, times).decode()
    text = text.replace("X_Dimension\t", "Y_Unit_Label\tMillimeters\t\nX_Dimension\t")
    assert 'x_rel = { from = "Disp", unit = "mm" }  # sure' in entry_of(tmp_path, "a.lvm", text.encode())
    assert 'unit = "?"' in entry_of(tmp_path, "a.lvm", text.replace("Millimeters", "").encode())


@pytest.mark.parametrize("key", ["unit_string", "NI_UnitDescription", "Unit"])
def test_properties_of_tdms(tmp_path: Path, key: str) -> None:
    properties = {key: "mm", "wf_increment": 1e-3, "wf_start_offset": 0.0}
    with TdmsWriter(tmp_path / "w.tdms") as writer:
        writer.write_segment([ChannelObject("rig", "Disp", DISP, properties)])
    entry = propose_entry(tmp_path / "w.tdms")
    assert 'x_rel = { from = "Disp", unit = "mm" }  # sure' in entry


def test_stamps_of_tdms_and_parquet(tmp_path: Path) -> None:
    stamps = np.datetime64("2024-02-29T23:59:59.5", "us") + (1e6 * TIME).astype("timedelta64[us]")
    with TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment([ChannelObject("rig", "Time", stamps), ChannelObject("rig", "x (mm)", DISP)])
    parquet.write_table(pa.table({"Time": pa.array(stamps), "x (mm)": DISP}), tmp_path / "a.parquet")
    for name in ("a.tdms", "a.parquet"):
        entry = propose_entry(tmp_path / name)
        assert 'time = { from = "Time", unit = "s" }  # sure' in entry
        assert 'x_rel = { from = "x (mm)", unit = "mm" }  # sure' in entry


def test_metadata_of_parquet(tmp_path: Path) -> None:
    fields = [
        pa.field("t", pa.float64(), metadata={"unit": "ms"}),
        pa.field("x", pa.float64(), metadata={"units": "um"}),
    ]
    table = pa.table([pa.array(1e3 * TIME), pa.array(1e3 * DISP)], schema=pa.schema(fields))
    parquet.write_table(table, tmp_path / "a.parquet")
    entry = propose_entry(tmp_path / "a.parquet")
    assert 'time = { from = "t", unit = "ms" }  # sure' in entry
    assert 'x_rel = { from = "x", unit = "um" }  # sure' in entry


@pytest.mark.parametrize("where", ["file", "group", "data set"])
def test_attributes_of_hdf5(tmp_path: Path, where: str) -> None:
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        group = file.create_group("run")
        data = group.create_dataset("disp", data=DISP)
        data.attrs["Units"] = np.bytes_("mm")
        {"file": file, "group": group, "data set": data}[where].attrs["sampling_rate"] = 1000.0
    entry = entry_of(tmp_path, "a.h5", content.getvalue())
    assert 'unit = "mm" }  # sure' in entry
    assert 'time = { rate = { value = 1000, unit = "Hz" } }  # likely' in entry


@pytest.mark.parametrize(
    ("name", "value"), [("fs", 1000.0), ("Fs", 1000.0), ("sample_rate", 1000.0), ("dt", 1e-3), ("Ts", 1e-3)]
)
@pytest.mark.parametrize("struct", [False, True])
def test_a_rate_or_a_step_of_matlab(tmp_path: Path, name: str, value: float, struct: bool) -> None:
    content, data = io.BytesIO(), {"disp": DISP, name: value}
    savemat(content, {"run": data} if struct else data)
    entry = entry_of(tmp_path, "a.mat", content.getvalue())
    assert 'time = { rate = { value = 1000, unit = "Hz" } }  # likely' in entry
    assert 'unit = "?"' in entry  # of the displacement, which MATLAB does not state


@pytest.mark.parametrize(
    ("titles", "rate"),
    [
        ("Sampling rate: 1.0E+3 Hz", "1000"),
        ("Sampling rate: 10 000 Hz", "10000"),
        ("Sampling rate: 10,000 Hz", '"?"'),
        ("Low-pass filter: 200 Hz\nAbtastrate: 1000,0 Hz", "1000"),
        ("Mains filter 50 Hz", '"?"'),
        ("Sample rate ch 4 100 Hz", '"?"'),
        ("Sampling rate: 1.024 kHz", "1024"),
        ("Sampling rate: 1 kHz\nSampling rate of channel 2: 500 Hz", '"?"'),
    ],
)
def test_a_rate_of_titles(tmp_path: Path, titles: str, rate: str) -> None:
    """Before: the first frequency of the titles, whatever it was of, with the comma as decimal mark."""
    text = f"{titles}\nx (mm)\n" + "".join(f"{x:.5f}\n" for x in DISP)
    assert f"rate = {{ value = {rate}, " in entry_of(tmp_path, "a.csv", text.encode())


@pytest.mark.parametrize(("name", "unit", "value"), [("dt", "ms", [1.0]), ("fs", "kHz", [1.0]), ("fs", "", 1000.0)])
def test_units_and_scalars_of_a_stored_rate(tmp_path: Path, name: str, unit: str, value: object) -> None:
    """Before: a unit was not read, and a scalar not seen."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file["x"], file[name] = DISP, value
        file[name].attrs["unit"] = unit
    assert "rate = { value = 1000, " in entry_of(tmp_path, "a.h5", content.getvalue())
    np.savez(tmp_path / "a.npz", fs=1000.0, dt=np.float32(1e-3), x=DISP)
    assert "rate = { value = 1000, " in propose_entry(tmp_path / "a.npz")


def test_a_symbol_over_its_unit(tmp_path: Path) -> None:
    """DIN and ISO 80000 write F_N/N for F_N in N. Before: F in N/N."""
    text = "v [mm/s];F_k/N;F_N/N\n" + "".join(f"{10 + k};{0.4 + 0.01 * k:.2f};{1 + 0.02 * k:.2f}\n" for k in range(12))
    entry = entry_of(tmp_path, "a.csv", text.encode())
    assert 'columns.normal_force = { from = "F_N/N", unit = "N" }' in entry
    assert 'columns.speed = { from = "v [mm/s]", unit = "mm/s" }' in entry


def test_sheets_named_in_other_letters_and_cells_of_per_cent(tmp_path: Path) -> None:
    """Before: two entries of one label, and 20 % read as 0.2 %."""
    book = openpyxl.Workbook()
    for sheet in (book.worksheets[0], book.create_sheet("Жёсткая")):
        sheet.append(["duty [%]", "F [N]"])
        for k in range(2, 9):
            sheet.append([k / 10, 2.0 * k])
            sheet.cell(k, 1).number_format = "0%"
    book.worksheets[0].title = "Мягкая"
    book.save(tmp_path / "a.xlsx")
    entry = propose_entry(tmp_path / "a.xlsx")
    assert 'label = "a_1"' in entry
    assert 'label = "a_2"' in entry
    assert "'duty [%]' is not read: line 2 has '20%'" in entry


def test_a_sign_of_per_cent_that_a_format_only_shows(tmp_path: Path) -> None:
    """``0.00"%"`` scales nothing."""
    book = openpyxl.Workbook()
    sheet = book.worksheets[0]
    sheet.append(["duty [%]", "F [N]"])
    for k in range(2, 9):
        sheet.append([10.0 * k, 2.0 * k])
        sheet.cell(k, 1).number_format = '0.00"%"'
    book.save(tmp_path / "a.xlsx")
    assert "20%" not in propose_entry(tmp_path / "a.xlsx")
    assert np.array_equal(
        EXPORTS[".xlsx"]((tmp_path / "a.xlsx").read_bytes(), tmp_path / "a.xlsx", Layout(columns=(1,))).values(0),
        10.0 * np.arange(2, 9),
    )


def test_scalars_do_not_move_columns_named_by_number(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", fs=1000.0, t=TIME, x=DISP)
    export = EXPORTS[".npz"]((tmp_path / "a.npz").read_bytes(), tmp_path / "a.npz", Layout(columns=(1, 2)))
    assert export.headers[0] == ("t", "x", "fs")
    np.testing.assert_array_equal(export.values(1), DISP)


def test_columns_that_are_not_used_are_named(tmp_path: Path) -> None:
    """Before: `Load (kg)` was dropped without a word."""
    push = "speed (m/s),distance (mm),Load (kg),Note\n0.1,1.2,5,a\n0.2,4.6,5,b\n0.3,10.1,5,c\n0.4,18,5,d\n"
    entry = entry_of(tmp_path, "push.csv", push.encode())
    assert "#: Not used: 'Load (kg)', 'Note'." in entry
    assert "normal_force" not in entry
    pull = "Pull force (N),Load (kg)\n3.1,0.5\n6.2,1.0\n9.0,1.5\n12.4,2.0\n"
    entry = entry_of(tmp_path, "pull.csv", pull.encode())
    assert 'columns.normal_force = { from = "Load (kg)", unit = "?" }  # unsure: write "kgf" if' in entry
