"""Standard streams as they may be: closed, in another locale, or with a reader that has left."""

import io
import os
import sys


def prepare() -> None:
    """Give the command the streams that it lacks, and let it write any character."""
    # What is opened first takes the number of the closed stream, which no data file then gets by chance.
    if sys.stdin is None:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def say(text: str) -> None:
    """Print to standard output at once; a reader who has heard enough (``| head``) is no failure."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        _discard()


def finish() -> None:
    """Write out what is left; the interpreter would complain if its last flush failed."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard()


def _discard() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
