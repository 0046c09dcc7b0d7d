"""``capsule-id init DIR``: a rig folder with a commented ``rig.toml`` to fill in, or one that reads the given exports."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from capsule_id.console import say
from capsule_id.errors import InputError, refusing
from capsule_id.experiments.kind import Registry, default_registry
from capsule_id.importing import entry_of, read_file
from capsule_id.output import replace_files
from capsule_id.rig.toml import NAME_PATTERN

#: The head of ``rig.toml``. Lines that begin with `#:` are comments; without its `# `, every other `#` line is TOML.
HEAD = Path(__file__).with_name("template.toml")


def template(kinds: Registry, name: str, entries: Sequence[str] | None = None) -> str:
    """The commented ``rig.toml`` of a rig called ``name``, with ``entries``, or a commented one for each of ``kinds``."""
    stated = [row for row in kinds.parameters.values() if row.prior_can_be_stated]
    head = HEAD.read_text(encoding="utf-8").replace("@NAME@", name)
    for kind in ("lognormal", "halfnormal", "normal"):
        rows = [row for row in stated if row.prior is not None and row.prior.kind == kind]
        words = ['"k2[<spring>]"' if row.symbol == "k2" else row.symbol for row in rows]
        head = head.replace(f"@{kind.upper()}@", " ".join(words))
    head = head.replace("@OPTIONAL@", " ".join(row.symbol for row in kinds.parameters.values() if row.optional))
    return "\n".join([head, *(entries or [kind.template for kind in kinds.values()])])


OPTIONS = {
    "": (
        ("dir", "DIR", "new or empty folder; with --from it may hold the files"),
        (
            "--from",
            "FILE",
            "exports of loggers and programs: copy them into DIR and guess the entries that read them",
            {"dest": "files", "nargs": "+", "type": Path, "default": []},
        ),
    )
}


def run(args: argparse.Namespace) -> int:
    """Write the folder; 0.

    Raises
    ------
    InputError
        If DIR holds other files, is no folder, or cannot be written; if an export cannot be read.
    """
    folder, files = Path(args.dir), list(args.files)
    kinds = default_registry()
    contents = {path.name: read_file(path) for path in files}
    if len(contents) < len(files):
        raise InputError("files must have different names", "two of one name", "rename one of them", folder)
    guesses = {path.name: entry_of(contents[path.name], path, kinds) for path in files}
    with refusing("DIR must be writable", "name another one", folder):
        own = {path.resolve() for path in files}
        if folder.exists() and (not folder.is_dir() or any(each.resolve() not in own for each in folder.iterdir())):
            raise InputError("DIR must be new or an empty folder", str(folder), "name another one", folder)
        folder.mkdir(parents=True, exist_ok=True)
        name = folder.resolve().name
        usable = re.fullmatch(NAME_PATTERN, name) and name.strip(".")
        text = template(kinds, name if usable else "rig", [entry for entry, _ in guesses.values()])
        contents = {"rig.toml": text.encode(), **contents}
        # A part of a table would be read as a table.
        replace_files({folder / file: text for file, text in contents.items() if (folder / file).resolve() not in own})
    if not files:
        say(
            f"wrote {folder / 'rig.toml'}: add tables, remove the `# ` of their entries, then run capsule-id check {folder}"
        )
        return 0
    lines = [f"wrote {folder / 'rig.toml'}:"]
    lines += [
        f"{file}: {'kind unsure' if guessed is None else guessed.kind}{', unsure' if guessed and guessed.unsure else ''}"
        for file, (_, guessed) in guesses.items()
    ]
    say("\n".join([*lines, f"check its guesses, state the masses, then run capsule-id check {folder}"]))
    return 0
