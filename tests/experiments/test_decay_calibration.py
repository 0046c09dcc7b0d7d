"""Calibration of decays under misfit: the second fit covers the truth, the default model does not."""

import numpy as np
import pytest

from tests.experiments.decay_calibration import MISFITS, coverage, outcome

#: Twins of each misfit in the study.
NUMBER = 10


def test_a_drifting_decay_is_clean_and_right() -> None:
    found = outcome("drift", 0)
    assert (found.clean, found.model) == (True, "viscous damping, Gaussian-process drift")
    assert np.max(np.abs(found.z)) < 4.0


def test_the_default_model_is_not_clean_and_wrong_by_many_sds() -> None:
    """Negative control: where all words are stated there is no second fit."""
    found = outcome("dry", 0, damping=("viscous",), stiffness="linear", drift="none", noise="white")
    assert (found.clean, found.model) == (False, "stated")
    assert np.max(np.abs(found.z)) > 4.0


@pytest.mark.slow
def test_clean_results_cover_the_truth() -> None:
    found = [outcome(misfit, seed) for seed in range(NUMBER) for misfit in MISFITS]
    clean, covered, wrong = coverage(found)
    assert clean >= 0.6
    # Of 80 values 68 or fewer are covered with probability 0.03 where the coverage is 0.9.
    assert covered > 0.85
    assert wrong <= 0.01
