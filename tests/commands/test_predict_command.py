"""``capsule-id predict``: wrong input ends in one line and exit code 2, and nothing is written."""

from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from capsule_id.cli import capsule_id
from capsule_id.commands import predict as command
from capsule_id.inference import prediction
from tests.cli_tools import message


@pytest.mark.parametrize(
    ("taken", "seed", "words"),
    [
        (True, "0", "--out must name a new file"),
        (False, "-1", "--seed must not be negative"),
        (False, "0", "a result must be a directory"),
    ],
)
def test_wrong_input_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], taken: bool, seed: str, words: str
) -> None:
    settings, out = tmp_path / "settings.csv", tmp_path / "predicted.csv"
    settings.write_text("period [ms],duty [%],periods [1]\n60,30,67\n")
    if taken:
        out.write_text("kept")
    code = capsule_id(
        ["predict", str(tmp_path / "none"), str(settings), "--out", str(out), "--seed", seed, "--no-cache"]
    )
    assert code == 2
    (line,) = message(capsys.readouterr().err).splitlines()
    assert words in line
    assert out.exists() == taken


@pytest.mark.parametrize(("trust", "code"), [("trusted", 0), ("not trusted", 3)])
def test_failed_checks_come_before_predictions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, trust: str, code: int
) -> None:
    """Before: no word of them, and exit code 0."""
    fit = SimpleNamespace(trust=trust, clean=trust == "trusted", findings=(), verdict="verdict: the words")
    monkeypatch.setattr(command.cid, "load", lambda _: fit, raising=False)
    monkeypatch.setattr(prediction, "predict", lambda *_, **__: SimpleNamespace(table=pd.DataFrame({"a": [1.0]})))
    out = tmp_path / "predicted.csv"
    assert capsule_id(["predict", str(tmp_path), "settings.csv", "--out", str(out), "--no-cache"]) == code
    assert ("verdict: the words" in capsys.readouterr().out) == (code == 3)
    assert out.read_text().startswith("a")


def test_a_figure_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure = tmp_path / "predicted.csv", tmp_path / "speeds.png"
    figure.write_text("kept")
    asked = ["predict", str(tmp_path), str(tmp_path / "settings.csv"), "--out", str(out), "--figure", str(figure)]
    assert capsule_id(asked) == 2
    assert "--figure must name a new file, it exists, choose another name" in message(capsys.readouterr().err)
    assert not out.exists()
    assert figure.read_text() == "kept"


@pytest.mark.parametrize(
    ("figure", "words"),
    [
        ("predicted.pdf", "--figure must name a .png file of its own, predicted.pdf, write NAME.png"),
        ("predicted.png", "--figure must name a .png file of its own, predicted.png, write NAME.png"),
        ("none/speeds.png", "--figure must stand in a directory, there is none, make "),
        (f"{'x' * 300}.png", "--figure must be writable"),
    ],
)
def test_a_figure_that_cannot_be_is_named_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], figure: str, words: str
) -> None:
    out = tmp_path / "predicted.png"
    asked = ["predict", str(tmp_path), str(tmp_path / "s.csv"), "--out", str(out), "--figure", str(tmp_path / figure)]
    assert capsule_id(asked) == 2
    assert words in message(capsys.readouterr().err)
    assert not out.exists()


def test_one_file_by_two_paths_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = ["predict", str(tmp_path), "s.csv", "--out", str(tmp_path / "predicted.png"), "--figure", "predicted.png"]
    assert capsule_id(asked) == 2
    assert "--figure must name a .png file of its own" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
