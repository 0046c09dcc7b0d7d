"""The commands, one file each: ``OPTIONS`` and ``run(args) -> exit code``."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

#: Name, metavar ("" for a flag, None for the name or the choices), help, and further settings.
Option = tuple[Any, ...]
PATH: dict[str, Any] = {"type": Path}
NO_CACHE: Option = ("--no-cache", "", "compile everything anew, and keep no compiled program")


def add_options(parser: argparse.ArgumentParser, options: Mapping[str, Sequence[Option]]) -> None:
    """Add the options of a command, by the title of their group: "" for none, ``title: description`` with a description."""
    for title, rows in options.items():
        group = parser.add_argument_group(*title.split(": ")) if title else parser
        for name, metavar, text, *settings in rows:
            shown: dict[str, Any] = {"action": "store_true"} if metavar == "" else {"metavar": metavar}
            group.add_argument(name, help=text, **shown, **dict(*settings))
