"""Workbooks of several sheets with numbers: which one is read, the others are named, each gets an entry. By XlsxWriter."""

from pathlib import Path

import numpy as np
import pytest
import xlsxwriter

import capsule_id as cid
from capsule_id import cli
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint

TIME = np.arange(500) / 500.0


def decay(size: float) -> np.ndarray:
    """m"""
    return size * np.exp(-3.0 * TIME) * np.cos(60.0 * TIME)


def book(folder: Path) -> Path:
    """A sheet of text, two decays, a table of angles, and a sheet with one number."""
    folder.mkdir(exist_ok=True)
    with xlsxwriter.Workbook(folder / "rig A.xlsx") as made:
        made.add_worksheet("Notes").write_row(0, 0, ["measured by", "NN"])
        for name, size in (("soft pull", 2.0), ("hard/pull".replace("/", " "), 1.0)):
            sheet = made.add_worksheet(name)
            sheet.write_row(0, 0, ["Time (s)", "Disp (mm)"])
            for row, pair in enumerate(zip(TIME, decay(size), strict=True), start=1):
                sheet.write_row(row, 0, pair)
        sheet = made.add_worksheet("tilts")
        sheet.write_column(0, 0, ["angle (deg)", 31.0, 32.5, 30.2, 31.9, 31.1, 32.0])
        made.add_worksheet("Year").write_row(0, 0, ["year", 2026])
    return folder / "rig A.xlsx"


def test_each_sheet_with_a_table_gets_an_entry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = book(tmp_path / "files")
    assert cli.capsule_id(["init", str(tmp_path / "my"), "--from", str(file)]) == 0
    toml = tmp_path / "my" / "rig.toml"
    text = toml.read_text(encoding="utf-8")
    assert "Sheet 'Year'" in text or 'sheet = "Year"' in text
    toml.write_text(text.replace("# m1 =", "m1 =", 1), encoding="utf-8")
    capsys.readouterr()
    assert cli.capsule_id(["check", str(tmp_path / "my")]) == 0, capsys.readouterr().err
    rig = cid.read_rig(tmp_path / "my")
    assert [table.label for table in rig.tables] == ["rig_A_soft_pull", "rig_A_hard_pull", "rig_A_tilts"]
    assert [table.kind for table in rig.tables] == ["free_vibration", "free_vibration", "static_friction"]
    for table, size in zip(rig.tables[:2], (2e-3, 1e-3), strict=True):
        np.testing.assert_allclose(table["x_rel"], decay(size), atol=1e-12)


def test_a_sheet_of_notes_that_comes_first_is_named(tmp_path: Path) -> None:
    """Before: no entry for any sheet. The remedy of the error without ``sheet`` works."""
    with xlsxwriter.Workbook(tmp_path / "rig A.xlsx") as made:
        made.add_worksheet("Notes").write_row(0, 0, ["mass (g)", 110.5])
        made.add_worksheet("Year").write_column(0, 0, ["year", 2026])
        sheet = made.add_worksheet("soft pull")
        sheet.write_row(0, 0, ["Time (s)", "Disp (mm)"])
        for row, pair in enumerate(zip(TIME, decay(2.0), strict=True), start=1):
            sheet.write_row(row, 0, pair)
    entry = cid.propose_entry(tmp_path / "rig A.xlsx")
    assert [f"#: Sheet '{name}' is not read: " in entry for name in ("Notes", "Year")] == [True, True]
    assert 'sheet = "soft pull"  # sure' in entry
    assert entry.count("[[experiment]]") == 1
    with pytest.raises(InputError, match='or sheet = "Year" or "soft pull", if that holds the readings'):
        cid.read_rig(rig_of(tmp_path, ""))
    np.testing.assert_allclose(cid.read_rig(rig_of(tmp_path, 'sheet = "soft pull"')).tables[0]["x_rel"], decay(2e-3))


def rig_of(folder: Path, line: str, file: str = "rig A.xlsx") -> Path:
    columns = '{ time = { from = "Time (s)", unit = "s" }, x_rel = { from = "Disp (mm)", unit = "mm" } }'
    (folder / "rig.toml").write_text(
        f'[rig]\nname = "r"\nm1 = {{ value = 110, sd = 0.5, unit = "g" }}\n[[experiment]]\nkind = "free_vibration"\n'
        f'file = "{file}"\ncolumns = {columns}\n{line}\n',
        encoding="utf-8",
    )
    return folder


def test_a_named_sheet_is_read_and_others_are_not_left_out_silently(tmp_path: Path) -> None:
    book(tmp_path)
    (table,) = cid.read_rig(rig_of(tmp_path, 'sheet = "hard pull"')).tables
    np.testing.assert_allclose(table["x_rel"], decay(1e-3), atol=1e-12)
    assert not [found for found in table.findings if found.code == "readings.sheets"]
    rig = cid.read_rig(rig_of(tmp_path, ""))
    np.testing.assert_allclose(rig.tables[0]["x_rel"], decay(2e-3), atol=1e-12)
    kinds = default_registry()
    (found,) = [one for one in lint(rig, kinds, rig.tables) if one.code == "readings.sheets"]
    assert found.facts["others"] == "'hard pull', 'tilts', 'Year'"


@pytest.mark.parametrize(
    ("line", "file", "words"),
    [
        ('sheet = "none"', "rig A.xlsx", "sheet must be one of the workbook, 'none', choose from 'Notes', 'soft pull'"),
        ('sheet = ""', "rig A.xlsx", "sheet must be the name of a sheet"),
        ('sheet = "Notes"', "rig A.xlsx", "number"),
        ('sheet = "a"', "a.csv", r"sheet needs a workbook \(.xlsx\)"),
    ],
)
def test_faults_of_sheet(tmp_path: Path, line: str, file: str, words: str) -> None:
    book(tmp_path)
    rows = "".join(f"{t},{x}\n" for t, x in zip(TIME, decay(1.0), strict=True))
    (tmp_path / "a.csv").write_text(f"Time (s),Disp (mm)\n{rows}", encoding="utf-8")
    with pytest.raises(InputError, match=words):
        cid.read_rig(rig_of(tmp_path, line, file))
