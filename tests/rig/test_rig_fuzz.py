"""A rig folder with random faults is either read or refused with a place; nothing else happens."""

import random
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.rig.formats.layouts import read_csv
from capsule_id.rig.formats.raw import RawTable
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


#: Longest time to read a table of twenty rows, s.
LONGEST = 0.3
TABLE = b"time [s],x_rel [mm]\n" + b"".join(b"%.2f,%.3f\n" % (0.01 * k, 1.5 + 0.3 * k % 1) for k in range(20))


def by_hand(content: bytes) -> list[list[float]]:
    """The numbers of a table that was read, by Python's own means; rows with a missing reading are left out."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252")
    head, *lines = re.split("\r\n?|\n", text)
    mark = next((mark for mark in "\t;," if mark in head), ",")
    cells = [[cell.strip('" ') for cell in line.split(mark)] for line in lines if line.strip()]
    return [[float(cell.replace(",", ".")) for cell in row] for row in cells if not {"", "nan"} & set(row)]


def kind_of_end(read: Callable[[bytes, Path], RawTable], content: bytes) -> str:
    """How the reading of a spoiled table ends."""
    began = time.process_time()
    try:
        end = (
            "read"
            if np.column_stack(read(content, Path("a.csv")).columns).tolist() == by_hand(content)
            else "other numbers"
        )
    except InputError:
        end = "refused"
    except Exception:  # whatever a reader may raise
        end = "failure"
    return "slow" if time.process_time() - began > LONGEST else end


def ends(read: Callable[[bytes, Path], RawTable], number: int, seed: int = 7) -> Counter[str]:
    chance = random.Random(seed)
    return Counter(kind_of_end(read, spoil(TABLE, chance)) for _ in range(number))


def test_spoiled_tables_are_read_as_written_or_refused() -> None:
    found = ends(read_csv, MUTATIONS)
    assert set(found) == {"read", "refused"}
    assert min(found.values()) > 0.1 * MUTATIONS


@pytest.mark.slow
def test_many_spoiled_tables() -> None:
    assert set(ends(read_csv, 10_000, seed=8)) == {"read", "refused"}


def raises(content: bytes, path: Path) -> RawTable:
    return {b"time": read_csv(content, path)}[content[:4]]


def reads_zero(content: bytes, path: Path) -> RawTable:
    table = read_csv(content, path)
    column = np.where(np.arange(len(table.rows)) == 3, 0.0, table.columns[-1])
    return replace(table, columns=(*table.columns[:-1], column))


def loops(content: bytes, path: Path) -> RawTable:
    if len(content) > len(TABLE) + 20:
        sum(one == other for one in content for other in content * 100)
    return read_csv(content, path)


@pytest.mark.parametrize(("read", "end"), [(raises, "failure"), (reads_zero, "other numbers"), (loops, "slow")])
def test_planted_faults_of_a_reader_are_found(read: Callable[[bytes, Path], RawTable], end: str) -> None:
    """The negative control of the test above."""
    assert ends(read, 60)[end] > 0
