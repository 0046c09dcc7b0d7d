"""``capsule-id import FILE``: describe an export and propose the entry of ``rig.toml`` that reads it; writes nothing."""

import argparse
from pathlib import Path

from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.importing import clock_line, import_report, read_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add FILE, and the options of its clock."""
    parser.add_argument("file", metavar="FILE", type=Path, help="table as a logger or a program exports it")
    parser.add_argument(
        "--clock-of", type=Path, metavar="OTHER", help="estimate the clock of FILE against that of OTHER"
    )
    parser.add_argument("--common", metavar="HEADER", help="signal that both files hold, for --clock-of")


def run(args: argparse.Namespace) -> int:
    """Print the report to standard output; 0.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    if (args.clock_of is None) != (args.common is None):
        raise InputError(
            "--clock-of and --common must stand together",
            "one of them",
            "name the other file and the common signal",
            args.file,
        )
    if args.clock_of is not None:
        files = {path: read_file(path) for path in (args.clock_of, args.file)}
        say(clock_line(files, args.common, default_registry()))
        return 0
    say("\n".join(import_report(read_file(args.file), args.file, default_registry())))
    return 0
