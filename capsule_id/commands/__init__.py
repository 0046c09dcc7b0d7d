"""The commands, one file each: ``OPTIONS`` and ``run(args) -> exit code``."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from capsule_id.errors import InputError

#: Name, metavar ("" for a flag, None for the name or the choices), help, and further settings.
Option = tuple[Any, ...]
PATH: dict[str, Any] = {"type": Path}
NO_CACHE: Option = ("--no-cache", "", "compile everything anew, and keep no compiled program")
QUIET: Option = ("--quiet", "", "no progress on standard error")


def add_options(parser: argparse.ArgumentParser, options: Mapping[str, Sequence[Option]]) -> None:
    """Add the options of a command, by the title of their group: "" for none, ``title: description`` with a description."""
    for title, rows in options.items():
        group = parser.add_argument_group(*title.split(": ")) if title else parser
        for name, metavar, text, *settings in rows:
            shown: dict[str, Any] = {"action": "store_true"} if metavar == "" else {"metavar": metavar}
            group.add_argument(name, help=text, **shown, **dict(*settings))


def rig_folders(named: Sequence[str]) -> Sequence[str]:
    """The rig folders that a command has ``named``; without a name the working folder.

    Raises
    ------
    InputError
        If none is named and the working folder is no rig folder.
    """
    if not named and not Path("rig.toml").is_file():
        rule, found = "DATA must be a rig folder", "none is named, and the working folder has no rig.toml"
        raise InputError(rule, found, "name a rig folder, or run capsule-id init DIR for a new one")
    return named or (".",)
