"""Roll decay of a ship model (KVLCC2, scale 1:68, 0 kn, run 21337): stiffness known independently, damping not viscous.

Relabelled: roll angle, rad, as x_rel, m; moment of inertia with added mass, 135.0 kg m², as m1, kg. So k1 is in N m/rad,
c in N m s/rad and c_q in N m s²/rad². The inertia is the authors' own value, so k1 tests the frequency and the
bookkeeping; it is no independent measurement of the stiffness.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import find_peaks

import capsule_id as cid
from capsule_id.api import Fit
from tests.measured.folders import Entry, make_rig, note, quantity
from tests.measured.sources import ship_roll, ship_roll_stiffness

pytestmark = pytest.mark.full

INERTIA = 135.0
#: From just after the release; the record goes on to 91.6 s, where the last third says the same once more.
START, STOP = 25.0, 70.0


@pytest.fixture(scope="module")
def roll(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    time, angle = ship_roll()
    entry = Entry(
        "free_vibration",
        "roll_21337",
        {"time [s]": time, "x_rel [m]": angle},
        {"start": quantity(START, "s"), "stop": quantity(STOP, "s")},
    )
    folder: Path = tmp_path_factory.mktemp("roll")
    return cid.fit(make_rig(folder, entry, head={"m1": quantity(INERTIA, "kg")}), budget=None)


def _peaks() -> tuple[np.ndarray, np.ndarray]:
    """Times and heights of the positive and negative extremes inside the window, by SciPy, raw."""
    time, angle = ship_roll()
    inside = (time >= START) & (time <= STOP)
    time, angle = time[inside], angle[inside]
    index = np.sort(np.concatenate([find_peaks(side * angle, distance=150, height=0.02)[0] for side in (1.0, -1.0)]))
    return time[index], np.abs(angle[index])


@pytest.mark.full
def test_the_hydrostatic_stiffness_comes_out(roll: Fit) -> None:
    assert ship_roll_stiffness() == pytest.approx(821.96, abs=0.005)  # as the authors print it
    k1 = roll.summary.loc["k1"]
    assert k1["map"] == pytest.approx(ship_roll_stiffness(), rel=0.01)
    assert k1["paper"] == pytest.approx(ship_roll_stiffness(), rel=0.01)
    assert all(finding.level == "ok" for finding in roll.findings if finding.code == "starts.agree")


def test_what_remains_is_reported(roll: Fit) -> None:
    assert not roll.clean
    (finding,) = [f for f in roll.findings if f.code == "residuals.white"]
    assert (finding.level, finding.experiment) == ("fail", "roll_21337")
    assert "Present in the fitted model: quadratic damping, a cubic spring" in roll.text(finding)
    # Damping and stiffness grow with the amplitude; the authors' cubic stiffness term is positive as well.
    growing = roll.summary.loc[["c_q", "k_cubic"]]
    assert (growing["map"] > 3.0 * growing["standard_error"]).all()


def test_quadratic_damping_and_a_cubic_spring_explain_the_decrements(roll: Fit) -> None:
    (finding,) = [f for f in roll.findings if f.code == "decays.second_fit"]
    assert 'damping = ["viscous", "quadratic"], stiffness = "cubic"' in roll.text(finding)
    frame = note(roll, "decays.second_fit").frame
    assert frame.loc["quoted", "BIC"] == 0.0
    assert frame.loc["stated", "BIC"] > 100.0
    k1, c, c_q, k_cubic = roll.summary.loc[["k1", "c", "c_q", "k_cubic"], "map"]
    # The authors' cubic term, over the inertia, is 5.2.
    assert k_cubic / INERTIA == pytest.approx(5.2, rel=0.15)
    omega = np.sqrt(k1 / INERTIA)
    # Energy lost in a cycle of amplitude A: decrement = pi / (m1 omega) (c + 8/(3 pi) c_q omega A).
    _, heights = _peaks()
    for part in (slice(0, 9), slice(-9, None)):
        size = 0.5 * (heights[part][:-1] + heights[part][1:])
        seen = -2.0 * np.polyfit(np.arange(8), np.log(size), 1)[0]
        expected = np.pi / (INERTIA * omega) * (c + 8.0 / (3.0 * np.pi) * c_q * omega * np.exp(np.mean(np.log(size))))
        assert seen == pytest.approx(expected, rel=0.1)
