"""Friction tests under misfit: the default law fails where the ratio is another, the free ratio covers the truth."""

import numpy as np
from scipy import stats

from tests.experiments.friction_calibration import MISFITS, outcome


def test_outcomes_of_one_twin_of_each_misfit() -> None:
    default, free, sessions = (outcome(misfit, 100) for misfit in MISFITS)
    assert (default.clean, free.clean, sessions.clean) == (False, True, False)
    assert np.max(np.abs(free.z)) < 4.0
    # The widened interval of the sessions covers the truth, by Student's quantile for up to eight parts; that of the
    # wrong law does not cover v_s.
    assert np.max(np.abs(sessions.z)) < stats.t.ppf(0.975, 7)
    assert np.max(np.abs(default.z)) > 4.0
