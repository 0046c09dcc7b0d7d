"""Long columns lie in temporary files: the same numbers and the same errors as in memory."""

import errno
import mmap
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.rig import filters
from capsule_id.rig.formats import columns
from capsule_id.rig.model import Table
from tests.rig.test_column_maps import rig_of

ROWS = 1000
_RNG = np.random.default_rng(0)
TIME = np.arange(ROWS) * 1e-3
CHANNELS = np.round(_RNG.normal(size=(3, ROWS)), 4)
CHANNELS[2] = np.arange(ROWS) % 3
_LINES = [",".join(repr(float(x)) for x in row) for row in np.column_stack([TIME, *CHANNELS])]
MAP = 'columns = { time = { from = 1, unit = "s" }, x_rel = { from = 2, unit = "mm" } }'
RATE = 'columns = { time = { rate = { value = 250, unit = "Hz" } }, x_rel = { from = 2, minus = 3, unit = "mm" } }'
SCALED = MAP.replace("from = 2", "from = 2, scale = -1, offset = 0.3")
TWICE = MAP.replace("}, x_rel", '}, velocity = { from = 2, unit = "mm/s" }, x_rel')


def text(header: str = "t,a,b,c", lines: list[str] = _LINES) -> str:
    return "\n".join([header, *lines, ""])


def table(folder: Path, content: str, entry: str) -> Table[Any]:
    """The table of one file; of two, the second one ends with the first half of its rows."""
    files: dict[str, str | bytes] = {
        "d.csv": content,
        "e.csv": text(lines=[f"{float(x.split(',')[0]) + 1}{x[x.index(',') :]}" for x in _LINES]),
    }
    if "files" not in entry:
        files, entry = {"d.csv": content}, f'file = "d.csv"\n{entry}'
    return rig_of(folder, files, entry).tables[0]


def lies_in_file(values: np.ndarray) -> bool:
    base: Any = values
    while base is not None and not isinstance(base, mmap.mmap):
        base = getattr(base, "base", None)
    return base is not None


@pytest.fixture
def short_memory(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(columns, "IN_MEMORY", 64)
    monkeypatch.setattr(filters, "PIECE", 64)
    return monkeypatch


@pytest.mark.parametrize(
    ("content", "entry"),
    [
        (text(), MAP),
        (text(), RATE),
        (text(), SCALED),
        (text(), TWICE),
        (text(), f"{MAP}\nwhere = {{ 4 = 2 }}"),
        (
            text(lines=[line if k % 7 else f"{TIME[k]},--,0,{k}" for k, line in enumerate(_LINES)]),
            f'{MAP}\nmissing = ["--"]',
        ),
        (text(), f'files = ["d.csv", "e.csv"]\n{MAP}'),
        (text("time [s],x_rel [mm],velocity [m/s],acceleration [m/s^2]"), ""),
    ],
)
def test_long_columns_have_the_numbers_of_short_ones(
    tmp_path: Path, content: str, entry: str, short_memory: pytest.MonkeyPatch
) -> None:
    long = table(tmp_path / "long", content, entry)
    short_memory.undo()
    short = table(tmp_path / "short", content, entry)
    assert (long.missing, long.other) == (short.missing, short.other)
    np.testing.assert_array_equal(long.rows, short.rows)
    for name, column in short.columns.items():
        np.testing.assert_array_equal(long[name], column.values)
        assert len(column.values) < 64 or (lies_in_file(long[name]) and not lies_in_file(column.values))


@pytest.mark.parametrize("cell", ["x", "1e999", "", "1e40"])
def test_faults_of_long_columns_have_their_place(tmp_path: Path, cell: str, short_memory: pytest.MonkeyPatch) -> None:
    lines = [*_LINES[:930], f"{TIME[930]},{cell},0,0", *_LINES[931:]]
    faults = []
    for _ in range(2):
        with pytest.raises(InputError) as caught:
            table(tmp_path, text(lines=lines), MAP)
        faults.append(str(caught.value))
        short_memory.undo()
    assert faults[0] == faults[1]
    assert "d.csv:932:" in faults[0]


def test_an_unsorted_time_is_located(tmp_path: Path, short_memory: pytest.MonkeyPatch) -> None:
    del short_memory
    with pytest.raises(InputError, match=r"d\.csv:703:1: time must increase"):
        table(tmp_path, text(lines=[*_LINES[:701], _LINES[700], *_LINES[701:]]), MAP)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no full device")
def test_a_full_disk_is_an_error_with_a_remedy(tmp_path: Path, short_memory: pytest.MonkeyPatch) -> None:
    short_memory.setattr(columns.tempfile, "TemporaryFile", lambda prefix: Path("/dev/full").open("r+b", 0))  # noqa: SIM115
    with pytest.raises(InputError, match=r"room for temporary files.*No space left.*TMPDIR"):
        table(tmp_path, text(), MAP)


@pytest.mark.parametrize(
    ("number", "remedy"),
    [(errno.EMFILE, "ulimit -n"), (errno.ENFILE, "ulimit -n"), (errno.ENOSPC, "TMPDIR"), (errno.ENOMEM, "TMPDIR")],
)
def test_a_column_that_cannot_be_mapped_is_an_error_with_a_remedy(
    number: int, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise OSError(number, "refused")

    column = columns.Growing()
    column.extend(np.zeros(columns.IN_MEMORY + 1))
    monkeypatch.setattr(columns.np, "memmap", refused)
    with pytest.raises(InputError, match=rf"temporary file.*refused.*{remedy}"):
        _ = column.values


_OPEN_FILES = """
import resource
import tempfile
import numpy as np
from capsule_id.errors import InputError
from capsule_id.rig.formats import columns

tempfile.gettempdir()
columns.IN_MEMORY = 8
resource.setrlimit(resource.RLIMIT_NOFILE, (64, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
held = []
try:
    for _ in range(64):
        column = columns.Growing()
        column.extend(np.zeros(9))
        held.append({held})
except InputError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="the system has no limit of open files to lower")
@pytest.mark.parametrize("held", ["column", "column.values"])
def test_too_many_open_files_are_an_error_with_a_remedy(held: str) -> None:
    command = [sys.executable, "-c", _OPEN_FILES.replace("{held}", held)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "each column of a long record needs an open temporary file" in run.stdout
    assert "Too many open files" in run.stdout
    assert "fit fewer records at once, or raise the limit of open files: ulimit -n" in run.stdout


def test_columns_grow_after_they_were_read() -> None:
    column = columns.Growing()
    column.extend(np.arange(columns.IN_MEMORY - 1.0))
    assert not lies_in_file(column.values)
    for first in (columns.IN_MEMORY - 1, columns.IN_MEMORY + 1):
        column.extend(np.array([first, first + 1.0]))
        assert lies_in_file(column.values)
    np.testing.assert_array_equal(column.values, np.arange(columns.IN_MEMORY + 3.0))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
def test_released_columns_leave_the_memory() -> None:
    def resident() -> float:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        return float(status.split("RssFile:")[1].split()[0]) / 1e3

    numbers = columns.whole_numbers(0, 8 << 20)  # 32 MB
    total = int(numbers.sum())
    used = resident()
    columns.release(numbers[5:], np.arange(3))
    assert used - resident() > 25.0
    assert int(numbers.sum()) == total == (8 << 20) * ((8 << 20) - 1) // 2


def test_a_private_map_keeps_what_was_written(tmp_path: Path) -> None:
    np.arange(4096.0).tofile(tmp_path / "numbers")
    private = np.memmap(tmp_path / "numbers", float, "c")
    private[:] = 7.0
    columns.release(private[1:])
    assert np.all(private == 7.0)
