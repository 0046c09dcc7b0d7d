"""``fit-params A B``: results as of single fits, from this process, from threads and from workers that die."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import pytest

from capsule_id.cli import fit_params
from capsule_id.commands import fit as many_rigs
from capsule_id.commands.bifurcate import client_of
from capsule_id.report import write as result_writer
from tests.cli_tools import listing, message, small_rig

TABLES = {"tilts": ("static_friction",), "spring": ("support_spring_soft",)}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    for name, tables in TABLES.items():
        small_rig(tmp_path / name, name, tables)
    yield tmp_path
    # As before: later files of this process are written without Dask.
    assert dask.config.get("scheduler", None) is None


def parameters(directory: Path) -> dict[str, Any]:
    return json.loads((directory / "parameters.json").read_text())["parameters"]


@pytest.mark.full
@pytest.mark.parametrize("scheduler", [(), ("--scheduler", "threads")], ids=["in turn", "threads"])
def test_several_rigs_have_the_results_of_single_fits(
    here: Path, capsys: pytest.CaptureFixture[str], scheduler: tuple[str, ...]
) -> None:
    code = fit_params(["tilts", "spring", "--no-sample", "--quiet", "--out", "all", *scheduler])
    out, err = capsys.readouterr()
    assert sorted(line.split(":")[0] for line in out.splitlines()) == ["spring", "tilts"]
    alone = {name: fit_params([name, "--no-sample", "--quiet", "--out", f"one/{name}"]) for name in TABLES}
    assert code == max(alone.values())
    assert all((f"{name}" in err) == (own == 3) for name, own in alone.items())
    for name in TABLES:
        assert parameters(here / "all" / name) == parameters(here / "one" / name)
        assert (here / "all" / name / "report.html").is_file()
    assert sorted(path.name for path in (here / "all").iterdir()) == sorted(TABLES)


@pytest.mark.full
def test_a_change_of_the_model_stands_below_the_line_of_its_rig(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = property(lambda fit: ["the second fit is quoted"] if fit.rig.name == "tilts" else [])
    monkeypatch.setattr("capsule_id.api.Fit.remarks", changed)
    fit_params(["tilts", "spring", "--no-sample", "--quiet"])
    first, second, third = capsys.readouterr().out.splitlines()
    assert (first.split(":")[0], second, third.split(":")[0]) == ("tilts", "the second fit is quoted", "spring")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("tilts", "none"), "none"),
        (("tilts", "tilts"), "must have different names, tilts, change one name in rig.toml, or name each folder once"),
        (("tilts", "spring", "--out", "old"), "must be none of a result, it holds parameters.json"),
        (("tilts", "spring", "--out", "busy"), "DIR.partial must be unfinished work, it holds notes.txt"),
        (("tilts", "spring", "--resume"), "--resume and --json are for one rig, 2 rigs"),
        (("tilts", "spring", "--json"), "--resume and --json are for one rig, 2 rigs"),
        (("tilts", "spring", "--compare", "lag"), "--compare takes one rig, 2 rigs"),
        (("tilts", "--scheduler", "threads"), "--scheduler is for several rigs, one rig"),
        (("tilts", "--compare", "lag", "--scheduler", "threads"), "remove --scheduler"),
        (("tilts", "spring", "--scheduler", "nowhere:1:2"), "the address of a Dask scheduler"),
        (("tilts", "spring", "--out", "tilts"), "--out"),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(
    here: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], named: str
) -> None:
    for folder, file in (("old", "parameters.json"), ("busy/spring.partial", "notes.txt")):
        (here / folder).mkdir(parents=True)
        (here / folder / file).write_text("kept")
    (here / "tilts" / "spring").mkdir()
    (here / "tilts" / "spring" / "mine.txt").write_text("kept")
    before = listing(here)
    assert fit_params([*words, "--no-sample", "--quiet"] if "--compare" not in words else [*words]) == 2
    assert named in message(capsys.readouterr().err)
    assert listing(here) == before


@pytest.mark.full
@pytest.mark.parametrize("scheduler", [(), ("--scheduler", "threads")], ids=["in turn", "threads"])
def test_a_rig_that_fails_does_not_stop_the_others(
    here: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, scheduler: tuple[str, ...]
) -> None:
    """Standard error holds one line, also of the workers."""
    fit = many_rigs.make_fit

    def written(rig: Any, *rest: Any) -> Any:
        if rig.name == "tilts":
            raise RuntimeError("no finite log-posterior")
        return fit(rig, *rest)

    monkeypatch.setattr(many_rigs, "make_fit", written)
    assert fit_params(["tilts", "spring", "--no-sample", "--quiet", *scheduler]) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert "1 rig not fitted: tilts (RuntimeError: no finite log-posterior; traceback in " in line
    assert [path.name for path in (here / "results").iterdir()] == ["spring"]


@pytest.mark.full
def test_a_result_that_cannot_be_written_does_not_stop_the_others(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_result = result_writer.replace_result

    def full(found: Any, directory: Path, fingerprint: Any) -> None:
        if directory.name == "tilts":
            raise OSError("No space left on device")
        replace_result(found, directory, fingerprint)

    monkeypatch.setattr(result_writer, "replace_result", full)
    assert fit_params(["tilts", "spring", "--no-sample", "--quiet"]) == 1
    assert "1 rig not fitted: tilts (OSError: No space left on device)" in capsys.readouterr().err
    assert (here / "results" / "spring" / "report.html").is_file()


@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize("scheduler", [(), ("--scheduler", "threads")], ids=["in turn", "threads"])
def test_an_interruption_ends_the_study(
    here: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, scheduler: tuple[str, ...]
) -> None:
    def interrupted(*_: Any) -> None:
        signal.raise_signal(signal.SIGINT) if not scheduler else os.kill(os.getpid(), signal.SIGINT)
        raise KeyboardInterrupt

    monkeypatch.setattr(many_rigs, "make_fit", interrupted)
    assert fit_params(["tilts", "spring", "--no-sample", "--quiet", *scheduler]) == 130
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("fit-params: interrupted")


@pytest.mark.slow
def test_a_study_of_many_rigs_survives_the_death_of_a_worker(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of the processes is killed after the first result: each rig has one line and one result.

    (Before: no rig was written by another process, for lack of a lock.)
    """
    names = [f"rig{i}" for i in range(5)]
    for name in names:
        small_rig(here / name, name, TABLES["tilts"])
    with client_of("processes") as client:
        pids = list(client.run(os.getpid).values())
        assert len(pids) >= 2, "with one worker there is nobody to take over"
        replace_result, written = result_writer.replace_result, list[str]()

        def killing(found: Any, directory: Path, fingerprint: Any) -> None:
            if not written:
                os.kill(pids[0], signal.SIGKILL)
            written.append(directory.name)
            replace_result(found, directory, fingerprint)

        monkeypatch.setattr(result_writer, "replace_result", killing)
        fit_params([*names, "--max-steps", "200", "--quiet", "--scheduler", client.scheduler.address])
        assert pids[0] not in client.run(os.getpid).values()
    assert sorted(written) == sorted(names)
    assert sorted(line.split(":")[0] for line in capsys.readouterr().out.splitlines()) == sorted(names)
    first = parameters(here / "results" / names[0])
    assert all(parameters(here / "results" / name) == first for name in names)
