"""A synthetic robot from its folder to predictions, by the commands and by the public interface."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import capsule_id as cid
from capsule_id.cli import capsule_id, fit_params
from capsule_id.inference import proposal as refinement
from capsule_id.inference import sampling as ensembles

PERIODS = 1e-3 * np.array([60.0, 80.0, 100.0])
SETTINGS = "period [ms],duty [%],periods [1]\n70,30,20\n90,30,20\n"


@pytest.mark.slow
def test_a_robot_is_fitted_sampled_and_predicted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The default pilot takes minutes on a loaded machine; its moves are not what is tested.
    for module, name, value in (
        (ensembles, "PILOT_STEPS", 40),
        (refinement, "DRAWS", 256),
    ):
        monkeypatch.setattr(module, name, value)
    folder, out = tmp_path / "robot", tmp_path / "result"
    cid.synthesize_robot(folder, 1, cid.RobotDesign(PERIODS, np.full(3, 0.3), sessions=3))
    code = fit_params([str(folder), "--out", str(out), "--max-steps", "120", "--quiet"])
    assert code in (0, 3)
    (tmp_path / "settings.csv").write_text(SETTINGS)
    made = tmp_path / "predicted.csv"
    asked = ["predict", str(out), str(tmp_path / "settings.csv"), "--out", str(made)]
    asked += ["--figure", str(made.with_suffix(".png"))]
    assert capsule_id(asked) == code
    assert made.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    written = pd.read_csv(made, comment="#")
    loaded = cid.load(out).predict(tmp_path / "settings.csv")
    for name in loaded:
        np.testing.assert_allclose(written[name], loaded[name], rtol=1e-3, atol=1e-2)
    assert (loaded["distance_lower [mm]"] < loaded["distance [mm]"]).all()
    assert (loaded["distance [mm]"] < loaded["distance_upper [mm]"]).all()
