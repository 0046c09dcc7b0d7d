"""The exceptions for bad input and for output that cannot be written; they name place, reason and remedy."""

import errno
import json
import os
import shutil
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


def printable(text: str) -> str:
    """``text`` without characters that command a terminal: each is written as JSON writes it, ``\\u001b``.

    Every text of a file passes here before it is shown: control characters, and marks that reverse or hide others.
    Line feeds, tabs and spaces of any width stay.
    """
    if text.isprintable():
        return text
    kept = (mark.isprintable() or mark in "\n\t" or unicodedata.category(mark) == "Zs" for mark in text)
    return "".join(mark if keep else json.dumps(mark)[1:-1] for mark, keep in zip(text, kept, strict=True))


class InputError(ValueError):
    """Bad input. A command prints it, on a terminal as ``shown``, and returns exit code 2; the message is one line.

    Parameters
    ----------
    rule : what must hold, e.g. "angle must lie between 0 and 90 deg"
    value : what was found instead, e.g. "95"
    remedy : what to do, e.g. "give the tilt angle at sliding"
    file, line, column : the place, 1-based, as far as known
    """

    def __init__(
        self,
        rule: str,
        value: str,
        remedy: str,
        file: str | Path = "",
        line: int | None = None,
        column: int | None = None,
    ) -> None:
        self.rule, self.value, self.remedy = rule, value, remedy
        self.file, self.line, self.column = str(file), line, column
        place = ":".join(str(part) for part in (self.file, line, column) if part not in ("", None))
        self._place = f"{place}: " * bool(place)
        super().__init__(_line(f"{self._place}{rule}, {value}, {remedy}"))

    @property
    def shown(self) -> str:
        """Three lines: the place and what was found, the rule, what to do."""
        lines = f"{self._place}found: {self.value}", f"rule: {self.rule}", f"to do: {self.remedy}"
        return "\n  ".join(map(_line, lines))


def _line(text: str) -> str:
    """``text`` in one line, printable."""
    return printable(" ".join(text.split()))


#: Most errors that are printed at once.
MOST_SHOWN = 20


class FolderError(InputError):
    """Several errors of a rig folder: message and ``shown`` have the first 20, then their number if there are more.

    Attributes
    ----------
    errors : all of them; rule, value, remedy and place are those of the first one
    """

    def __init__(self, errors: Sequence[InputError]) -> None:
        first = errors[0]
        super().__init__(first.rule, first.value, first.remedy, first.file, first.line, first.column)
        self.errors = tuple(errors)

    def __str__(self) -> str:
        return self._first(str)

    @property
    def shown(self) -> str:
        """Three lines for each error."""
        return self._first(lambda error: error.shown)

    def _first(self, text: Callable[[InputError], str]) -> str:
        more = [f"{len(self.errors)} errors"] * (len(self.errors) > MOST_SHOWN)
        return "\n".join([*map(text, self.errors[:MOST_SHOWN]), *more])


class OutputError(OSError):
    """A folder, a file or standard output takes no more. A command prints it in one line and returns exit code 1."""


#: No space on the disk, a file beyond its limit, or a full quota.
_FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}


@contextmanager
def writing(path: Path, needed: int = 0) -> Iterator[None]:
    """Raise ``OutputError`` where the operating system refuses what the body writes into ``path``, a folder or a file.

    needed : bytes that are still to be written, as far as known
    """
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        raise _refused(path, error, needed) from error


def _refused(path: Path, error: OSError, needed: int) -> OutputError:
    """The error of a write: names the folder and, on a full disk, the space that is needed and left."""
    folder = path if os.path.isdir(path) else path.parent  # noqa: PTH112 (Path raises without permission)
    text, choice = f"{folder} cannot be written: {error.strerror or error}", "choose another folder"
    if error.errno in _FULL:
        there = next(part for part in (folder, *folder.absolute().parents) if part.exists())
        text += f"; at least {needed / 1e6:.2f} MB are needed" if needed else ""
        text += f"; {shutil.disk_usage(there).free / 1e6:.2f} MB are left"
        choice = f"make space, or {choice}"
    elif not folder.exists():
        choice = f"make this folder, or {choice}"
    return OutputError(" ".join(f"{text}; {choice}".split()))


@contextmanager
def refusing(rule: str, remedy: str, file: str | Path = "") -> Iterator[None]:
    """Raise ``InputError`` where the operating system refuses what the body does, ``OutputError`` on a full disk."""
    try:
        yield
    except OSError as error:
        cause = error.__cause__ if isinstance(error.__cause__, OSError) else error  # of an OutputError
        if cause.errno in _FULL:
            raise error if isinstance(error, OutputError) else _refused(Path(file), error, 0) from error
        raise InputError(rule, str(cause.strerror or cause), remedy, file) from None


@contextmanager
def collecting(errors: list[InputError]) -> Iterator[None]:
    """Append an ``InputError`` of the body, or the several of a ``FolderError``, to ``errors`` instead of raising it."""
    try:
        yield
    except FolderError as error:
        errors += error.errors
    except InputError as error:
        errors.append(error)


def raise_all(errors: Sequence[InputError]) -> None:
    """Raise the only error as it is, several different ones as ``FolderError``; return if there is none."""
    errors = [*{str(error): error for error in errors}.values()]
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise FolderError(errors)
