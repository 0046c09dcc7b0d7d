"""Limits and errors that all readers of files share."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from capsule_id.errors import InputError

#: Largest decompressed size of a file, bytes. It stops archives that grow without limit when they are unpacked.
LARGEST_CONTENT = 1 << 30


def refuse_large(size: int, path: Path) -> None:
    """Refuse a file with more than ``LARGEST_CONTENT`` bytes of readings.

    Raises
    ------
    InputError
        Naming the size.
    """
    if size > LARGEST_CONTENT:
        rule = f"a {path.suffix} file must hold at most {LARGEST_CONTENT >> 20} MiB, decompressed"
        raise InputError(rule, f"{size >> 20} MiB", "export a part of the record, or fewer channels", path)


@contextmanager
def installed(package: str, path: Path) -> Iterator[None]:
    """Name the optional package that reads ``path`` where its import in the body fails.

    Raises
    ------
    InputError
        With the command that installs it.
    """
    try:
        yield
    except ModuleNotFoundError:
        rule, remedy = f"a {path.suffix} file needs the package {package}", 'run pip install "capsule-id[formats]"'
        raise InputError(rule, "not installed", remedy, path) from None


@contextmanager
def complete(path: Path, remedy: str) -> Iterator[None]:
    """Turn every exception of a library about a damaged file into an error line; its warnings are not shown.

    Libraries document no list of exceptions for damaged files, and fuzzing finds most of Python's.

    Raises
    ------
    InputError
        Where the body raises an exception; an ``InputError`` passes unchanged.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:
        value = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"a {path.suffix} file must be complete", value[:200], remedy, path) from None
