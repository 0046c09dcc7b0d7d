"""The output directory of ``fit-params``: refused, replaced, and unchanged after a refusal."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import IO, cast

import pytest

from capsule_id.cli import fit_params
from capsule_id.errors import InputError
from capsule_id.output import CHAINS, LOCK, STATE, check_directory, publish, work_in_progress
from tests.cli_tools import argv, environment, listing, run, small_rig

RESULT = {"parameters.json", "parameters.csv", "report.html", "figures"}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a rig in ``rig``."""
    monkeypatch.chdir(tmp_path)
    small_rig(tmp_path / "rig")
    return tmp_path


def fake_result(directory: Path, mark: str = "old") -> Path:
    """A directory like one that this program has written."""
    directory.mkdir(parents=True)
    text = json.dumps({"mark": mark, "provenance": {"versions": {"capsule-id": "0"}}})
    (directory / "parameters.json").write_text(text)
    return directory


def fake_run(directory: Path, resume: bool = False, mark: str = "new") -> None:
    """The directory operations of ``fit-params`` without the fit."""
    check_directory(directory)
    with work_in_progress(directory, {"seed": 0}, resume) as partial:
        (partial / CHAINS).touch()
        text = json.dumps({"mark": mark, "provenance": {"versions": {"capsule-id": "0"}}})
        (partial / "parameters.json").write_text(text)
        publish(partial, directory)


def test_directories_that_are_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "file").touch()
    (here / "link").symlink_to("rig")
    (here / "dangling").symlink_to("nowhere")
    (here / "foreign" / "thesis").mkdir(parents=True)
    (fake_result(here / "annotated") / "notes.txt").touch()
    fake_result(here / "stranger")
    (here / "stranger" / "parameters.json").write_text('{"provenance": {"versions": {}}}')
    (here / "figures-only" / "figures").mkdir(parents=True)
    (here / "busy.partial" / "thesis").mkdir(parents=True)
    (here / "taken.partial").symlink_to("rig")
    (here / "kept.partial.old" / "thesis").mkdir(parents=True)
    before = listing(here)
    for out, named in (
        ("file", "a file or a link"),
        ("link", "a file or a link"),
        ("dangling", "a file or a link"),
        ("file/below", "writable"),
        ("file/far/below", "writable"),
        ("foreign", "it holds thesis"),
        ("rig", "it holds rig.toml"),
        ("annotated", "it holds notes.txt"),
        ("stranger", "it is not one"),
        ("figures-only", "it is not one"),
        ("busy", "it holds thesis"),
        ("taken", "a file or a link"),
        ("kept", "something else"),
        ("x.partial", "must not end"),
        ("x.partial.lock", "must not end"),
        (".", "must have a name"),
        ("..", "must have a name"),
        ("", "must have a name"),
        ("/", "must have a name"),
        ("n" * 250, "name too long"),
        ("n" * 300, "name too long"),
    ):
        assert fit_params(["rig", "--no-sample", "--out", out]) == 2
        stdout, stderr = capsys.readouterr()
        assert (stdout, stderr.count("\n")) == ("", 1)
        assert named in stderr.lower()
        assert listing(here) == before


def test_nothing_is_left_where_the_fit_itself_refuses(here: Path) -> None:
    before = listing(here)
    with pytest.raises(InputError), work_in_progress(here / "far" / "away", {}, resume=False) as partial:  # noqa: PT012
        (partial / "figures").mkdir()
        raise InputError("a rule", "broken", "mend it")
    assert listing(here) == before


@pytest.mark.parametrize("there", ["absent", "empty", "result"])
def test_what_is_replaced(here: Path, there: str) -> None:
    if there == "empty":
        (here / "out").mkdir()
    if there == "result":
        (fake_result(here / "out") / "figures").mkdir()
    fake_run(here / "out")
    assert {path.name for path in here.iterdir()} == {"rig", "out"}
    assert {path.name for path in (here / "out").iterdir()} == {"parameters.json"}
    assert json.loads((here / "out" / "parameters.json").read_text())["mark"] == "new"


class Killed(BaseException):
    """Simulates a kill: no handler catches it."""


def die_at(patch: pytest.MonkeyPatch, moment: int) -> None:
    """Die instead of the ``moment``-th renaming or removal."""
    steps = count()

    def dying(real: Callable[..., object]) -> Callable[..., object]:
        def step(self: Path, *args: object, **options: object) -> object:
            if next(steps) == moment:
                raise Killed
            return real(self, *args, **options)

        return step

    patch.setattr(Path, "rename", dying(Path.rename))
    patch.setattr(Path, "unlink", dying(Path.unlink))


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("moment", range(6))
def test_a_kill_between_the_steps_of_publishing(
    here: Path, monkeypatch: pytest.MonkeyPatch, moment: int, resume: bool
) -> None:
    """DIR is then the old result, the new one or absent, never incomplete; the next run repairs it."""
    old = fake_result(here / "out") / "parameters.json"
    with pytest.raises(Killed), work_in_progress(here / "out", {"seed": 0}, resume=False) as partial:  # noqa: PT012
        (partial / "parameters.json").write_text(old.read_text().replace("old", "new"))
        with monkeypatch.context() as patch:
            die_at(patch, moment)
            publish(partial, here / "out")
    assert not (here / "out").exists() or json.loads(old.read_text())["mark"] in ("old", "new")
    fake_run(here / "out", resume and (here / "out.partial").exists(), "newest")
    assert {path.name for path in here.iterdir()} == {"rig", "out"}
    assert {path.name for path in (here / "out").iterdir()} == {"parameters.json"}
    assert json.loads(old.read_text())["mark"] == "newest"


def test_one_run_at_a_time(here: Path) -> None:
    with (
        work_in_progress(here / "out", {}, resume=False),
        pytest.raises(InputError, match="one run at a time"),
        work_in_progress(here / "out", {}, resume=False),
    ):
        pass
    holder = "import sys\nfrom pathlib import Path\nfrom capsule_id.output import work_in_progress\n"
    holder += "with work_in_progress(Path(sys.argv[1]), {}, resume=False):\n"
    holder += "    print('locked', flush=True)\n    sys.stdin.read()\n"
    command = [sys.executable, "-c", holder, str(here / "out")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        # The other process holds the lock from here on.
        assert cast("IO[bytes]", other.stdout).readline() == b"locked\n"
        before = listing(here)
        for more in ([], ["--resume"]):
            assert fit_params(["rig", "--no-sample", "--out", "out", *more]) == 2
            assert listing(here) == before
        other.kill()
    assert (here / f"out{LOCK}").exists()
    fake_run(here / "out")  # the lock died with its holder
    assert {path.name for path in here.iterdir()} == {"rig", "out"}


@pytest.mark.parametrize("damage", [None, "", "{", "[]", '{"fingerprint": 1}', "\udcff"])
def test_a_damaged_state_is_refused_or_begun_afresh(here: Path, damage: str | None) -> None:
    with work_in_progress(here / "out", {"seed": 0}, resume=False) as partial:
        state = partial / STATE
    state.unlink() if damage is None else state.write_bytes(damage.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match="missing or damaged"):
        fake_run(here / "out", resume=True)
    fake_run(here / "out")
    assert {path.name for path in here.iterdir()} == {"rig", "out"}


def test_resume_needs_something_to_resume(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = listing(here)
    assert fit_params(["rig", "--resume"]) == 2
    assert "there is none" in capsys.readouterr().err
    assert listing(here) == before


@pytest.mark.full
def test_a_point_fit_in_an_odd_place(here: Path) -> None:
    """Unusual paths, a current directory without results, a closed pipe and an ASCII terminal, all at once."""
    small_rig(here / "-mein Prüfstand")
    (here / "empty").mkdir()
    env = environment(PYTHONIOENCODING="ascii", HOME=None, MPLCONFIGDIR=None)
    done = run(
        "--no-sample", "--quiet", "--out", "../new/Ergebnis ä/", "--", "../-mein Prüfstand", cwd=here / "empty", env=env
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "report: ../new/Ergebnis ?/report.html" in done.stdout
    assert list((here / "empty").iterdir()) == []
    assert {path.name for path in (here / "new" / "Ergebnis ä").iterdir()} == RESULT
    content = json.loads((here / "new" / "Ergebnis ä" / "parameters.json").read_text(encoding="utf-8"))
    for row in content["parameters"].values():
        assert [row[key] for key in ("mean", "median", "ci95", "ess", "rhat")] == [None] * 5
        assert (row["basis"], row["value"]) == ("point", row["map"])
        assert row["sd"] > 0.0
        assert row["map"] > 0.0
    reader, writer = os.pipe()
    os.close(reader)
    left = subprocess.run(
        argv("rig", "--no-sample", "--quiet"), cwd=here, env=env, stdout=writer, stderr=subprocess.PIPE, check=False
    )
    os.close(writer)
    assert (left.returncode, left.stderr) == (0, b"")
    assert {path.name for path in (here / "results" / "small").iterdir()} == RESULT
