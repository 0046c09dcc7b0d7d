"""The output directory of ``fit-params``: refused, replaced, and unchanged after a refusal."""

import errno
import itertools
import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import IO, Any, cast

import pytest
from filelock import FileLock

from capsule_id import output
from capsule_id.cli import fit_params
from capsule_id.errors import InputError, OutputError
from capsule_id.output import CHAINS, LOCK, STATE, check_directory, publish, replace_file, work_in_progress
from capsule_id.report.write import write_result
from tests.cli_tools import Killed, argv, environment, failing, listing, message, run, small_rig

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
        assert (stdout, message(stderr).count("\n")) == ("", 1)
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


OLD_FILES = ("parameters.json", "parameters.csv", "posterior.nc", "report.html", "figures/data.npz")
OLD_FILES += tuple(f"figures/{letter}.png" for letter in "abcdefg")


def whole_run(directory: Path, mark: str, resume: bool = False, error: BaseException | None = None) -> None:
    """All file operations of ``fit-params`` without the fit; every file says ``mark``."""
    check_directory(directory)
    with work_in_progress(directory, {"seed": 0}, resume) as partial:
        replace_file(partial / CHAINS, mark)
        text = json.dumps({"mark": mark, "provenance": {"versions": {"capsule-id": "0"}}})
        write_result(dict.fromkeys(OLD_FILES, mark.encode()) | {"parameters.json": text.encode()}, partial)
        if error is not None:
            raise error
        publish(partial, directory)


def mark_of(directory: Path) -> str | None:
    """What all files of a complete result say; None if there is none."""
    if not directory.exists():
        return None
    marks = {(directory / name).read_text() for name in OLD_FILES[1:]}
    marks.add(json.loads((directory / "parameters.json").read_text())["mark"])
    (mark,) = marks
    return mark


def ended_at(moment: int, *words: Any) -> bool:
    """Whether ``whole_run``, killed instead of its ``moment``-th operation on files, has come so far."""
    locks = list[FileLock]()

    def lock(*words: Any, **options: Any) -> FileLock:
        locks.append(FileLock(*words, **options))
        return locks[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output, "FileLock", lock)
        with failing(Killed, moment) as operations, suppress(Killed):
            whole_run(*words)
    for each in locks:  # the operating system releases them
        each.release(force=True)
    return len(operations) > moment


def recovered(directory: Path, ends: str) -> None:
    """What the next run makes of the state that a kill has left: the old or the new result, and nothing else."""
    before = mark_of(directory)
    if ends == "refused":
        with pytest.raises(InputError, match="mend it"):
            whole_run(directory, "newest", error=InputError("a rule", "broken", "mend it"))
        assert mark_of(directory) in ({before} if before else {None, "old", "new"})
        return
    whole_run(directory, "newest", resume=ends == "resumed" and (directory.parent / "out.partial" / STATE).exists())
    assert mark_of(directory) == "newest"
    assert {path.name for path in directory.parent.iterdir()} == {"out"}
    assert len([path for path in directory.rglob("*") if path.is_file()]) == len(OLD_FILES)


@pytest.mark.parametrize("ends", ["anew", "resumed", "refused"])
@pytest.mark.parametrize("old", [True, False])
def test_a_kill_at_any_operation(tmp_path: Path, old: bool, ends: str) -> None:
    """DIR is then the old result, the new one or absent, never incomplete; the next run repairs it."""
    for moment in count():
        directory = tmp_path / str(moment) / "out"
        if old:
            whole_run(directory, "old")
        with suppress(KeyboardInterrupt):
            whole_run(directory, "stopped", error=KeyboardInterrupt())
        killed = ended_at(moment, directory, "new")
        assert mark_of(directory) in ("old", "new", None)
        if old and not directory.exists():
            assert mark_of(directory.parent / "out.partial.old") == "old"
        recovered(directory, ends)
        if old:
            assert directory.exists()
        if not killed:
            break
    assert moment >= (40 if old else 20)


@pytest.mark.full
def test_two_kills_at_any_operations(tmp_path: Path) -> None:
    for first, second in itertools.product(range(0, 50, 6), range(0, 65, 2)):
        directory = tmp_path / f"{first}-{second}" / "out"
        whole_run(directory, "old")
        ended_at(first, directory, "new")
        ended_at(second, directory, "newer")
        recovered(directory, "refused")
        assert directory.exists()
        recovered(directory, "anew")
        shutil.rmtree(directory.parent)


def test_a_full_disk_at_any_operation(tmp_path: Path) -> None:
    """One line names the folder; the old result stays, and the run resumes."""
    refused = 0
    for moment in count():
        directory = tmp_path / str(moment) / "out"
        whole_run(directory, "old")
        text = None
        with failing(partial(OSError, errno.ENOSPC, "No space left on device"), moment, moment + 1) as operations:
            try:
                whole_run(directory, "new")
            except OutputError as error:
                text = str(error)
        assert mark_of(directory) == ("new" if text is None else "old")
        if text is not None:
            refused += 1
            assert text.startswith(str(directory.parent))
            assert "cannot be written: No space left on device; " in text
            assert text.endswith(" MB are left; make space, or choose another folder")
        recovered(directory, "resumed")
        if len(operations) <= moment:
            break
    assert refused >= 15


def test_a_read_only_result_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the fit: it could be moved, but not removed. The tests may run as an administrator, who can."""
    directory, access = tmp_path / "out", os.access
    whole_run(directory, "old")
    for closed in (directory, directory / "figures"):
        with monkeypatch.context() as patch:
            patch.setattr(os, "access", lambda path, mode, closed=closed: Path(path) != closed and access(path, mode))
            with pytest.raises(InputError, match="must be writable"):
                whole_run(directory, "new")
    assert mark_of(directory) == "old"
    shutil.copytree(directory, tmp_path / "out.partial.old")  # an earlier version could not remove it

    def denied(folder: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", folder)

    monkeypatch.setattr(shutil, "rmtree", denied)
    with pytest.raises(InputError, match="Permission denied, move it away"):
        whole_run(directory, "new")
    assert mark_of(directory) == "old"


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


def test_resume_is_promised_where_something_is_saved(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """``test_cli_resume`` holds the other half."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("capsule_id.commands.fit.make_experiments", interrupted)
    assert fit_params(["rig", "--no-sample", "--out", "out"]) == 130
    assert capsys.readouterr().err == "fit-params: interrupted\n"
    assert {path.name for path in here.iterdir()} == {"rig"}


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


@pytest.mark.skipif(os.name != "posix", reason="modes and pipes")
def test_a_replaced_file_keeps_its_mode_and_a_pipe_stays(tmp_path: Path) -> None:
    old, pipe = tmp_path / "old", tmp_path / "pipe"
    old.touch(mode=0o640)
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    replace_file(old, "new")
    replace_file(pipe, "through")
    assert (old.read_text(), old.stat().st_mode & 0o777) == ("new", 0o640)
    assert os.read(reader, 99) == b"through"
    os.close(reader)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old", "pipe"]
