"""Free swing of a small rotary pendulum: dry friction beside the viscous, in the one record that gets to small angles.

Relabelled: the angle, rad, as x_rel, m; unit inertia as m1 = 1 kg. So k1 is the square of the natural frequency,
rad²/s², c twice the rate of decay, 1/s, and F_dry the dry moment over the inertia, rad/s². The encoder's step of
0.09 deg is stated as x_rel_resolution.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import find_peaks

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.experiments import make_experiments
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.settings import DAMPING, DecayModel
from capsule_id.experiments.free_vibration.tables import DAMPING_MODELS
from capsule_id.inference.fit.point_fit import bic, point_fit
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.rig.model import Rig
from tests.measured.folders import Entry, make_rig, note, quantity
from tests.measured.sources import pendulum

#: Where the swing of record 3 is down to 24 deg, s after its first sample: from there sin x is x to 3 %.
START = 3.3
RESOLUTION = np.deg2rad(0.09)


def _rig(folder: Path, time: np.ndarray, angle: np.ndarray) -> Rig:
    settings = {"start": quantity(START, "s"), "x_rel_resolution": quantity(float(RESOLUTION), "m")}
    entry = Entry("free_vibration", "swing", {"time [s]": time, "x_rel [m]": angle}, settings)
    return make_rig(folder, entry, head={"m1": quantity(1.0, "kg")})


@pytest.fixture(scope="module")
def swing(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    return cid.fit(_rig(tmp_path_factory.mktemp("swing"), *pendulum(3)), budget=None)


@pytest.mark.parametrize("record", [1, 2])
def test_the_other_records_end_before_the_angle_is_small(record: int) -> None:
    _, angle = pendulum(record)
    peaks = [angle[find_peaks(side * angle, distance=200)[0]] for side in (1.0, -1.0)]
    assert min(np.min(np.abs(part)) for part in peaks) > np.deg2rad(30.0)


def test_the_part_that_is_fitted_has_small_angles(swing: Fit) -> None:
    (panel,) = swing.comparisons
    assert np.max(np.abs(panel.points[0].y)) < np.deg2rad(25.0)


def test_the_decrement_is_said_to_grow_as_the_swing_falls(swing: Fit) -> None:
    (finding,) = [f for f in swing.findings if f.code == "residuals.white"]
    assert finding.level == "fail"
    assert "the damping grows as the amplitude falls" in swing.text(finding)


def test_mixed_dry_and_viscous_damping_is_preferred(swing: Fit) -> None:
    models = note(swing, "decays.damping")
    frame = models.frame
    assert frame["BIC"].idxmin() == "dry"
    assert (frame["BIC"].drop("dry") > 100.0).all()
    assert (frame["starts agree"] == "yes").all()
    assert "takes off the same amount every cycle" in swing.text(models)
    F_dry, error = _dry_friction(str(frame.loc["dry", "further"]))
    assert F_dry > 20.0 * error
    assert frame.loc["dry", "c, N s/m"] > 0.1


def test_the_dry_friction_is_what_the_peaks_lose(swing: Fit) -> None:
    frame = note(swing, "decays.damping").frame
    F_dry, _ = _dry_friction(str(frame.loc["dry", "further"]))
    time, angle = pendulum(3)
    angle = angle[time >= START]
    index = np.sort(np.concatenate([find_peaks(side * angle, distance=250, height=0.1)[0] for side in (1.0, -1.0)]))
    height = np.abs(angle[index])
    # Of neighbours, so that the zero of the encoder drops out: next = ratio · this - shift (1 + ratio).
    size = 0.5 * (height[1:] + height[:-1])
    ratio, intercept = np.polyfit(size[:-1], size[1:], 1)
    assert F_dry / frame.loc["dry", "k1, N/m"] == pytest.approx(-intercept / (1.0 + ratio), rel=0.15)


def test_a_viscous_swing_is_not_taken_for_a_dry_one(tmp_path: Path) -> None:
    time, _ = pendulum(3)
    rng = np.random.default_rng(5)
    angle = 0.6 * np.exp(-0.52 * (time - 1.0)) * np.cos(10.9 * time) + 0.002 * rng.standard_normal(time.size)
    rig = _rig(tmp_path, time, RESOLUTION * np.round(angle / RESOLUTION))
    (record,) = make_experiments(rig)
    assert isinstance(record, FreeVibration)
    assert record.damping_trend() == {}
    scores = {}
    for damping in DAMPING_MODELS:
        target = LogPosterior(rig, [record.with_model(DecayModel((damping,) if damping in DAMPING else ()))])
        fit = point_fit(target, seed=1)
        scores[damping] = bic(target, fit)
        assert fit.agree
    assert min(scores, key=lambda name: scores[name]) == "viscous"
    # What is not there costs its unknown and gains next to nothing.
    assert all(0.0 < scores[name] - scores["viscous"] < 2.0 * np.log(record.n) for name in ("dry", "quadratic"))


def _dry_friction(text: str) -> tuple[float, float]:
    """Value and standard error out of ``F_dry = 1.959 ± 0.023``."""
    found = re.fullmatch(r"F_dry = ([\d.e-]+) ± ([\d.e-]+)", text)
    assert found is not None
    return float(found[1]), float(found[2])
