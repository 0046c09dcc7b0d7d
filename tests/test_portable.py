"""Windows and macOS: no module or function of Unix alone; every text file states its encoding and its line ends."""

import ast
import tomllib
from pathlib import Path

import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from tests import matrix
from tests.cli_tools import ROOT, run, small_rig

#: Modules that Windows does not have, with those that filelock does not replace.
UNIX_MODULES = frozenset({"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"})
UNIX_NAMES = frozenset(
    {"SIGALRM", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGUSR1", "SIGUSR2", "alarm", "chown", "fork", "forkpty"}
    | {"geteuid", "getpgid", "getuid", "killpg", "mkfifo", "pthread_kill", "sched_getaffinity", "setsid", "uname"}
)


def faults_of(text: str) -> list[str]:
    """What a module does that only Unix does, or that depends on the encoding or line ends of the machine."""
    faults = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [each.name for each in node.names]
            faults += [f"{node.lineno}: import {name}" for name in names if name.partition(".")[0] in UNIX_MODULES]
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("os", "signal"):
            faults += [f"{node.lineno}: {node.attr}"] if node.attr in UNIX_NAMES else []
        if isinstance(node, ast.Call):
            faults += [f"{node.lineno}: {fault}" for fault in _faults_of_call(node)]
    return faults


def _faults_of_call(call: ast.Call) -> list[str]:
    """Missing keywords of a call that opens a text file."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    method = isinstance(call.func, ast.Attribute)
    stated = {keyword.arg for keyword in call.keywords}
    words = [
        node.value
        for node in (*call.args, *(keyword.value for keyword in call.keywords))
        if isinstance(node, ast.Constant)
    ]
    modes = [word for word in words if isinstance(word, str) and set(word) <= set("rwaxbt+") and word]
    needed: set[str] = set()
    if name == "read_text" and method:
        needed = {"encoding"}
    elif name == "write_text" and method:
        needed = {"encoding", "newline"}
    elif name == "to_csv":
        needed = {"lineterminator"}
    elif "force_zip64" in stated:
        needed = set()  # a member of an archive holds bytes
    elif name == "NamedTemporaryFile" or (name == "open" and (not method or modes)):
        writes = any(set("wax+") & set(mode) for mode in modes)
        needed = (
            set()
            if any("b" in mode for mode in modes)
            else {"encoding"} | ({"newline"} if writes and name == "open" and method else set())
        )
    return [f"{name} without {keyword}" for keyword in sorted(needed - stated)]


def test_the_package_needs_nothing_of_one_system() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{fault}"
        for path in sorted((ROOT / "capsule_id").rglob("*.py"))
        for fault in faults_of(path.read_text(encoding="utf-8"))
    ]
    assert found == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("import fcntl", "1: import fcntl"),
        ("import signal\nsignal.SIGHUP", "2: SIGHUP"),
        ("path.read_text()", "1: read_text without encoding"),
        ('path.write_text("a", encoding="utf-8")', "1: write_text without newline"),
        ('open(path, "w", newline="")', "1: open without encoding"),
        ('path.open("r")', "1: open without encoding"),
        ('path.open("w", encoding="utf-8")', "1: open without newline"),
        ("table.to_csv(path)", "1: to_csv without lineterminator"),
    ],
)
def test_the_search_finds_what_it_looks_for(text: str, fault: str) -> None:
    """Negative control."""
    assert faults_of(text) == [fault]


@pytest.mark.full
def test_a_fit_without_the_modules_of_unix(tmp_path: Path) -> None:
    small_rig(tmp_path / "rig")
    before = "import os, signal, sys\n"
    before += f"sys.modules.update(dict.fromkeys({sorted(UNIX_MODULES - {'posix'})}))\n"
    before += "del os.fork, signal.SIGHUP, signal.SIGKILL\n"
    done = run("rig", "--no-sample", "--quiet", "--out", "out", cwd=tmp_path, before=before)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"rig", "out"}
    assert b"\r\n" not in (tmp_path / "out" / "parameters.csv").read_bytes()


@pytest.mark.parametrize("name", ["nul", "COM1", "aux.twin"])
def test_names_that_windows_refuses(tmp_path: Path, name: str) -> None:
    small_rig(tmp_path / "rig", name=name)
    with pytest.raises(InputError, match=r"rig\.toml:2:8: name must not be the name of a device of Windows") as caught:
        read_rig(tmp_path / "rig")
    text = (tmp_path / "rig" / "rig.toml").read_text(encoding="utf-8")
    (tmp_path / "rig" / "rig.toml").write_text(text.replace(f'"{name}"', str(caught.value).rsplit(" ", 1)[1]))
    assert read_rig(tmp_path / "rig").name == name.split(".")[0] + "-1"


def test_the_matrix_pins_every_lower_bound_and_names_missing_interpreters() -> None:
    assert matrix.lowest(["jax>=0.7.2,<0.13", "pyright[nodejs]>=1.1", "capsule-id[formats]"]) == [
        "jax==0.7.2",
        "pyright==1.1",
    ]
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    assert len(matrix.lowest(needed)) == len(needed)
    assert matrix.interpreter("2.0") is None
