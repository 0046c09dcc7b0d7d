"""The import assistant on thirty spoiled exports: kind, columns and units, judged by the readings in SI."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id import cli
from capsule_id.rig.guess import name_and_unit
from tests.cli_tools import message
from tests.importing.spoiled_exports import Spoiled, spoiled_exports
from tests.measured.sources import measured_file

EXPORTS = spoiled_exports()
#: Least share of exports read correctly, and largest share of unsure guesses.
CORRECT, UNSURE = 0.9, 0.1


def written(folder: Path, export: Spoiled) -> str:
    """The rig.toml that ``init --from`` writes for one export, with the masses stated."""
    folder.mkdir()
    (folder / export.file).write_bytes(export.content)
    assert cli.capsule_id(["init", str(folder / "rig"), "--from", str(folder / export.file)]) == 0
    text = (folder / "rig" / "rig.toml").read_text(encoding="utf-8")
    for mass in ("m1", "m2"):
        text = text.replace(f"# {mass} = ", f"{mass} = ")
    # The tilts by height and length: no file states which side was measured.
    return text.replace("columns.height", 'length_is = "board"\ncolumns.height')


def outcome(folder: Path, export: Spoiled) -> str:
    """ "correct", "unsure" or "wrong"."""
    text = written(folder, export)
    entry = text[text.index(f'file = "{export.file}"') - 200 :]
    columns = entry[entry.find("columns.") :] if "columns." in entry else ""
    kinds = [line for line in entry.split("\n") if "kind = " in line]
    if not columns or any("# unsure:" in line for line in (*kinds, *columns.split("\n"))):
        return "unsure"
    (folder / "rig" / "rig.toml").write_text(text, encoding="utf-8")
    (table,) = capsule_id.read_rig(folder / "rig").tables
    same = table.kind == export.kind and set(table.columns) == set(export.columns)
    return "correct" if same and all(_equal(table[name], true) for name, true in export.columns.items()) else "wrong"


def _equal(found: np.ndarray, true: np.ndarray) -> bool:
    return found.shape == true.shape and np.allclose(found, true, rtol=1e-9, atol=1e-9 * np.max(np.abs(true)))


def test_most_exports_are_read_correctly_and_none_silently_wrong(tmp_path: Path) -> None:
    outcomes = {export.file: outcome(tmp_path / str(k), export) for k, export in enumerate(EXPORTS)}
    assert len(outcomes) == 30
    found = list(outcomes.values())
    assert "wrong" not in found, outcomes
    assert found.count("correct") >= CORRECT * len(found), outcomes
    assert found.count("unsure") <= UNSURE * len(found), outcomes


@pytest.mark.parametrize("factor", [1e3, -1.0])
def test_a_wrong_unit_or_sign_would_be_found(tmp_path: Path, factor: float) -> None:
    """Negative control: the same reading of the same file against another truth."""
    export = EXPORTS[0]
    other = replace(export, columns={**export.columns, "x_rel": factor * export.columns["x_rel"]})
    assert outcome(tmp_path / "a", export) == "correct"
    assert outcome(tmp_path / "b", other) == "wrong"


def test_the_release_is_proposed_where_a_record_rests_before_it(tmp_path: Path) -> None:
    rest = np.zeros(800)
    export = EXPORTS[0]
    x = 1e3 * np.concatenate([rest, export.columns["x_rel"]]) + 1e-3 * np.sin(np.arange(2000.0))
    time = np.arange(2000) * 1e-3
    text = "Time (s),Disp (mm)\n" + "".join(f"{t:.4f},{value:.4f}\n" for t, value in zip(time, x, strict=True))
    lines = written(tmp_path / "a", replace(export, content=text.encode())).split("\n")
    (start,) = (line for line in lines if line.startswith("start = "))
    assert "# likely: the free decay begins here" in start
    assert abs(float(start.split("value = ")[1].split(",")[0]) - 0.8) < 0.03


def test_the_entry_in_python_is_the_one_that_the_command_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export = EXPORTS[0]
    (tmp_path / export.file).write_bytes(export.content)
    entry = capsule_id.propose_entry(tmp_path / export.file)
    assert cli.capsule_id(["import", str(tmp_path / export.file)]) == 0
    assert capsys.readouterr().out == entry
    masses = '[rig]\nname = "a"\nm1 = { value = 110, unit = "g" }\n\n'
    (tmp_path / "rig.toml").write_text(masses + entry, encoding="utf-8")
    (table,) = capsule_id.read_rig(tmp_path).tables
    assert all(_equal(table[name], true) for name, true in export.columns.items())
    with pytest.raises(capsule_id.InputError, match="regular file"):
        capsule_id.propose_entry(tmp_path / "absent.csv")


def test_files_that_cannot_be_read_are_refused_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "words.csv").write_text("no numbers here\n", encoding="utf-8")
    (tmp_path / "photo.png").write_bytes(b"\x89PNG")
    for name, part in (("words.csv", "rows of numbers"), ("photo.png", "known format"), ("none.csv", "no such file")):
        for words in (["import"], ["init", str(tmp_path / "rig"), "--from"]):
            assert cli.capsule_id([*words, str(tmp_path / name)]) == 2
            err = message(capsys.readouterr().err)
            assert part in err
            assert err.count("\n") == 1
    assert not (tmp_path / "rig").exists()


#: Periods of a pulsed drive, duty, number of periods, distance, and its mean velocity, as a capsule robot's table has them.
PROGRESSION = "T;tau;n;x;V\nms;%;;cm;m/s\n" + "".join(
    f"{t};30;100;{x};{x * 0.1 / t:.4f}\n".replace(".", ",")
    for t, x in zip(range(30, 80, 5), np.arange(10) - 2.5, strict=True)
)


@pytest.mark.parametrize("source", ["synthetic", "measured"])
def test_a_table_of_progressions_is_no_table_of_pushes(tmp_path: Path, source: str) -> None:
    """Speed and distance are columns of pushes too; the period, the duty and the periods decide."""
    text = PROGRESSION.encode()
    if source == "measured":
        text = measured_file("capsubot_pulse/exp_data_tau30.csv").read_bytes()
    lines = written(tmp_path / "a", Spoiled("trials.csv", text, "progression", {})).split("\n")
    (kind,) = (line for line in lines if line.startswith("kind = "))
    assert kind.startswith('kind = "progression"  # sure')
    found = {
        line.split(" = ")[0].removeprefix("columns."): line
        for line in lines
        if "{ from = " in line and not line.startswith("#")
    }
    units = {name: line.split('unit = "')[1].split('"')[0] for name, line in found.items()}
    assert units == {"period": "ms", "periods": "1", "distance": "cm", "duty": "%"}
    assert 'distance = { from = "x"' in found["distance"]


def decay_rows(separator: str = ",", digits: int = 4) -> str:
    time = np.arange(400) * 5e-4
    values = 2.5 * np.exp(-12.0 * time) * np.cos(113.0 * time)
    return "".join(f"{t:.{digits}f}{separator}{x:.3f}\n" for t, x in zip(time, values, strict=True))


@pytest.mark.parametrize(
    ("header", "found"),
    [
        ("Force (N) Run 5", ("Force Run 5", "N")),
        ("x [mm] top", ("x top", "mm")),
        ("Force (left) Run 5", ("Force (left) Run 5", None)),
    ],
)
def test_brackets_before_further_words_hold_a_unit_if_it_is_one(header: str, found: tuple[str, str | None]) -> None:
    assert name_and_unit(header, ["N", "m", "s"]) == found


@pytest.mark.parametrize("header", ["Time,CH1\ns,mm\n", "Time (s),LVDT [mm]\n", "t/s,LVDT/mm\n"])
def test_the_unit_of_a_column_without_known_name_is_kept(
    tmp_path: Path, header: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "decay.csv"
    file.write_text(header + decay_rows(), encoding="utf-8")
    assert cli.capsule_id(["import", str(file)]) == 0
    out = capsys.readouterr().out
    assert 'kind = "free_vibration"  # unsure' in out
    (line,) = [line for line in out.splitlines() if line.startswith("columns.x_rel = ")]
    assert re.search(r'unit = "mm".*# unsure', line)


def test_times_that_do_not_increase_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "decay.csv"
    for first, named in (("", False), ("5.0,2.5\n", True)):
        file.write_text("time [s],x_rel [mm]\n" + first + decay_rows(), encoding="utf-8")
        assert cli.capsule_id(["import", str(file)]) == 0
        assert ("Times must increase; 'time [s]' does not at line 3." in capsys.readouterr().out) == named


def test_an_export_of_one_row_is_refused_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "one.csv").write_text("time [s],x_rel [mm]\n0,2.5\n", encoding="utf-8")
    assert cli.capsule_id(["import", str(tmp_path / "one.csv")]) == 2
    assert "one.csv:2: an export must have two rows of numbers or more, one row" in message(capsys.readouterr().err)
    assert cli.capsule_id(["import", str(tmp_path)]) == 2
    assert "a directory" in capsys.readouterr().err


def two_columns(first: str, second: str) -> str:
    """Rows of a time, a decay and a second decay."""
    rows = [line.split(",") for line in decay_rows().splitlines()]
    return f"Time (s),{first},{second}\n" + "".join(f"{t},{x},{-0.8 * float(x):.3f}\n" for t, x in rows)


@pytest.mark.parametrize(
    ("headers", "rival"),
    [
        (("Acceleration x (m/s^2)", "Acceleration y (m/s^2)"), "column 3, 'Acceleration y (m/s^2)', fits as well"),
        (("x (mm)", "x (mm)"), "column 3, 'x (mm)', fits as well"),
        (("Disp (mm)", "Temp (degC)"), None),
    ],
)
def test_of_two_columns_that_fit_alike_none_is_sure(
    tmp_path: Path, headers: tuple[str, str], rival: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "decay.csv"
    file.write_text(two_columns(*headers), encoding="utf-8")
    assert cli.capsule_id(["import", str(file)]) == 0
    said = [
        line for line in capsys.readouterr().out.splitlines() if re.match("(# )?columns.(x_rel|acceleration) =", line)
    ]
    assert len(said) == (1 if rival is None else 2)
    assert all(line.startswith("# ") == ("# unsure" in line) == (rival is not None) for line in said)
    assert rival is None or rival in said[0]


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("0.0000,", "00:00:00.000,", "'Time (s)' is not read: line 2 has '00:00:00.000'. Export times as seconds"),
        (",2.500\n", ",OVER\n", "'Disp (mm)' is not read: line 2 has 'OVER'. Correct the cell"),
        (",2.500\n", ",2:500\n", "'Disp (mm)' is not read: line 2 has '2:500'. Correct the cell"),
        (
            "0.1995,",
            "End,",
            "'Time (s)' is not read: line 401 has 'End'. Correct the cell, or add \"End\" to missing",
        ),
    ],
)
def test_a_column_with_a_cell_that_is_no_number_is_named(
    tmp_path: Path, old: str, new: str, part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "decay.csv"
    text = "Time (s),Disp (mm)\n" + decay_rows()
    assert text.count(old) == 1
    for written_text, named in ((text, False), (text.replace(old, new), True)):
        file.write_text(written_text, encoding="utf-8")
        assert cli.capsule_id(["import", str(file)]) == 0
        assert (part in capsys.readouterr().out) == named


def test_a_decay_that_is_pushed_near_its_end_is_not_sure_to_be_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: sure to be a forced run, by its last part alone."""
    time = np.arange(2000) / 100.0
    x = np.exp(-0.15 * time) * np.cos(6.0 * time)
    push, texts = (time > 18.5) * 0.8 * np.sin(9.0 * time), dict[str, str]()
    light = np.exp(-0.005 * time) * np.cos(6.0 * time)
    for name, motion in (("decay", x), ("pushed", x + push), ("light", light), ("driven", np.cos(6.0 * time))):
        rows = "\n".join(f"{t:.3f},{one:.6f}" for t, one in zip(time, motion, strict=True))
        (tmp_path / f"{name}.csv").write_text(f"time [s],x_rel [mm]\n{rows}\n", encoding="utf-8")
        assert cli.capsule_id(["import", str(tmp_path / f"{name}.csv")]) == 0
        texts[name] = capsys.readouterr().out
    assert 'kind = "free_vibration"  # sure' in texts["decay"]
    assert 'kind = "forced_run"  # unsure' in texts["pushed"]
    # A decay that loses a tenth in the record: before, sure to be driven.
    assert 'kind = "forced_run"  # unsure' in texts["light"]
    assert 'kind = "forced_run"  # sure' in texts["driven"]


@pytest.mark.full
def test_decays_with_a_clock_of_their_own_each_are_decays_and_are_not_sorted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: "static_friction # sure", and "sort the rows", which interleaves the decays."""
    time = np.arange(300) / 50.0
    one = 0.1 * np.exp(-0.3 * time) * np.cos(3.0 * time)
    rows = [f"{t:.2f},{x:.5f}" for _ in range(3) for t, x in zip(time, one, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["Time/s,Displacement/mm", *rows, ""]), encoding="utf-8")
    assert cli.capsule_id(["import", str(tmp_path / "run.csv")]) == 0
    said = capsys.readouterr().out
    assert 'kind = "free_vibration"' in said
    assert "start =" not in said
    columns = 'columns = { time = { from = "Time/s", unit = "s" }, x_rel = { from = 2, unit = "mm" } }'
    entry = f'[[experiment]]\nkind = "free_vibration"\nfile = "run.csv"\n{columns}\n'
    (tmp_path / "rig.toml").write_text(
        f'[rig]\nname = "a"\nm1 = {{ value = 1, unit = "kg" }}\n{entry}', encoding="utf-8"
    )
    tables = capsule_id.read_rig(tmp_path).tables
    assert [(table.label, int(table.rows[0])) for table in tables] == [("run_1", 2), ("run_2", 302), ("run_3", 602)]
    assert all(np.array_equal(table["time"], time) for table in tables)
    # Negative control: a row out of order is no new clock.
    (tmp_path / "run.csv").write_text(
        "\n".join(["Time/s,Displacement/mm", *rows[:200], *rows[201:300], rows[200], ""]), encoding="utf-8"
    )
    with pytest.raises(capsule_id.InputError, match="sort the rows"):
        capsule_id.read_rig(tmp_path)
