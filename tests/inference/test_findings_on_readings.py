"""Findings on the readings enter the verdict of the fit."""

from pathlib import Path

import pytest

import capsule_id as cid
from tests.cli_tools import small_rig


@pytest.mark.full
def test_a_file_that_is_entered_twice_is_not_clean(tmp_path: Path) -> None:
    folder = small_rig(tmp_path / "rig", tables=("motor_current",))
    assert cid.fit(cid.read_rig(folder), budget=None).clean
    text = (folder / "motor_current.csv").read_bytes()
    (folder / "copy.csv").write_bytes(text)
    toml = (folder / "rig.toml").read_text()
    entry = toml[toml.index("[[experiment]]") :].replace("motor_current.csv", "copy.csv")
    (folder / "rig.toml").write_text(toml + "\n" + entry)
    result = cid.fit(cid.read_rig(folder), budget=None)
    (found,) = [f for f in result.findings if f.code == "readings.repeated_file"]
    assert (found.level, found.experiment) == ("fail", "copy")
    assert "the file of motor_current" in result.text(found)
