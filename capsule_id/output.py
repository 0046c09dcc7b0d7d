"""Files and directories of results: an unfinished result is ``DIR.partial``; one rename makes it ``DIR``."""

import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from filelock import FileLock, Timeout

from capsule_id.errors import InputError, refusing, writing

#: Files of a result directory. A directory with another file is never replaced.
RESULT_FILES = frozenset({"parameters.json", "parameters.csv", "posterior.nc", "report.html", "figures"})
STATE, CHAINS, NEW = "state.json", "chains.saved", ".new"
#: Additional files of an unfinished run.
WORK_FILES = frozenset({STATE, STATE + NEW, CHAINS, CHAINS + NEW, "chains.h5"})  # the last: of versions before
#: The lock stands beside ``DIR.partial``: Windows renames no directory with an open file.
PARTIAL, OLD, LOCK = ".partial", ".partial.old", ".partial.lock"
_writable = partial(refusing, "the output directory must be writable", "choose another --out")
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP)  # a file system without locks


def as_utf8(text: str) -> bytes:
    """A text for a file. Names of files that are no text, as the operating system allows them, show question marks."""
    return text.encode("utf-8", "replace")


def write_file(path: Path, content: bytes | str, needed: int = 0) -> None:
    """Write a file, text as UTF-8.

    needed : bytes that are still to be written with this file, where there are more

    Raises
    ------
    OutputError
        If the operating system refuses.
    """
    content = content if isinstance(content, bytes) else as_utf8(content)
    with writing(path, max(needed, len(content))):
        path.write_bytes(content)


def replace_file(path: Path, content: bytes | str, needed: int = 0) -> None:
    """Write a file beside ``path`` and rename it: whenever the process ends, the old or the new one is complete.

    Raises
    ------
    OutputError
        As ``write_file``.
    """
    replace_files({path: content}, needed)


def replace_files(contents: Mapping[Path, bytes | str], needed: int = 0) -> None:
    """As ``replace_file``; no file is renamed before all are written. A pipe or a device is written into."""
    files = [Path(os.path.realpath(path)) for path in contents]  # a link stays
    new = [path if path.exists() and not path.is_file() else path.with_name(path.name + NEW) for path in files]
    try:
        for path, file, content in zip(new, files, contents.values(), strict=True):
            write_file(path, content, needed)
            with suppress(OSError):  # a new file has no older mode
                shutil.copymode(file, path)
        for path, file in zip(new, files, strict=True):
            if path != file:
                with writing(file):
                    path.replace(file)
    except BaseException:  # of an interrupt too
        for path in {*new} - {*files}:
            with suppress(OSError):
                path.unlink()
        raise


def _beside(directory: Path, ending: str) -> Path:
    """``DIR.partial``, ``DIR.partial.lock``, or ``DIR.partial.old``, where an older result lies while it is replaced."""
    return directory.with_name(directory.name + ending)


def check_directory(directory: Path) -> None:
    """Refuse ``directory`` unless it is absent, empty, or a result of this program.

    Raises
    ------
    InputError
        If it is something else, which is never overwritten, or where something else stands in the place of its
        unfinished work or of its older result.
    """
    rule, remedy = "the output directory must be new or a result of fit-params", "choose another --out"
    if directory.name in ("", "..") or directory.name.endswith((PARTIAL, OLD, LOCK)):
        named = f"the output directory must have a name, which must not end in {PARTIAL}, {OLD} or {LOCK}"
        raise InputError(named, f"'{directory}'", remedy)
    with refusing("the output directory must be usable", remedy, directory):
        _check_unfinished(directory, resume=False)
        if _beside(directory, OLD).exists():  # what holds a sample must not be hidden from the caller's checks
            with _locked(directory):
                _recover(directory)
        names = _names_in(directory, rule, remedy)
        for place in (directory / "parameters.json", directory / "figures" / "data.npz"):
            check_parents(place, "the output directory must be writable", directory)
    if names and not _is_result(directory):
        foreign = sorted(names - RESULT_FILES - WORK_FILES)
        raise InputError(rule, f"it holds {foreign[0]}" if foreign else "it is not one", remedy, directory)


def check_parents(path: Path, rule: str, place: str | Path) -> None:
    """Refuse a path whose folder is none, or cannot be written."""
    parent = next((parent for parent in path.parents if parent.exists()), Path())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(rule, f"{parent} is not", "choose another --out", place)


def _names_in(directory: Path, rule: str, remedy: str) -> set[str]:
    """Names of what ``directory`` holds; a file or a link in its place is refused."""
    if directory.is_symlink() or (directory.exists() and not directory.is_dir()):
        raise InputError(rule, "it is a file or a link", remedy, directory)
    return {entry.name for entry in directory.iterdir()} if directory.exists() else set()


def _is_result(directory: Path) -> bool:
    """Whether this program wrote every file of ``directory``."""
    if not {entry.name for entry in directory.iterdir()} <= RESULT_FILES | WORK_FILES:
        return False
    try:
        text = (directory / "parameters.json").read_text(encoding="utf-8")
        return "capsule-id" in json.loads(text)["provenance"]["versions"]
    except (OSError, ValueError, KeyError, TypeError):
        return False


@contextmanager
def work_in_progress(directory: Path, fingerprint: Mapping[str, object], resume: bool) -> Iterator[Path]:
    """``DIR.partial``, new or resumed, locked until the block ends.

    An interrupted block keeps it for ``--resume``. A block that ends in an ``InputError`` removes what it has made.

    Parameters
    ----------
    fingerprint : the inputs of the result; only a run with the same fingerprint can resume
    resume : continue from the saved state

    Raises
    ------
    InputError
        If there is nothing to resume, the saved state has other data, seed or versions, another run uses it, or
        ``DIR.partial`` is something else.
    """
    partial = _beside(directory, PARTIAL)
    with _locked(directory):
        new = not partial.exists()
        try:
            _check_unfinished(directory, resume)
            if resume:
                _check_fingerprint(partial, fingerprint)
            with _writable(partial):
                _recover(directory)
                partial.mkdir(exist_ok=True)
                if not resume:
                    _clear(partial)
            replace_file(partial / STATE, json.dumps({"fingerprint": dict(fingerprint)}, indent=1))
            yield partial
        except InputError:
            if new:
                with suppress(OSError):
                    _clear(partial)
                    shutil.rmtree(partial)
            raise


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Hold the lock of ``directory``. The operating system releases it when this process ends."""
    partial, lock = _beside(directory, PARTIAL), FileLock(_beside(directory, LOCK), blocking=False)
    missing = [path for path in directory.parents if not path.exists()]
    try:
        with _writable(partial):
            directory.parent.mkdir(parents=True, exist_ok=True)
            try:
                lock.acquire()
            except Timeout:
                raise InputError(
                    "one run at a time writes to a directory",
                    "another run is active",
                    "wait, or choose another --out",
                    partial,
                ) from None
            except OSError as error:
                if error.errno not in _WITHOUT_LOCKS:
                    raise
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):  # Windows removes an open file only with the release
                Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()
        for path in missing:
            with suppress(OSError):  # it holds what this run has written
                path.rmdir()


def _check_unfinished(directory: Path, resume: bool) -> None:
    """Refuse a ``DIR.partial`` that is no unfinished run of this program, and a ``DIR.partial.old`` that is no result.

    An older result lies there while it is replaced.
    """
    partial, old = _beside(directory, PARTIAL), _beside(directory, OLD)
    rule, remedy = "DIR.partial must be unfinished work", "move it away or choose another --out"
    with _writable(partial):
        if resume and not partial.exists():
            raise InputError("--resume needs an interrupted run", "there is none", "run without --resume", partial)
        names = _names_in(partial, rule, remedy)
        foreign = sorted(names - RESULT_FILES - WORK_FILES)
        if foreign or (names and not names & WORK_FILES):
            raise InputError(rule, f"it holds {(foreign or sorted(names))[0]}", remedy, partial)
        if _names_in(old, "DIR.partial.old must be an older result", "move it away") - RESULT_FILES - WORK_FILES:
            raise InputError("DIR.partial.old must be an older result", "it is something else", "move it away", old)


def _recover(directory: Path) -> None:
    """Restore the older result if a run died during its replacement; remove what is left of it after that."""
    old = _beside(directory, OLD)
    if not old.exists():
        return
    if directory.exists():
        with refusing("an older result must be removable", "move it away", old):
            shutil.rmtree(old)
    elif _is_result(old):
        old.rename(directory)


def _clear(partial: Path) -> None:
    """Remove what ``partial`` holds but its state: without one it would not show whose it is."""
    for path in partial.iterdir():
        if path.name != STATE:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def _check_fingerprint(partial: Path, fingerprint: Mapping[str, object]) -> None:
    remedy = "run without --resume"
    try:
        saved = json.loads((partial / STATE).read_text(encoding="utf-8"))["fingerprint"]
        saved = {key: saved[key] for key in fingerprint}
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            "--resume needs the state that the interrupted run saved",
            "it is missing or damaged",
            remedy,
            partial / STATE,
        ) from None
    for key, value in fingerprint.items():
        if saved[key] != json.loads(json.dumps(value)):
            raise InputError(f"--resume needs the same {key} as the interrupted run", f"{key} changed", remedy, partial)


def publish(partial: Path, directory: Path) -> None:
    """Rename the finished ``partial`` to ``directory``, replacing an older result.

    The work files are removed after the rename, so that a run can resume until then.
    """
    with writing(directory):
        try:
            if directory.exists():
                directory.rename(_beside(directory, OLD))
            partial.rename(directory)
        except OSError:
            _recover(directory)
            raise
    for name in WORK_FILES:
        with suppress(OSError):
            (directory / name).unlink()
    shutil.rmtree(_beside(directory, OLD), ignore_errors=True)
