"""Helpers of the fault tables: compare the reported place with that of the mark."""

from pathlib import Path

import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError

MARK = "‸"


def place_of(text: str, mark: str) -> tuple[int, int]:
    """1-based line and column of the only or first ``mark``."""
    before = text[: text.index(mark)].split("\n")
    return len(before), len(before[-1]) + 1


def fault_of(folder: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        read_rig(folder)
    assert "\n" not in str(caught.value)
    assert all((caught.value.rule, caught.value.value, caught.value.remedy))
    return caught.value


def assert_fault(fault: InputError, file: Path, place: tuple[int, int], rule: str) -> None:
    assert (fault.file, fault.line, fault.column) == (str(file), *place), str(fault)
    assert str(fault).startswith(f"{file}:{place[0]}:{place[1]}: {fault.rule}")
    assert rule in str(fault)
