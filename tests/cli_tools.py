"""Runs commands as a user does, in a separate process or in this one."""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import xarray as xr

import capsule_id
from capsule_id import cli

ROOT = Path(capsule_id.__file__).resolve().parents[1]
DATA = ROOT / "data"
#: Ctrl-C reaches the command even where the tests themselves run in the background of a shell.
CODE = """\
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from capsule_id.cli import {name}
sys.exit({name}())
"""


def argv(*words: str, name: str = "fit_params", before: str = "") -> list[str]:
    """The command line of a command of this checkout; ``before`` is Python code that runs first."""
    return [sys.executable, "-c", before + CODE.format(name=name), *words]


def peak_memory(command: list[str], what: str) -> float:
    """Run a command; its peak memory, MB, which is printed with its time."""
    code = f"import resource, subprocess\nsubprocess.run({command!r}, check=True)\n"
    code += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment())
    kilobytes = float(done.stdout.split()[-1]) / (1.0 if sys.platform == "linux" else 1024.0)
    print(f"{what}: {time.perf_counter() - begin:.1f} s, {kilobytes / 1e3:.0f} MB")
    return kilobytes / 1e3


def environment(**changes: str | None) -> dict[str, str]:
    """The environment of this process with this checkout first, and ``changes``; None removes a variable."""
    merged = {**os.environ, "PYTHONPATH": str(ROOT), **changes}
    return {name: value for name, value in merged.items() if value is not None}


def run(
    *words: str, cwd: Path, name: str = "fit_params", before: str = "", env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        argv(*words, name=name, before=before),
        cwd=cwd,
        env=env or environment(),
        capture_output=True,
        text=True,
        timeout=300,
        stdin=subprocess.DEVNULL,
        check=False,
    )


def message(err: str) -> str:
    """The printed errors, of three lines each, as their messages: ``place: rule, value, remedy``; other lines as they are."""
    form = r"(?m)^(.+: )?found: (.*)\n  rule: (.*)\n  to do: (.*)$"
    return re.sub(form, lambda part: f"{part[1] or ''}{part[3]}, {part[2]}, {part[4]}", err)


def parsers() -> list[argparse.ArgumentParser]:
    """The parsers of both commands, and those of the subcommands."""
    capsule = cli._capsule_parser("capsule-id")
    (commands,) = (action for action in capsule._actions if isinstance(action, argparse._SubParsersAction))
    return [cli._fit_parser("fit-params"), capsule, *commands.choices.values()]


def small_rig(folder: Path, name: str = "small", tables: tuple[str, ...] = ("static_friction",)) -> Path:
    """A rig of one or two small tables of ``data/``, quick to fit; its folder."""
    folder.mkdir(parents=True)
    lines = ["[rig]", f'name = "{name}"']
    for table in tables:
        kind = "support_spring" if table.startswith("support_spring") else table
        lines += ["[[experiment]]", f'kind = "{kind}"', f'file = "{table}.csv"']
        lines += ['spring = "soft"'] if kind == "support_spring" else []
        shutil.copy(DATA / f"{table}.csv", folder)
    (folder / "rig.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


class Killed(BaseException):
    """Simulates a kill: no handler catches it."""


_fault: list[Callable[[str, tuple[Any, ...]], None]] = []
#: Operations on files that change the disk, as Python reports them.
_CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.symlink", "os.link"}


def _audit(event: str, details: tuple[Any, ...]) -> None:
    if _fault:
        _fault[0](event, details)


sys.addaudithook(_audit)


@contextmanager
def failing(error: Callable[[], BaseException], first: int, end: int | None = None) -> Iterator[list[str]]:
    """Raise ``error`` instead of the operations on files from number ``first`` on, before number ``end``.

    Yields the list of the operations: every opened file, renaming, removal, new folder.
    """
    operations = list[str]()

    def fault(event: str, details: tuple[Any, ...]) -> None:
        opened = event == "open" and bool(details[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        if (opened or event in _CHANGES) and isinstance(details[0], str | Path) and details[0] != os.devnull:
            operations.append(f"{event} {details[0]}")
            if first < len(operations) and (end is None or len(operations) <= end):
                raise error()

    _fault.append(fault)
    try:
        yield operations
    finally:
        _fault.clear()


def same_result(one: Path, other: Path) -> None:
    """Assert that two results have the same numbers, to the last bit."""
    for name in ("parameters.json", "parameters.csv"):
        assert (one / name).read_bytes() == (other / name).read_bytes()
    trees = [xr.open_datatree(folder / "posterior.nc", engine="h5netcdf") for folder in (one, other)]
    assert trees[0].identical(trees[1])
    for tree in trees:
        tree.close()


def listing(folder: Path) -> dict[str, bytes]:
    """All files below ``folder`` with their content."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"-"
        for path in sorted(folder.rglob("*"))
    }
