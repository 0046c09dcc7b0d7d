"""Error of the model in runs and decays: intervals that cover under misfits between periods and within them."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.optimize import curve_fit

from capsule_id.experiments.base import refit
from capsule_id.experiments.forced_run.drives import BaseRun
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.models import decay
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.checks import verdict
from capsule_id.inference.checks.verdict import (
    FEWEST_PARTS,
    PRIORS,
    by_load,
    by_phase,
    by_time,
    normal_equations,
    parts_of_residuals,
    steps_of_parts,
    widening,
    widenings,
)
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.views import Finding
from tests.experiments import bench
from tests.experiments import test_base_run as shaken
from tests.inference.stub import plain_jacobian, plain_residuals
from tests.measured.folders import Entry, make_rig, quantity

NO_ARRAY = np.zeros(0)


@cache
def fitted(folder: Path) -> SampledFit:
    """The shaken capsule of the tests of base runs at its true values, with a failed check."""
    rig = shaken.rig(folder)
    run = BaseRun(rig.tables[0], rig)
    target = LogPosterior(rig, [run])
    truth = {**shaken.TRUTH, "x_start[shaken]": float(shaken.base(0.0)), "noise_x_capsule[shaken]": shaken.NOISE}
    u = target.unconstrain(np.array([truth[name] for name in target.names]))
    fit = PointFit(target.names, u, truth, NO_ARRAY, {}, NO_ARRAY, NO_ARRAY, NO_ARRAY, NO_ARRAY, NO_ARRAY)
    finding = Finding("residuals.white", "fail", {}, "shaken")
    return SampledFit(target, fit, None, {**target.fixed, **truth}, findings=(finding,))


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> SampledFit:
    return fitted(tmp_path_factory.mktemp("shaken"))


def pulls(s: SampledFit, misfit: float, divisions: tuple = (by_time, by_phase)) -> tuple[np.ndarray, np.ndarray]:
    """Errors of k1 over its sd, and over 1.96 times the widened sd and t quantile, of 300 linearised fits.

    misfit : amplitude of each of six random harmonics of the excitation in x_capsule, units of the noise
    """
    rng, located = np.random.default_rng(0), s.target.located
    run, k = s.experiments[0], [s.target.names[i] for i in located].index("k1")
    jacobian = plain_jacobian(s.target, s.fit.u)
    parts = [parts_of_residuals(s, [run], division) for division in divisions]  # type: ignore[list-item]
    inverse = np.linalg.pinv(jacobian)
    sd = float(np.linalg.norm(inverse[k]))
    angle = np.multiply.outer(run.table["time"], np.arange(1, 7)) * 4.0 * np.pi
    plain, widened = [], []
    for _ in range(300):
        residuals = np.zeros(len(jacobian))
        waves = [wave(angle) @ rng.standard_normal(6) for wave in (np.cos, np.sin)]
        residuals[: run.n] = rng.standard_normal(run.n) + misfit * np.sum(waves, axis=0)
        step = inverse @ residuals
        found = [
            widening(steps_of_parts(normal_equations(jacobian, residuals - jacobian @ step, part), k)) for part in parts
        ]
        one = max(found, key=lambda w: w.stretch)
        plain.append(step[k] / sd)
        widened.append(step[k] / (sd * one.stretch) / 1.96)
    return np.abs(plain), np.abs(widened)


@pytest.mark.full
def test_intervals_cover_under_a_misfit_that_repeats(known: SampledFit) -> None:
    plain, widened = pulls(known, 5.0)
    assert np.mean(plain < 1.96) < 0.5
    assert np.mean(widened < 1.0) >= 0.9
    # Negative control: successive parts of the record do not show a misfit that they share.
    assert np.mean(pulls(known, 5.0, (by_time,))[1] < 1.0) < 0.7


@pytest.mark.full
def test_noise_alone_widens_little(known: SampledFit) -> None:
    plain, widened = pulls(known, 0.0)
    assert np.mean(plain < 1.96) == pytest.approx(0.95, abs=0.04)
    assert np.median(plain / widened) / 1.96 < 1.8  # t quantile of 4 to 8 parts included


def test_a_failed_check_widens_the_parameters_of_its_run(known: SampledFit, monkeypatch: pytest.MonkeyPatch) -> None:
    """By residuals and differences in NumPy: the derivatives of a run take ten seconds to compile."""
    monkeypatch.setattr(verdict, "linearised", lambda *at: (plain_residuals(*at), plain_jacobian(*at)))
    assert widenings(replace(known, findings=())) == {}
    quiet = widenings(known)
    assert all(one.factor < 2.0 for one in quiet.values())
    # The rod's spring is 10 % stiffer than the record shows.
    u = known.fit.u + np.where(np.array(known.target.names) == "k1", 0.1, 0.0)
    values = {**known.values, "k1": 1.1 * known.values["k1"]}
    wide = widenings(replace(known, fit=replace(known.fit, u=u), values=values))
    assert wide["k1"].factor > 5.0
    assert wide["k1"].parts >= FEWEST_PARTS
    assert set(wide) <= set(shaken.TRUTH)
    # A fit no start of which has found a maximum may lie where no derivative is finite.
    monkeypatch.setattr(verdict, "linearised", lambda *at: (plain_residuals(*at), np.nan * plain_jacobian(*at)))
    assert widenings(known) == {}


def test_parts_are_whole_periods_and_phases(known: SampledFit) -> None:
    run = cast(BaseRun, known.experiments[0])
    time, phase = (cast(np.ndarray, parts(run)) for parts in (by_time, by_phase))
    assert np.array_equal(np.unique(time), np.arange(4))  # 2 s at 2 Hz
    assert np.array_equal(np.bincount(time), [50, 50, 50, 50])
    assert np.mean(phase[:50] == phase[50:100]) > 0.95  # a sample on an edge
    assert np.all(np.abs(np.bincount(phase) - 200 / 6) < 4)


def test_the_rows_of_the_priors_are_no_part(known: SampledFit) -> None:
    run, dimension = cast(BaseRun, known.experiments[0]), known.target.dimension
    part = parts_of_residuals(known, [run], by_time)
    assert len(part) == len(known.target.residual_owners(known.fit.u))
    assert np.all(part[-dimension:] == PRIORS)
    assert np.all(part[:-dimension] != PRIORS)


def test_a_parameter_that_only_its_prior_determines_does_not_widen_another() -> None:
    """As the damping of a run on a shaken table does: a part without which the rest is less certain gives no step."""
    rng = np.random.default_rng(0)
    jacobian = np.concatenate([rng.standard_normal((60, 2)) * [1.0, 1e-6], np.eye(2)])
    jacobian[:60, 1] += 1e-6 * jacobian[:60, 0]
    residuals = np.append(rng.standard_normal(60), [0.0, 0.0])
    residuals -= jacobian @ np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
    part = np.append(np.repeat(np.arange(6), 10), [PRIORS, PRIORS])
    assert widening(steps_of_parts(normal_equations(jacobian, residuals, part), 0)).factor < 2.0
    shared = np.where(part == PRIORS, -1, part)
    assert len(steps_of_parts(normal_equations(jacobian, residuals, shared), 0)) == 6
    jacobian[:60, 1] *= 1e8  # the data determine it
    assert len(steps_of_parts(normal_equations(jacobian, residuals, shared), 0)) == 7
    assert len(steps_of_parts(normal_equations(jacobian, residuals, part), 0)) == 6  # the priors are no part


def test_the_step_of_a_part_is_its_own_estimate() -> None:
    """One parameter: least squares of the rows of each part. Two: the other one from the rest alone."""
    rng = np.random.default_rng(1)
    jacobian, residuals, part = rng.standard_normal((40, 2)), rng.standard_normal(40), np.repeat(np.arange(4), 10)
    for number, (step, sd) in enumerate(steps_of_parts(normal_equations(jacobian[:, :1], residuals, part), 0)):
        x, y = jacobian[part == number, 0], residuals[part == number]
        assert (step, sd) == pytest.approx((-(x @ y) / (x @ x), (x @ x) ** -0.5))
    (first, _), *_ = steps_of_parts(normal_equations(jacobian, residuals, part), 0)
    rest, own = part != 0, part == 0
    other = -np.linalg.lstsq(jacobian[rest], residuals[rest])[0]
    # Score of the efficient derivative at the values from the rest.
    score = jacobian[:, 0] - jacobian[:, 1] * (jacobian[:, 0] @ jacobian[:, 1]) / (jacobian[:, 1] @ jacobian[:, 1])
    expected = other[0] - score[own] @ (residuals[own] + jacobian[own] @ other) / (score[own] @ score[own])
    assert first == pytest.approx(expected)


@pytest.mark.parametrize(
    ("loads", "parts"),
    [([1.0, 3.0, 1.0, 3.0], [0, 1, 0, 1]), (list(range(16, 0, -1)), [7 - i // 2 for i in range(16)])],
)
def test_a_part_holds_the_trials_of_a_load(loads: list[float], parts: list[int]) -> None:
    table = SimpleNamespace(loads=(np.array(loads), np.ones(len(loads))))
    assert cast(np.ndarray, by_load(cast(BaseRun, table))).tolist() == parts


@cache
def dry_decay(k_cubic: float = 0.0) -> SampledFit:
    """A decay of twelve periods with dry friction at its true values, but for the cubic force of its record."""
    time, truth = np.arange(480) / 800.0, {"k1": 1420.0, "c": 0.3, "F_dry": 0.05, "amplitude[d]": 2e-3}
    motion = np.asarray(decay(time, {**truth, "m1": bench.M1, "k_cubic": k_cubic}, 2e-3, 0.0, 40).x_rel)
    columns = [bench.column("time", time), bench.column("x_rel", motion)]
    table = bench.table("free_vibration", columns, "d", damping=("viscous", "dry"), thin=1, drift="none", noise="white")
    rig = bench.rig(table)
    target = LogPosterior(rig, [FreeVibration(table, rig)])
    values = {**truth, "turning_time[d]": 0.0, "noise_sd[d]": 2e-5, "m1": bench.M1}
    u = target.unconstrain(np.array([values[name] for name in target.names]))
    fit = PointFit(target.names, u, values, NO_ARRAY, {}, NO_ARRAY, NO_ARRAY, NO_ARRAY, NO_ARRAY, NO_ARRAY)
    return SampledFit(
        target, fit, None, {**target.fixed, **values}, findings=(Finding("residuals.white", "fail", {}, "d"),)
    )


def errors_of_decays(misfit: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors of F_dry over its sd, and over the half-length of its widened interval, of 300 linearised fits.

    misfit : of one half period, units of the noise; relative to the amplitude, and independent of the other ones
    """
    s, rng = dry_decay(), np.random.default_rng(0)
    run, located = cast(FreeVibration, s.experiments[0]), s.target.located
    k = [s.target.names[i] for i in located].index("F_dry")
    jacobian = plain_jacobian(s.target, s.fit.u)
    part, inverse = parts_of_residuals(s, [run], by_time), np.linalg.pinv(jacobian)
    half, envelope = (2.0 * run.cycles).astype(int), np.exp(-run.cycles / 6.0)
    sd, plain, widened = float(np.linalg.norm(inverse[k])), [], []
    for _ in range(300):
        residuals = np.zeros(len(jacobian))
        waves = misfit * rng.standard_normal(half[-1] + 1)[half] * envelope * np.sin(2.0 * np.pi * run.cycles)
        residuals[: run.n] = rng.standard_normal(run.n) + waves
        step = inverse @ residuals
        one = widening(steps_of_parts(normal_equations(jacobian, residuals - jacobian @ step, part), k))
        plain.append(step[k] / sd)
        widened.append(step[k] / (sd * one.stretch) / 1.96)
    return np.abs(plain), np.abs(widened)


@pytest.mark.full
def test_intervals_of_a_decay_with_an_amplitude_of_its_own_cover_under_misfit() -> None:
    plain, widened = errors_of_decays(10.0)
    assert np.mean(plain < 1.96) < 0.6
    assert np.mean(widened < 1.0) >= 0.9
    plain, widened = errors_of_decays(0.0)
    assert np.mean(plain < 1.96) == pytest.approx(0.95, abs=0.04)
    assert np.median(plain / widened) / 1.96 < 1.8


@pytest.mark.full
def test_a_failed_check_widens_the_parameters_of_a_decay_with_dry_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    """As for a run, by differences: the derivatives of a decay with dry friction take as long to compile."""
    monkeypatch.setattr(verdict, "linearised", lambda *at: (plain_residuals(*at), plain_jacobian(*at)))
    assert widenings(replace(dry_decay(), findings=())) == {}
    assert all(one.factor < 1.01 for one in widenings(dry_decay()).values())
    # The stiffness falls by 5 % with the amplitude.
    wide = widenings(dry_decay(0.05 * 1420.0 / 2e-3**2))
    assert wide["k1"].factor > 3.0
    assert wide["k1"].parts >= FEWEST_PARTS
    assert set(wide) <= {"k1", "c", "F_dry"}


def test_a_parameter_without_effect_has_no_estimate(tmp_path: Path) -> None:
    """Of c = 1e-300 N s/m the readings hold nothing: a column of zeros. (Before: 0/0, a warning in a fit's output.)"""
    t = np.linspace(0.0, 0.3, 200)
    columns = {"time [s]": np.round(t, 7), "x_rel [mm]": np.round(2.0 * np.cos(113.7 * t), 5)}
    entry = Entry("free_vibration", "d", columns)
    (experiment,) = make_experiments(make_rig(tmp_path, entry, head={"m1": quantity(0.11, "kg", 0.0005)}))
    found = refit(experiment, {"m1": 0.11, "k1": 1422.0, "c": 1e-300, experiment.scatters[0]: 1e-5}, [])
    assert found["c"][1] == np.inf
    x, t = experiment.values, experiment.time

    def cosine(t: np.ndarray, k1: float, a: float, b: float, offset: float) -> np.ndarray:
        angle = np.sqrt(k1 / 0.11) * t
        return a * np.cos(angle) + b * np.sin(angle) + offset

    best, covariance = curve_fit(cosine, t, x, [1422.0, 2e-3, 0.0, 0.0])
    assert found["k1"][0] == pytest.approx(best[0], rel=1e-6)
    assert found["k1"][1] == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.02)
