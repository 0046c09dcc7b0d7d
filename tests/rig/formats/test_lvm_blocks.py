"""LabVIEW files read in blocks and cell by cell: the same numbers, places and errors, damaged files included."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.rig.formats import layouts as lvm
from capsule_id.rig.formats.raw import Layout
from capsule_id.rig.formats.text import Rows
from tests.rig.formats.writers import WRITERS

TIME = np.arange(8) * 0.25
COLUMNS = {"t": TIME, "x": np.round(np.cos(TIME), 3)}
KINDS = [name for name, (suffix, _) in WRITERS.items() if suffix == ".lvm"]
#: What a line of readings becomes; {0}, {1} are two of its cells.
DAMAGES = (
    "",
    "{line}\tnote",
    "\t{line}",
    "{line}\t",
    "# {line}",
    "{0}",
    "{0}\t",
    "{0}\tNaN",
    "{0}\t--",
    "{0},5\t{1},5",
    "{line}\n",
)


def outcome(content: bytes) -> tuple[object, ...]:
    """All that a caller sees of a file."""
    path = Path("f.lvm")
    try:
        export = lvm.read_lvm(content, path, Layout(missing=("NaN",)))
    except InputError as error:
        return (str(error),)
    seen: list[object] = [export.headers, export.lines.tolist(), export.encoding]
    for column in range(export.width):
        try:
            seen.append(np.nan_to_num(export.values(column), nan=-9e9).tolist())
        except InputError as error:
            seen.append(str(error))
        seen += [export.place(row, column) for row in (None, 0, len(export.lines) - 1)]
    return tuple(seen)


def damaged(text: str, rng: np.random.Generator) -> str:
    """The file with one to three of its lines damaged, or none."""
    lines = text.split("\n")
    for index in rng.integers(len(lines) - 10, len(lines), int(rng.integers(0, 4))):
        line = lines[index]
        cells = [*line.split("\t"), "", ""]
        lines[index] = str(rng.choice(DAMAGES)).format(*cells[:2], line=line)
    return "\n".join(lines)


@pytest.mark.parametrize("kind", KINDS)
def test_blocks_and_cells_give_the_same(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text, rng = WRITERS[kind][1](COLUMNS).decode(), np.random.default_rng(0)
    files = [damaged(text, rng).encode() for _ in range(150)]
    in_blocks, used = lvm._plain, list[bool]()

    def counted(*file: Any) -> Rows | None:
        rows = in_blocks(*file)
        used.append(rows is not None)
        return rows

    for content in files:
        with monkeypatch.context() as patch:
            patch.setattr(lvm, "_plain", counted)
            found = outcome(content)
            patch.setattr(lvm, "_plain", lambda *file: None)
            assert outcome(content) == found, content
    # Several segments, and the row of commas behind the last reading, are read cell by cell.
    assert (sum(used) > 20) == (kind in ("LabVIEW text, one time column", "LabVIEW text, no times"))
