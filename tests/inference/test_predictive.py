"""Every posterior predictive p-value of a result is one number, wherever it is shown."""

from pathlib import Path

import pytest

import capsule_id as cid
from capsule_id.api import read_rig
from tests.cli_tools import small_rig


@pytest.mark.full
def test_caption_and_table_show_the_same_p_value(tmp_path: Path) -> None:
    """The scatter of a line is a nuisance with its own random draw, so two evaluations would differ."""
    result = cid.fit(read_rig(small_rig(tmp_path / "rig", tables=("motor_current", "support_spring_soft"))), budget=40)
    (note,) = [note for note in result.notes if note.code == "readings.predictive"]
    shown = {item.label: item.predictive_p for item in result.comparisons}
    assert set(shown) == set(note.frame.index)
    assert shown == dict(note.frame["p"])
