"""Second fit of runs with coloured noise, and residuals that repeat with the excitation."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from scipy.signal import lfilter

from capsule_id.api import fit
from capsule_id.experiments.base import LEVEL
from capsule_id.experiments.forced_run.drives import FEWEST_PERIODS, BaseRun, ForcedRun, repetition
from capsule_id.experiments.friction_model import FrictionModel
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference import point_stage as second_fits
from capsule_id.inference.point_stage import error_of_sum, fit_points, law_of_runs
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import Quantity, Rig
from capsule_id.views import Finding
from tests.experiments import bench
from tests.experiments.test_base_run import BASE, M2, TRUTH, N, base
from tests.measured.folders import Entry, make_rig, quantity
from tests.scipy_general import simulate_general

RATE, NOISE = 100.0, 4e-6


def ar1(n: int, rho: float, seed: int) -> np.ndarray:
    """(n,) stationary AR(1) noise of unit sd."""
    innovations = np.random.default_rng(seed).standard_normal(n + 500)
    return np.sqrt(1.0 - rho**2) * lfilter([1.0], [1.0, -rho], innovations)[500:]


def shaken(folder: Path, rho: float, n: int = 600, ratio: float = 0.5, seed: int = 1, **settings: str) -> Rig:
    """A rig with one run of ``n`` samples, DOP853, with AR(1) noise; ``ratio``: kinetic over static friction."""
    time = np.arange(n) / RATE
    absent = dict.fromkeys(("m1", "k2", "c2", "k_cubic", "k2_back", "slope", "reaction", "viscous"), 0.0)
    far = {"G": 1e3, "G_back": 1e3, "ratio": ratio, "mu_back": TRUTH["mu"], "m2": M2, "g": 9.81, "N0": N - M2 * 9.81}
    states, _ = simulate_general({**TRUTH, **absent, **far}, (lambda t, on: 0.0, ()), time, rod=base)
    x = states[:, 2] - 3e-3 + NOISE * ar1(n, rho, seed)
    columns = {"time [s]": time, "x_base [m]": base(time) + 0.01, "x_capsule [m]": x}
    return make_rig(
        folder, Entry("forced_run", "shaken", columns, {**BASE, **settings}), head={"m2": quantity(M2, "kg")}
    )


def values_of(run: BaseRun) -> dict[str, float]:
    return {**TRUTH, "m2": M2, "g": 9.81, "x_start": float(base(0.0)), "noise_x_capsule": NOISE} | (
        {"ar1_x_capsule": 0.0} if run.coloured else {}
    )


@pytest.mark.full
@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_coloured_noise_starts_at_the_correlation_of_the_residuals(tmp_path: Path, rho: float) -> None:
    rig = shaken(tmp_path, rho)
    white = BaseRun(rig.tables[0], rig)
    run, starts = cast(tuple[BaseRun, dict[str, float]], white.with_coloured_noise(values_of(white)))
    assert run.coloured
    assert "ar1_x_capsule" in {row.symbol for row in run.parameters}
    assert np.tanh(starts["ar1_x_capsule[shaken]"]) == pytest.approx(rho, abs=0.1)
    assert starts["noise_x_capsule[shaken]"] == pytest.approx(NOISE * np.sqrt(1.0 - rho**2), rel=0.15)
    assert run.with_coloured_noise(values_of(run)) is None


def test_a_run_says_whether_it_has_a_spring_and_which_noise_is_stated(tmp_path: Path) -> None:
    """The remedies of its findings name no spring where there is none."""
    rig, time = shaken(tmp_path, 0.0, noise='"white"'), np.arange(120) / 1000.0
    columns = [bench.column("time", time), bench.column("x_rel", 1e-3 * np.cos(35.0 * time))]
    contacts = {"spring": "stiff", "gap": Quantity(1e-3, 2e-5), "Omega": 35.0, "P_d": Quantity(4.0)}
    driven = bench.table("forced_run", columns, **contacts)
    facts = [run.noise_facts() for run in (BaseRun(rig.tables[0], rig), ForcedRun(driven, bench.rig(driven)))]
    assert [(one["spring"], one["noise"]) for one in facts] == [(False, "white"), (True, None)]


@pytest.mark.parametrize("noise", ["white", "ar1"])
def test_stated_noise_stays(tmp_path: Path, noise: str) -> None:
    rig = shaken(tmp_path, 0.9, noise=f'"{noise}"')
    run = BaseRun(rig.tables[0], rig)
    assert run.coloured == (noise == "ar1")
    assert run.with_coloured_noise(values_of(run)) is None


@pytest.mark.full
def test_parts_of_a_record_share_their_noise(tmp_path: Path) -> None:
    rig = shaken(tmp_path, 0.9)
    parts = BaseRun(rig.tables[0], rig).parts(3.0)
    assert len(parts) == 2
    coloured = [part.with_coloured_noise(values_of(part)) for part in parts]  # type: ignore[arg-type]
    names = [{row.name for row in new[0].parameters if row.symbol.startswith("ar1")} for new in coloured if new]
    assert names == [{"ar1_x_capsule[shaken]"}] * 2
    assert {part.shares_noise for part in parts} == {"shaken"}


def test_noise_repeats_at_the_stated_rate_only(tmp_path: Path) -> None:
    """The innovations of AR(1) noise are white; its harmonics are found where it repeats."""
    rig = shaken(tmp_path, 0.0)
    run = BaseRun(rig.tables[0], rig)
    rng = np.random.default_rng(0)
    p = np.array([found[1] for _ in range(150) if (found := repetition(run, rng.standard_normal(600)))])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.055)
    cycles = cast(np.ndarray, run.cycles)
    repeated = 0.5 * np.sin(2.0 * np.pi * 3.0 * cycles) + rng.standard_normal(600)
    assert cast(tuple[float, float], repetition(run, repeated))[1] < LEVEL
    # negative control: the same size at a frequency that is no harmonic
    other = 0.5 * np.sin(2.0 * np.pi * 3.37 * cycles) + rng.standard_normal(600)
    assert cast(tuple[float, float], repetition(run, other))[1] > LEVEL


def test_few_periods_show_no_repetition(tmp_path: Path) -> None:
    n = int(RATE / 2.0 * (FEWEST_PERIODS - 0.5))
    rig = shaken(tmp_path, 0.0, n)
    assert repetition(BaseRun(rig.tables[0], rig), np.ones(n)) is None


def second_of(findings: tuple[Finding, ...]) -> list[Finding]:
    return [finding for finding in findings if finding.code == "runs.second_fit"]


def at_truth(target: LogPosterior, known: Mapping[str, float], seed: int, starts: np.ndarray | None = None) -> PointFit:
    """In place of a fit: the true values, the noise as known, and the largest likelihood there."""
    del seed, starts
    values = {"noise_x_capsule[shaken]": NOISE, **known, **TRUTH, "ratio": 0.8, "x_start[shaken]": float(base(0.0))}
    u = target.unconstrain(np.array([values[name] for name in target.names]))
    own = target.mapping(target.theta(u))
    height = sum(float(e.log_likelihood(e.local(own), np)) for e in target.experiments)
    errors = dict.fromkeys(target.names, 0.0)
    rest = (np.eye(len(u)), errors, u[None], u[None], np.array([height]), np.zeros(1, bool), np.zeros(1, bool))
    return PointFit(target.names, u, dict(zip(target.names, target.theta(u).tolist(), strict=True)), *rest)


def test_a_second_fit_is_quoted_where_it_explains_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fits are replaced by the truth, with starts for the noise; the choice between both is the real one."""
    monkeypatch.setattr(second_fits, "joint_fit", at_truth)
    for rho, quoted in ((0.9, True), (0.0, False)):
        rig = shaken(tmp_path / str(rho), rho)
        target = LogPosterior(rig, [BaseRun(rig.tables[0], rig)])
        first = at_truth(target, {}, 0)
        new, second, findings = second_fits.fit_coloured(target, first, 0)
        assert new.experiments[0].coloured is quoted  # type: ignore[attr-defined]
        assert len(second_of(tuple(findings))) == quoted
        assert (second is first) == (not quoted)
        if quoted:
            white, coloured = findings[0].facts["alternatives"]
            assert (white["residuals white"], coloured["residuals white"]) == ("no", "yes")
            assert coloured["log-posterior"] > white["log-posterior"] + 100.0
            assert "k1 = 400 ±" in coloured["parameters"]


def test_the_law_that_explains_the_runs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinetic friction of 0.8 of static friction; other fits are replaced by the truth."""
    monkeypatch.setattr(second_fits, "joint_fit", at_truth)
    found = {}
    for ratio in (0.8, 0.5):
        rig = shaken(tmp_path / str(ratio), 0.0, ratio=ratio)
        target = LogPosterior(rig, [BaseRun(rig.tables[0], rig)])
        found[ratio] = second_fits.compare_laws(target, at_truth(target, {}, 0), 0)
    (law,) = found[0.8]
    assert (law.level, law.facts["law"], law.facts["line"]) == ("warn", "eq. (1), free ratio", 'free = ["ratio"]')
    assert next(row["fit"] for row in law.facts["alternatives"]) == "eq. (1), free ratio"
    # negative control: eq. (1) is right
    assert found[0.5] == []


def test_the_error_of_a_sum_is_that_of_its_parts() -> None:
    """And a record of one period gives no warning."""
    parts = np.random.default_rng(0).normal(1.0, 2.0, (2000, 30))
    sums, errors = np.sum(parts, axis=1), [error_of_sum(row) for row in parts]
    assert np.mean(errors) == pytest.approx(np.std(sums), rel=0.05)
    assert error_of_sum(np.array([5.0])) == 0.0


def test_friction_tests_beside_runs_compare_the_laws_themselves(tmp_path: Path) -> None:
    tilts = Entry("static_friction", "tilts", {"angle [deg]": np.array([16.0, 16.5, 17.0, 16.6])}, {})
    rig = make_rig(tmp_path, tilts, head={"m2": quantity(M2, "kg")})
    assert law_of_runs(make_experiments(rig, "all")) is None
    shaken_rig = shaken(tmp_path / "run", 0.0)
    runs = [BaseRun(shaken_rig.tables[0], shaken_rig, FrictionModel(constant=True))]
    assert law_of_runs(runs) == FrictionModel(constant=True)
    assert law_of_runs([*runs, *make_experiments(rig, "all")]) is None


@pytest.mark.slow
def test_correlated_noise_is_fitted_without_a_word(tmp_path: Path) -> None:
    rig = shaken(tmp_path, 0.9)
    point = fit_points(LogPosterior(rig, [BaseRun(rig.tables[0], rig)]), default_registry(), 0, sampled=False)
    assert len(second_of(point.findings)) == 1
    for name, truth in TRUTH.items():
        assert abs(point.fit.values[name] - truth) < 3.5 * point.fit.standard_errors[name], name


@pytest.mark.slow
def test_a_wrong_friction_law_is_named(tmp_path: Path) -> None:
    """Kinetic friction of 0.8 of static friction instead of 0.5, fitted with eq. (1)."""
    result = fit(shaken(tmp_path / "first", 0.9, ratio=0.8), budget=None)
    failed = {finding.code for finding in result.findings if finding.level == "fail"}
    assert "runs.repeated" in failed
    assert result.trust == "not trusted"
    (law,) = [finding for finding in result.findings if finding.code == "runs.laws"]
    assert 'write in [model] of rig.toml: free = ["ratio"]' in result.text(law)
    # its remedy
    rig = shaken(tmp_path / "remedy", 0.9, ratio=0.8)
    better = fit(replace(rig, model=replace(rig.model, free=("ratio",))), budget=None)
    assert not better.failed
    assert abs(better.summary.loc["ratio", "value"] - 0.8) < 3.5 * better.summary.loc["ratio", "sd"]
