"""``capsule-id next`` and ``plan``: tables, figure, words about a result that is not trusted, wrong input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from capsule_id.api import Fit, read_rig
from capsule_id.cli import capsule_id
from capsule_id.inference.result import Result


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _next(monkeypatch: pytest.MonkeyPatch, result: Result, *words: str) -> int:
    """The command on ``result``, with the friction tables of the example rig."""
    rig = read_rig(Path(__file__).parents[2] / "data")
    rig = replace(rig, tables=tuple(table for table in rig.tables if "friction" in table.kind))
    assert result.posterior is not None
    # Draws of the stub are normal; those of a fit of positive parameters are positive.
    sample = replace(result.posterior, draws=np.abs(result.posterior.draws))
    monkeypatch.setattr("capsule_id.api.load", lambda _: Fit(**vars(replace(result, rig=rig, posterior=sample))))
    return capsule_id(["next", "results/twin", "--quiet", "--draws", "2", *words])


def test_a_trusted_result_gives_table_lines_and_figure(
    result: Result, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _next(monkeypatch, result, "--for", "mu, v_s", "--out", "t.csv", "--figure", "t.png") == 0
    out = capsys.readouterr().out
    assert out.startswith("sd today: mu ")
    assert "further choices: --out FILE.csv has all" in out
    assert "[[experiment]]\nkind = " in out
    table = pd.read_csv("t.csv")
    assert (table["mu, ratio"] <= 1.0 + 1e-9).all()
    assert table["minutes"].max() <= 30.0
    with Image.open("t.png") as picture:
        assert picture.size[0] == 1290


def test_a_result_that_is_not_trusted_names_its_failed_checks_first(
    unclean: Result, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _next(monkeypatch, unclean, "--for", "mu") == 3
    out = capsys.readouterr().out
    assert out.startswith("fail errors.stated: ")
    assert out.index("not trusted") < out.index("sd today")


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (("--minutes", "-3"), "--minutes must be positive"),
        (("--for", "k9"), "a target must be a parameter of the fit"),
        (("--out", "there.csv"), "--out must name a new file"),
        (("--figure", "t.jpg"), "--figure must name a .png file"),
    ],
)
def test_wrong_input_is_refused(
    result: Result,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    rule: str,
) -> None:
    Path("there.csv").write_text("", encoding="utf-8")
    assert _next(monkeypatch, result, *words) == 2
    assert rule in capsys.readouterr().err


def test_a_plan_is_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    lines = ['[rig]\nname = "p"', *(f'{m} = {{ value = 0.1, sd = 1e-4, unit = "kg" }}' for m in ("m1", "m2"))]
    Path("rig.toml").write_text("\n".join([*lines, "[plan]\ntests = { tilt = 4 }\n"]), encoding="utf-8")
    assert capsule_id(["plan", "--draws", "2"]) == 0
    out = capsys.readouterr().out
    assert "mu  bounded" in out
    assert out.endswith("4 min of tests; sd / value: expected, in the mean over 2 draws of the priors\n")
    Path("rig.toml").write_text("\n".join(lines), encoding="utf-8")
    assert capsule_id(["plan"]) == 2
    assert "add e.g. tests = { push = 10" in capsys.readouterr().err
