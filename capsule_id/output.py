"""Where results go: work in progress stands in ``DIR.partial`` and becomes ``DIR`` by one rename."""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from capsule_id.errors import InputError
from capsule_id.inference.result import Result
from capsule_id.report.write import write_result

#: Everything that a result directory may hold; a directory with anything else in it is not replaced.
CONTENTS = frozenset({"parameters.json", "parameters.csv", "posterior.nc", "report.html", "figures"})
STATE, CHAINS = "state.json", "chains.h5"


def partial_of(directory: Path) -> Path:
    """``DIR.partial`` beside ``DIR``."""
    return directory.with_name(directory.name + ".partial")


def check_directory(directory: Path) -> None:
    """Make sure that ``directory`` may be written: absent, empty, or a result of this program.

    Raises
    ------
    InputError
        If it is something else, which is never overwritten.
    """
    rule, remedy = "the output directory must be new or a result of fit-params", "choose another --out"
    if directory.is_symlink() or (directory.exists() and not directory.is_dir()):
        raise InputError(rule, "it is a file or a link", remedy, directory)
    for parent in directory.parents:
        if parent.exists():
            if not parent.is_dir() or not os.access(parent, os.W_OK):
                raise InputError("the output directory must be writable", f"{parent} is not", remedy, directory)
            break
    if not directory.exists():
        return
    names = {entry.name for entry in directory.iterdir()}
    if names and not ("parameters.json" in names and names <= CONTENTS and _is_ours(directory / "parameters.json")):
        foreign = sorted(names - CONTENTS)
        raise InputError(rule, f"it holds {foreign[0]}" if foreign else "it is not one", remedy, directory)


def _is_ours(path: Path) -> bool:
    try:
        return "capsule-id" in json.loads(path.read_text(encoding="utf-8"))["provenance"]["versions"]
    except (OSError, ValueError, KeyError, TypeError):
        return False


def open_partial(directory: Path, fingerprint: Mapping[str, object], resume: bool) -> Path:
    """Make ``DIR.partial``, or take up the one of an interrupted run; returns its path.

    Parameters
    ----------
    fingerprint : what the result depends on; a run is resumed only by one with the same
    resume : go on from the saved state

    Raises
    ------
    InputError
        If there is nothing to resume, the saved state belongs to other data, seed or versions, or another run is at
        work in it.
    """
    partial = partial_of(directory)
    state = _read_state(partial)
    if partial.exists() and state is None:
        raise InputError("work in progress stands here", "it holds something else", "move it away", partial)
    if state is not None and _alive(state.get("pid")):
        raise InputError("one run at a time works on a directory", f"process {state['pid']} does", "wait", partial)
    if resume:
        if state is None:
            raise InputError("--resume takes up an interrupted run", "there is none", "run without --resume", partial)
        for key, value in fingerprint.items():
            if state["fingerprint"].get(key) != json.loads(json.dumps(value)):
                rule, remedy = f"--resume needs the same {key} as the interrupted run", "run without --resume"
                raise InputError(rule, "it has changed", remedy, partial)
    elif partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True, exist_ok=True)
    saved = {"program": "capsule-id", "pid": os.getpid(), "fingerprint": dict(fingerprint)}
    (partial / STATE).write_text(json.dumps(saved, indent=1), encoding="utf-8")
    return partial


def _read_state(partial: Path) -> dict | None:
    try:
        state = json.loads((partial / STATE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return state if isinstance(state, dict) and state.get("program") == "capsule-id" else None


def _alive(pid: object) -> bool:
    """Another process of that number runs."""
    if not isinstance(pid, int) or pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def publish(result: Result, directory: Path) -> None:
    """Write ``result`` into ``DIR.partial`` and rename it to ``DIR``; an older result there is replaced."""
    partial = partial_of(directory)
    write_result(result, partial)
    for name in (CHAINS, STATE):
        (partial / name).unlink(missing_ok=True)
    old = directory.with_name(directory.name + ".partial.old")
    if directory.exists():
        directory.rename(old)
    partial.rename(directory)
    shutil.rmtree(old, ignore_errors=True)
