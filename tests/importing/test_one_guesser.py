"""One guesser of columns: what the errors of `check` propose is what `import` finds; `?` is what a file does not say."""

import re
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id import cli
from capsule_id.rig.model import Rig
from tests.cli_tools import message

MASSES = '[rig]\nname = "a"\nm1 = { value = 0.1, unit = "kg" }\nm2 = { value = 0.5, unit = "kg" }\n'


def read(folder: Path, kind: str, lines: str = "") -> Rig:
    """The rig of one table."""
    (folder / "rig.toml").write_text(
        f'{MASSES}[[experiment]]\nkind = "{kind}"\nfile = "a.csv"\n{lines}\n', encoding="utf-8"
    )
    return capsule_id.read_rig(folder)


def refusal(folder: Path, kind: str, lines: str = "") -> capsule_id.InputError:
    """The error about the table."""
    with pytest.raises(capsule_id.InputError) as refused:
        read(folder, kind, lines)
    return refused.value


def written(folder: Path, header: str, rows: int = 8, *, constant: str = "") -> None:
    """A file of increasing numbers; texts in a column `note`, and one number in the column ``constant``."""
    cells = [
        ["ok" if name == "note" else "7" if name == constant else f"{0.01 * (k + 1) + 0.001 * k * j:.4f}"]
        for k in range(rows)
        for j, name in enumerate(header.split(","))
    ]
    width = len(header.split(","))
    lines = [",".join(cell for (cell,) in cells[k : k + width]) for k in range(0, len(cells), width)]
    (folder / "a.csv").write_text("\n".join([header, *lines, ""]), encoding="utf-8")


@pytest.mark.parametrize(
    ("kind", "header", "columns"),
    [
        ("dynamic_friction", "v (m/s),Disp_mm", {"speed": ("v (m/s)", "m/s"), "distance": ("Disp_mm", "mm")}),
        ("dynamic_friction", "d_mm,v0 (m/s)", {"speed": ("v0 (m/s)", "m/s"), "distance": ("d_mm", "mm")}),
        ("static_friction", "angle_deg", {"angle": ("angle_deg", "deg")}),
        ("free_vibration", "Time (s),Acc (g)", {"time": ("Time (s)", "s"), "acceleration": ("Acc (g)", "g_n")}),
        ("free_vibration", "Time (s),Acc (mg)", {"time": ("Time (s)", "s"), "acceleration": ("Acc (mg)", "mg_n")}),
        ("free_vibration", "time,gFz", {"time": ("time", "?"), "acceleration": ("gFz", "g_n")}),
        ("free_vibration", "Acc (V),Time (s)", {"time": ("Time (s)", "s"), "x_rel": ("?", "?")}),
        ("free_vibration", "Time (s),Disp ( V )", {"time": ("Time (s)", "s"), "x_rel": ("?", "?")}),
        ("static_friction", "mass [kg],force [N]", {"force": ("force [N]", "N")}),
        ("static_friction", "note,Winkel (deg)", {"angle": ("Winkel (deg)", "deg")}),
        ("static_friction", "mass [kg],note", {"angle": ("?", "?")}),
        ("support_spring", "note,Weg,Kraft (N)", {"deflection": ("Weg", "?"), "force": ("Kraft (N)", "N")}),
    ],
)
def test_check_proposes_only_what_fits(
    tmp_path: Path, kind: str, header: str, columns: dict[str, tuple[str, str]]
) -> None:
    """Before: the next unused column in SI, so that `Disp_mm` was in m, and a mass or a text an angle in rad."""
    written(tmp_path, header)
    lines = 'spring = "a"\n' if kind == "support_spring" else ""
    error = refusal(tmp_path, kind, lines)
    ((first, proposed),) = re.findall(r"(?:(data_from_line = 2) and )?(columns = \{.*\} \})", error.remedy)
    assert bool(first) == ("note" in header)
    assert dict(re.findall(r"(\w+) = \{ (from = .*?) \}", proposed)) == {
        name: f'from = "{source}", unit = "{unit}"' for name, (source, unit) in columns.items()
    }
    entry = f"{lines}{first}\n{proposed}"
    if "?" not in proposed:
        (table,) = read(tmp_path, kind, entry).tables
        assert set(table.columns) == set(columns)
        assert {name: column.unit for name, column in table.columns.items()} == {
            name: u for name, (_, u) in columns.items()
        }
        return
    followed = refusal(tmp_path, kind, entry)
    assert "'?'" in str(followed)
    assert ("state the unit" in followed.rule) == ('from = "?"' not in proposed)


def test_the_unit_of_a_column_is_asked_and_its_statement_is_followed(tmp_path: Path) -> None:
    """The assistant and `check` ask alike, and read alike once the user has answered."""
    written(tmp_path, "Weg,Kraft")
    entry = capsule_id.propose_entry(tmp_path / "a.csv")
    assert 'deflection = { from = "Weg", unit = "?" }  # unsure' in entry
    answers = [
        ("write a unit such as mm", {}),
        ("write a unit such as N", {"Weg": "mm"}),
        ("", {"Weg": "mm", "Kraft": "N"}),
    ]
    for part, units in answers:
        text = entry
        for name, unit in units.items():
            text = text.replace(f'"{name}", unit = "?"', f'"{name}", unit = "{unit}"')
        (tmp_path / "rig.toml").write_text(MASSES + text, encoding="utf-8")
        if part:
            with pytest.raises(capsule_id.InputError, match=re.escape(part)):
                capsule_id.read_rig(tmp_path)
        else:
            (table,) = capsule_id.read_rig(tmp_path).tables
            np.testing.assert_allclose(table["deflection"][0], 1e-5)


def test_a_trace_in_time_is_not_proposed_as_trials(tmp_path: Path) -> None:
    """Before: the times as tilts in rad. Negative control: a calibration may be recorded in time."""
    written(tmp_path, "time [s],force [N]", 200)
    error = refusal(tmp_path, "static_friction")
    assert error.value == "a record against time"
    assert "from =" not in error.remedy
    written(tmp_path, "Time (s),Force (N)", 200)
    error = refusal(tmp_path, "static_friction")
    assert 'force = { from = "?", unit = "N" }' in error.remedy
    assert "the file is a record in time" in error.remedy
    written(tmp_path, "time [s],Force (N),I [A]", 200)
    error = refusal(tmp_path, "motor_current")
    assert 'force = { from = "Force (N)", unit = "N" }' in error.remedy


def test_a_file_without_a_column_of_numbers_is_refused_and_headers_command_no_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: StopIteration, and an escape code as it stood in the file."""
    (tmp_path / "a.csv").write_text("angle [deg]\n30\n31\n1e400\n32\n", encoding="utf-8")
    assert cli.capsule_id(["import", str(tmp_path / "a.csv")]) == 2
    assert "a.csv:4:1: a cell must be a finite number" in message(capsys.readouterr().err)
    rows = "".join(f"{0.01 * k:.2f},{k % 5}.5\n" for k in range(60))
    (tmp_path / "a.csv").write_text(f"\x1b[31mT (s),x\x07\x1b]0;evil\x07 (mm)\n{rows}", encoding="utf-8")
    assert cli.capsule_id(["import", str(tmp_path / "a.csv")]) == 0
    out = capsys.readouterr().out
    assert "evil" in out
    assert all(mark.isprintable() or mark == "\n" for mark in out)


def test_a_trace_of_a_pull_is_no_table_of_pulls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before: 500 samples of one pull passed for 500 pulls, and their mean for the break-away force."""
    time = np.arange(500) / 100.0
    pull = 0.5 + np.where(time < 4.0, time, 2.2) + 0.02 * np.random.default_rng(1).standard_normal(500)
    rows = "".join(f"{t:.2f},{f:.4f}\n" for t, f in zip(time, pull, strict=True))
    (tmp_path / "pull.csv").write_text("time [s],force [N]\n" + rows, encoding="utf-8")
    words = ["init", str(tmp_path / "rig"), "--m1", "0.1", "0", "kg", "--m2", "0.5", "0", "kg"]
    assert cli.capsule_id([*words, "--from", str(tmp_path / "pull.csv")]) == 0
    capsys.readouterr()
    assert cli.capsule_id(["check", str(tmp_path / "rig")]) == 2
    said = message(capsys.readouterr().err)
    assert "static_friction must be a table of trials, a record against time, read angle," in said
    (tmp_path / "rig" / "pull.csv").write_text("force [N]\n4.5\n4.4\n4.6\n", encoding="utf-8")
    toml = tmp_path / "rig" / "rig.toml"
    entry = re.sub(r"\ncolumns\..*", "", toml.read_text(encoding="utf-8"), flags=re.DOTALL)
    toml.write_text(entry, encoding="utf-8")  # the remedy: a row per trial
    assert cli.capsule_id(["check", str(tmp_path / "rig")]) == 0
