"""``capsule-id import FILE``: describe an export and propose the entry of ``rig.toml`` that reads it; writes nothing."""

import argparse

from capsule_id.commands import PATH
from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.importing import clock_line, import_report, read_file

OPTIONS = {
    "": (
        ("file", "FILE", "table as a logger or a program exports it", PATH),
        ("--clock-of", "OTHER", "estimate the clock of FILE against that of OTHER", PATH),
        ("--common", "HEADER", "signal that both files hold, for --clock-of"),
    )
}


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
