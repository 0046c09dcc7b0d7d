"""Spoiled inputs by number, and how the package ends on each: ``python -m tests.fuzz FIRST LAST RESULT``.

Five families in turn: rig.toml and tables of a rig folder (``capsule-id check``), the numbers of a table, files of every
other format, files of the result in the folder RESULT. Good ends are "read" and "refused"; all others are faults.
A line of JSON for each input on standard output: number, family, end, time, s, and peak of the memory, MB.
"""

import contextlib
import io
import json
import random
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from capsule_id import load
from capsule_id.cli import capsule_id
from capsule_id.errors import InputError
from capsule_id.rig.formats.layouts import read_csv
from tests.report.test_damaged_results import DAMAGES
from tests.rig.folder import RIG_TOML, TABLES, write_folder
from tests.rig.formats.test_damaged_files import COLUMNS, WRITERS, damaged, refusal
from tests.rig.test_rig_fuzz import TABLE, kind_of_end, spoil

FAMILIES = ("rig.toml", "table", "numbers", "format", "result")
#: Longest time for an input, s.
LONGEST = 20.0


def other_digits(content: bytes, chance: random.Random) -> bytes:
    """``content`` with one to eight digits changed, left out or repeated: most such folders can still be read."""
    for _ in range(chance.randint(1, 8)):
        at = chance.choice([i for i, byte in enumerate(content) if byte in b"0123456789"])
        content = (
            content[:at]
            + chance.choice((b"", b"%d" % chance.randrange(10), content[at : at + 1] * 2))
            + content[at + 1 :]
        )
    return content


def of_command(words: list[str]) -> str:
    """The end of a command: it reads, refuses in printable lines, or fails."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = capsule_id(words)
    text = err.getvalue()
    clean = all(line.isprintable() for line in (out.getvalue() + text).split("\n"))
    if code in (0, 3) and clean:
        return "read"
    return "refused" if code == 2 and clean and text else f"code {code}: {text[:200]}"


def of_folder(folder: Path, name: str, content: bytes) -> str:
    """The end of ``check`` on a rig folder whose file ``name`` has another content."""
    write_folder(folder)
    (folder / name).write_bytes(content)
    return of_command(["check", str(folder)])


def of_format(content: bytes, suffix: str) -> str:
    error = refusal(suffix, content)
    return "read" if error is None else "refused" if str(error).isprintable() else f"unprintable: {error!r}"


def of_result(folder: Path, name: str, content: bytes) -> str:
    """The end of ``load`` and of ``report`` on a result whose file ``name`` has another content."""
    (folder / name).write_bytes(content)
    if name == "parameters.json":
        return of_command(["report", str(folder)])
    try:
        load(folder)
    except InputError as error:
        return "refused" if error.file == str(folder / name) else f"another file: {error}"
    return "read"


def end_of(number: int, whole: Path, folder: Path) -> str:
    """How the input ``number`` ends; ``folder`` does not exist, ``whole`` holds a result."""
    chance, family = random.Random(number), FAMILIES[number % len(FAMILIES)]
    if family == "rig.toml":
        return of_folder(folder, family, chance.choice((spoil, other_digits))(RIG_TOML.encode(), chance))
    if family == "table":
        name = chance.choice(list(TABLES))
        return of_folder(folder, name, chance.choice((spoil, other_digits))(TABLES[name].encode(), chance))
    if family == "numbers":
        return kind_of_end(read_csv, spoil(TABLE, chance))
    if family == "format":
        suffix, write = WRITERS[chance.choice(list(WRITERS))]
        return of_format(damaged(write(COLUMNS), chance), suffix)
    name, damage = chance.choice(DAMAGES)
    shutil.copytree(whole, folder)
    return of_result(folder, name, damage((whole / name).read_bytes(), np.random.default_rng(number)))


def ends(first: int, last: int, whole: Path) -> list[dict]:
    """The ends of the inputs ``first`` to ``last`` - 1, one after the other in this process."""
    found = []
    for number in range(first, last):
        began = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            try:
                end = end_of(number, whole, Path(folder) / "input")
            except Exception as error:  # whatever the package may raise
                end = f"{type(error).__name__}: {error}"
        seconds, peak = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        line = {"number": number, "family": FAMILIES[number % len(FAMILIES)], "end": end, "s": seconds, "MB": peak}
        found.append({**line, "end": "slow"} if seconds > LONGEST else line)
    return found


if __name__ == "__main__":
    for one in range(int(sys.argv[1]), int(sys.argv[2])):
        print(json.dumps(ends(one, one + 1, Path(sys.argv[3]))[0]), flush=True)
