"""The word of a parameter follows from the findings about the experiments that inform it."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.checks.verdict import trust_words
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.result import Posterior
from capsule_id.inference.target import LogPosterior
from capsule_id.synthetic import synthesize
from capsule_id.views import Finding, Trust
from tests.measured.folders import Entry, make_rig, quantity


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> SampledFit:
    """A bench without runs; no check reads the draws of its sample."""
    folder = tmp_path_factory.mktemp("trust") / "rig"
    synthesize(folder, 0)
    rig = read_rig(folder)
    target = LogPosterior(rig, make_experiments(rig))
    fit = point_fit(target, 0, 1)
    nothing = np.zeros(target.dimension)
    draws = np.zeros((1, 1, 1, target.dimension))
    posterior = Posterior(target.names, draws, draws[..., 0], *[nothing] * 6, 1.0, True, {}, 1, 1)
    return SampledFit(target, fit, posterior, {**target.fixed, **fit.values})


def words(fitted: SampledFit, *findings: Finding, uninformed: str = "") -> dict[str, Trust]:
    known = np.array([name != uninformed for name in fitted.target.names])
    return trust_words(replace(fitted, findings=findings), known)


def test_a_clean_sample_is_trusted_and_a_point_fit_is_not_judged(sampled: SampledFit) -> None:
    assert set(words(sampled, Finding("x", "warn", {}, "motor_current")).values()) == {"trusted"}
    assert set(words(replace(sampled, posterior=None)).values()) == {"not judged"}


def test_a_failed_check_concerns_the_parameters_of_its_experiment(sampled: SampledFit) -> None:
    for fitted in (sampled, replace(sampled, posterior=None)):
        found = words(fitted, Finding("x", "fail", {}, "free_vibration_1"))
        assert [name for name, word in found.items() if word == "not trusted"] == [
            "k1",
            "c",
            "noise_sd[free_vibration_1]",
        ]


def test_a_finding_may_name_its_parameters_or_concern_all(sampled: SampledFit) -> None:
    named = words(sampled, Finding("x", "fail", {}, "free_vibration_1", ("m1",)))
    assert [name for name, word in named.items() if word == "not trusted"] == ["m1"]
    assert set(words(sampled, Finding("x", "fail")).values()) == {"not trusted"}


def test_what_the_data_do_not_inform_is_not_judged_except_a_weighing(sampled: SampledFit) -> None:
    assert words(sampled, uninformed="v_s")["v_s"] == "not judged"
    assert words(sampled, uninformed="m1")["m1"] == "trusted"
    assert words(sampled, Finding("x", "fail"), uninformed="v_s")["v_s"] == "not trusted"


def test_a_warning_that_names_parameters_leaves_them_not_judged(sampled: SampledFit) -> None:
    found = words(sampled, Finding("x", "warn", {}, "motor_current", ("K",)))
    assert [name for name, word in found.items() if word == "not judged"] == ["K"]


def test_what_only_very_few_rows_inform_is_not_judged(sampled: SampledFit) -> None:
    """Before: a calibration of four rows along a curve was trusted."""
    few = [Finding("readings.few", "warn", {}, "motor_current")]
    assert words(sampled, *few)["K"] == "not judged"
    assert words(sampled, *few, Finding("x", "fail", {}, "motor_current"))["K"] == "not trusted"
    # Other records inform k1 too.
    assert words(sampled, Finding("readings.few", "warn", {}, "free_vibration_1"))["k1"] == "trusted"


def test_a_stated_slope_is_trusted_beside_very_few_rows(sampled: SampledFit, tmp_path: Path) -> None:
    pulls = Entry("static_friction", "pulls", {"force [N]": np.array([4.1, 4.2, 4.3])})
    slope = '{ value = 1.0, sd = 0.1, unit = "deg" }'
    rig = make_rig(tmp_path, pulls, head={"m1": quantity(0.11, "kg"), "m2": quantity(0.53, "kg"), "slope": slope})
    target = LogPosterior(rig, make_experiments(rig))
    found = words(replace(sampled, target=target), Finding("readings.few", "warn", {}, "pulls"))
    assert (found["mu"], found["slope"]) == ("not judged", "trusted")


def test_the_words_are_ordered_from_best_to_worst() -> None:
    assert get_args(Trust) == ("trusted", "not judged", "not trusted")
