"""Output directories: work in progress lies in ``DIR.partial`` and becomes ``DIR`` by one rename."""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from capsule_id.errors import InputError

#: Everything that a result directory may hold; a directory with anything else in it is not replaced.
CONTENTS = frozenset({"parameters.json", "parameters.csv", "posterior.nc", "report.html", "figures"})
STATE, CHAINS, LOCK = "state.json", "chains.h5", "lock"
#: Further files of an unfinished run.
SCRATCH = frozenset({STATE, "state.new", CHAINS, "chains.saved", "chains.saved-new", LOCK})
PARTIAL, OLD = ".partial", ".partial.old"


def partial_of(directory: Path) -> Path:
    """``DIR.partial`` beside ``DIR``."""
    return directory.with_name(directory.name + PARTIAL)


def check_directory(directory: Path) -> None:
    """Make sure that ``directory`` may be written: absent, empty, or a result of this program.

    Raises
    ------
    InputError
        If it is something else, which is never overwritten.
    """
    rule, remedy = "the output directory must be new or a result of fit-params", "choose another --out"
    if directory.name in ("", "..") or directory.name.endswith((PARTIAL, OLD)):
        named = f"the output directory must have a name, which must not end in {PARTIAL} or {OLD}"
        raise InputError(named, f"'{directory}'", remedy)
    try:
        if directory.is_symlink() or (directory.exists() and not directory.is_dir()):
            raise InputError(rule, "it is a file or a link", remedy, directory)
        _check_parents(directory, remedy)
        names = {entry.name for entry in directory.iterdir()} if directory.exists() else set()
    except OSError as error:
        raise InputError("the output directory must be usable", str(error.strerror), remedy, directory) from None
    if names and not _is_result(directory):
        foreign = sorted(names - CONTENTS - SCRATCH)
        raise InputError(rule, f"it holds {foreign[0]}" if foreign else "it is not one", remedy, directory)


def _check_parents(directory: Path, remedy: str) -> None:
    for parent in directory.parents:
        if parent.exists():
            if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
                raise InputError("the output directory must be writable", f"{parent} is not", remedy, directory)
            return


def _is_result(directory: Path) -> bool:
    """This program wrote everything in ``directory``."""
    if not {entry.name for entry in directory.iterdir()} <= CONTENTS | SCRATCH:
        return False
    try:
        text = (directory / "parameters.json").read_text(encoding="utf-8")
        return "capsule-id" in json.loads(text)["provenance"]["versions"]
    except (OSError, ValueError, KeyError, TypeError):
        return False


@contextmanager
def work_in_progress(directory: Path, fingerprint: Mapping[str, object], resume: bool) -> Iterator[Path]:
    """``DIR.partial``, made or taken up, and locked until the block ends.

    An interrupted block leaves it for ``--resume``; one that ends in an ``InputError`` leaves nothing behind that it
    has made.

    Parameters
    ----------
    fingerprint : what the result depends on; a run is taken up only by one with the same
    resume : go on from the saved state

    Raises
    ------
    InputError
        If there is nothing to take up, the saved state belongs to other data, seed or versions, another run is at work
        in it, or something else stands in its place.
    """
    partial = partial_of(directory)
    try:
        _check_partial(partial, resume)
        _check_old(directory)
        made = [path for path in (partial, *partial.parents) if not path.exists()]
        partial.mkdir(parents=True, exist_ok=True)
        lock = os.open(partial / LOCK, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        rule, remedy = "the output directory must be writable", "choose another --out"
        raise InputError(rule, str(error.strerror), remedy, partial) from None
    try:
        _lock(lock, partial)
        _recover(directory)
        if resume:
            _check_fingerprint(partial, fingerprint)
        else:
            _clear(partial)
        _write_state(partial, fingerprint)
        yield partial
    except InputError:
        if made:
            shutil.rmtree(made[0], ignore_errors=True)
            for path in made[1:]:
                path.rmdir()
        raise
    finally:
        os.close(lock)


def _check_partial(partial: Path, resume: bool) -> None:
    """Absent, or an unfinished run of this program."""
    if resume and not partial.exists():
        raise InputError("--resume takes up an interrupted run", "there is none", "run without --resume", partial)
    rule, remedy = "work in progress stands here", "move it away or choose another --out"
    if partial.is_symlink() or (partial.exists() and not partial.is_dir()):
        raise InputError(rule, "it is a file or a link", remedy, partial)
    names = {entry.name for entry in partial.iterdir()} if partial.exists() else set()
    foreign = sorted(names - CONTENTS - SCRATCH)
    if foreign or (names and not names & SCRATCH):
        raise InputError(rule, f"it holds {(foreign or sorted(names))[0]}", remedy, partial)


def _lock(lock: int, partial: Path) -> None:
    """Take the lock, which ends with this process however it ends."""
    rule, remedy = "one run at a time works on a directory", "wait, or choose another --out"
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(rule, "another one does", remedy, partial) from None
    except OSError:
        return  # a file system without locks
    try:
        same = os.path.samestat(os.fstat(lock), (partial / LOCK).stat())
    except FileNotFoundError:
        same = False
    if not same:
        raise InputError(rule, "another one has just finished", remedy, partial)


def _check_old(directory: Path) -> None:
    """``DIR.partial.old``, where an older result stands for the moment of its replacement, is free or holds one."""
    old = directory.with_name(directory.name + OLD)
    if old.is_symlink() or (old.exists() and not (old.is_dir() and _is_result(old))):
        raise InputError("a replaced result stands here", "it is something else", "move it away", old)


def _recover(directory: Path) -> None:
    """Put back, or away, the older result of a run that died while it was being replaced."""
    old = directory.with_name(directory.name + OLD)
    if old.exists() and directory.exists():
        shutil.rmtree(old)
    elif old.exists():
        old.rename(directory)


def _clear(partial: Path) -> None:
    for path in partial.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


def _check_fingerprint(partial: Path, fingerprint: Mapping[str, object]) -> None:
    remedy = "run without --resume"
    try:
        saved = json.loads((partial / STATE).read_text(encoding="utf-8"))["fingerprint"]
        saved = {key: saved[key] for key in fingerprint}
    except (OSError, ValueError, KeyError, TypeError):
        rule = "--resume needs the state that the interrupted run saved"
        raise InputError(rule, "it is missing or damaged", remedy, partial / STATE) from None
    for key, value in fingerprint.items():
        if saved[key] != json.loads(json.dumps(value)):
            rule = f"--resume needs the same {key} as the interrupted run"
            raise InputError(rule, f"{key} changed", remedy, partial)


def _write_state(partial: Path, fingerprint: Mapping[str, object]) -> None:
    new = partial / "state.new"
    new.write_text(json.dumps({"fingerprint": dict(fingerprint)}, indent=1), encoding="utf-8")
    new.replace(partial / STATE)


def publish(partial: Path, directory: Path) -> None:
    """Rename the finished ``partial`` to ``directory``; an older result there is replaced.

    What the run kept for itself is removed afterwards, so that it can be taken up until the rename.
    """
    old = directory.with_name(directory.name + OLD)
    if directory.exists():
        directory.rename(old)
    partial.rename(directory)
    for name in SCRATCH:
        (directory / name).unlink(missing_ok=True)
    shutil.rmtree(old, ignore_errors=True)
