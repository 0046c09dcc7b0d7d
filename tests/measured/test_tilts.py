"""Heights at which objects on a tilted tray began to slide, as noted by hand; the notes do not say what "length" is."""

from pathlib import Path

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.errors import InputError
from capsule_id.rig.model import Rig
from tests.measured.folders import Entry, make_rig, named_line, quantity
from tests.measured.sources import tilt_notes

#: Pair: the line of the notes with the reading, heights and length, cm.
PAIRS = {
    "foam_box": ("μ = height / length = 14 / 29.5 ~= 0.474", (14.0,), 29.5),
    "foam_tray": ("height at sliding ~= 13cm\n* μ = 13 / 24 ~= 0.54", (13.0,), 24.0),
    "block_box_smooth": ("μ = height / length = 8 / 29.5 ~= 0.27", (8.0,), 29.5),
    "block_box_rough": ("μ = height / length = 13 / 29.5 ~= 0.44", (13.0,), 29.5),
    "block_tray": ("height at sliding = 13--14cm", (13.0, 14.0), 24.0),
    "bottle_wood": ("μ = 10 / 28.5 ~= 0.35", (10.0,), 28.5),
}


def _rig(folder: Path, pair: str, length_is: str | None) -> Rig:
    reading, heights, length = PAIRS[pair]
    assert reading in tilt_notes()
    settings = {"height_resolution": quantity(1.0, "cm")}
    if length_is is not None:
        settings["length_is"] = f'"{length_is}"'
    columns = {"height [cm]": np.array(heights), "length [cm]": np.full(len(heights), length)}
    return make_rig(folder, Entry("static_friction", pair, columns, settings))


@pytest.mark.parametrize("pair", PAIRS)
def test_each_reading_of_length_gives_its_own_coefficient(tmp_path: Path, pair: str) -> None:
    _, heights, length = PAIRS[pair]
    ratio = np.array(heights) / length
    expected = {"board": np.tan(np.arcsin(ratio)), "base": ratio}
    found = {}
    for length_is, coefficients in expected.items():
        result = cid.fit(_rig(tmp_path / length_is, pair, length_is), budget=None)
        mu = result.summary.loc["mu"]
        assert mu["paper"] == pytest.approx(np.mean(coefficients), rel=1e-12)
        # Between the two the angles are averaged, not their tangents, and the prior is felt a little.
        assert mu["map"] == pytest.approx(np.mean(coefficients), abs=0.1 * mu["standard_error"])
        # One reading to 1 cm, or two, and the default scatter of a tilt: about 4 %.
        assert 0.02 < mu["standard_error"] / mu["map"] < 0.08
        found[length_is] = mu["map"]
    assert found["board"] > found["base"]


def test_the_two_readings_of_the_foam_die(tmp_path: Path) -> None:
    mu = {
        length_is: cid.fit(_rig(tmp_path / length_is, "foam_box", length_is), budget=None).summary.loc["mu", "paper"]
        for length_is in ("board", "base")
    }
    assert mu["board"] == pytest.approx(0.539, abs=5e-4)
    assert mu["base"] == pytest.approx(0.474, abs=1e-3)  # as the notes read it


def test_without_a_word_on_the_length_the_toolkit_asks(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"length_is = \"board\" for the sloping side") as caught:
        _rig(tmp_path, "foam_box", None)
    assert "length_is" in caught.value.rule
    assert caught.value.file == str(tmp_path / "rig.toml")
    assert named_line(caught.value) == "[[experiment]]"
