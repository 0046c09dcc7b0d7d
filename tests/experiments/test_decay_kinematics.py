"""Channels of one decay that contradict each other are named; those of one motion are not."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from capsule_id.experiments.free_vibration.models import decay
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.read import read_rig
from capsule_id.views import Finding
from tests.experiments import bench

KINDS = default_registry()
TIME = np.arange(250) / 500.0


def findings(folder: Path, *, velocity: str = 'unit = "m/s"', forces: dict[str, float] | None = None) -> list[Finding]:
    """What is said of the channels of a decay, its velocity mapped with these words."""
    own = {"k1": bench.K1, "c": 1.0, "m1": bench.M1, **(forces or {})}
    motion = decay(TIME, own, 2e-3, 0.0, 30)
    noisy = [
        np.asarray(one) + 0.005 * np.ptp(one) * stats.norm.rvs(size=len(TIME), random_state=i)
        for i, one in enumerate(motion)
    ]
    folder.mkdir(exist_ok=True)
    np.savetxt(folder / "decay.csv", np.stack([TIME, *noisy], axis=1), delimiter=",", header="t,x,v,a", comments="")
    (folder / "rig.toml").write_text(
        '[rig]\nname = "a"\nm1 = { value = 110, sd = 0.2, unit = "g" }\n[[experiment]]\nkind = "free_vibration"\n'
        'file = "decay.csv"\n[experiment.columns]\ntime = { from = "t", unit = "s" }\nx_rel = { from = "x", unit = "m" }\n'
        f'velocity = {{ from = "v", {velocity} }}\nacceleration = {{ from = "a", unit = "m/s^2" }}\n',
        encoding="utf-8",
    )
    rig = read_rig(folder, KINDS)
    return [found for found in lint(rig, KINDS, rig.tables) if found.code == "decays.kinematics"]


@pytest.mark.full
@pytest.mark.parametrize("forces", [{}, {"F_dry": 0.05 * bench.K1 * 2e-3}, {"c": 8.0}])
def test_channels_of_one_motion_raise_nothing(tmp_path: Path, forces: dict[str, float]) -> None:
    assert findings(tmp_path, forces=forces) == []


@pytest.mark.parametrize(("words", "ratio"), [('unit = "mm/s"', 1e-3), ('unit = "m/s", scale = 42', 42.0)])
def test_a_velocity_in_another_unit_is_named(tmp_path: Path, words: str, ratio: float) -> None:
    (found,) = findings(tmp_path, velocity=words)
    assert found.facts["ratio"] == pytest.approx(ratio, rel=0.02)
    assert "Check the units of both columns" in finding_text(found, messages_of(KINDS))


def test_a_turned_sign_is_called_a_sign_and_its_remedy_works(tmp_path: Path) -> None:
    (found,) = findings(tmp_path, velocity='unit = "m/s", scale = -1')
    text = finding_text(found, messages_of(KINDS))
    assert "velocity must be the derivative of x_rel" in text
    assert "scale = -1" in text
    assert findings(tmp_path, velocity='unit = "m/s", scale = 1') == []
