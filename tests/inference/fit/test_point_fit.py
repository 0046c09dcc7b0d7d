"""The point fit against SciPy on the same readings, its standard errors, and starts that cannot agree."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import optimize

from capsule_id.api import read_rig
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference import marginal
from capsule_id.inference import point_fit as point_module
from capsule_id.inference.checks.posterior import check_starts
from capsule_id.inference.marginal import density_of
from capsule_id.inference.point_fit import dispersed_starts, point_fit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.synthetic import Truth, synthesize
from tests.measured.folders import Entry, make_rig, quantity


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> LogPosterior:
    folder = tmp_path_factory.mktemp("twin") / "rig"
    synthesize(folder, 21)
    rig = read_rig(folder)
    return LogPosterior(rig, make_experiments(rig))


@pytest.fixture(scope="module")
def fit(twin: LogPosterior) -> PointFit:
    return point_fit(twin, seed=5)


def test_all_starts_agree(fit: PointFit) -> None:
    assert fit.agree
    assert not fit.stalled.any()
    assert np.ptp(fit.log_posterior) < 1e-3


def test_starts_agree_where_errors_of_many_readings_hide_the_scatter(tmp_path: Path) -> None:
    """Before: its sd was that of 2n readings that show it, and ends 0.005 of its logarithm apart "did not agree"."""
    angle = 33.0 + 0.5 * np.random.default_rng(3).standard_normal(60_000)
    tilts = Entry("static_friction", "tilt", {"angle [deg]": angle}, {"angle_sd": quantity(0.502, "deg")})
    rig = make_rig(tmp_path, tilts)
    target = LogPosterior(rig, make_experiments(rig))
    fit = point_fit(target, seed=0)
    sd = np.sqrt(np.diag(fit.covariance))[target.scatter]
    assert fit.agree
    assert 0.1 < sd < 1.0  # of a logarithm; 0.003 = 120,000^-0.5 before


def test_it_is_a_maximum(twin: LogPosterior, fit: PointFit) -> None:
    """SciPy's simplex in whitened coordinates cannot climb: the gain stays below 1e-4, the step below 0.02 sd."""
    root = np.linalg.cholesky(fit.covariance)

    def objective(v: np.ndarray) -> float:
        return -float(density_of(twin)((fit.u + root @ v)[None])[0])

    step = 1e-3
    gradient = optimize.approx_fprime(np.zeros(twin.dimension), objective, step)
    backward = -optimize.approx_fprime(np.zeros(twin.dimension), lambda v: objective(-v), step)
    assert np.max(np.abs(0.5 * (gradient + backward))) < 0.02
    # The curvature of whitened coordinates is 1: forward less backward difference is the step.
    np.testing.assert_allclose((gradient - backward) / step, 1.0, atol=0.02)


def test_the_curvature_is_taken_anew_where_a_quarter_of_the_steps_does_not_suffice(
    twin: LogPosterior, fit: PointFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control: as many steps and one curvature stop before the maximum, and the other starts spend no more steps there."""
    calls, places = list[tuple[int, bool]](), list[tuple[float, ...]]()
    plain, curvature = point_module.polish, point_module.root_of_covariance

    def counted(*args: Any) -> tuple[np.ndarray, float, bool]:
        found = plain(*args)
        calls.append((args[3], found[2]))
        return found

    def placed(target: LogPosterior, u: np.ndarray, *rest: Any) -> tuple[np.ndarray, np.ndarray]:
        places.append(tuple(u))
        return curvature(target, u, *rest)

    monkeypatch.setattr(point_module, "polish", counted)
    monkeypatch.setattr(point_module, "root_of_covariance", placed)
    monkeypatch.setattr(point_module, "BASIN_SOLVER", replace(point_module.BASIN_SOLVER, max_steps=1))  # ends far off
    monkeypatch.setattr(point_module, "MAX_STEPS", 40)
    again = point_fit(twin, seed=5)
    assert np.max(again.log_posterior) == pytest.approx(np.max(fit.log_posterior), abs=1e-4)
    assert calls[0] == (10, False)
    assert (10, True) in calls
    assert calls[-1][0] == 40
    assert len(set(places)) == len(places) > 2  # each time at another point
    calls.clear()
    monkeypatch.setattr(point_module, "MAX_STEPS", 10)
    monkeypatch.setattr(point_module, "ROUNDS", 1)
    assert point_fit(twin, seed=5).stalled.all()
    assert {steps for steps, _ in calls} == {10}


def test_one_difference_for_all_scatters_leads_to_the_same_maximum(
    twin: LogPosterior, fit: PointFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of more than a hundred parameters. From the start alone: it is far from the maximum in every scatter."""
    rows, batches = [], marginal.in_batches
    monkeypatch.setattr(point_module, "MANY", 0)
    monkeypatch.setattr(
        marginal, "in_batches", lambda f, points, n: (rows.append(len(points)), batches(f, points, n))[1]
    )
    again = point_fit(twin, 5, 1)
    scatters = int(np.sum(twin.integrated))
    assert scatters > 3
    assert 1 + 2 * (twin.dimension - scatters + 1) in rows
    assert 1 + 2 * twin.dimension not in rows
    assert not again.stalled.any()
    assert np.max(np.abs(again.u - fit.u) / np.sqrt(np.diag(fit.covariance))) < 0.01
    assert again.log_posterior[0] == pytest.approx(np.max(fit.log_posterior), abs=1e-6)


def test_springs_against_scipy(twin: LogPosterior, fit: PointFit) -> None:
    """A line with stated errors of both columns: k2 is the ordinary slope, its standard error that of least squares."""
    for experiment in twin.experiments:
        if experiment.kind == "support_spring":
            x, y = experiment.table["deflection"], experiment.table["force"]
            (slope, _), scaled = np.polyfit(x, y, 1, cov="unscaled")
            columns = experiment.table.columns
            noise = np.hypot(columns["force"].reading_sd, slope * columns["deflection"].reading_sd)
            name = next(row.name for row in experiment.parameters if row.symbol == "k2")
            assert fit.values[name] == pytest.approx(slope, rel=1e-4)
            assert fit.standard_errors[name] == pytest.approx(noise * np.sqrt(scaled[0, 0]), rel=2e-3)


def test_truth_is_within_reach(fit: PointFit) -> None:
    for name, truth in Truth().items():
        if name in fit.values:
            assert abs(fit.values[name] - truth) < 4.0 * fit.standard_errors[name], name


@pytest.mark.parametrize(
    ("log_posterior", "at_other_maximum", "stalled", "level"),
    [
        ([0.0, 0.0, 0.0], [0, 0, 0], [0, 0, 0], "ok"),
        ([0.0, 0.0, -100.0], [0, 0, 1], [0, 0, 1], "warn"),
        ([0.0, 0.0, -5.0], [0, 0, 1], [0, 0, 0], "fail"),
        ([0.0, -100.0, -100.0], [0, 1, 1], [0, 0, 0], "fail"),
        ([0.0, 0.0, 0.0], [0, 0, 0], [0, 1, 0], "ok"),
        ([0.0, 0.0, 0.0], [0, 0, 0], [1, 1, 1], "fail"),
    ],
)
def test_other_maxima_are_judged_by_the_mass_they_can_hold(
    fit: PointFit, log_posterior: list[float], at_other_maximum: list[int], stalled: list[int], level: str
) -> None:
    other = replace(
        fit,
        starts=fit.starts[:3],
        ends=fit.u + 3.0 * np.array(at_other_maximum)[:, None],
        log_posterior=np.array(log_posterior),
        at_other_maximum=np.array(at_other_maximum, dtype=bool),
        stalled=np.array(stalled, dtype=bool),
    )
    assert [finding.level for finding in check_starts(other)] == [level]


@pytest.mark.full
def test_starts_are_away_from_each_other(twin: LogPosterior) -> None:
    """The first is the proposed centre; every other leaves it in every parameter by at least a third of its spread."""
    starts = dispersed_starts(twin, 3, 6)
    spread = np.array([twin.starts()[name].spread for name in twin.names])
    distance = np.abs(starts[1:] - starts[0]) / spread
    assert distance.min() >= 1.0 / 3.0 - 1e-12
    assert np.array_equal(dispersed_starts(twin, 3, 6), starts)
    assert not np.array_equal(dispersed_starts(twin, 4, 6)[1:], starts[1:])


def test_seeds_do_not_move_the_maximum(twin: LogPosterior, fit: PointFit) -> None:
    other = point_fit(twin, seed=77)
    sd = np.sqrt(np.diag(fit.covariance))
    np.testing.assert_allclose((other.u - fit.u) / sd, 0.0, atol=0.05)
    np.testing.assert_allclose(other.covariance / np.outer(sd, sd), fit.covariance / np.outer(sd, sd), atol=0.02)
