"""Measured runs on a diagram: the runs with its settings, their places, and the reasons for the others."""

import json
from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.cli import capsule_id
from capsule_id.commands import bifurcate
from capsule_id.commands.bifurcate import overlay
from capsule_id.report.figures.sweeps import MeasuredPoint
from capsule_id.synthetic import synthesize

#: The paper's Fig. 10, of which runs 3 and 4 are synthesized; and near Fig. 6, of which run 1 is.
FIG_10 = {"k2": 59410.0, "G": 1.5e-3, "P_d": 2.5, "Omega": 34.56}
FIG_6 = {"k2": 18960.0, "G": 1e-3, "P_d": 4.0, "Omega": 34.56}
FITTED = {"K": 2.0, "k2[medium]": 18960.0, "k2[stiff]": 56410.0}
F = ("f", (3.0, 9.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rigs") / "rig"
    synthesize(folder, 3, name="rig", runs=True)
    return folder


def _truth(folder: Path, run: str) -> dict:
    return json.loads(folder.with_name("rig.truth.json").read_text(encoding="utf-8"))["runs"][run]


@pytest.mark.full
def test_fig_10_shows_its_two_runs(folder: Path) -> None:
    found, said = overlay(read_rig(folder), *F, FIG_10, FITTED)
    assert [run.label for run in found] == ["P-1-F-3", "P-1-F-2"]
    expected = [_truth(folder, name)["Omega"] / (2.0 * np.pi) for name in ("run_3", "run_4")]
    np.testing.assert_allclose([run.value for run in found], expected, rtol=1e-12)
    # As tests/physics/exact_cases.json has them, fig10_Om_26.58 and fig10_Om_46; labels too.
    np.testing.assert_allclose([run.mean_velocity for run in found], [8.345e-6, 2.71341e-4], atol=5e-7)
    assert "2 of 4 measured runs overlaid; omitted: run_1 (k2 = 1.896e+04, not 5.941e+04 N/m); run_2" in said
    # The same in rad/s.
    turned, _ = overlay(read_rig(folder), "Omega", (20.0, 60.0), FIG_10, FITTED)
    np.testing.assert_allclose([run.value for run in turned], [26.58, 46.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"G": 1e-3}, "G = 0.001464, not 0.001 m"),
        ({"P_d": 2.7}, "P_d = 2.5, not 2.7 N"),
        # The spring of runs 3 and 4 is known by its prior only, 72.1 kN/m within a factor of 1.5.
        ({"k2": 40e3}, "k2 = 7.21e+04, not 4e+04 N/m"),
    ],
)
def test_another_setting_leaves_a_run_out(folder: Path, change: dict[str, float], reason: str) -> None:
    found, said = overlay(read_rig(folder), *F, FIG_10 | change, FITTED)
    assert found == []
    assert reason in said


@pytest.mark.full
def test_the_value_of_a_run_is_its_own(folder: Path) -> None:
    """P_d is K times the current; k2 is fitted or the paper's estimate; the gap is stated."""
    rig = read_rig(folder)
    (load,) = overlay(rig, "P_d", (1.0, 8.0), FIG_6, FITTED | {"K": 2.2}, "medium")[0]
    assert load.value == pytest.approx(2.2 * _truth(folder, "run_1")["current_amplitude"], rel=1e-3)
    assert overlay(rig, "k2", (1e3, 55e3), FIG_6, FITTED)[0][0].value == 18960.0
    (paper,) = overlay(rig, "k2", (1e3, 55e3), FIG_6, {})[0]
    assert paper.value == pytest.approx(18960.0, rel=0.01)
    assert paper.value != 18960.0
    (gap,) = overlay(rig, "G", (0.0, 2e-3), FIG_6, FITTED)[0]
    assert gap.value == pytest.approx(1.032e-3)
    # At another frequency, by less than 0.5 % and by more.
    assert overlay(rig, "G", (0.0, 2e-3), FIG_6 | {"Omega": 34.7}, FITTED)[0] == [gap]
    assert overlay(rig, "G", (0.0, 2e-3), FIG_6 | {"Omega": 34.8}, FITTED)[0] == []


@pytest.mark.full
def test_the_sentence_gives_reasons_for_omitted_runs(folder: Path) -> None:
    rig = read_rig(folder)
    assert "f = 4.23 Hz is outside the diagram" in overlay(rig, "f", (5.0, 9.0), FIG_10, FITTED)[1]
    assert "mu is not a setting of a run" in overlay(rig, "mu", (0.1, 0.9), FIG_10, FITTED)[1]
    by_name = overlay(rig, *F, FIG_10, FITTED, "stiff")
    assert "run_3 (spring hard, not stiff)" in by_name[1]


@pytest.mark.full
def test_the_command_draws_them(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("results/rig").mkdir(parents=True)
    rows = {"parameters": {name: {"map": value} for name, value in FITTED.items()}}
    Path("results/rig/parameters.json").write_text(json.dumps(rows), encoding="utf-8")
    drawn: list[MeasuredPoint] = []
    draw = bifurcate.draw

    def watch(*words: object, **options: object) -> object:
        drawn.extend(words[2])  # type: ignore[arg-type]
        return draw(*words, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(bifurcate, "draw", watch)
    over = ["--over", "f", "--from", "3", "--to", "9", "--points", "3", "--dropped", "20", "--observed", "6"]
    settings = ["--k2", "59410", "--G", "0.0015", "--P_d", "2.5", "--quiet"]
    assert capsule_id(["bifurcate", str(folder), *over, *settings]) == 0
    assert [run.label for run in drawn] == ["P-1-F-3", "P-1-F-2"]
    said = capsys.readouterr().err
    assert (said[:30], said.count("\n")) == ("2 of 4 measured runs overlaid;", 1)
