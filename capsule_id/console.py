"""Standard streams that may be closed, in another locale, or without a reader; and the type of progress callbacks."""

import io
import os
import sys
from collections.abc import Callable

#: Called with (draws or points done, how many in all, the stage).
OnProgress = Callable[[int, int, str], None]


def prepare() -> None:
    """Give the command the streams that it lacks, and let it write any character."""
    # Opening the null device first takes the number of the closed stream, so no data file gets it.
    if sys.stdin is None:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def say(text: str) -> None:
    """Print to standard output at once; a closed reader (``| head``) is no failure."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        _discard()


def finish() -> None:
    """Flush standard output; otherwise the interpreter reports a failed last flush."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard()


def _discard() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
