"""What an error of the initial state becomes over a record, with a negative control."""

import numpy as np

from capsule_id.experiments.forced_run.experiment import ForcedRun
from capsule_id.experiments.forced_run.predictability import LARGEST_GROWTH, check_predictable, growth
from capsule_id.inference.checks.setting import Setting
from capsule_id.inference.result import PointFit
from capsule_id.inference.target.log_posterior import LogPosterior
from tests.forced_runs import make, theta


def test_a_motion_that_forgets_its_start_is_predictable_and_a_chaotic_one_is_not() -> None:
    run = make(0, samples=2000)
    assert growth(run, theta(0)) < 1.0
    assert check_predictable([run], fitted(run, theta(0)))[0].level == "ok"
    # The chaotic motion of tests/capsule/test_lyapunov.py.
    wild = theta(0) | {"m2": 0.3, "k2": 56410.0, "c": 0.5, "mu": 0.2, "G": 0.5e-3, "I_d": 4.0}
    assert growth(run, wild) > LARGEST_GROWTH
    found = check_predictable([run], fitted(run, wild))
    assert found[0].level == "fail"
    assert found[0].experiment == "run_1"


def fitted(run: ForcedRun, values: dict[str, float]) -> Setting:
    """A fit of ``run`` alone at ``values`` by symbol."""
    by_symbol = {row.symbol: row.name for row in run.parameters}
    named = {by_symbol.get(symbol, symbol): value for symbol, value in values.items()}
    target, none = LogPosterior(run.rig, [run]), np.zeros((1, 1))
    fit = PointFit(target.names, none[0], named, none, {}, none, none, none[0], none[0] > 0, none[0] > 0)
    return Setting(target, fit, None, named)
