"""``capsule-id predict``: wrong input ends in one line and exit code 2, and nothing is written."""

from pathlib import Path

import pytest

from capsule_id.cli import capsule_id


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
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert out.exists() == taken


def test_a_figure_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure = tmp_path / "predicted.csv", tmp_path / "speeds.png"
    figure.write_text("kept")
    asked = ["predict", str(tmp_path), str(tmp_path / "settings.csv"), "--out", str(out), "--figure", str(figure)]
    assert capsule_id(asked) == 2
    assert "--figure must name a new file, it exists, choose another name" in capsys.readouterr().err
    assert not out.exists()
    assert figure.read_text() == "kept"
