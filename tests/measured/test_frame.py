"""Labels of the shaken frame of Marino and Cicirello: plainly period 1, 0.3 to 1.4 % variation from cycle to cycle."""

from pathlib import Path

import numpy as np
import pytest

from capsule_id.records.label import measured_motion
from capsule_id.records.repeat import Repeat, find_period
from capsule_id.records.tone import fit_harmonic
from tests.measured.folders import Entry, make_rig, quantity
from tests.measured.sources import frame


def period_of(time: np.ndarray, x: np.ndarray) -> Repeat:
    return find_period(time, x, 2.0 * np.pi / fit_harmonic(time, x, 2.0 * np.pi).Omega)


@pytest.mark.parametrize("load", ["350g", "450g"])
def test_the_frame_is_of_period_one(load: str) -> None:
    time, storey, base = frame(load)
    for record in (storey, base, base - storey):
        found = period_of(time, record)
        assert (found.period, found.probability > 0.9) == (1, True), found.reason


@pytest.mark.parametrize("load", ["350g", "450g"])
def test_the_frame_is_a_run_with_a_prescribed_rod(tmp_path: Path, load: str) -> None:
    """Its label comes from x_base - x_capsule; tests/experiments/test_base_run.py fits a twin."""
    time, storey, base = frame(load)
    columns = {"time [s]": time, "x_base [m]": base, "x_capsule [m]": storey}
    settings = {"drive": '"base"', "normal_force": quantity(1e-3 * float(load[:3]) * 9.81, "N")}
    rig = make_rig(tmp_path, Entry("forced_run", load, columns, settings), head={"m2": quantity(3.0799, "kg")})
    assert measured_motion(rig.tables[0]).label == "P-1"


def twin(part: float) -> tuple[np.ndarray, np.ndarray]:
    """Ten seconds at 250 Hz of 1 Hz with three harmonics, scatter of 1.4 %, drift of 3 %, noise of 0.5 um."""
    time, rng = np.arange(2500) / 250.0, np.random.default_rng(3)
    size = 1.0 + 0.014 * np.interp(time, np.arange(12) - 0.5, rng.standard_normal(12)) + 0.003 * time
    angle = 2.0 * np.pi * time
    wave = np.cos(angle) + 0.2 * np.cos(3.0 * angle + 1.0) + 0.05 * np.cos(5.0 * angle) + part * np.cos(0.5 * angle)
    return time, 1.8e-3 * size * wave + 0.5e-6 * rng.standard_normal(2500)


def test_a_twin_of_the_frame_is_of_period_one() -> None:
    found = period_of(*twin(0.0))
    assert found.period == 1
    assert found.probability > 0.9
    # negative control: with 20 % of the motion at half the frequency
    assert period_of(*twin(0.2)).period == 2
