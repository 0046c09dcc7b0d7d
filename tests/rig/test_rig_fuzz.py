"""A rig folder with random faults is either read or refused with a place; nothing else happens."""

import random
import re
from pathlib import Path

import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from tests.rig.folder import RIG_TOML, TABLES, write_folder

MUTATIONS = 300
# Pieces that parsers trip over
PIECES = [
    b"\0",
    b"\xff",
    b"\xef\xbb\xbf",
    b"\r",
    b"\n\n",
    b"\t",
    b";",
    b",",
    b'"',
    b"'",
    b'"""',
    b"[",
    b"]",
    b"[[",
    b"]]",
    b"{",
    b"}",
    b"=",
    b"#",
    b".",
    b"-",
    b"e",
    b"1e999",
    b"nan",
    b"inf",
    b"true",
    b"0x" + b"f" * 400,
    b"1979-05-27",
    b"9" * 400,
    b"\\",
    b"\\u0000",
    b"\xe2\x80\xa8",
    b"../",
    b"/",
    b" ",
    b"m^9",
    b"kN/m",
    b"[1]",
    b"[deg]",
    b"\xc2\xb5m",
    b"x_rel",
    b"[[experiment]]\n",
    b"kind",
    b"a.b.c = 1\n",
    b"[rig.m1]\n",
]


def spoil(content: bytes, chance: random.Random) -> bytes:
    """``content`` with one to three cuts, insertions, swaps of lines or repeats of lines."""
    for _ in range(chance.randint(1, 3)):
        start = chance.randint(0, len(content))
        stop = min(len(content), start + chance.choice((0, 1, 1, 2, 5, 40)))
        match chance.randrange(4):
            case 0:
                content = content[:start] + content[stop:]
            case 1:
                content = content[:start] + chance.choice(PIECES) + content[start:]
            case 2:
                content = content[:start] + chance.choice(PIECES) + content[stop:]
            case _:
                lines = content.split(b"\n")
                here, there = chance.randrange(len(lines)), chance.randrange(len(lines))
                lines[here] = lines[there]
                content = b"\n".join(lines)
    return content


def outcome(folder: Path) -> InputError | None:
    """The fault, or None if the folder is valid."""
    try:
        read_rig(folder)
    except InputError as error:
        return error
    return None


@pytest.mark.full
def test_spoiled_folders_read_or_are_refused(tmp_path: Path) -> None:
    chance = random.Random(20)
    contents = {name: text.encode() for name, text in {"rig.toml": RIG_TOML, **TABLES}.items()}
    names = ["rig.toml"] * len(TABLES) + list(TABLES)
    folder = write_folder(tmp_path / "rig")
    refused = 0
    for number in range(MUTATIONS):
        name = chance.choice(names)
        spoiled = spoil(contents[name], chance)
        (folder / name).write_bytes(spoiled)
        fault = outcome(folder)
        if fault is not None:
            refused += 1
            assert all(line.isprintable() for line in str(fault).split("\n")), (number, spoiled)
            text = re.sub("\r\n?", "\n", Path(fault.file).read_bytes().decode("utf-8", "replace"))
            widths = [len(line) for line in text.split("\n")]
            assert fault.line in range(1, len(widths) + 1), (number, spoiled)
            assert fault.column in range(1, widths[fault.line - 1] + 2), (number, spoiled)
        (folder / name).write_bytes(contents[name])
    assert 0.5 * MUTATIONS < refused < MUTATIONS  # the spoiling spoils, and not everything
