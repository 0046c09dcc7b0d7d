"""The import assistant on headers of angles, headers in quotation marks, records in time, and columns alike."""

import re
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id import cli
from capsule_id.rig.guess import find_layout


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("Time (s),Angle (deg)", 'x_rel = { from = "Angle (deg)", unit = "m", scale = 0.01745329252 }  # unsure: '),
        (
            "Time (s),Angle",
            'x_rel = { from = "Angle", unit = "?" }  # unsure: an angle without unit: write m and scale = 1 for rad, 0.01745',
        ),
        ("Zeit t / s,Weg b_A1 / rad", 'x_rel = { from = "Weg b_A1 / rad", unit = "m", scale = 1 }  # unsure: '),
        (
            "t [s],speed [deg/s]",
            'velocity = { from = "speed [deg/s]", unit = "m/s", scale = 0.01745329252 }  # unsure: ',
        ),
        ("Temps (s),D\u00e9placement (mm)", 'x_rel = { from = "D\u00e9placement (mm)", unit = "mm" }  # sure: '),
    ],
)
def test_a_record_of_an_angle_is_no_table_of_tilts(tmp_path: Path, header: str, line: str) -> None:
    time = np.arange(0.0, 10.0, 0.01)
    x = 20.0 * np.exp(-0.3 * time) * np.cos(5.0 * time)
    rows = "".join(f"{t:.2f},{value:.5f}\n" for t, value in zip(time, x, strict=True))
    (tmp_path / "swing.csv").write_text(f"{header}\n{rows}", encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "swing.csv")
    # Of a velocity there are free decays only, whether it decays or not.
    assert f'kind = "free_vibration"  # {"unsure" if "speed" in header else "sure"}' in entry
    assert line in entry
    masses = '[rig]\nname = "a"\nm1 = { value = 0.02, unit = "kg" }\n\n'
    entry = entry.replace('unit = "?"', 'unit = "m", scale = 0.01745329252')
    (tmp_path / "rig.toml").write_text(masses + entry, encoding="utf-8")
    (table,) = capsule_id.read_rig(tmp_path).tables
    factor = 1e-3 if "mm" in header else 1.0 if "rad" in header else np.radians(1.0)
    (name,) = set(table.columns) - {"time"}
    assert np.allclose(table[name], factor * x, rtol=1e-4, atol=1e-5)


def test_empty_brackets_leave_the_unit_to_the_row_of_units(tmp_path: Path) -> None:
    """Before: a unit that the file does not state, although its second line does."""
    time = np.arange(0.0, 5.0, 0.01)
    rows = "".join(f"{t:.2f};{3.0 * np.exp(-0.3 * t) * np.cos(25.0 * t):.5f}\n" for t in time)
    (tmp_path / "a.csv").write_text("Zeit [];Weg []\ns;mm\n" + rows, encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "a.csv")
    assert 'time = { from = "Zeit []", unit = "s" }' in entry
    assert 'x_rel = { from = "Weg []", unit = "mm" }' in entry


def test_a_record_in_time_is_never_surely_a_table_of_trials(tmp_path: Path) -> None:
    """A pull recorded in time is no list of pulls; the same column without times may be one."""
    force = 3.0 + np.sin(np.arange(100.0))
    for name, rows, sure in (("record", 100, False), ("table", 100, True)):
        header = "Time (s),Pull (N)\n" if name == "record" else "Pull (N),Normal (N)\n"
        first = [f"{0.1 * k:.1f},{force[k]:.3f}" if name == "record" else f"{force[k]:.3f},9.81" for k in range(rows)]
        (tmp_path / f"{name}.csv").write_text(header + "\n".join(first) + "\n", encoding="utf-8")
        entry = capsule_id.propose_entry(tmp_path / f"{name}.csv")
        (kind,) = (line for line in entry.split("\n") if line.startswith("kind = "))
        assert ("the file is a record in time" in kind) == (not sure)
        assert ("# unsure" in kind) or sure


@pytest.mark.parametrize(
    ("header", "lines"),
    [
        ("Time (s),Displacement (mm),Motor speed (rpm)", ("forced_run", 'x_rel = { from = "Displacement (mm)"')),
        (
            "Time (s),Angle (deg),Position (mm)",
            ("forced_run", 'x_rel = { from = "Position (mm)", unit = "mm" }  # sure'),
        ),
        (
            "Time (s),Position (mm),Angle (deg)",
            ("forced_run", 'x_rel = { from = "Position (mm)", unit = "mm" }  # sure'),
        ),
        ("t (s),\u03c3x (mm),x (mm)", ("forced_run", 'x_rel = { from = "x (mm)", unit = "mm" }  # sure')),
        (
            "Time (s),Speed (rpm),Angle (deg)",
            ("forced_run", 'x_rel = { from = "Angle (deg)", unit = "m", scale = 0.017'),
        ),
    ],
)
def test_an_angle_beside_a_displacement_is_not_taken(tmp_path: Path, header: str, lines: tuple[str, str]) -> None:
    """Nor the uncertainty of a column for the column, as where letters outside ASCII are dropped."""
    time = np.arange(0.0, 10.0, 0.01)
    rows = "".join(f"{t:.2f},{3.0 * np.sin(12.0 * t):.5f},{np.cos(12.0 * t + 0.1):.5f}\n" for t in time)
    (tmp_path / "run.csv").write_text(f"{header}\n{rows}", encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "run.csv")
    assert f'kind = "{lines[0]}"' in entry
    assert lines[1] in entry
    assert "velocity" not in entry


@pytest.mark.parametrize("pause", [0.1, 3.0])
def test_few_rows_or_a_pause_make_no_table_of_trials(tmp_path: Path, pause: float) -> None:
    time = np.append(0.1 * np.arange(20), 2.0 + pause + 0.1 * np.arange(20))
    rows = "".join(f"{t:.2f},{3.0 + np.sin(t):.4f}\n" for t in time)
    (tmp_path / "pull.csv").write_text(f"Time (s),Pull (N)\n{rows}", encoding="utf-8")
    assert "the file is a record in time" in capsule_id.propose_entry(tmp_path / "pull.csv")


@pytest.mark.parametrize(
    ("header", "between"),
    [
        ('"Time (s)","Displacement, laser (mm)"', ","),  # as spreadsheets write a header that holds the separator
        ('"Time (s)";"Displacement; laser (mm)"', ";"),
        ("Time (s),Displacement laser (mm)", "\t"),  # headers with another separator than the rows
        ("Time (s);Displacement laser (mm)", "\t"),
        ("# Time (s), Displacement laser (mm)", " "),
    ],
)
def test_quoted_headers_and_headers_with_another_separator_are_kept(tmp_path: Path, header: str, between: str) -> None:
    """Before, "column 1 without name [unit unknown]"."""
    time = np.arange(0.0, 10.0, 0.01)
    x = 2.0 * np.exp(-0.4 * time) * np.cos(6.0 * time)
    rows = "".join(f"{t:.2f}{between}{value:.5f}\n" for t, value in zip(time, x, strict=True))
    (tmp_path / "swing.csv").write_text(f"{header}\n{rows}", encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "swing.csv")
    (tmp_path / "rig.toml").write_text(
        '[rig]\nname = "a"\nm1 = { value = 110, unit = "g" }\n\n' + entry, encoding="utf-8"
    )
    (table,) = capsule_id.read_rig(tmp_path).tables
    np.testing.assert_allclose(table["time"], time, atol=1e-9)
    np.testing.assert_allclose(table["x_rel"], 1e-3 * x, atol=1e-8)
    assert 'unit = "mm" }  # sure' in entry


def test_a_record_of_a_force_and_an_angle_is_not_surely_a_decay(tmp_path: Path) -> None:
    time = np.arange(0.0, 10.0, 0.01)
    rows = "".join(f"{t:.2f},{3.0 + np.sin(t):.4f},{8.0 * np.exp(-t) * np.cos(9.0 * t):.4f}\n" for t in time)
    (tmp_path / "pull.csv").write_text(f"Time (s),Pull (N),Angle (deg)\n{rows}", encoding="utf-8")
    assert 'kind = "free_vibration"  # unsure' in capsule_id.propose_entry(tmp_path / "pull.csv")


def test_a_column_that_never_changes_is_no_motion(tmp_path: Path) -> None:
    rows = "".join(f"{t:.2f},3.9,{0.4 + 0.01 * np.sin(t):.4f}\n" for t in np.arange(100) / 50.0)
    (tmp_path / "slide.csv").write_text("T (s),X (mm),COF\n" + rows, encoding="utf-8")
    assert "No kind fits its headers" in capsule_id.propose_entry(tmp_path / "slide.csv")


@pytest.mark.parametrize("order", [("ax", "ay", "az"), ("az", "ay", "ax")])
def test_of_several_axes_the_largest_motion_is_chosen(tmp_path: Path, order: tuple[str, ...]) -> None:
    time = np.arange(300) / 100.0
    size = {"ax": 0.2, "ay": 3.0, "az": 0.5}
    rows = zip(time, *(size[axis] * np.exp(-time) * np.cos(30.0 * time) for axis in order), strict=True)
    header = ",".join(f"acceleration {axis} (m/s^2)" for axis in order)
    text = f"Time (s),{header}\n" + "".join(",".join(f"{x:.6f}" for x in row) + "\n" for row in rows)
    (tmp_path / "phone.csv").write_text(text, encoding="utf-8")
    proposed = capsule_id.propose_entry(tmp_path / "phone.csv")
    assert 'acceleration = { from = "acceleration ay (m/s^2)"' in proposed
    assert "fits as well" in proposed


@pytest.mark.parametrize(
    ("text", "columns"),
    [("force [N],current [A]\n1,2\n2,4\n3,6\n4,8\n", 2), ("force [N]\n1,2\n2,4\n3,6\n4,8\n", 1)],
    ids=["two names", "one name"],
)
def test_whole_numbers_below_two_names_are_two_columns(
    tmp_path: Path, text: str, columns: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: "1,2" was read as 1.2, below any header."""
    (tmp_path / "motor.csv").write_text(text, encoding="utf-8")
    assert cli.capsule_id(["import", str(tmp_path / "motor.csv")]) == 0
    assert ('decimal = "."' in capsys.readouterr().out) == (columns == 2)
    assert find_layout(text.encode(), tmp_path / "motor.csv", ["A", "N"]).export.width == columns


@pytest.mark.parametrize("sides", [1.0, -1.0])
def test_a_table_of_amplitudes_is_proposed_as_turning_points_and_can_be_fitted(tmp_path: Path, sides: float) -> None:
    """Before: a record of ten samples, whose times were too far apart."""
    turns = np.arange(10)
    x = 20.0 * np.exp(-0.1 * turns) * sides**turns
    rows = "".join(f"{0.9 * k:.1f};{value:.1f}\n" for k, value in enumerate(x))
    (tmp_path / "a.csv").write_text(f"Zeit (s);Amplitude (mm)\n{rows}", encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "a.csv")
    assert 'samples = "turning_points"  # unsure: ' in entry
    masses = '[rig]\nname = "a"\nm1 = { value = 0.02, unit = "kg" }\n\n'
    (tmp_path / "rig.toml").write_text(masses + entry, encoding="utf-8")
    (table,) = capsule_id.read_rig(tmp_path).tables
    assert table.settings.samples == "turning_points"


def test_few_rows_of_a_swing_are_no_turning_points(tmp_path: Path) -> None:
    x = 20.0 * np.cos(np.arange(12))
    rows = "".join(f"{0.1 * k:.1f},{value:.2f}\n" for k, value in enumerate(x))
    (tmp_path / "a.csv").write_text(f"time (s),position (mm)\n{rows}", encoding="utf-8")
    assert "turning_points" not in capsule_id.propose_entry(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("header", "kind", "lines"),
    [
        ("Federkraft (N);Verformung (mm)", "support_spring", ("force = ", "deflection = ")),
        ("Haftreibungskraft (N);Normalkraft (N)", "static_friction", ("force = ", "normal_force = ")),
        ("Versuch;slope (deg)", "static_friction", ("angle = ",)),
    ],
)
def test_compounds_and_slopes_are_known(tmp_path: Path, header: str, kind: str, lines: tuple[str, ...]) -> None:
    """``Federkraft`` is a force, and of two forces ``Normalkraft`` is the normal one."""
    rows = "".join(f"{k + 1},{k};{2.1 * k + 3.0:.1f}\n".replace(".", ",") for k in range(6))
    (tmp_path / "a.csv").write_text(f"{header}\n{rows}", encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "a.csv")
    assert f'kind = "{kind}"' in entry
    names = header.split(";")
    for line, name in zip(lines, names[-len(lines) :], strict=True):
        assert f'{line}{{ from = "{name}"' in entry


def swing(rows: range, head: str = "Time (s),Disp (mm)\n") -> str:
    """Rows of a decay in mm."""
    return head + "".join(f"{5e-4 * k:.4f},{2.5 * np.exp(-2e-3 * k) * np.cos(0.06 * k):.4f}\n" for k in rows)


@pytest.mark.parametrize("header", ["Disp*100 (mm)", "Disp x 10 (mm)", "Disp (mm) x0.1", "10^3*Disp (mm)"])
def test_a_factor_in_a_header_leaves_the_unit_open(tmp_path: Path, header: str) -> None:
    """Before: "sure" in mm, 100 times too large. Control: a sensor's number is no factor."""
    for name, unit in ((header, "?"), ("Disp 2 (mm)", "mm"), ("x1 (mm)", "mm")):
        (tmp_path / "d.csv").write_text(swing(range(900), f"Time (s),{name}\n"), encoding="utf-8")
        assert f'from = "{name}", unit = "{unit}"' in capsule_id.importing.propose_entry(tmp_path / "d.csv")


@pytest.mark.full
def test_each_block_of_a_record_that_a_line_interrupts_has_an_entry(tmp_path: Path) -> None:
    """Before: 400 rows with the release were read by no entry. Control: a footer of three rows is none."""
    for last, lines in ((400, [(403, 902), (2, 401)]), (897, [(2, 898)])):
        text = swing(range(last)) + "buffer overrun\n" + swing(range(last, 900), "")
        (tmp_path / "d.csv").write_text(text, encoding="utf-8")
        entry = capsule_id.propose_entry(tmp_path / "d.csv")
        found = re.findall(r"^data_from_line = (\d+) .*\ndata_to_line = (\d+)", entry, re.MULTILINE)
        assert [(int(first), int(end)) for first, end in found] == lines
        assert entry.count('kind = "free_vibration"') == len(lines)
        folder = tmp_path / f"rig_{last}"
        assert cli.capsule_id(["init", str(folder), "--m1", "110", "1", "g", "--from", str(tmp_path / "d.csv")]) == 0
        rig = capsule_id.read_rig(folder)
        assert sum(len(table["time"]) for table in rig.tables) == sum(end - first + 1 for first, end in lines)


def test_blocks_that_end_with_statistics_or_hold_no_column(tmp_path: Path) -> None:
    """Before: the block above rows of means had two entries of one label; a block without numbers was "Sheet None"."""
    means = "0.0250,0.1,mean\n0.0145,0.7,std\n"
    cells = ("{:.4f},NaN,NaN", "NaN,1.5,NaN", "NaN,NaN,2.5")
    holes = "".join(f"{cells[k % 3].format(5e-4 * k)}\n" for k in range(80))
    for rest in ("run 2\n" + swing(range(90)).replace("\n", ",\n"), "Block 2\n" + holes):
        wide = rest.endswith(holes)
        head, end = ("Note (1)", ",1\n") if wide else ("remark", ",\n")
        first = swing(range(100), "").replace("\n", end)
        text = f"Time (s),Disp (mm),{head}\n{first}" + means * (not wide)
        (tmp_path / "d.csv").write_text(text + rest, encoding="utf-8")
        entry = capsule_id.propose_entry(tmp_path / "d.csv")
        labels = re.findall(r'^label = "(.*)"', entry, re.MULTILINE)
        assert labels == (["d.csv_2"] if wide else ["d.csv_2", "d.csv_106"])
        assert ("#: Lines 103 to 182 are not read: " in entry) == wide


def test_masses_that_hang_from_a_spring_are_offered_as_its_force(tmp_path: Path) -> None:
    """Before: no kind. Control: beside a pull they are no force, and a mass alone is no spring."""
    rows = [f"{100 * k};{1.5 * k:.1f}" for k in range(1, 7)]
    for header, line in (
        ("Mass (g);Displacement (mm)", 'columns.force = { from = "Mass (g)", unit = "gf" }  # unsure'),
        ("Masse [kg];Federweg [mm]", 'columns.force = { from = "Masse [kg]", unit = "kgf" }  # unsure'),
        ("Mass (g);Pull force (N)", 'columns.force = { from = "Pull force (N)", unit = "N" }'),
        ("Mass (g);Temperature (C)", "# [[experiment]]"),
    ):
        (tmp_path / "s.csv").write_text("\n".join([header, *rows, ""]), encoding="utf-8")
        entry = capsule_id.propose_entry(tmp_path / "s.csv")
        assert line in entry
        assert ('kind = "support_spring"  # unsure: a mass is read as a force' in entry) == (
            "f" in line[-20:] and "unsure" in line
        )


def test_numbered_names_are_names(tmp_path: Path) -> None:
    """Before: no kind. Two motions side by side are asked about, equal times are not."""
    rows = "".join(
        f"{5e-4 * k:.4f},{np.cos(0.06 * k):.4f},{5e-4 * k:.4f},{2 * np.cos(0.06 * k):.4f}\n" for k in range(900)
    )
    (tmp_path / "d.csv").write_text(f"t1 (s),x1 (mm),t2 (s),x2 (mm)\n{rows}", encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "d.csv")
    assert '\ncolumns.time = { from = "t1 (s)", unit = "s" }  # likely' in entry
    for name in ("x1 (mm)", "x2 (mm)"):
        assert f'\n# columns.x_rel = {{ from = "{name}", unit = "mm" }}' in entry


def test_a_cell_that_stops_a_column_leaves_the_kind_open(tmp_path: Path) -> None:
    """Before: a motor table with one text was "sure" a table of pulls."""
    rows = "0.5,1.05\n1.0,2.11\n1.5,3.14\n2.0,4.2\n"
    for text, kind in (("", "motor_current"), ("slope,2.1\n", "static_friction")):
        (tmp_path / "m.csv").write_text(f"Current (A),Force (N)\n{rows}{text}", encoding="utf-8")
        doubt = "unsure: column 1, 'Current (A)', has a cell that is no number" if text else "sure"
        assert f'kind = "{kind}"  # {doubt}' in capsule_id.importing.propose_entry(tmp_path / "m.csv")


def test_only_the_column_without_a_name_is_called_so(tmp_path: Path) -> None:
    """Before: "no header names the column" for a column named Time too."""
    time = np.arange(0.0, 10.0, 0.1)
    rows = "".join(f"{t:.2f},{20.0 * np.exp(-0.3 * t) * np.cos(5.0 * t):.5f}\n" for t in time)
    (tmp_path / "a.csv").write_text(f"Time,Channel 1\n{rows}", encoding="utf-8")
    entry = capsule_id.propose_entry(tmp_path / "a.csv")
    assert 'time = { from = "Time", unit = "?" }  # unsure: the file states no unit' in entry
    assert 'x_rel = { from = "Channel 1", unit = "?" }  # unsure: no header names the column' in entry
