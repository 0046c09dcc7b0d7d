"""The two commands: parse, call, exit code. ``fit-params DATA`` fits; ``capsule-id`` does everything else."""

import argparse
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import NoReturn

from capsule_id.commands import check, fit, init, synthesize
from capsule_id.errors import InputError

BAD_INPUT, INTERNAL, INTERRUPTED = 2, 1, 130


class _Parser(argparse.ArgumentParser):
    """Wrong usage is one line on standard error and exit code 2."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(BAD_INPUT)


def fit_params(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``fit-params``; returns the exit code."""
    parser = _Parser(prog="fit-params", description="Fit the vibro-impact capsule to a folder of rig measurements.")
    fit.add_arguments(parser)
    return _run("fit-params", parser, fit.run, arguments)


def capsule_id(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``capsule-id``; returns the exit code."""
    parser = _Parser(prog="capsule-id", description="Everything about a rig folder but its fit (see fit-params).")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, module, text in (
        ("init", init, "an empty rig folder with a commented rig.toml"),
        ("check", check, "read and lint a rig folder"),
        ("synthesize", synthesize, "a rig folder with known truth"),
    ):
        sub = commands.add_parser(name, help=text, description=text)
        module.add_arguments(sub)
        sub.set_defaults(run=module.run)
    return _run("capsule-id", parser, lambda args: args.run(args), arguments)


def _run(
    program: str,
    parser: argparse.ArgumentParser,
    action: Callable[[argparse.Namespace], int],
    arguments: Sequence[str] | None,
) -> int:
    """Parse and act; every way to end becomes an exit code and at most one line on standard error."""
    try:
        args = parser.parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        code = action(args)
        sys.stdout.flush()
        return code
    except InputError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"{program}: interrupted; --resume goes on from the saved state", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        print(f"{program}: internal failure: {_one_line(error)}; traceback in {_save_traceback()}", file=sys.stderr)
        return INTERNAL


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def _save_traceback() -> Path:
    with tempfile.NamedTemporaryFile("w", prefix="capsule-id-", suffix=".txt", delete=False, encoding="utf-8") as file:
        traceback.print_exc(file=file)
    return Path(file.name)
