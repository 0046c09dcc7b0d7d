"""``capsule-id import FILE``: print the entry of ``rig.toml`` that reads an export, as ``init --from`` writes it."""

import argparse

from capsule_id.commands import PATH
from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.importing import clock_line, propose_entry, read_file

OPTIONS = {
    "": (
        ("file", "FILE", "table as a logger or a program exports it", PATH),
        ("--clock-of", "OTHER", "estimate the clock of FILE against that of OTHER", PATH),
        ("--common", "HEADER", "signal that both files hold, for --clock-of"),
    )
}


def run(args: argparse.Namespace) -> int:
    """Print the entry, or the line of the clock, to standard output; 0.

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
    if args.clock_of is None:
        say(propose_entry(args.file).rstrip())
    else:
        files = {path: read_file(path) for path in (args.clock_of, args.file)}
        say(clock_line(files, args.common, default_registry()))
    return 0
