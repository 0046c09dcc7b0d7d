"""Measured files are read as they are, by ``rig.toml`` alone: every file is copied byte for byte.

Rotary records are relabelled by the stated unit: a radian is written "m", a degree "mm". tests/rig/test_column_maps.py
has the same layouts as synthetic twins.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.rig.model import Table
from tests.measured import sources


def read(folder: Path, kind: str, names: list[str], lines: str, *masses: str) -> Table:
    """The table that ``lines`` of rig.toml make of the measured files ``names``; ``masses`` default to m1."""
    for name in names:
        shutil.copy(sources.measured_file(name), folder)
    files = ", ".join(f'"{Path(name).name}"' for name in names)
    stated = "".join(f'{mass} = {{ value = 1, unit = "kg" }}\n' for mass in masses or ("m1",))
    head = f'[rig]\nname = "measured"\n{stated}'
    entry = f'[[experiment]]\nkind = "{kind}"\nfiles = [{files}]\n{lines}\n'
    (folder / "rig.toml").write_text(head + entry, encoding="utf-8")
    rig = read_rig(folder)
    assert set(rig.files) == {"rig.toml", *(Path(name).name for name in names)}
    return rig.tables[0]


def assert_record(table: Table, time: np.ndarray, x: np.ndarray) -> None:
    np.testing.assert_allclose(table["time"], time, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(table["x_rel"], x, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("record", [1, 2, 3])
def test_pendulum_without_times(tmp_path: Path, record: int) -> None:
    name = f"pendulum_jensen/pendulum_free_swing_data_{record:02d}.txt"
    rate = 'time = { rate = { value = 1000, unit = "Hz" } }'
    lines = f'data_from_line = 3\ncolumns = {{ {rate}, x_rel = {{ from = 1, unit = "mm" }} }}'
    time, angle = sources.pendulum(record)
    assert_record(read(tmp_path, "free_vibration", [name], lines), time, 1e-3 * np.rad2deg(angle))


@pytest.mark.parametrize("name", ["L20", "L29"])
def test_pendulum_with_uneven_times(tmp_path: Path, name: str) -> None:
    source = '{ from = "x_rel [m]", unit = "m", scale = -1, offset = 0.1 }'
    lines = f'columns = {{ time = {{ from = "time [s]", unit = "s" }}, x_rel = {source} }}'
    table = read(tmp_path, "free_vibration", [f"pendulum_phy180/{name}.csv"], lines)
    time, angle = np.loadtxt(tmp_path / f"{name}.csv", delimiter=",", skiprows=1).T
    assert_record(table, time, 0.1 - angle)


@pytest.mark.parametrize("run", [21337, 21338])
def test_ship_roll_among_other_columns(tmp_path: Path, run: int) -> None:
    lines = 'columns = { time = { from = "time", unit = "s" }, x_rel = { from = "phi", unit = "m" } }'
    table = read(tmp_path, "free_vibration", [f"kvlcc2_roll/model_test_{run}.csv"], lines)
    assert_record(table, *sources.ship_roll(run))


def test_load_cells_without_header(tmp_path: Path) -> None:
    lines = 'columns = { force = { from = 11, unit = "N" }, current = { from = 12, unit = "A" } }'
    table = read(tmp_path, "motor_current", ["loadcell_cie324/LoadCellCalibrationData.txt"], lines)
    np.testing.assert_array_equal(np.stack([table["force"], table["current"]], axis=1), sources.load_cells()[1])


def test_a_matrix_of_load_cells(tmp_path: Path) -> None:
    source = (
        '{ force = { from = "acquiredData(:,1)", unit = "N" }, current = { from = "acquiredData(:,2)", unit = "A" } }'
    )
    table = read(tmp_path, "motor_current", ["loadcell_cie324/loadCellCalData.mat"], f"columns = {source}")
    assert len(table.rows) == 2046


@pytest.mark.parametrize(
    ("name", "time", "reading", "slope"),
    [
        ("LoadCellCalibrationData.txt", 'from = 1, unit = "ms"', "11", 997.1),
        ("loadCellCalData.mat", 'rate = { value = 10, unit = "Hz" }', '"acquiredData(:,4)"', 993.3),
    ],
)
def test_load_cells_as_a_transducer(tmp_path: Path, name: str, time: str, reading: str, slope: float) -> None:
    """The trace with drop-outs becomes one reading per load; slopes in counts/lbf, the first one published."""
    levels = [0, 10, 20, 30, 40, 30, 20, 10, 0]
    lines = (
        f'columns = {{ time = {{ {time} }}, reading = {{ from = {reading}, unit = "1" }} }}\n'
        'reject = { rule = "hampel", window = "1 s", n_sd = 8 }\n'
        f'plateaus = {{ levels = {levels}, unit = "lbf", guard = "2 s" }}'
    )
    table = read(tmp_path, "transducer", [f"loadcell_cie324/{name}"], lines)
    assert np.polyfit(levels, table["reading"], 1)[0] == pytest.approx(slope, abs=0.5)


@pytest.mark.parametrize("load", ["350g", "450g"])
def test_frame_in_two_files(tmp_path: Path, load: str) -> None:
    names = [f"frame_marino/s_b_{load}_{axis}.mat" for axis in "xy"]
    x_rel = '{ from = "x", minus = "y", unit = "mm" }'
    table = read(
        tmp_path, "free_vibration", names, f'columns = {{ time = {{ from = "t", unit = "s" }}, x_rel = {x_rel} }}'
    )
    time, storey, base = sources.frame(load)
    assert_record(table, time, storey - base)


@pytest.mark.parametrize("load", ["350g", "450g"])
def test_frame_as_a_run_with_a_prescribed_base(tmp_path: Path, load: str) -> None:
    names = [f"frame_marino/s_b_{load}_{axis}.mat" for axis in "xy"]
    sources_of = {"time": ("t", "s"), "x_base": ("y", "mm"), "x_capsule": ("x", "mm")}
    maps = ", ".join(f'{name} = {{ from = "{own}", unit = "{unit}" }}' for name, (own, unit) in sources_of.items())
    table = read(tmp_path, "forced_run", names, f'drive = "base"\ncolumns = {{ {maps} }}', "m2")
    time, storey, base = sources.frame(load)
    for name, values in {"time": time, "x_base": base, "x_capsule": storey}.items():
        np.testing.assert_allclose(table[name], values, rtol=1e-12, atol=1e-15)


def test_capsule_robot_as_a_progression(tmp_path: Path) -> None:
    sources_of = {"period": (1, "ms"), "duty": (2, "%"), "periods": ("n", "1"), "distance": ("x", "cm")}
    maps = ", ".join(f"{name} = {{ from = {own!r}, unit = '{unit}' }}" for name, (own, unit) in sources_of.items())
    lines = f'drive = "pulses"\nP_on = {{ value = 0, sd = 2, unit = "N" }}\ndata_from_line = 3\ncolumns = {{ {maps} }}'
    table = read(tmp_path, "progression", ["capsubot_pulse/exp_data_tau30.csv"], lines, "m1", "m2")
    text = (tmp_path / "exp_data_tau30.csv").read_text(encoding="utf-8").replace(",", ".")
    rows = np.array([[row.split(";")[k] for k in (0, 1)] for row in text.splitlines()[2:]], float)
    assert len(table.rows) == 75
    np.testing.assert_allclose(np.stack([table["period"], table["duty"]], axis=1), rows * [1e-3, 1e-2], rtol=1e-12)
    assert table["distance"].max() > 0.01


def test_capsule_robot_with_units_row_and_missing_markers(tmp_path: Path) -> None:
    """Header `tau` stands four times, so `where` names column 2. Most cells of column 11 are `--`."""
    name = "capsubot_pulse/exp_data_tau30.csv"
    source = 'columns = { force = { from = "x", unit = "N" }, current = { from = 11, unit = "A", scale = -1 } }'
    lines = f'data_from_line = 3\nwhere = {{ 2 = 30 }}\nmissing = ["--"]\n{source}'
    table = read(tmp_path, "motor_current", [name], lines)
    text = (tmp_path / "exp_data_tau30.csv").read_text(encoding="utf-8").replace(",", ".")
    rows = [line.split(";") for line in text.splitlines()[2:]]
    used = [(float(row[3]), -float(row[10])) for row in rows if row[10] != "--"]
    np.testing.assert_array_equal(np.stack([table["force"], table["current"]], axis=1), used)
    assert (table.missing, table.other) == (75 - len(used), 0)
    assert table.missing > 0
