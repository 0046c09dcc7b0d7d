"""``capsule-id tune``: tables, figure, words about a result that is not trusted, wrong input."""

import json
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from capsule_id.api import Fit
from capsule_id.cli import capsule_id
from capsule_id.inference import tuning
from capsule_id.inference.result import Result
from capsule_id.motions.response import Settling

SEARCH = ["--P_d", "3", "4.5", "--Omega", "30", "40", "--G", "0.001", "--spring", "medium", "--draws", "2", "--quiet"]


@pytest.fixture(autouse=True)
def _quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in (("MEMBERS", 4), ("GENERATIONS", 2), ("MAP_POINTS", 4), ("STARTS", 3)):
        monkeypatch.setattr(tuning, name, value)
    for name in ("SEARCH", "FINAL"):
        monkeypatch.setattr(tuning, name, Settling(20, 12, exponent_periods=0))


def _tune(monkeypatch: pytest.MonkeyPatch, result: Result, *words: str) -> int:
    monkeypatch.setattr("capsule_id.api.load", lambda _: Fit(**vars(result)))
    return capsule_id(["tune", "results/twin", *SEARCH, *words])


def test_a_result_that_is_not_trusted_names_its_failed_checks_first(
    unclean: Result, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _tune(monkeypatch, unclean, "--out", "t.csv", "--figure", "t.png") == 3
    said = capsys.readouterr()
    assert said.err == ""
    first, *_, last = said.out.splitlines()
    assert first.startswith("fail errors.stated: ")
    assert said.out.index("not trusted") < said.out.index("best of ")
    assert last == "wrote t.png"
    table = pd.read_csv("t.csv")
    assert set(table["trust"]) == {"not judged"}
    assert list(table.columns[:3]) == ["setting", "P_d [N]", "Omega [rad/s]"]
    with Image.open("t.png") as picture:
        assert picture.size == (1110, 750)


def test_a_trusted_result_gives_its_numbers_as_json(
    result: Result, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _tune(monkeypatch, result, "--out", "t.json") == 0
    out = capsys.readouterr().out
    assert out.startswith("best of ")
    assert "settled motions of this setting" in out
    saved = json.loads(Path("t.json").read_text(encoding="utf-8"))
    assert saved["table"]["best"]["trust"] == "trusted"
    assert set(saved["best"]) == set(saved["bounds"]) == {"P_d", "Omega"}
    assert saved["given"] == {"G": 0.001}
    assert 3.0 <= saved["best"]["P_d"] <= 4.5
    assert saved["sensitivity"]["mu"]["change"] == "sd"


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["--out", "t.txt"], "--out must end in .csv or .json"),
        (["--out", "t.csv", "--mu", "1", "2", "3"], "--mu takes one or two numbers, 3"),
        (["--out", "t.csv", "--k1", "stiff"], "--k1 takes a number"),
        (["--out", "t.csv", "--draws", "0"], "--draws must be a whole number of at least 1"),
        (["--out", "t.csv", "--draws", "9999"], "draws must lie between 1 and the sample's"),
        (["--out", "t.csv", "--faster-than", "-1"], "the velocity to exceed must be finite and not negative"),
        (["--out", "none/t.csv"], "--out must stand in a directory"),
        (["--out", "t.csv", "--seed", "-1"], "--seed must not be negative"),
    ],
)
def test_wrong_input_is_one_line(
    result: Result, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], rule: str
) -> None:
    assert _tune(monkeypatch, result, *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert rule in line
    assert list(Path().iterdir()) == []
