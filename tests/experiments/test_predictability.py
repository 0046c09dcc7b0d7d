"""What an error of the initial state becomes over a record, with a negative control."""

import numpy as np
import pytest
from scipy.linalg import expm

from capsule_id.experiments.forced_run import experiment as predictability
from capsule_id.experiments.forced_run.drives import ForcedRun, check_predictable
from capsule_id.experiments.forced_run.experiment import LARGEST_GROWTH, growth
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from tests.forced_runs import make, theta

#: The chaotic motion of tests/motions/test_lyapunov.py.
WILD = {"m2": 0.3, "k2": 56410.0, "c": 0.5, "mu": 0.2, "G": 0.5e-3, "I_d": 4.0}


@pytest.mark.full
def test_an_oscillator_in_a_heavy_capsule_has_its_closed_form() -> None:
    """Without contacts and sliding: the matrix exponential of m1 x'' + c x' + k1 x = drive. Y2 decays at once."""
    run = make(1, samples=400)
    values = theta(1) | {"m2": 1e4, "G": 1.0, "c": 0.1}
    matrix = np.array([[0.0, 1.0], [-values["k1"] / values["m1"], -values["c"] / values["m1"]]])
    end = expm(matrix * (run.time[-1] - run.time[0]))
    scale = np.array([1.0, run.Omega])
    # An error of Y2 is one of the rod's speed as well, and the capsule stops.
    known = np.linalg.norm((end * scale / scale[:, None])[:, [0, 1, 1]], 2)
    assert growth(run, values) == pytest.approx(known, rel=1e-3)
    assert growth(run, values | {"c": 1.0}) < 0.9 * known


@pytest.mark.full
@pytest.mark.parametrize(("number", "samples", "exact"), [(0, 600, 8837.48), (2, 1500, 346611.0), (3, 1500, 77621.0)])
def test_differences_agree_with_those_of_scipy(number: int, samples: int, exact: float) -> None:
    """Chaotic motions, while rounding does not change them yet. ``exact``: central differences by tests.scipy_capsule.

    Their steps are 1e-8 of the motion, with rtol 1e-13 and max_step 0.2 ms (2 ms for the last): a longer one misses
    contacts. After 2000 samples engines of an accuracy of 1e-13 m differ by 2e-6 m and their factors by 3 %.
    """
    assert growth(make(number, samples=samples), theta(number) | WILD) == pytest.approx(exact, rel=0.01)


@pytest.mark.full
def test_a_factor_beyond_differences_is_extrapolated(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first instant above 1e4 of a record that reaches about 8e7."""
    monkeypatch.setattr(predictability, "MEASURABLE", 1e4)
    found = growth(make(3, samples=2000), theta(3) | WILD)
    assert np.log(found) == pytest.approx(np.log(85943570.0), rel=0.5)
    assert found != pytest.approx(85943570.0, rel=0.1)


def test_a_motion_that_forgets_its_start_is_predictable_and_a_chaotic_one_is_not() -> None:
    run = make(0, samples=2000)
    assert growth(run, theta(0)) < 1.0
    assert check_predictable([run], fitted(run, theta(0)))[0].level == "ok"
    wild = theta(0) | WILD
    assert growth(run, wild) > LARGEST_GROWTH
    found = check_predictable([run], fitted(run, wild))
    assert found[0].level == "fail"
    assert found[0].experiment == "run_1"


def fitted(run: ForcedRun, values: dict[str, float]) -> SampledFit:
    """A fit of ``run`` alone at ``values`` by symbol."""
    by_symbol = {row.symbol: row.name for row in run.parameters}
    named = {by_symbol.get(symbol, symbol): value for symbol, value in values.items()}
    target, none = LogPosterior(run.rig, [run]), np.zeros((1, 1))
    fit = PointFit(target.names, none[0], named, none, {}, none, none, none[0], none[0] > 0, none[0] > 0)
    return SampledFit(target, fit, None, named)
