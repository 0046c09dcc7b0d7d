"""Exports with several blocks of readings, titles between them, and lines below the last one."""

import re
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id.rig import guess
from capsule_id.rig.guess import find_layout
from capsule_id.rig.model import Rig

TITLES = "Instrument 7, 2026\nStep No. {step}\nSpeed = 240\nForce = {step}\n\nT,X,F\nsec,mm,N\n\n"
TIME = np.arange(80) / 100.0


def block(step: int, rows: int) -> str:
    """Titles and the first ``rows`` of a decay, released from ``step`` mm."""
    x = step * np.exp(-TIME) * np.cos(30.0 * TIME)
    lines = (f"{t:.2f},{one:.6f},{-one:.6f}\n" for t, one in zip(TIME[:rows], x[:rows], strict=True))
    return TITLES.format(step=step) + "".join(lines)


def rig(folder: Path, text: str, *entries: str) -> Rig:
    (folder / "steps.csv").write_text(text, encoding="utf-8")
    head = '[rig]\nname = "a"\nm1 = { value = 0.02, unit = "kg" }\n'
    (folder / "rig.toml").write_text("\n".join([head, *entries]), encoding="utf-8")
    return capsule_id.read_rig(folder)


def entry(*lines: str) -> str:
    columns = 'columns = { time = { from = "T", unit = "s" }, x_rel = { from = "X", unit = "mm" } }'
    return "\n".join(['[[experiment]]\nkind = "free_vibration"\nfile = "steps.csv"', columns, *lines])


def test_two_blocks_of_a_file_are_two_experiments(tmp_path: Path) -> None:
    text = block(1, 70) + "\n" + block(2, 80)
    first, second = 9, 9 + 70 + 1 + 8
    both = (
        entry(f"data_from_line = {first}\ndata_to_line = {first + 69}"),
        entry('label = "two"', f"data_from_line = {second}\ndata_to_line = {second + 79}"),
    )
    one, two = rig(tmp_path, text, *both).tables
    assert (len(one.rows), len(two.rows)) == (70, 80)
    assert (one.rows[0], one.rows[-1], two.rows[-1]) == (first, first + 69, second + 79)
    assert (one["x_rel"][0], two["x_rel"][0]) == (1e-3, 2e-3)


def test_the_remedy_for_a_block_that_ends_reads_it(tmp_path: Path) -> None:
    text = block(1, 70) + "\n" + block(2, 80)
    with pytest.raises(capsule_id.InputError, match="a row must have 3 cells, as line 9 has") as caught:
        rig(tmp_path, text, entry("data_from_line = 9"))
    (stated,) = re.findall(r"data_to_line = \d+", caught.value.remedy)
    (table,) = rig(tmp_path, text, entry("data_from_line = 9", stated)).tables
    assert len(table.rows) == 70
    with pytest.raises(capsule_id.InputError, match="must be a line of the file, which has 167, 168"):
        rig(tmp_path, text, entry("data_from_line = 9\ndata_to_line = 168"))


@pytest.mark.full
@pytest.mark.parametrize("packed", [False, True])
def test_import_reads_the_longest_block_first_and_names_all(tmp_path: Path, packed: bool) -> None:
    text = block(1, 70) + "\n" + block(2, 80)
    # A long first block: the titles of the second one lie beyond the beginning that the layout is found from.
    text = text if not packed else text.replace("\n\nInstrument", "\n" * 120_000 + "Instrument")
    (tmp_path / "steps.csv").write_text(text, encoding="utf-8")
    proposed = capsule_id.propose_entry(tmp_path / "steps.csv")
    assert proposed.count("the end of one of 2 blocks of readings, lines 9 to 78, ") == 2
    longest, other = rig(tmp_path, text, proposed).tables
    assert (len(longest.rows), longest["x_rel"][0]) == (80, 2e-3)
    assert (len(other.rows), other["x_rel"][0]) == (70, 1e-3)


def test_import_of_a_second_table_with_the_same_headers(tmp_path: Path) -> None:
    table = block(1, 70).split("2026\n", 1)[1].split("240\n")[1].split("\n", 1)[1]
    (tmp_path / "steps.csv").write_text(table + table, encoding="utf-8")
    assert "2 blocks of readings, lines 5 to 74, 79 to 148" in capsule_id.propose_entry(tmp_path / "steps.csv")


def test_import_ends_above_lines_below_the_readings(tmp_path: Path) -> None:
    text = block(1, 70) + "Mean of the channels\nX: 0.2\nF: -0.2\n"
    (tmp_path / "steps.csv").write_text(text, encoding="utf-8")
    proposed = capsule_id.propose_entry(tmp_path / "steps.csv")
    assert "data_to_line = 78  # likely: the last row of readings" in proposed
    assert len(rig(tmp_path, text, proposed).tables[0].rows) == 70


@pytest.mark.parametrize("line", [40, 78])
def test_a_damaged_row_ends_no_block(tmp_path: Path, line: int) -> None:
    lines = block(1, 70).splitlines()
    lines[line - 1] = "0.33,0.1"
    (tmp_path / "steps.csv").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(capsule_id.InputError):
        capsule_id.propose_entry(tmp_path / "steps.csv")


def test_a_missing_first_cell_ends_no_block(tmp_path: Path) -> None:
    """Before: the rows below it were another block, and half of the readings was left out."""
    rows = [f"{t:.2f},{x:.6f}" for t, x in zip(TIME, np.exp(-TIME) * np.cos(30.0 * TIME), strict=True)]
    rows[30] = "NaN," + rows[30].split(",")[1]
    text = "T (s),X (mm)\n" + "\n".join([*rows, "Run 2", *rows[:20]]) + "\n"
    found = find_layout(text.encode(), tmp_path / "a.csv", ())
    assert found.blocks == ((2, 81), (83, 102))


@pytest.mark.parametrize("row", ["{}", "{},{}", "-{}", "{};"])
def test_long_texts_have_lines_below_their_readings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, row: str) -> None:
    """Before: no blocks beyond 500,000 lines, and none of one column beyond the first 3000 lines."""
    monkeypatch.setattr(guess, "_MOST_RUNS", 5)
    head = "x [mm],t [s]\n" if "," in row else "x [mm]\n"
    rows = "".join(f"{row.format(k, k)}\n" + "-1\n" * (row == "-{}") for k in range(1, 4001))
    found = find_layout(f"{head}{rows}End of the record\n\nchecked\n".encode(), tmp_path / "a.csv", ())
    number = rows.count("\n")
    assert found.blocks == ((2, number + 1),)
    assert len(found.columns[0]) == number


def test_rows_that_change_too_often_have_no_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guess, "_MOST_RUNS", 5)
    text = "x [mm]\n" + "1\n" * 3500 + "1,2\n3,4\n1\n2\n" * 10
    with pytest.raises(capsule_id.InputError):
        find_layout(text.encode(), tmp_path / "a.csv", ())
    monkeypatch.setattr(guess, "_MOST_RUNS", 500)
    assert len(find_layout(text.encode(), tmp_path / "a.csv", ()).blocks) == 11
