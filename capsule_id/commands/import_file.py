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
    if (args.clock_of is None) != (args.common is None) or args.clock_of == args.file:
        raise InputError(
            "--clock-of and --common must stand together, and name another file",
            "one of them, or the same file",
            "name the file of the other logger and the common signal",
            args.file,
        )
    kinds, content = default_registry(), read_file(args.file)
    if args.clock_of is None:
        say("\n".join(import_report(content, args.file, kinds)))
    else:
        say(clock_line({args.clock_of: read_file(args.clock_of), args.file: content}, args.common, kinds))
    return 0
