"""Empty and NaN cells are missing readings: counted, and a warning where they can change a result."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import capsule_id
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.inference.checks.verdict import with_scaled
from capsule_id.rig.model import Rig
from capsule_id.views import Finding

TIME = np.arange(1000) * 1e-3
#: 10 Hz, with rest for 0.1 s before the release.
DISP = np.where(TIME < 0.1, 2.0, 2.0 * np.exp(-2.0 * (TIME - 0.1)) * np.cos(2 * np.pi * 10.0 * (TIME - 0.1)))


def rig_of(folder: Path, rows: dict[int, str], lines: str = "", header: str = "time [s],x_rel [mm]") -> Rig:
    noise = 2e-3 * np.random.default_rng(1).standard_normal(len(TIME))
    cells = [f"{x:.5f}" for x in DISP + noise]
    for row, text in rows.items():
        cells[row] = text
    text = "".join(f"{t:.3f},{cell}\n" for t, cell in zip(TIME, cells, strict=True))
    (folder / "d.csv").write_text(f"{header}\n{text}", encoding="utf-8")
    entry = f'[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n{lines}\n'
    (folder / "rig.toml").write_text(f'[rig]\nname = "r"\nm1 = {{ value = 1, unit = "kg" }}\n{entry}', encoding="utf-8")
    return capsule_id.read_rig(folder)


def findings_of(rig: Rig, code: str = "readings.missing") -> list[Finding]:
    return [found for found in lint(rig, default_registry(), rig.tables) if found.code == code]


MAP = 'columns = { time = { from = "t", unit = "s" }, x_rel = { from = "x", unit = "mm" } }'


@pytest.mark.parametrize(("header", "lines"), [("time [s],x_rel [mm]", ""), ("t,x", MAP)])
@pytest.mark.parametrize("text", ["", "NaN", "nan", "-nan", "--", "N/A", "n/a", "NULL", "None", "#N/A"])
def test_missing_cells_are_counted(tmp_path: Path, text: str, header: str, lines: str) -> None:
    """Before: an error that asked for two lines of rig.toml."""
    rig = rig_of(tmp_path, {500: text, 700: text, 701: text}, lines, header)
    (table,) = rig.tables
    np.testing.assert_array_equal(table.rows, np.delete(np.arange(2, 1002), [500, 700, 701]))
    np.testing.assert_allclose(table["time"], np.delete(TIME, [500, 700, 701]), rtol=1e-12)
    assert (table.missing, table.lost.tolist()) == (3, [502, 702, 703])
    (found,) = findings_of(rig)
    assert (found.level, found.facts["rows"], found.facts["near"]) == ("ok", 3, 0)
    # They are no gap of the clock, nor rounded times.
    assert findings_of(rig, "readings.gaps") == findings_of(rig, "readings.rounded_times") == []


@pytest.mark.parametrize("text", ["inf", "over", "n.a. 3", "NaN0"])
def test_any_other_text_is_an_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"d\.csv:502:\d+: a cell must be"):
        rig_of(tmp_path, {500: text}, MAP, "t,x")


@pytest.mark.parametrize(
    ("rows", "level", "near"),
    [
        ([*range(400, 1000, 11)], "warn", 0),  # 5.5 %
        pytest.param([*range(400, 1000, 13)], "ok", 0, marks=pytest.mark.full),
        pytest.param([110], "warn", 1, marks=pytest.mark.full),
        # within two periods of 0.1 s after the release at 0.1 s
        ([299], "warn", 1),
        pytest.param([320], "ok", 0, marks=pytest.mark.full),
        ([50], "ok", 0),  # at rest before the release
        # the logger went on without readings
        pytest.param([*range(900, 1000)], "ok", 0, marks=pytest.mark.full),
    ],
)
def test_many_or_early_ones_are_a_warning(tmp_path: Path, rows: list[int], level: str, near: int) -> None:
    (found,) = findings_of(rig_of(tmp_path, dict.fromkeys(rows, "NaN")))
    assert (found.level, found.facts["near"], found.facts["unjudged"]) == (level, near, level == "warn")


def test_first_readings_may_be_the_release(tmp_path: Path) -> None:
    """A sensor beyond its range writes NaN at the release: the record seems to begin later."""
    (found,) = findings_of(rig_of(tmp_path, dict.fromkeys(range(130), "NaN")))
    assert (found.level, found.facts["near"]) == ("warn", 130)


def test_a_warning_leaves_the_parameters_of_the_table_not_judged() -> None:
    names = {"d": ("k1", "c"), "pull": ("mu",)}
    experiments: Any = [
        SimpleNamespace(
            label=label,
            table=SimpleNamespace(label=label),
            masses=(),
            parameters=[SimpleNamespace(name=name) for name in own],
        )
        for label, own in names.items()
    ]
    found = Finding("readings.missing", "warn", {"unjudged": True}, "d")
    assert with_scaled(found, experiments).parameters == ("k1", "c")
    assert not with_scaled(Finding("readings.missing", "ok", {"unjudged": False}, "d"), experiments).parameters


def test_a_table_of_trials_counts_its_share(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("angle [deg]\n34.1\n33.8\n--\n34.4\n33.9\n", encoding="utf-8")
    entry = '[[experiment]]\nkind = "static_friction"\nfile = "t.csv"\n'
    (tmp_path / "rig.toml").write_text(f'[rig]\nname = "r"\n{entry}', encoding="utf-8")
    (found,) = findings_of(capsule_id.read_rig(tmp_path))
    assert (found.level, found.facts["rows"], found.facts["used"]) == ("warn", 1, 4)


def test_settings_of_a_prediction_have_no_missing_cell(tmp_path: Path) -> None:
    """Its rows answer to the rows of the table."""
    from capsule_id.rig.read import read_settings

    (tmp_path / "s.csv").write_text("period [ms],periods [1]\n40,\n50,100\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"s\.csv:2:1: settings must have no missing cell"):
        read_settings(tmp_path / "s.csv", default_registry()["progression"], "distance")
