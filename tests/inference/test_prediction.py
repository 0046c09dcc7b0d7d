"""Predictions of progressions: their spread is that of new trials, and faults of the settings are named."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.inference.prediction import predict
from capsule_id.inference.result import Result
from capsule_id.report.figures.fits import side_by_side
from capsule_id.synthetic import ROBOT, RobotDesign, robot_progression, synthesize_robot

PERIODS = 1e-3 * np.array([60.0, 80.0, 100.0])
DESIGN = RobotDesign(PERIODS, np.full(3, 0.3), sessions=3, session_sd=0.05, trial_sd=1e-3)
NAMES = ("m1", "m2", "k1", "c", "mu", "v_s", "ratio", "P_on", "lag", "session_sd", "trial_scatter")
OWN = {"trial_sd[progression]": 1e-3, "discrepancy[progression]": 1e-12}
SETTINGS = "period [ms],duty [%],periods [1]\n60,30,67\n80,30,50\n100,30,40\n"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """A fit that knows the truth: every draw is the truth."""
    folder = tmp_path_factory.mktemp("robot") / "rig"
    synthesize_robot(folder, 1, DESIGN)
    truth = {**ROBOT, "session_sd": 0.05, "trial_scatter": 0.04, **OWN}
    names = (*NAMES, *OWN)
    draws = np.broadcast_to(np.array([truth[name] for name in names]), (2, 32, 32, len(names)))
    posterior = SimpleNamespace(names=names, draws=draws)
    rig, registry = read_rig(folder), default_registry()
    observed = {"progression": rig.tables[0]["distance"]}
    return cast(Any, SimpleNamespace(rig=rig, registry=registry, posterior=posterior, observed=observed, fixed={}))


@pytest.mark.full
@pytest.mark.parametrize(("draws", "seeds"), [(500, 60), pytest.param(1500, 120, marks=pytest.mark.slow)])
def test_the_band_is_that_of_new_trials_in_new_sessions(result: Result, tmp_path: Path, draws: int, seeds: int) -> None:
    path = tmp_path / "settings.csv"
    path.write_text(SETTINGS)
    made = predict(result, path, draws=draws)
    table = made.table
    assert list(table) == ["distance [mm]", "distance_lower [mm]", "distance_upper [mm]", "mean_velocity [mm/s]"]
    # The twin has no two sessions alike: its tables are new trials.
    trials = np.array([robot_progression(seed, DESIGN)["distance [mm]"][::3] for seed in range(seeds)])
    inside = (trials >= table["distance_lower [mm]"].to_numpy()) & (trials <= table["distance_upper [mm]"].to_numpy())
    assert 0.90 <= inside.mean() <= 0.985
    np.testing.assert_allclose(
        table["distance [mm]"], np.median(trials, axis=0), atol=0.2 * np.std(trials, axis=0).max()
    )
    time = np.array([60.0 * 67, 80.0 * 50, 100.0 * 40]) * 1e-3
    np.testing.assert_allclose(table["mean_velocity [mm/s]"], table["distance [mm]"] / time)
    (panel,) = made.panels
    (curve,), (points,) = panel.curves, panel.points
    np.testing.assert_allclose(curve.x, [60.0, 80.0, 100.0])
    for name, drawn in (("distance", curve.y), ("distance_lower", curve.lower), ("distance_upper", curve.upper)):
        np.testing.assert_allclose(drawn, table[f"{name} [mm]"] / time)
    measured = 1e3 * result.rig.tables[0]["distance"]
    np.testing.assert_allclose(sorted(points.y), sorted(measured / np.repeat(time, 3)))


@pytest.mark.full
def test_settings_of_other_duties_have_panels_of_their_own(result: Result, tmp_path: Path) -> None:
    """In any order of rows; a duty without trials has no points."""
    path = tmp_path / "settings.csv"
    path.write_text("period [ms],duty [%],periods [1]\n80,40,50\n100,30,40\n60,40,67\n")
    made = predict(result, path, draws=16)
    assert [panel.title for panel in made.panels] == [
        "progression, duty 30 %: mean velocity", "progression, duty 40 %: mean velocity",
    ]  # fmt: skip
    one, two = made.panels
    assert [len(points.x) for points in one.points] == [9]
    assert two.points == ()
    speed = made.table["mean_velocity [mm/s]"].to_numpy()
    assert one.curves[0].y.tolist() == [speed[1]]
    assert two.curves[0].x.tolist() == [60.0, 80.0]
    assert two.curves[0].y.tolist() == [speed[2], speed[0]]
    figure = side_by_side(made.panels)
    assert [ax.get_title(loc="left") for ax in figure.axes] == [panel.title for panel in made.panels]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("period [ms],periods [1]\n60,67\n", "the settings must have the drive columns of progression: duty, none"),
        ("period [ms],duty [%],periods [1],distance [mm]\n60,30,67,1\n", "unknown column in progression, 'distance'"),
        ("period [ms],duty [%],periods [1]\n-60,30,67\n", "period must be greater than 0"),
        # Before: a displacement between those of 50 and 51 periods, which no trial has.
        ("period [ms],duty [%],periods [1]\n60,30,50.5\n", "periods must be a whole number"),
    ],
)
def test_faults_of_the_settings_are_named(result: Result, tmp_path: Path, text: str, rule: str) -> None:
    path = tmp_path / "settings.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        predict(result, path, draws=16)
    assert rule in str(caught.value)
    assert caught.value.file == str(path)
    path.write_text(SETTINGS)
    assert len(predict(result, path, draws=1).table) == 3
