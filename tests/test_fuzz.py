"""Spoiled inputs of every kind are read or refused, in time and with little memory: see ``tests/fuzz.py``."""

import json
import os
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from capsule_id.report.write import result_files, write_result
from tests import fuzz
from tests.report.conftest import make_result

ROOT = Path(__file__).parent.parent
#: Inputs of a child process, its longest time, s, and the most memory of an input, MB.
BLOCK, BLOCK_TIME, MOST_MEMORY = 250, 900.0, 1024.0
GOOD = {"read", "refused"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("capsule_id.report.write.pictures", lambda _: ())  # no command reads them
        write_result(result_files(make_result()), path)
    return path


def faults(lines: list[dict]) -> list[dict]:
    return [line for line in lines if line["end"] not in GOOD]


def counted(lines: list[dict]) -> Counter[tuple[str, str]]:
    return Counter((line["family"], line["end"]) for line in lines)


@pytest.mark.parametrize(("first", "last"), [(0, 48), pytest.param(48, 300, marks=pytest.mark.full)])
def test_three_hundred_inputs(whole: Path, first: int, last: int) -> None:
    lines = fuzz.ends(first, last, whole)
    assert faults(lines) == []
    # Each family has inputs that are read and some that are refused; of few results none is read.
    assert len(counted(lines)) == 2 * len(fuzz.FAMILIES) - (last < 100)


def test_a_planted_fault_is_found(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control; those of a reader of tables stand in ``rig/test_rig_fuzz.py``."""
    monkeypatch.setattr(fuzz, "refusal", lambda suffix, content: {}[suffix])
    assert {line["family"] for line in faults(fuzz.ends(0, 20, whole))} == {"format"}


def block(first: int, whole: Path) -> list[dict]:
    """The ends of a block of inputs in a child process; what it does not end with is a fault."""
    command = [sys.executable, "-m", "tests.fuzz", str(first), str(first + BLOCK), str(whole)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=BLOCK_TIME, env=os.environ)
        text, left = done.stdout, f"exit code {done.returncode}: {done.stderr[-500:]}"
    except subprocess.TimeoutExpired as stop:
        text, left = (stop.stdout or b"").decode(), "no end"
    lines = [json.loads(line) for line in text.splitlines() if line.endswith("}")]
    lines += [] if len(lines) == BLOCK else [{"number": first + len(lines), "family": "?", "end": left, "MB": 0.0}]
    return [line if line["MB"] < MOST_MEMORY else {**line, "end": f"{line['MB']} MB"} for line in lines]


@pytest.mark.slow
def test_ten_thousand_inputs(whole: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        parts = pool.map(lambda first: block(first, whole), range(1000, 11_000, BLOCK))
        lines = [line for part in parts for line in part]
    print(json.dumps({f"{family}, {end}": n for (family, end), n in sorted(counted(lines).items())}))
    assert faults(lines) == []
    assert len(lines) == 10_000
