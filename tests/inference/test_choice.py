"""Choice of the model: the variants of a rig, the density of a setting left out, the recommendation."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.experiments.progression.twin import ROBOT, RobotDesign, synthesize_robot
from capsule_id.inference.choice.compare import _choose, _Variant
from capsule_id.inference.choice.leave_out import conditional_densities
from capsule_id.inference.choice.variants import variants_of
from capsule_id.rig.model import ModelChoices, Rig

PERIODS = 1e-3 * np.array([60.0, 80.0, 100.0])
THETA = {**ROBOT, "g": 9.81, "session_sd": 0.05, "trial_scatter": 0.04, "trial_sd": 1e-3, "discrepancy": 2e-4}


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    folder = tmp_path_factory.mktemp("robot") / "rig"
    synthesize_robot(folder, 1, RobotDesign(PERIODS, np.full(3, 0.3), sessions=2))
    return read_rig(folder)


def test_each_word_varies_its_own_choice(rig: Rig) -> None:
    found = variants_of(rig, ["friction", "reaction", "lag"])
    assert list(found) == [
        "as stated", "constant friction", "eq. (1)", "viscous part", "direction", "reaction on the ground", "no lag",
    ]  # fmt: skip
    assert found["as stated"] == ModelChoices("stribeck", ("ratio", "lag"), "capsule")
    assert found["constant friction"].free == ("lag",)
    assert found["no lag"].free == ("ratio",)
    assert found["reaction on the ground"].reaction == "ground"
    with pytest.raises(InputError, match="--compare takes some of friction,reaction,lag,cubic, lagg"):
        variants_of(rig, ["lagg"])


def test_a_setting_left_out_has_the_conditional_density(rig: Rig) -> None:
    (e,) = make_experiments(rig)
    assert isinstance(e, Progression)
    misfit = e.misfit(THETA)
    covariance = np.diag(misfit.sd**2) + misfit.design @ misfit.design.T
    found = conditional_densities(e, [THETA, THETA])
    for setting, column in enumerate(e.setting.T):
        rest = np.flatnonzero(column == 0.0)
        # p(y_b | y_rest) = p(y) / p(y_rest)
        joint = multivariate_normal(cov=covariance).logpdf(misfit.raw)
        other = multivariate_normal(cov=covariance[np.ix_(rest, rest)]).logpdf(misfit.raw[rest])
        np.testing.assert_allclose(found[:, setting], joint - other, rtol=1e-6)


def variant(parameters: int, density: list[float]) -> _Variant:
    return _Variant(parameters, 0.0, np.array(density), 0.3, 0)


def test_the_simplest_variant_within_two_standard_errors_is_recommended() -> None:
    fitted = {
        "best": variant(5, [1.0, 1.2, 0.9, 1.1]),
        "as good": variant(4, [0.9, 1.3, 0.9, 1.0]),
        "wrong": variant(3, [-3.0, -2.5, -3.1, -2.9]),
    }
    choice = _choose(fitted, dict.fromkeys(fitted, ModelChoices(free=("lag",))))
    assert list(choice.table.index) == ["best", "as good", "wrong"]
    assert choice.recommended == "as good"
    assert 'free = ["lag"]' in choice.line
    difference = np.array(fitted["as good"].density) - np.array(fitted["best"].density)
    assert choice.table.loc["as good", "se"] == pytest.approx(2.0 * np.std(difference, ddof=1))
