"""The phase portrait: the record beside the model seen through the same filter."""

import numpy as np

from capsule_id.experiments.forced_run.drives import _portrait
from capsule_id.records.view import FILTER_ORDER
from capsule_id.rig.filters import choose_window, sampling_step, window_samples
from tests.forced_runs import make, theta

N = 1000


def test_the_filter_explains_what_the_portrait_shows_and_its_edges_are_left_out() -> None:
    run = make(1, samples=N)
    (panel,) = _portrait(run, theta(1))
    (record,) = panel.points
    plain, filtered, _ = panel.curves
    window = window_samples(choose_window(run.time, run.channels[0].values, FILTER_ORDER), sampling_step(run.time))
    assert record.x.size == filtered.x.size == N - (window - 1)
    inside = slice(window // 2, N - window // 2)
    through = np.max(np.abs(record.y - filtered.y))
    assert through < 0.03 * np.ptp(plain.y)
    assert np.max(np.abs(record.y - plain.y[inside])) > 5.0 * through
    # A wrong stiffness shows through the filter too.
    (other,) = _portrait(run, theta(1) | {"k1": 1.1 * theta(1)["k1"]})
    assert np.max(np.abs(record.y - other.curves[1].y)) > 5.0 * through
