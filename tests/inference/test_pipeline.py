"""The stages of a fit, run one by one, give the numbers of ``capsule_id.fit``."""

import dataclasses
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import pytest

import capsule_id as cid
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference.pipeline import (
    check_fit,
    check_readings,
    make_result,
    provenance,
    sample_posterior,
    stage_seeds,
)
from capsule_id.inference.point_stage import SampledFit, fit_points
from capsule_id.inference.result import Pointwise, Posterior
from capsule_id.inference.target import LogPosterior
from tests.cli_tools import small_rig

BUDGET = 40


def test_stages_one_by_one_give_the_numbers_of_the_whole(tmp_path: Path) -> None:
    folder = small_rig(tmp_path / "rig", tables=("motor_current",))
    kinds = default_registry()
    rig = cid.read_rig(folder, kinds)
    seeds = stage_seeds(3)
    experiments = make_experiments(rig, "bench", kinds)
    target = LogPosterior(rig, experiments)
    point = fit_points(target, kinds, seeds.starts, True)
    sampled = sample_posterior(point, seeds.walkers, BUDGET)
    before = check_readings(rig, "bench", kinds)
    checked = check_fit(sampled, before)
    assert before
    assert [found for found in checked.findings if found in before] == list(before)
    result = make_result(checked, kinds, seeds.report, provenance(rig, 3, "bench", "eq. (1)"))
    assert sampled.findings == ()
    assert len(checked.findings) > 5
    for stage in (point, sampled, checked, result):
        with pytest.raises(dataclasses.FrozenInstanceError):
            stage.fit = None  # type: ignore[misc]
    whole = cid.fit(rig, 3, "bench", BUDGET)
    pd.testing.assert_frame_equal(result.summary, whole.summary, check_exact=True)
    pd.testing.assert_frame_equal(result.nuisances, whole.nuisances, check_exact=True)
    assert result.findings == whole.findings
    assert result.provenance == whole.provenance
    assert [note.code for note in result.notes] == [note.code for note in whole.notes]
    assert [item.predictive_p for item in result.comparisons] == [item.predictive_p for item in whole.comparisons]
    own, other = cast(Pointwise, result.pointwise), cast(Pointwise, whole.pointwise)
    assert list(own.log_likelihood) == list(other.log_likelihood)
    for label, values in own.log_likelihood.items():
        np.testing.assert_array_equal(values, other.log_likelihood[label])
        np.testing.assert_array_equal(own.replicates[label], other.replicates[label])
    # Negative control: another seed gives another sample.
    another = sample_posterior(cast(SampledFit, point), stage_seeds(4).walkers, BUDGET)
    draws = [cast(Posterior, each.posterior).draws for each in (another, result)]
    assert not np.array_equal(*draws)
