"""The phase portrait: record and model through one filter, which lets the contacts pass."""

import numpy as np
import pytest

from capsule_id.experiments.forced_run.drives import _filtered, _portrait
from capsule_id.records.view import FILTER_ORDER
from capsule_id.rig.filters import choose_window
from tests.forced_runs import make, theta

N = 1000


@pytest.mark.full
def test_the_portrait_shows_the_contacts_and_a_wrong_model() -> None:
    run = make(1, samples=N)
    (panel,) = _portrait(run, theta(1))
    (record,), (fitted, _) = panel.points, panel.curves
    motion = run.motion(theta(1), np)
    size = np.ptp(np.asarray(motion.Y1 - motion.Y2))
    # The edges of the filter, whose rates are those of a polynomial's end, are left out.
    left_out = N - fitted.x.size
    assert record.x.size == fitted.x.size
    assert 0 < left_out < 0.05 * N
    through = np.sqrt(np.mean((record.y - fitted.y) ** 2))
    assert through < 0.03 * size
    # The rate is that of the model, in the contacts too. A filter chosen for the drive alone hides them.
    rate = np.asarray(motion.Y1 - motion.Y2)
    assert np.max(np.abs(fitted.y - rate[left_out // 2 : -(left_out // 2)])) < 0.06 * size
    x_rel = np.asarray(motion.x_rel)
    hidden = _filtered(run.time, x_rel, choose_window(run.time, x_rel, FILTER_ORDER))[1]
    half = (N - hidden.size) // 2
    assert np.max(np.abs(hidden - rate[half:-half])) > 0.2 * size
    (other,) = _portrait(run, theta(1) | {"k1": 1.1 * theta(1)["k1"]})
    assert np.sqrt(np.mean((record.y - other.curves[0].y) ** 2)) > 2.0 * through
