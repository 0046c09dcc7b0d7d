"""Bench against runs: against closed forms, each with a negative control."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from capsule_id.inference.checks.posterior import (
    Distance,
    _by_sample,
    agreement,
    check_agreement,
    disagreement,
)
from capsule_id.inference.result import PointFit
from capsule_id.parameters import parameter
from capsule_id.report.messages import FIT_MESSAGES, finding_text
from capsule_id.views import Finding

NAMES = ("k1", "c")
#: u and its sd from the runs alone, by name.
Alone = dict[str, tuple[float, float]]


def words(found: Finding) -> str:
    return finding_text(found, FIT_MESSAGES)


def fit(u: np.ndarray, covariance: np.ndarray) -> PointFit:
    values = dict(zip(NAMES, np.exp(u), strict=True))
    none = np.zeros((1, 2))
    return PointFit(NAMES, u, values, covariance, values, none, none, np.zeros(1), *np.zeros((2, 1), dtype=bool))


def estimates(rng: np.random.Generator, shift: float) -> tuple[Alone, PointFit]:
    """Runs and bench, two linear experiments; the runs see the first parameter ``shift`` too high."""
    bench_cov = np.array([[4e-6, 1e-6], [1e-6, 9e-6]])
    runs_cov = np.array([[1e-6, -5e-7], [-5e-7, 2e-6]])
    one = rng.multivariate_normal(np.zeros(2), bench_cov)
    other = rng.multivariate_normal([shift, 0.0], runs_cov)
    return dict(zip(NAMES, zip(other, np.sqrt(np.diag(runs_cov)), strict=True), strict=True)), fit(one, bench_cov)


def test_the_disagreement_is_standard_normal_where_there_is_none() -> None:
    rng = np.random.default_rng(1)
    z = np.array([_ordered(*estimates(rng, 0.0)) for _ in range(3000)])
    assert stats.kstest(z[:, 0], "norm").pvalue > 1e-3
    assert stats.kstest(z[:, 1], "norm").pvalue > 1e-3


def _ordered(runs: Alone, bench: PointFit) -> list[float]:
    found = disagreement(NAMES, runs, bench, None)
    return [found[name].z for name in NAMES]


def test_false_alarms_keep_to_their_level_and_a_shift_is_named() -> None:
    rng = np.random.default_rng(2)
    clean = [agreement(disagreement(NAMES, *estimates(rng, 0.0), None), True) for _ in range(1500)]
    alarms = np.mean([found.level == "fail" for found in clean])
    assert 0.01 < alarms < 0.03
    planted = [agreement(disagreement(NAMES, *estimates(rng, 0.015), None), False) for _ in range(50)]
    assert all(found.level == "warn" and "largest disagreement in k1" in words(found) for found in planted)


def test_without_a_sample_a_gross_disagreement_fails_and_a_moderate_one_warns() -> None:
    levels = {sd: agreement({"K": Distance(sd, sd), "c": Distance(0.0, 0.0)}, False).level for sd in (1.0, 5.0, 70.0)}
    assert levels == {1.0: "ok", 5.0: "warn", 70.0: "fail"}


def test_the_bench_test_of_the_largest_disagreement_is_named() -> None:
    """A motor gain 10 % off, which moves mu a little too."""
    found = {"K": Distance(15.0, 15.0), "mu": Distance(-5.0, -5.0)}
    tests = {"K": ["motor_current"], "mu": ["static_friction", "dynamic_friction"]}
    finding = agreement(found, True, tests)
    assert finding.level == "fail"
    assert "calibration of motor_current and repeat" in words(finding)
    assert "static_friction" not in words(finding)
    assert agreement({"K": Distance(0.5, 0.5)}, True, tests).level == "ok"


def test_named_is_where_the_error_came_from() -> None:
    """Heavy tails make nothing of what lies between 19 and 7 sd; a parameter that is no surprise is not named at all."""
    found = {"k1": Distance(30.0, 1.0), "v_s": Distance(-6.6, -4.1), "mu": Distance(18.6, 4.0), "c": Distance(2.0, 2.0)}
    text = words(agreement(found, True))
    assert "largest disagreement in mu (+18.6 sd" in text
    assert "then v_s (-6.6 sd" in text
    assert "p = 0.00025 by the bench's sample" in text
    assert "k1" not in text
    assert "c (" not in text
    assert "p < 1e-10 over" in words(agreement({"K": Distance(70.0, 70.0)}, False))


def test_what_is_not_finite_is_not_taken_for_agreement() -> None:
    nothing = Distance(float("nan"), float("nan"))
    found = agreement({"k1": nothing, "c": Distance(0.0, 0.0)}, True)
    assert found.level == "warn"
    assert "k1" in words(found)
    assert agreement({"k1": nothing, "c": Distance(9.0, 9.0)}, True).level == "fail"


def test_tails_follow_the_sample() -> None:
    draws = stats.t(5).rvs(100_000, random_state=3)
    for value in (0.5, 2.0, 6.0, 12.0):
        expected = -stats.norm.isf(stats.t(5).sf(value))
        assert _by_sample(draws, value, -1.0) == pytest.approx(expected, abs=0.35)
    # The normal density would call the farthest of these twelve sd.
    assert abs(_by_sample(draws, 12.0, -1.0)) < 5.0


def test_what_rig_toml_states_is_no_independent_estimate() -> None:
    """Bench and runs both hold the certificate of an instrument, the clock of a logger, the slope of the table."""
    rows = [parameter("gain", "cell"), parameter("clock_drift", "logger"), parameter("slope")]
    fitted: Any = SimpleNamespace(
        experiments=[SimpleNamespace(bench=False, parameters=rows)],
        bench=SimpleNamespace(names=tuple(row.name for row in rows)),
    )
    assert check_agreement(fitted) == []
