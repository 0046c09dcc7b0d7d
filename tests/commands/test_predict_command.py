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
