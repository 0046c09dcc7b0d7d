"""Runs of signs, largest residual and trend: calibrated on clean twins, large where the model or a reading is wrong."""

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.readings import DecayModel
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference.checks.posterior import (
    STATISTICS,
    check_statistics,
    decisive_readings,
    experiment_p_values,
    p_values,
)
from capsule_id.inference.result import Pointwise
from capsule_id.views import Finding
from tests.experiments import bench
from tests.scipy_decay import scipy_decay

KINDS = default_registry()
LINE_SD, DECAY_SD = 0.05, 2e-5  # N, m
Twin = tuple[Experiment, dict[str, float]]


def line(seed: int, bend: float = 0.0, outlier: float = 0.0) -> Twin:
    """A support spring of 11 readings; ``bend`` in N/m^2, ``outlier`` in sds, at a random reading."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 1e-3, 11)
    y = 18960.0 * x + LINE_SD * rng.standard_normal(11) + bend * (x - np.mean(x)) ** 2
    y[rng.integers(11)] += outlier * LINE_SD * rng.choice([-1, 1])
    table = bench.table("support_spring", [bench.column("deflection", x), bench.column("force", y)], spring="soft")
    (e,) = make_experiments(bench.rig(table), "bench", KINDS)
    return e, {"k2": 18960.0, "scatter": LINE_SD}


def decay(seed: int, F_dry: float = 0.0, outlier: float = 0.0) -> Twin:
    """A decay of 300 samples; ``F_dry`` in N is dry friction that the viscous model lacks."""
    rng = np.random.default_rng(seed)
    t = np.arange(300) * 1e-3
    forces = {"k1": bench.K1, "c": bench.C, "m1": bench.M1, "F_dry": F_dry}
    x = scipy_decay(t, forces, 2e-3, 0.0)[0] if F_dry else bench.released(t, 2e-3)
    x = x + DECAY_SD * rng.standard_normal(300)
    x[rng.integers(300)] += outlier * DECAY_SD * rng.choice([-1, 1])
    table = bench.table("free_vibration", [bench.column("time", t), bench.column("x_rel", x)])
    (e,) = make_experiments(bench.rig(table), "bench", KINDS)
    return e, {"k1": bench.K1, "c": bench.C, "noise_sd": DECAY_SD, "m1": bench.M1, "m2": bench.M2, "g": bench.G}


def shares(make: Callable[[int], Twin], number: int) -> dict[str, float]:
    """Share of twins with p < 0.05, by statistic."""
    found = [experiment_p_values(*make(seed)) for seed in range(number)]
    return {name: float(np.mean([p[name] < 0.05 for p in found])) for name in STATISTICS}


@pytest.mark.full
@pytest.mark.parametrize("make", [line, decay])
def test_clean_twins_have_small_p_values_as_often_as_they_should(make: Callable[[int], Twin]) -> None:
    """20 twins: at most 20 %. The study of 200 is slow."""
    assert max(shares(make, 20).values()) <= 0.2


@pytest.mark.slow
@pytest.mark.parametrize("make", [line, decay])
def test_of_200_clean_twins_2_to_9_percent_have_a_small_p_value(make: Callable[[int], Twin]) -> None:
    assert all(0.02 <= share <= 0.09 for share in shares(make, 200).values())


@pytest.mark.full
@pytest.mark.parametrize(
    ("make", "statistic"),
    [
        (partial(line, bend=1.2e6), "trend"),  # leaves the line by 0.3 N at both ends, 6 sd
        (partial(decay, outlier=6.0), "largest"),
        (partial(decay, F_dry=0.02), "sign runs"),  # 2 % of the first spring force is 0.06 N
    ],
)
@pytest.mark.parametrize(("rigs", "least"), [(8, 0.87), pytest.param(50, 0.9, marks=pytest.mark.slow)])
def test_what_the_scatter_cannot_absorb_is_found(
    make: Callable[[int], Twin], statistic: str, rigs: int, least: float
) -> None:
    assert shares(make, rigs)[statistic] >= least


def test_the_noise_level_does_not_matter() -> None:
    """The p-values of residuals and of ten times the residuals are equal: a fitted scatter changes nothing."""
    rng = np.random.default_rng(0)
    r, columns = rng.standard_normal(40), rng.standard_normal((40, 3))
    assert p_values(r, columns) == pytest.approx(p_values(10.0 * r, columns))
    assert p_values(r, columns) == pytest.approx(p_values(r + columns @ [5.0, -2.0, 1.0], columns))


def test_p_values_beyond_the_replicates_are_not_too_small() -> None:
    """Before: none was below 1.2e-4, so one of 20 tests could not fail. Against 200,000 replicates, and far beyond them."""
    n, number = 60, 200_000
    columns = np.column_stack([np.ones(n), np.arange(n)])
    basis = np.linalg.qr(columns)[0]
    rng = np.random.default_rng(1)
    drawn = rng.standard_normal((number, n))
    drawn -= drawn @ basis @ basis.T
    drawn /= np.sqrt(np.mean(drawn**2, axis=1, keepdims=True))
    for name in ("sign runs", "trend"):  # "largest" is studentised
        rare = drawn[np.argsort(STATISTICS[name](drawn))[-20]]  # p = 1e-4
        assert 0.5e-4 < p_values(rare, columns)[name] < 5e-4
    slow = np.cos(2.0 * np.pi * np.arange(n) / n) + 0.1 * rng.standard_normal(n)
    assert max(p_values(slow, columns)[name] for name in ("sign runs", "trend")) < 1e-6


def test_few_residuals_have_small_p_values_too() -> None:
    """Their statistics are bounded, so that no exponential tail describes them. By 1e6 replicates: 1.1e-4 and 6.2e-4."""
    columns = np.vander(np.linspace(-1.0, 1.0, 8), 2)
    for seed, exact in ((2, 1.11e-4), (3, 6.22e-4)):
        spike = 20.0 * (np.arange(8) == 4) + np.random.default_rng(seed).standard_normal(8)
        assert p_values(spike, columns)["largest"] == pytest.approx(exact, rel=0.35)


def test_of_many_tests_one_small_p_value_is_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: of 500 clean decays two failed, and the rig was not trusted."""
    tests = [SimpleNamespace(bench=True, event_driven=False, n=300, label=f"d{i}", local=dict) for i in range(40)]
    monkeypatch.setattr(
        "capsule_id.inference.checks.posterior.experiment_p_values",
        lambda e, _: {"trend": {"d0": 5e-4, "d1": 1e-6}.get(e.label, 0.5)},
    )

    def failed(experiments: list[Any]) -> list[str]:
        found = check_statistics(cast(Any, SimpleNamespace(experiments=experiments, values={}, flagged={})))
        return [finding.experiment for finding in found if finding.level == "fail"]

    assert failed(tests[:1]) == ["d0"]
    assert failed(tests) == ["d1"]


def finding_of(made: Twin) -> Finding:
    """The finding on one experiment at these values."""
    e, values = made
    named = {row.name: values[row.symbol] for row in e.parameters}
    return check_statistics(cast(Any, SimpleNamespace(experiments=(e,), values={**values, **named}, flagged={})))[0]


@pytest.mark.full
@pytest.mark.parametrize(
    ("made", "level", "statistic"),
    [
        (partial(line, 3), "ok", None),
        (partial(line, 3, bend=4e7), "fail", "trend"),
        (partial(decay, 3, F_dry=0.05), "fail", "sign runs"),
        (partial(decay, 3, outlier=8.0), "warn", "largest"),
    ],
)
def test_slow_residuals_fail_and_a_large_one_is_a_warning(
    made: Callable[[], Twin], level: str, statistic: str | None
) -> None:
    """Before: a decay whose residuals kept their sign was trusted, with a warning."""
    found = finding_of(made())
    assert found.level == level
    if statistic:
        assert found.facts["statistic"] in (statistic, "trend")


@pytest.mark.full
def test_a_modelled_drift_explains_slow_residuals() -> None:
    e, values = decay(0)
    drifting = cast(FreeVibration, e).with_model(DecayModel(drift="gp"))
    own = {"drift_ratio": 1.0, "drift_time": 0.3}
    assert "trend" in experiment_p_values(e, values)
    assert "trend" not in experiment_p_values(drifting, {**values, **own})


def test_a_reading_is_decisive_by_the_shorter_tail_of_a_sample_with_many_draws() -> None:
    """35 weights of 1000 have a heavy tail, which the 95 of independent weights do not show; 8000 draws leave 34."""
    rng = np.random.default_rng(3)
    weights = np.sort(np.exp(1.2 * rng.standard_normal(1000)))
    weights[-34:] = weights[-35] * (1.0 + 0.15 * (rng.uniform(size=34) ** -1.1 - 1.0) / 1.1)
    density = -np.log(rng.permutation(weights)).reshape(100, 10, 1)
    pointwise = Pointwise({"slides": density}, {"slides": np.array([4])}, {}, np.arange(100), np.arange(10), 1)
    named = []
    for draws in (200, 25):  # effective sizes of about eight times and of once the number of weights
        found = decisive_readings(pointwise, rng.standard_normal((4, draws, 10, 2)))
        named.append(found.facts["rows"])
    assert named == ["slides reading 5 (1.04)", ""]
