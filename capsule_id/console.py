"""Standard streams that may be closed or have another encoding; the type of progress callbacks."""

import io
import os
import sys
from collections.abc import Callable

#: Called with (number of draws or points done, total number, name of the stage).
OnProgress = Callable[[int, int, str], None]


def prepare() -> None:
    """Open missing standard streams, and make standard output accept any character."""
    # The null device takes the number of a closed stream, so no data file gets this number.
    if sys.stdin is None:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def say(text: str) -> None:
    """Print to standard output and flush; a closed pipe (``| head``) is no error."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        _discard()


def finish() -> None:
    """Flush standard output; otherwise the interpreter reports a failed flush at exit."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard()


def _discard() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
