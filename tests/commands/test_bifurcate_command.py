"""``capsule-id bifurcate``: files, units, resumed maps, bands, parameters of a rig, errors."""

import argparse
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from capsule_id.cli import capsule_id
from capsule_id.commands import add_options
from capsule_id.commands import bifurcate as command
from capsule_id.console import Progress
from capsule_id.motions import sweep
from capsule_id.motions.response import Settling, response
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.report.figures.sweeps import MeasuredPoint
from tests.cli_tools import ROOT, listing, message, small_rig

SHORT = ["--dropped", "20", "--observed", "6", "--quiet"]
OVER = ["--over", "k2", "--from", "5", "--to", "50", "--unit", "kN/m", "--points", "4"]
MAP = ["--with", "f", "--with-from", "3", "--with-to", "6", "--with-points", "3"]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _run(*words: str) -> int:
    return capsule_id(["bifurcate", *words])


def _opened(name: str) -> xr.Dataset:
    with xr.open_dataset(name, engine="h5netcdf") as data:
        return data.load()


@pytest.mark.full
def test_a_diagram_becomes_a_file_in_si_and_a_picture(capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(*OVER, *SHORT, "--c", "4") == 0
    said = capsys.readouterr()
    assert (said.out.splitlines()[-1], said.err) == ("wrote bifurcation-k2.nc and bifurcation-k2.png", "")
    data = _opened("bifurcation-k2.nc")
    np.testing.assert_allclose(data["k2"], [5e3, 2e4, 3.5e4, 5e4])
    assert (data["k2"].attrs["units"], data.attrs["c"], data.attrs["Omega"], data.attrs["dropped"]) == (
        "N/m", 4.0, 34.56, 20,
    )  # fmt: skip
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=data["k2"].to_numpy(), c=4.0, mu=0.66, v_s=0.3, G=1e-3)
    r = response(p, Excitation(4.0, 34.56), settling=Settling(dropped=20, observed=6))
    np.testing.assert_array_equal(data["label"][0], r.label)
    np.testing.assert_array_equal(data["mean_velocity"][0], r.mean_velocity)
    with Image.open("bifurcation-k2.png") as picture:
        assert picture.size == (1110, 990)
    assert sorted(listing(Path())) == ["bifurcation-k2.nc", "bifurcation-k2.png"]


@pytest.mark.full
def test_continuation_and_many_states(capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(*OVER, *SHORT, "--method", "both", "--out", "new/both.nc") == 0
    assert list(_opened("new/both.nc")["branch"].to_numpy()) == ["forward", "backward"]
    assert _run(*OVER, *SHORT, "--method", "states", "--states", "3", "--out", "states.nc") == 0
    assert _opened("states.nc").sizes["branch"] == 3
    assert "motions of" in capsys.readouterr().out


@pytest.mark.full
def test_an_interrupted_map_is_taken_up_and_equals_the_whole_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(*OVER, *MAP, *SHORT, "--out", "whole.nc") == 0
    monkeypatch.setitem(sweep.motion_map.__kwdefaults__, "block", 5)
    plain = Progress.__call__

    def stop(self: Progress, done: int, total: int, stage: str) -> None:
        if done >= 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", stop)
    assert _run(*OVER, *MAP, *SHORT, "--out", "part.nc") == 130
    assert not Path("part.nc").exists()
    assert len(list(Path("part.nc.partial").glob("block_*"))) == 1
    monkeypatch.setattr(Progress, "__call__", plain)
    # Other settings do not reuse these blocks.
    assert _run(*OVER, *MAP, *SHORT, "--c", "4", "--out", "part.nc", "--resume") == 2
    assert "same points only" in capsys.readouterr().err
    assert _run(*OVER, *MAP, *SHORT, "--out", "part.nc", "--resume", "--scheduler", "threads") == 0
    xr.testing.assert_identical(_opened("part.nc"), _opened("whole.nc"))
    assert not Path("part.nc.partial").exists()
    assert _run(*OVER, *MAP, *SHORT, "--out", "part.nc", "--resume") == 2
    assert "there is none" in capsys.readouterr().err


def _posterior(path: Path, draws: int = 6) -> dict[str, np.ndarray]:
    """A posterior.nc of two chains with two springs; its draws by symbol."""
    rng = np.random.default_rng(1)
    columns = {"k1": 1420.0, "c": 3.89, "mu": 0.66, "v_s": 0.3, "m1": 0.11, "m2": 0.53}
    drawn = {name: value * (1.0 + 0.01 * rng.standard_normal((2, draws))) for name, value in columns.items()}
    k2 = np.array([5e3, 3e4]) * (1.0 + 0.01 * rng.standard_normal((2, draws, 2)))
    variables = {name: (("chain", "draw"), x) for name, x in drawn.items()}
    spring = {"k2": (("chain", "draw", "spring"), k2), "K": (("chain", "draw"), np.ones((2, draws)))}
    # The gaps of the runs of a fit: the diagram has the gap of the option. (Before: an internal failure, or run_2's gap.)
    gaps = {"G": (("chain", "draw", "G_of"), np.full((2, draws, 2), 5e-3))}
    data = xr.Dataset(variables | spring | gaps, {"spring": ["soft", "stiff"], "G_of": ["run_1", "run_2"]})
    xr.DataTree.from_dict({"posterior": data}).to_netcdf(path, engine="h5netcdf")
    return drawn | {"k2": k2}


@pytest.mark.full
def test_a_diagram_whose_runs_all_fail_says_so_alone(capsys: pytest.CaptureFixture[str]) -> None:
    """Before: a RuntimeWarning of NumPy beside it."""
    words = ["--over", "m1", "--from", "0.1", "--to", "1", "--points", "3", "--k2", "18960", "--dropped", "5"]
    assert _run(*words, "--observed", "3", "--c", "1e300", "--out", "f.nc") == 0
    said = capsys.readouterr()
    assert "3 runs failed" in said.out
    # A slow machine has the time to report its progress.
    assert [line for line in said.err.splitlines() if not line.startswith("points: ")] == []


def test_posterior_bands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drawn = _posterior(tmp_path / "posterior.nc")
    axis = ["--over", "P_d", "--from", "3", "--to", "4.5", "--points", "3", "--posterior", "posterior.nc"]
    assert _run(*axis, *SHORT, "--draws", "12", "--out", "b.nc") == 2
    assert "add --spring or --k2" in capsys.readouterr().err
    assert _run(*axis, *SHORT, "--draws", "12", "--spring", "stiff", "--mu", "0.6", "--out", "b.nc") == 0
    assert "best in the mean of 12 draws: P_d = " in capsys.readouterr().out
    data = _opened("b.nc")
    np.testing.assert_allclose(data["probability"].sum("label"), 1.0)
    # All draws of the file, in some order; mu is the option's.
    flat = {name: x.reshape(12, *x.shape[2:]) for name, x in drawn.items()}
    leaves = {name: flat[name] for name in ("m1", "m2", "k1", "c", "v_s")}
    p = CapsuleParameters(**leaves, k2=flat["k2"][:, 1], mu=0.6, G=1e-3)
    r = response(p, Excitation(4.5, 34.56), settling=Settling(dropped=20, observed=6))
    quantiles = data["mean_velocity_quantiles"].isel(P_d=-1)
    np.testing.assert_allclose(quantiles, np.quantile(r.mean_velocity, [0.025, 0.5, 0.975]), rtol=1e-12)
    assert _run(*axis, *SHORT, "--draws", "13", "--k2", "2e4", "--out", "c.nc") == 2
    assert "at most 12" in capsys.readouterr().err
    # The result beside the posterior states the rest. Before: Table 1, without a word.
    rows = {name: {"map": 1.0} for name in ("m1", "m2", "k1", "c", "v_s")}
    saved = {"parameters": rows, "provenance": {"friction": "mine.Law"}}
    Path("parameters.json").write_text(json.dumps(saved), encoding="utf-8")
    assert _run(*axis, *SHORT, "--draws", "12", "--k2", "2e4", "--out", "c.nc") == 2
    assert "mine.Law" in capsys.readouterr().err


def test_parameters_of_a_fitted_rig(capsys: pytest.CaptureFixture[str]) -> None:
    small_rig(Path("rig"), "small")
    assert _run("rig", *OVER, *SHORT) == 2
    assert "run fit-params on it" in capsys.readouterr().err
    Path("results/small").mkdir(parents=True)
    rows = {"k1": {"map": 1500.0}, "k2[L60]": {"map": 2e4}, "K": {"map": 20.0}}
    Path("results/small/parameters.json").write_text(json.dumps({"parameters": rows}), encoding="utf-8")
    assert _run("rig", *OVER, *SHORT) == 0
    data = _opened("results/small-k2.nc")
    assert (data.attrs["rig"], data.attrs["k1"], data.attrs["c"]) == ("small", 1500.0, 3.89)


def test_measured_runs_are_laid_over_the_diagram() -> None:
    assert _run(*OVER, *SHORT) == 0
    axes = (command.Axis("k2", np.linspace(5e3, 5e4, 4), "kN/m", 1e3),)
    figure = command.draw(_opened("bifurcation-k2.nc"), axes, [MeasuredPoint(2e4, "P-1-F-2", 4e-4)])
    lower = figure.axes[1]
    (run,) = [line for line in lower.lines if line.get_label() == "measured"]
    np.testing.assert_allclose(run.get_xydata(), [[20.0, 0.4]])
    assert "P-1-F-2" in [text.get_text() for text in lower.texts]


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["--over", "k2", "--from", "5", "--to", "4"], "--from must be less than --to"),
        (["--over", "k2", "--from", "soft", "--to", "4"], "--from takes a number"),
        (["--over", "k2", "--from", "1", "--to", "4", "--unit", "mm"], "dimension of N/m"),
        (["--over", "k2", "--from", "-1", "--to", "4"], "k2 must not be negative"),
        (["--over", "f", "--from", "0", "--to", "4", "--k2", "1e4"], "f must be positive"),
        ([*OVER, "--m1", "-1"], "m1 must be positive, --m1 -1"),
        ([*OVER, "--v_s", "0"], "v_s must be positive, --v_s 0"),
        ([*OVER, "--mu", "-0.1"], "mu must not be negative, --mu -0.1"),
        (["--over", "f", "--from", "1", "--to", "4"], "k2 (stiffness of the support spring) must be given"),
        ([*OVER, "--points", "1"], "--points must lie between 2 and"),
        ([*OVER, "--k2", "2e4"], "a varied k2 has no fixed value, --k2 is given, remove --k2"),
        ([*OVER, "--with", "P_d"], "a second quantity needs its range"),
        ([*OVER, "--with-points", "3"], "--with-points needs a second quantity, there is none, add --with NAME"),
        ([*OVER, "--with", "k2", "--with-from", "1", "--with-to", "2"], "two different quantities"),
        ([*OVER, *MAP, "--method", "both"], "maps and bands start from rest"),
        ([*OVER, "--scheduler", "threads"], "--scheduler is for maps"),
        ([*OVER, "--resume"], "--resume is for maps"),
        ([*OVER, "--draws", "5"], "--draws needs --posterior, there is none, add --posterior FILE"),
        ([*OVER, "--states", "5"], "--states needs --method states, --method rest, remove --states"),
        ([*OVER, "--seed", "5"], "--seed needs random states or draws, none, remove --seed"),
        ([*OVER, "--spring", "soft"], "--spring chooses k2, k2 is varied, remove --spring"),
        ([*OVER, "--posterior", "none.nc"], "--posterior takes the posterior.nc"),
        ([*OVER, "--observed", "2"], "observed must be at least 3"),
        ([*OVER, "--merge-contacts", "1"], "less than half a period"),
        ([*OVER, "--out", "diagram.csv"], "must end in .nc"),
        ([*OVER, "--result", "nowhere"], "--result takes a result"),
        (["nowhere", *OVER], "nowhere"),
    ],
)
def test_errors_are_one_message_and_write_nothing(
    words: list[str], rule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(*words, "--quiet") == 2
    said = capsys.readouterr()
    assert rule in message(said.err)
    assert (message(said.err).count("\n"), said.out) == (1, "")
    assert listing(Path()) == {}


def test_what_is_not_ours_stays(capsys: pytest.CaptureFixture[str]) -> None:
    Path("a.nc.partial").mkdir()
    Path("a.nc.partial/letter.txt").write_text("mine", encoding="utf-8")
    Path("b.nc").mkdir()
    before = listing(Path())
    assert _run(*OVER, *MAP, *SHORT, "--out", "a.nc") == 2
    assert _run(*OVER, *SHORT, "--out", "b.nc") == 2
    assert message(capsys.readouterr().err).count("\n") == 2
    assert listing(Path()) == before


def test_what_a_kill_has_left_of_a_store_is_removed(tmp_path: Path) -> None:
    """Before, a store without its points was taken for a folder of somebody else."""
    for names in ([], ["block_000000004.npz"], ["points.json.new"], ["block_000000000.npz.new", "points.json"]):
        store = tmp_path / "a.nc.partial"
        store.mkdir()
        for name in names:
            (store / name).touch()
        assert command.prepare_store(tmp_path / "a.nc", resume=False) == store
        assert not store.exists()


def test_progress_has_a_rate_and_the_time_left(capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(*OVER, *SHORT[:-1]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert "0/4" in lines[0]
    with Progress(enabled=True, unit="point") as progress:
        progress._stage, progress._first, progress._share, progress._left = "points", 0.0, 0.5, 10.0
        assert "50/100, 5 points/s" in progress._line(50, 100, 10.0)
        assert "00:10 left" in progress._line(50, 100, 10.0)


def test_the_commands_of_the_guide_are_understood() -> None:
    """The commands parse and pass the checks that need no fitted rig."""
    text = (ROOT / "capsule_id" / "guide" / "maps.md").read_text(encoding="utf-8")
    lines = re.findall(r"^capsule-id bifurcate (.*)$", text, re.MULTILINE)
    assert len(lines) >= 4
    parser = argparse.ArgumentParser()
    add_options(parser, command.OPTIONS)
    for line in lines:
        args = parser.parse_args(shlex.split(line))
        axes = command._axes(args)
        command._check_combination(args, axes)
        assert args.data is None or (ROOT / args.data / "rig.toml").is_file()
