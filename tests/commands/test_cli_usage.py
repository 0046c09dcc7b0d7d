"""Exit codes and standard error of both commands, without a fit."""

import argparse
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

from capsule_id import cli, console
from capsule_id.cli import capsule_id, fit_params
from capsule_id.views import Level, Trust
from tests.cli_tools import DATA, argv, environment, listing, message, parsers, run, small_rig

HEAVY = ("jax", "matplotlib", "pandas", "emcee", "equinox", "optimistix", "xarray")


def refused(capsys: pytest.CaptureFixture[str], *words: str, program: str = "fit_params") -> str:
    """The one message with which a command refuses ``words``."""
    code = {"fit_params": fit_params, "capsule_id": capsule_id}[program](words)
    out, err = capsys.readouterr()
    err = message(err)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    return err


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("fit_params", ()),
        ("capsule_id", ()),
        *(("capsule_id", (sub,)) for sub in ("init", "check", "synthesize", "report")),
    ],
)
def test_help_is_quick_and_light(tmp_path: Path, name: str, words: tuple[str, ...]) -> None:
    report = "import atexit, sys\natexit.register(lambda: print('loaded', *sys.modules, file=sys.stderr))\n"
    done = run(*words, "--help", cwd=tmp_path, name=name, before=report)
    assert done.returncode == 0
    assert done.stdout.startswith("usage: " + name.replace("_", "-"))
    (loaded,) = done.stderr.splitlines()
    assert not set(loaded.split()) & set(HEAVY)
    assert list(tmp_path.iterdir()) == []


def test_a_check_of_bench_tests_loads_what_it_needs(tmp_path: Path) -> None:
    """No pandas, no figures, no sampler: they take as long as the check itself."""
    report = "import atexit, sys\natexit.register(lambda: print('loaded', *sys.modules, file=sys.stderr))\n"
    rig = small_rig(tmp_path / "rig", tables=("static_friction", "motor_current"))
    done = run("check", str(rig), cwd=tmp_path, name="capsule_id", before=report)
    assert done.returncode == 0
    assert not set(done.stderr.split()) & set(HEAVY) - {"jax", "equinox"}


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((), "DATA"),
        (("a", "b"), "a"),
        (("a", "--colour"), "--colour"),
        (("a", "--seed", "x"), "--seed"),
        (("a", "--seed", "1.5"), "--seed"),
        (("a", "--seed", "-1"), "-1"),
        (("a", "--seed", ""), "--seed"),
        (("a", "--max-steps", "0"), "--max-steps"),
        (("a", "--ess", "0"), "--ess"),
        ((str(DATA), "--compare", "lag", "--json", "--out", "x"), "remove --out, --json"),
        ((str(DATA), "--compare", "lag", "--json", "--resume"), "remove --json, --resume"),
        ((str(DATA), "--compare", "lag", "--experiments", "bench", "--ess", "9"), "remove --experiments, --ess"),
        ((str(DATA), "--compare", "lag", "--max-steps", "9"), "remove --max-steps"),
        (("a", "--experiments", "some"), "bench"),
        (("a", "--out"), "--out"),
        ((str(DATA), "two\nlines"), "two lines"),
    ],
)
def test_wrong_usage_is_one_message(capsys: pytest.CaptureFixture[str], words: tuple[str, ...], named: str) -> None:
    assert named in refused(capsys, *words)


@pytest.mark.parametrize(
    "words", [("fit", "--seed"), ("init",), ("check", "a", "b"), ("synthesize", "a", "--seed", "x")]
)
def test_wrong_usage_of_the_second_command(capsys: pytest.CaptureFixture[str], words: tuple[str, ...]) -> None:
    assert "--help" in refused(capsys, *words, program="capsule_id")


@pytest.mark.parametrize(
    ("program", "words", "meant"),
    [
        ("capsule_id", ("chekc", "rig"), "check"),
        ("capsule_id", ("synthesise", "rig"), "synthesize"),
        ("capsule_id", ("fit", "rig", "--experiments", "banch"), "bench"),
        ("fit_params", ("rig", "--experiments", "run"), "runs"),
        ("capsule_id", ("zzz",), None),
    ],
)
def test_a_mistyped_word_is_answered_with_the_meant_one(
    capsys: pytest.CaptureFixture[str], program: str, words: tuple[str, ...], meant: str | None
) -> None:
    line = refused(capsys, *words, program=program)
    assert ("did you mean" in line) == (meant is not None)
    assert meant is None or f"; did you mean {meant}?; see " in line


def test_every_help_has_an_example_that_parses() -> None:
    for parser in parsers():
        example = parser.format_help().partition("example: ")[2].partition(";")[0]
        program, *words = shlex.split(example)
        whole = {"fit-params": cli._fit_parser, "capsule-id": cli._capsule_parser}[program](program)
        assert example.startswith(parser.prog)
        assert example.startswith(whole.parse_args(words).program)


@pytest.mark.parametrize(
    ("program", "words"), [("fit_params", ()), ("capsule_id", ("fit",)), ("capsule_id", ("check",))]
)
def test_the_working_folder_is_the_default_rig(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    program: str,
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, *words, program=program)
    assert line.startswith(
        "DATA must be a rig folder, none is named, and the working folder has no rig.toml, name a rig"
    )
    monkeypatch.chdir(small_rig(tmp_path / "rig", name="here"))
    if words == ("check",):
        assert capsule_id(words) == 0
        assert capsys.readouterr().out.startswith("here: 1 experiment")
    else:  # it reads the folder
        assert "--experiments runs" in refused(capsys, *words, "--experiments", "runs", program=program)


def test_capsule_id_fit_is_fit_params(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = str(small_rig(tmp_path / "rig"))
    capsule, alone = cli._capsule_parser("capsule-id"), cli._fit_parser("fit-params")
    (commands,) = (action for action in capsule._actions if isinstance(action, argparse._SubParsersAction))
    options = [{*parser._option_string_actions} - {"--version"} for parser in (commands.choices["fit"], alone)]
    assert options[0] == options[1]
    said = []
    for call, words in ((fit_params, ()), (capsule_id, ("fit",))):
        assert call([*words, rig, "--no-sample", "--quiet", "--out", str(tmp_path / call.__name__)]) == 0
        said.append(capsys.readouterr().out.replace(f"/{call.__name__}/", "/"))
    assert said[0] == said[1]
    one, other = (tmp_path / name / "parameters.json" for name in ("fit_params", "capsule_id"))
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize(
    ("terminal", "NO_COLOR", "TERM", "coloured"),
    [(True, "", "xterm", True), (True, "1", "xterm", False), (True, "", "dumb", False), (False, "", "xterm", False)],
)
def test_colours_on_a_terminal_alone(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    terminal: bool, NO_COLOR: str, TERM: str, coloured: bool,
) -> None:  # fmt: skip
    """Without colours the text is the same; a text of a file brings none of its own."""
    monkeypatch.setenv("NO_COLOR", NO_COLOR)
    monkeypatch.setenv("TERM", TERM)
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal, raising=False)
    text = "k1  1422 ± 3  not trusted\nwarn: a\x1b[1m check is ok\nverdict: trusted"
    console.say(text, coloured=True)
    out = capsys.readouterr().out
    assert ("\x1b[31mnot trusted\x1b[0m" in out, "\x1b[33mwarn\x1b[0m:" in out, "\x1b[32mtrusted" in out) == (
        coloured,
    ) * 3
    assert re.sub(r"\x1b\[\d*m", "", out) == text.replace("\x1b", "\\u001b") + "\n"
    console.say(text)
    assert "\x1b" not in capsys.readouterr().out
    assert {*console._COLOURS} == {*get_args(Level), *get_args(Trust)}


def test_report_puts_results_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One unit a row, differences in sd, the verdict of each, and a word about readings that both have."""
    folders = [tmp_path / name for name in ("one", "two", "three")]
    fit_params([str(small_rig(tmp_path / "rig")), "--no-sample", "--quiet", "--out", str(folders[0])])
    text = (folders[0] / "parameters.json").read_text(encoding="utf-8")
    saved = json.loads(text)
    mu = saved["parameters"]["mu"]
    # The table of one result comes with the errors that its sds leave out. Before: without.
    capsys.readouterr()
    capsule_id(["report", str(folders[0])])
    (left_out,) = saved["not_in_sd"]
    assert left_out in capsys.readouterr().out
    for folder, moved, name in ((folders[1], 5.0, "mu"), (folders[2], 0.5, "v_s")):
        folder.mkdir()
        changed = {**mu, "value": mu["value"] + moved * math.sqrt(2.0) * mu["sd"], "trust": "not trusted"}
        other = {**saved, "parameters": {name: changed}, "provenance": {"files": {"other.csv": folder.name}}}
        (folder / "parameters.json").write_text(json.dumps(other), encoding="utf-8")
    capsys.readouterr()
    assert capsule_id(["report", *map(str, folders)]) == 0
    head, _, first, second, *rest = capsys.readouterr().out.splitlines()
    assert head.split() == ["unit", "A", "B", "C", "B", "−", "A,", "sd", "C", "−", "A,", "sd"]
    assert re.fullmatch(r"mu +1 +0\.\d+ ± 0\.\d+ \(not judged\) +0\.\d+ ± 0\.\d+ \(not trusted\) +– +\+5\.0 +–", first)
    assert re.fullmatch(r"v_s +1 +– +– +0\.\d+ ± 0\.\d+ \(not trusted\) +– +–", second)
    assert rest[:2] == ["B differs from A in mu", "C differs from A in no parameter with a number in both"]
    assert "shares" not in "".join(rest)
    capsule_id(["report", str(folders[0]), str(folders[0])])
    assert "it shares 2 files with A" in " ".join(capsys.readouterr().out.split())
    assert "--json is for one result" in refused(capsys, "report", "a", "b", "--json", program="capsule_id")
    assert "run fit-params first" in refused(capsys, "report", str(folders[0]), "b", program="capsule_id")


def test_synthesize_refuses_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "full" / "of").mkdir(parents=True)
    before = listing(tmp_path)
    for words, named in (
        (("rig", "--set", "k1"), "NAME=VALUE"),
        (("rig", "--set", "k1=x"), "number"),
        (("rig", "--set", "k3=1"), "k3"),
        (("rig", "--set", "k1=-1"), "positive"),
        (("rig", "--set", "k1=nan"), "positive"),
        (("rig", "--name", "a b"), "a b"),
        (("a b",), "--name"),
        (("rig", "--seed", "-1"), "--seed"),
        (("file",), "file"),
        (("file/below",), "file"),
        (("full",), "full"),
    ):
        assert named in refused(capsys, "synthesize", *words, program="capsule_id")
        assert listing(tmp_path) == before


def test_data_that_is_no_rig(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    small_rig(tmp_path / "rig")
    (tmp_path / "empty").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    before = listing(tmp_path)
    for data in (
        "rig/static_friction.csv",
        "missing",
        "empty",
        "loop",
        "",
        "a\0b",
        "x" * 5000,
        "rig/x",
    ):
        line = refused(capsys, data)
        assert line.count(", ") >= 2  # rule, value, remedy
        assert listing(tmp_path) == before


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "../a", "a b", "a\\nb", "é", "a\u0000"])
def test_a_rig_name_that_is_no_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    small_rig(tmp_path / "rig", name=name)
    before = listing(tmp_path)
    assert "rig.toml:2" in refused(capsys, "rig")
    assert listing(tmp_path) == before


@pytest.mark.parametrize("name", ["a.partial", "a.partial.old"])
def test_a_rig_name_that_work_in_progress_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    small_rig(tmp_path / "rig", name=name)
    assert "must not end in .partial" in refused(capsys, "rig")


def test_experiments_that_are_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    small_rig(tmp_path / "rig")
    before = listing(tmp_path)
    assert "--experiments runs" in refused(capsys, "rig", "--experiments", "runs")
    assert listing(tmp_path) == before


def test_an_internal_failure_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*given: object) -> None:
        raise ZeroDivisionError("first line\nsecond line")

    monkeypatch.setattr("capsule_id.commands.check.read_rig", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert capsule_id(["check", "rig"]) == 1
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "ZeroDivisionError: first line second line" in line
    (saved,) = tmp_path.iterdir()
    assert str(saved) in line
    assert saved.read_text().startswith("Traceback")

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    assert capsule_id(["check", "rig"]) == 1
    line = capsys.readouterr().err
    assert (line.count("\n"), "could not be saved" in line) == (1, True)


@pytest.mark.full
def test_commands_in_a_bare_surrounding(tmp_path: Path) -> None:
    """No HOME, no locale, closed standard streams: the exit code is right and no traceback appears."""
    small_rig(tmp_path / "rig ü")
    bare = environment(HOME=None, LC_ALL="C", LANG=None, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    done = run("check", "rig ü", cwd=tmp_path, name="capsule_id", env=bare)
    assert (done.returncode, done.stderr) == (0, "")
    closed = " ".join(map(_quoted, argv("check", "rig ü", name="capsule_id")))
    for redirection, code in (("<&-", 0), (">&-", 0), ("2>&-", 0), ("<&- >&- 2>&-", 0)):
        shell = subprocess.run(
            ["/bin/sh", "-c", f"{closed} {redirection}"],
            cwd=tmp_path,
            env=environment(),
            capture_output=True,
            check=False,
        )
        assert (shell.returncode, shell.stderr) == (code, b"")
    missing = subprocess.run(
        ["/bin/sh", "-c", f"{' '.join(map(_quoted, argv('missing')))} 2>&-"],
        cwd=tmp_path, env=environment(), capture_output=True, check=False,
    )  # fmt: skip
    assert (missing.returncode, missing.stdout) == (2, b"")


@pytest.mark.full
def test_a_reader_that_leaves_is_no_failure(tmp_path: Path) -> None:
    for words in (("check", str(DATA)), ("--help",)):
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run(
            argv(*words, name="capsule_id"),
            env=environment(), stdout=writer, stderr=subprocess.PIPE, check=False, cwd=tmp_path,
        )  # fmt: skip
        os.close(writer)
        assert (done.returncode, done.stderr) == (0, b"")


def test_entry_points_are_installed() -> None:
    for name in ("fit-params", "capsule-id"):
        assert shutil.which(name, path=str(Path(sys.executable).parent))


def _quoted(word: str) -> str:
    return "'" + word.replace("'", "'\\''") + "'"


def test_a_warning_is_shown_as_one_line(tmp_path: Path) -> None:
    """Numerical warnings reach the user; deprecations of the libraries do not."""
    before = """\
import warnings
from capsule_id.commands import check
def act(args):
    warnings.warn("overflow\\nencountered", RuntimeWarning)
    warnings.warn_explicit("old", DeprecationWarning, "lib.py", 1, module="lib")
    return 0
check.run = act
"""
    done = run("check", str(DATA), cwd=tmp_path, name="capsule_id", before=before)
    assert (done.returncode, done.stdout) == (0, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("capsule-id: warning: RuntimeWarning: overflow encountered (")


@pytest.mark.full
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is always full")
@pytest.mark.parametrize("words", [("check", str(DATA)), ("init", "rig")])
def test_a_full_disk_behind_standard_output_is_one_line(tmp_path: Path, words: tuple[str, ...]) -> None:
    """Before: an internal failure with a traceback."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            argv(*words, name="capsule_id"), cwd=tmp_path, env=environment(), stdout=full, stderr=subprocess.PIPE,
            text=True, timeout=120, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert (
        done.stderr == "capsule-id: standard output cannot be written: No space left on device; direct it elsewhere\n"
    )
    assert (tmp_path / "rig").is_dir() == (words[0] == "init")  # what was asked for is done
