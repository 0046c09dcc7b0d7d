"""A friction table of several directions or surfaces: divided by a column, or by ``where``; never mixed unseen."""

from pathlib import Path

import numpy as np
import pytest

from capsule_id import cli
from capsule_id.api import fit, read_rig
from tests.cli_tools import message
from tests.importing.published_exports import MASSES

TABLE = """Versuch;Untergrund;Richtung;Kraft [N];Bemerkung
1;Stahl;vorwärts;3,91;
2;Stahl;vorwärts;4,02;
3;Stahl;rückwärts;3,51;
4;Stahl;vorwärts;3,97;gut
5;PTFE;vorwärts;1,02;
6;Stahl;rückwärts;3,58;
7;Stahl;rückwärts;3,49;
8;PTFE;rückwärts;0,98;
"""
FORWARD, BACKWARD = [3.91, 4.02, 3.97], [3.51, 3.58, 3.49]


@pytest.fixture
def rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """What ``init --from`` writes for the table."""
    (tmp_path / "haft.csv").write_text(TABLE, encoding="cp1252")
    assert cli.capsule_id(["init", str(tmp_path / "rig"), *MASSES, "--from", str(tmp_path / "haft.csv")]) == 0
    capsys.readouterr()
    return tmp_path / "rig"


def edited(rig: Path, *edits: tuple[str, str]) -> Path:
    text = (rig / "rig.toml").read_text(encoding="utf-8")
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    (rig / "rig.toml").write_text(text, encoding="utf-8")
    return rig


def refusal(rig: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert cli.capsule_id(["check", str(rig)]) == 2
    return message(capsys.readouterr().err)


CHOSEN = ('{ "Untergrund" = "?" }', '{ "Untergrund" = "Stahl" }')


def test_the_surface_is_asked_and_each_direction_is_an_experiment(
    rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: the eight rows were pulls on one surface in one direction."""
    assert "column 'Untergrund' holds 'PTFE' 'Stahl', '?', write one of the values" in refusal(rig, capsys)
    tables = read_rig(edited(rig, CHOSEN)).tables
    assert [(one.label, one.settings.direction) for one in tables] == [
        ("haft_ruckwarts", "backward"),
        ("haft_vorwarts", "forward"),
    ]
    for table, force in zip(tables, (BACKWARD, FORWARD), strict=True):
        np.testing.assert_allclose(table["force"], force)
    result = fit(edited(rig, ("\n[[experiment]]", '\n[model]\nfree = ["mu_back"]\n[[experiment]]')), budget=None)
    for name, force in (("mu", FORWARD), ("mu_back", BACKWARD)):
        assert result[name].value == pytest.approx(np.mean(force) / (0.64 * 9.81), rel=0.02)


def test_all_directions_may_be_one_experiment(rig: Path) -> None:
    (table,) = read_rig(edited(rig, CHOSEN, ("split_by = ", "# split_by = "))).tables
    assert sorted(table["force"]) == pytest.approx(sorted(FORWARD + BACKWARD))


def test_surfaces_are_not_divided_into_one_fit(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edits = (("where = ", "# where = "), ('split_by = "Richtung"', 'split_by = "Untergrund"'))
    said = refusal(edited(rig, *edits), capsys)
    assert "one fit has one surface" in said
    remedy = 'where = { "Untergrund" = "PTFE" }'
    assert remedy in said
    (table,) = read_rig(edited(rig, ('split_by = "Untergrund"', remedy))).tables
    assert sorted(table["force"]) == [0.98, 1.02]


@pytest.mark.parametrize(
    ("column", "said"),
    [
        ("Kraft", "Kraft"),
        ("", "split_by must be the header of a column"),
        ("Bemerkung", "split_by needs a text in every row of Bemerkung"),
    ],
)
def test_what_cannot_divide_is_refused(column: str, said: str, rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in refusal(edited(rig, CHOSEN, ('split_by = "Richtung"', f'split_by = "{column}"')), capsys)


def test_an_error_about_an_unknown_column_names_the_surface(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Followed literally, the columns alone would mix both surfaces."""
    (tmp_path / "a.csv").write_text("surface,force [N]\nsteel,3.9\nsteel,4.0\nPTFE,1.0\n", encoding="utf-8")
    head = '[rig]\nname = "a"\nm1 = { value = 110, unit = "g" }\nm2 = { value = 530, unit = "g" }\n'
    entry = head + '[[experiment]]\nkind = "static_friction"\nfile = "a.csv"\n'
    (tmp_path / "rig.toml").write_text(entry, encoding="utf-8")
    said = refusal(tmp_path, capsys)
    remedy = 'and where = { "surface" = "?" }'
    assert remedy in said
    columns = 'columns = { force = { from = "force [N]", unit = "N" } }'
    assert columns in said
    (tmp_path / "rig.toml").write_text(f"{entry}{columns}\n{remedy[4:]}\ndata_from_line = 2\n", encoding="utf-8")
    assert "holds 'PTFE' 'steel', '?'" in refusal(tmp_path, capsys)
