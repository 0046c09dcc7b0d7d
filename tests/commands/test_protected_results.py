"""A command never replaces a sample by less; options are written out; both commands state their version and help."""

import json
import shutil
from importlib.metadata import version
from pathlib import Path

import pytest

from capsule_id.cli import capsule_id, fit_params
from tests.cli_tools import listing, small_rig


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory: a rig and a result that holds a sample."""
    monkeypatch.chdir(tmp_path)
    small_rig(tmp_path / "rig")
    assert fit_params(["rig", "--no-sample", "--quiet", "--out", "out"]) in (0, 3)
    (tmp_path / "out" / "posterior.nc").write_bytes(b"sample")
    return tmp_path


@pytest.mark.full
def test_no_sample_keeps_a_posterior(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = listing(here / "out")
    assert fit_params(["rig", "--no-sample", "--quiet", "--out", "out"]) == 2
    assert "--no-sample must not replace a result with a sample" in capsys.readouterr().err
    assert listing(here / "out") == before
    shutil.move(here / "out", here / "moved")  # the remedy
    assert fit_params(["rig", "--no-sample", "--quiet", "--out", "out"]) in (0, 3)


def test_json_prints_the_file_and_nothing_else(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    code = fit_params(["rig", "--no-sample", "--quiet", "--json", "--out", "second"])
    printed = capsys.readouterr().out
    assert printed == (here / "second" / "parameters.json").read_text(encoding="utf-8")
    assert json.loads(printed)["trust"] == "not judged"
    assert capsule_id(["report", "second", "--json"]) == code
    assert capsys.readouterr().out == printed


def test_a_sweep_is_not_written_into_a_result(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = listing(here)
    sweep = ["bifurcate", "--over", "P_d", "--from", "1", "--to", "2", "--points", "2", "--k2", "18960", "--out"]
    for name in ("posterior.nc", "sweep.nc"):
        assert capsule_id([*sweep, f"out/{name}"]) == 2
        assert "the output must not lie in a result of fit-params" in capsys.readouterr().err
    assert listing(here) == before


def test_options_are_not_abbreviated(capsys: pytest.CaptureFixture[str]) -> None:
    assert capsule_id(["simulate", "--out", "a.csv", "--fig", "a.png"]) == 2
    assert "unrecognized arguments: --fig" in capsys.readouterr().err
    assert fit_params(["rig", "--no-s"]) == 2
    assert "unrecognized arguments: --no-s" in capsys.readouterr().err


def test_version_and_bare_command(capsys: pytest.CaptureFixture[str]) -> None:
    for name, command in (("fit-params", fit_params), ("capsule-id", capsule_id)):
        assert command(["--version"]) == 0
        assert capsys.readouterr().out == f"{name} {version('capsule-id')}\n"
    assert capsule_id([]) == 0
    assert "usage: capsule-id" in capsys.readouterr().out
