"""The same seed gives the same numbers after any number of interruptions and kills."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import emcee
import numpy as np
import pytest
import xarray as xr

from capsule_id.cli import fit_params
from capsule_id.console import Progress, fit_stages
from capsule_id.experiments.kind import Registry, default_registry
from capsule_id.output import CHAINS
from capsule_id.report.html import pictures
from tests.cli_tools import CODE, environment, listing, same_result, small_rig

WORDS = ("rig", "--quiet", "--max-steps", "60")
#: A short run that is checked often and never converges, so that every ensemble goes on after several checks; and
#: chains saved after every draw.
SHORT = {
    "FIRST_CHECK": 15,
    "CHECK_EVERY": 15,
    "PILOT_STEPS": 60,
    "MAX_RHAT": 0.0,
}


class Killed(BaseException):
    """Simulates a kill: no handler catches it."""


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``rig`` and the result of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    small_rig(folder / "rig")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        shorten(patch)
        assert fit_params([*WORDS, "--out", "whole"]) == 0
    return folder


@pytest.fixture
def here(uninterrupted: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same folder as the current directory."""
    monkeypatch.chdir(uninterrupted)
    shorten(monkeypatch)
    return uninterrupted


def shorten(patch: pytest.MonkeyPatch) -> None:
    """``SHORT``, and reports without pictures: the tests compare the numbers."""
    patch.setattr("capsule_id.report.write.pictures", lambda _: ())
    patch.setattr("capsule_id.inference.moves.SAVE_EVERY", 0.0)
    for name, value in SHORT.items():
        patch.setattr(f"capsule_id.inference.sampling.{name}", value)


def die_in_progress(patch: pytest.MonkeyPatch, stage: str, draws: int, death: Callable[[], object]) -> None:
    """Raise ``death()`` when the run reports this number of draws in ``stage`` ("" for any)."""

    def call(self: Progress, done: int, total: int, text: str) -> None:
        if stage in text and done >= draws:
            death()

    patch.setattr(Progress, "__call__", call)


def same_as_uninterrupted(folder: Path, out: str) -> None:
    assert not (folder / f"{out}.partial").exists()
    same_result(folder / out, folder / "whole")


@pytest.mark.full
def test_two_runs_agree_to_the_byte(here: Path) -> None:
    assert fit_params([*WORDS, "--out", "again"]) == 0
    same_as_uninterrupted(here, "again")


@pytest.mark.full
def test_another_seed_gives_other_numbers(here: Path) -> None:
    fit_params([*WORDS, "--out", "other", "--seed", "1"])
    whole, other = (json.loads((here / name / "parameters.json").read_text()) for name in ("whole", "other"))
    mean, sd = (whole["parameters"]["mu"][key] for key in ("mean", "sd"))
    assert other["provenance"]["seed"] == 1
    assert 0.0 < abs(other["parameters"]["mu"]["mean"] - mean) < 0.2 * sd


def test_an_ensemble_never_repeats_itself(here: Path) -> None:
    """emcee restarts from the state it receives; after a convergence check it must continue from the last draw."""
    with xr.open_datatree(here / "whole" / "posterior.nc", engine="h5netcdf") as tree:
        mu = tree["posterior"]["mu"].to_numpy()
    assert mu.shape[1] > 2 * SHORT["CHECK_EVERY"]
    states = np.unique(np.round(mu, 15), axis=1)
    assert states.shape == mu.shape


@pytest.mark.parametrize(
    ("stage", "draws"),
    [
        pytest.param("point fit", 0, marks=pytest.mark.full),
        pytest.param("burn-in", 0, marks=pytest.mark.full),
        pytest.param("sampling", 1, marks=pytest.mark.slow),
        ("sampling", 35),
        pytest.param("sampling", 100, marks=pytest.mark.slow),
        pytest.param("report", 0, marks=pytest.mark.full),
    ],
)
def test_interrupted_and_resumed(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], stage: str, draws: int
) -> None:
    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        if stage == "report":  # the signal is read where the first picture is drawn
            patch.setattr("capsule_id.report.write.pictures", pictures)
        die_in_progress(patch, stage, draws, interrupt)
        assert fit_params([*WORDS, "--out", "out"]) == 130
    assert capsys.readouterr().err == "fit-params: interrupted; --resume continues from the saved state\n"
    assert not (here / "out").exists()
    assert fit_params([*WORDS, "--out", "out", "--resume"]) == 0
    same_as_uninterrupted(here, "out")
    _remove(here / "out")


def test_killed_inside_emcee_and_spoilt_afterwards(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill between coordinates and counter leaves a readable but wrong file; the run must not use it."""
    real = emcee.backends.HDFBackend.save_step

    def dying(self: emcee.backends.HDFBackend, state: emcee.State, accepted: np.ndarray) -> None:
        if self.iteration == 25:
            with self.open("a") as file:
                file[self.name].attrs["iteration"] = 28
            raise Killed
        real(self, state, accepted)

    with monkeypatch.context() as patch:
        patch.setattr(emcee.backends.HDFBackend, "save_step", dying)
        with pytest.raises(Killed):
            fit_params([*WORDS, "--out", "out"])
    assert fit_params([*WORDS, "--out", "out", "--resume"]) == 0
    same_as_uninterrupted(here, "out")
    _remove(here / "out")


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param("truncated", marks=pytest.mark.slow),
        "flipped",
        pytest.param("empty", marks=pytest.mark.slow),
        pytest.param("missing", marks=pytest.mark.full),
    ],
)
def test_damaged_chains_are_drawn_again(here: Path, monkeypatch: pytest.MonkeyPatch, damage: str) -> None:
    with monkeypatch.context() as patch:
        die_in_progress(patch, "sampling", 80, lambda: (_ for _ in ()).throw(KeyboardInterrupt))
        assert fit_params([*WORDS, "--out", "out"]) == 130
    file = here / "out.partial" / CHAINS
    content = file.read_bytes()
    middle = len(content) // 2
    spoilt = {
        "truncated": content[:middle],
        "flipped": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "empty": b"",
        "missing": b"",
    }[damage]
    file.unlink() if damage == "missing" else file.write_bytes(spoilt)
    assert fit_params([*WORDS, "--out", "out", "--resume"]) == 0
    same_as_uninterrupted(here, "out")
    _remove(here / "out")


def test_killed_from_outside_and_resumed(here: Path) -> None:
    """SIGKILL at a real process: nothing of Python runs after it."""
    kill = "import os, signal\nfrom capsule_id.console import Progress\n"
    kill += "from capsule_id.inference import moves, sampling\nmoves.SAVE_EVERY = 0.0\n"
    kill += "".join(f"sampling.{name} = {value}\n" for name, value in SHORT.items())
    kill += "call = lambda self, done, total, text: done > 100 and os.kill(os.getpid(), signal.SIGKILL)\n"
    kill += "Progress.__call__ = call\n"
    code = kill + CODE.format(name="fit_params")
    done = subprocess.run(
        [sys.executable, "-c", code, *WORDS, "--out", "out"], env=environment(), check=False, cwd=here
    )
    assert done.returncode == -signal.SIGKILL
    assert (here / "out.partial" / "chains.saved").exists()
    assert fit_params([*WORDS, "--out", "out", "--resume"]) == 0
    same_as_uninterrupted(here, "out")
    _remove(here / "out")


def test_resume_refuses_what_has_changed(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        die_in_progress(patch, "point fit", 0, lambda: (_ for _ in ()).throw(KeyboardInterrupt))
        assert fit_params([*WORDS, "--out", "out"]) == 130
    capsys.readouterr()
    small_rig(here / "changed")
    (here / "changed" / "static_friction.csv").write_text("angle [deg]\n30\n31\n32\n")
    for words, named in (
        ((*WORDS, "--seed", "1"), "seed"),
        (("changed", *WORDS[1:]), "data"),
        ((*WORDS, "--experiments", "bench"), "experiments"),
        ((*WORDS[:-1], "61"), "max-steps"),
    ):
        before = listing(here)
        assert fit_params([*words, "--out", "out", "--resume"]) == 2
        assert f"the same {named}" in capsys.readouterr().err
        assert listing(here) == before
    with monkeypatch.context() as patch:
        versions = {"python": "0"}
        patch.setattr("capsule_id.inference.pipeline.package_versions", lambda packages: versions)
        assert fit_params([*WORDS, "--out", "out", "--resume"]) == 2
        assert "the same versions" in capsys.readouterr().err
    with monkeypatch.context() as patch:
        kinds = default_registry()
        with_package = Registry(kinds.kinds, {**kinds.packages, "rolling-rig": "0.2"})
        patch.setattr("capsule_id.commands.fit.default_registry", lambda: with_package)
        assert fit_params([*WORDS, "--out", "out", "--resume"]) == 2
        assert "the same versions" in capsys.readouterr().err
    _remove(here / "out.partial")
    _remove(here / "changed")


def test_progress_in_a_file_is_sparse_and_on_a_terminal_has_rate_and_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = iter(np.arange(0.0, 1000.0, 0.5))
    monkeypatch.setattr("time.monotonic", lambda: next(now))
    with Progress(enabled=True) as progress:
        for done in range(1, 201):  # 100 s
            progress(done, 400, "move")
    lines = capsys.readouterr().err.splitlines()
    assert 9 <= len(lines) <= 11
    assert all("move" in line and "\r" not in line for line in lines)
    assert ", 2 draws/s 4" in lines[-1]
    assert lines[-1].endswith(", 01:50 left")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with Progress(enabled=True) as progress:
        for done in range(1, 4):
            progress(done, 400, "move")
    text = capsys.readouterr().err
    assert (text.count("\r"), text.count("\n")) == (3, 1)
    with Progress(enabled=False) as progress:
        progress(1, 400, "move")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("terminal", [False, True])
def test_one_bar_covers_a_fit_and_never_goes_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], terminal: bool
) -> None:
    """Stages that last longer than planned, and a goal that moves away: share and time left stay or improve."""
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", os.devnull)
    with Progress(enabled=True, stages=fit_stages(sampled=True)) as progress:
        for stage, total, pause in (("readings", 1, 3.0), ("point fit", 1, 90.0), ("burn-in", 1, 1.0)):
            progress(0, total, stage)
            clock[0] += pause
        progress.note("a table")
        for goal in (100, 300, 1000):
            for done in range(goal // 3, goal, 10):
                progress(done, goal, "sampling")
                clock[0] += 11.0
        progress(0, 1, "report")
    text = capsys.readouterr().err
    assert "2 of 5: point fit, compiling" in text
    shares = [int(share) for share in re.findall(r"(\d+) %", text)]
    left = [60 * int(m) + int(s) for m, s in re.findall(r"(\d+):(\d+) left", text)]
    assert len(shares) > len(left) > 40
    assert shares == sorted(shares)
    assert left == sorted(left, reverse=True)
    assert shares[-1] == round(100.0 * (1.0 - fit_stages(sampled=True)["report"]))
    if not terminal:
        assert "\r" not in text
        assert text.replace("\n", "").isprintable()
    else:
        assert text.count("\n") == 3  # before the note, after it, at the end: one bar


def test_programs_are_said_to_be_compiled_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    for expected in ("point fit, compiling (once per machine) ", "point fit "):
        with Progress(enabled=True, stages=fit_stages(sampled=False)) as progress:
            progress(0, 1, "point fit")
        assert f"2 of 3: {expected}" in capsys.readouterr().err
        (tmp_path / "program").touch()


def _remove(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    folder.rmdir()
