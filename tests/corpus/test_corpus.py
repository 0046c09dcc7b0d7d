"""The corpus: its list, and a comparison that finds each kind of difference."""

import copy
import json
from pathlib import Path

import pytest

from tests.corpus.__main__ import compared
from tests.corpus.rigs import GENERATED, QUICK, RIGS

TABLE = json.loads(Path(__file__).with_name("table.json").read_text(encoding="utf-8"))


def test_the_list_is_short_and_the_table_holds_it() -> None:
    assert len(RIGS) <= 80
    assert len(QUICK) == 20
    assert set(QUICK) <= set(RIGS)
    assert set(TABLE) == set(RIGS)
    assert len(GENERATED) >= 25


def test_the_folders_are_written(tmp_path: Path) -> None:
    for name, write in GENERATED.items():
        write(tmp_path / name)
        assert (tmp_path / name / "rig.toml").is_file(), name


def test_a_table_is_equal_to_itself() -> None:
    assert compared(TABLE, TABLE) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda rig: rig["parameters"]["k1"].update(value=rig["parameters"]["k1"]["value"] * 1.01), "k1: value"),
        (lambda rig: rig["parameters"]["k1"].update(sd=rig["parameters"]["k1"]["sd"] * 1.2), "k1: sd"),
        (lambda rig: rig["parameters"]["k1"].update(trust="not judged"), "k1: trust trusted -> not judged"),
        (lambda rig: rig["parameters"].pop("c"), "c is gone"),
        (lambda rig: rig.update(status=70), "status 0 -> 70"),
        (lambda rig: rig.update(failure="Traceback"), "internal failure"),
        (lambda rig: rig["findings"].append("decay.late"), "finding decay.late is new"),
        (lambda rig: rig.update(time=2.0 * rig["time"]), "takes 2.00 times as long"),
    ],
)
def test_each_kind_of_difference_is_found(change: object, line: str) -> None:
    after = copy.deepcopy(TABLE)
    change(after["single_clean_1"])  # type: ignore[operator]
    (found,) = compared(TABLE, after)
    assert found.startswith(f"single_clean_1: {line}")
