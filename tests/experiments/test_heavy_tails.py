"""Progressions with heavy tails: the density against sums over outlying trials, outliers that move nothing, rules."""

from pathlib import Path
from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.special import logsumexp

from capsule_id.api import read_rig
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.progression.declaration import MOST_TRIALS, OUTLIER_SHARE, TIMES, alternatives
from capsule_id.experiments.progression.density import MIDDLE, NODES, Sessions, TrialGroups, TrialMisfit
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference.checks.settings import outliers
from tests.experiments.summed_sessions import integrated, linear_misfit
from tests.inference.three_settings import THETA, three_settings
from tests.rig.faults import fault_of

SCATTERS = {"session_sd": THETA["session_sd"], "trial_scatter": 0.0}


@pytest.mark.full
@pytest.mark.parametrize("lone", [(), (0,), pytest.param((0, 1, 2), marks=pytest.mark.slow)])
def test_the_density_is_the_sum_over_outlying_trials(lone: tuple[int, ...]) -> None:
    """Two settings in two sessions each, of which some are integrated out, against SciPy."""
    rng, scatters, z = np.random.default_rng(5), np.array([0.1, 0.7]), np.linspace(-5.0, 5.0, 81)
    sizes = [2, 1, 4, 2]
    b, j = np.repeat([0, 0, 1, 1], sizes), np.repeat([0, 1, 2, 3], sizes)
    sessions = Sessions(np.eye(2)[b], np.eye(4)[j], np.array([-1 if k in lone else k for k in range(4)]))
    distance, at_nodes = 0.3 * rng.normal(size=9), 0.3 * rng.normal(size=(4, len(NODES)))
    distance[1] += 6.0
    at_nodes = np.asarray(sessions.responses(at_nodes.ravel()[: len(sessions.case)]))
    X2 = [make_interp_spline(NODES, x, k=1)(z) if k in lone else x[[MIDDLE]] for k, x in enumerate(at_nodes)]

    def expected(setting: int, discrepancy: float, scatter: float) -> float:
        rows, cases = np.flatnonzero(b == setting), [2 * setting, 2 * setting + 1]
        own, variance = [X2[k] for k in cases], [0.04 + scatter**2 + 0.0 * X2[k] for k in cases]
        trials, found = [distance[j == k] for k in cases], list[float]()
        for outlying in (-1, *rows):
            relative, share = (
                np.where(rows == outlying, TIMES**2, 1.0),
                OUTLIER_SHARE if outlying >= 0 else 1.0 - OUTLIER_SHARE,
            )
            found.append(integrated(trials, own, variance, discrepancy**2, z, relative) + np.log(share))
        return float(logsumexp(found)) - np.log(1.0 - OUTLIER_SHARE + len(rows) * OUTLIER_SHARE)

    trials = TrialMisfit(TrialGroups(distance, sessions, heavy=True), at_nodes, 0.04, 0.0, np.array([0.3, 0.8]))
    by_sums = [[expected(setting, d, scatter) for setting, d in ((0, 0.3), (1, 0.8))] for scatter in scatters]
    normal = TrialMisfit(TrialGroups(distance, sessions), at_nodes, 0.04, 0.0, np.array([0.3, 0.8]))
    for xp in (np, jnp):
        np.testing.assert_allclose(np.asarray(trials.of_settings(scatters, xp)), by_sums, rtol=1e-3)
        assert np.all(np.asarray(normal.of_settings(scatters, xp))[:, 0] < np.array(by_sums)[:, 0] - 5.0)


def test_alternatives_of_settings_with_different_numbers_of_trials() -> None:
    variance, log_share, of = alternatives(np.eye(2)[[0, 1, 1]], heavy=True)
    assert of.tolist() == [0, 0, 1, 1, 1]
    assert variance.tolist() == [[1, 1, 1], [100, 1, 1], [1, 1, 1], [1, 100, 1], [1, 1, 100]]
    np.testing.assert_allclose(np.exp(log_share), [0.95, 0.05, 0.95 / 1.05, 0.05 / 1.05, 0.05 / 1.05])
    np.testing.assert_allclose(np.bincount(of, weights=np.exp(log_share)), 1.0)
    variance, log_share, of = alternatives(np.eye(2)[[0, 1, 1]], heavy=False)
    np.testing.assert_array_equal(variance, np.ones((2, 3)))
    np.testing.assert_array_equal(log_share, np.zeros(2))


def progression(folder: Path, tails: str) -> Progression:
    """The rig of three settings with these tails."""
    if not (folder / "rig.toml").exists():
        three_settings(folder)
    toml = (folder / "rig.toml").read_text(encoding="utf-8")
    toml = "\n".join(line for line in toml.splitlines() if not line.startswith("tails"))
    (folder / "rig.toml").write_text(f'{toml}\ntails = "{tails}"\n', encoding="utf-8")
    (e,) = make_experiments(read_rig(folder))
    return cast(Progression, e)


def with_outlier(e: Progression, row: int, size: float) -> Progression:
    distance = e.distance + size * (np.arange(e.n) == row)
    groups = TrialGroups(distance, e.sessions, e.heavy)
    return eqx.tree_at(lambda one: (one.distance, one.groups), e, (distance, groups))


def best_scatter(e: Progression, discrepancy: float) -> float:
    """Most probable ``trial_sd``, m."""
    at = np.geomspace(1e-4, 0.1, 200)
    profile = e.profile({**THETA, "trial_scatter": 0.0, "discrepancy": discrepancy})
    return float(at[np.argmax([profile({**SCATTERS, "trial_sd": sd, "discrepancy": discrepancy}) for sd in at])])


@pytest.mark.full
def test_an_outlying_trial_widens_nothing_else(tmp_path: Path) -> None:
    normal, heavy = (with_outlier(progression(tmp_path, tails), 4, 0.025) for tails in ("normal", "heavy"))
    clean = best_scatter(progression(tmp_path, "normal"), 1e-4)
    assert best_scatter(normal, 1e-4) > 5.0 * clean
    assert best_scatter(heavy, 1e-4) < 1.5 * clean
    X2 = np.asarray(heavy.responses(THETA))
    misfit, plain = (linear_misfit(e, THETA, X2) for e in (heavy, normal))
    np.testing.assert_array_equal(misfit.scale, np.where(np.arange(heavy.n) == 4, TIMES, 1.0))
    np.testing.assert_array_equal(plain.scale, 1.0)
    np.testing.assert_allclose(misfit.fixed_variance / plain.fixed_variance, misfit.scale**2, rtol=0.2)
    # Outliers are part of the model: none is a finding, unless it is far beyond ten times the scatter.
    assert [one.row for one in outliers(normal, THETA, 0.01)] == [4]
    assert outliers(heavy, THETA, 0.01) == []


@pytest.mark.parametrize("tails", ["normal", "heavy"])
def test_new_trials_have_the_tails_of_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tails: str) -> None:
    e = progression(tmp_path, tails)
    monkeypatch.setattr(Progression, "displacements", lambda *_: np.zeros((20_000, 3)))
    draws = 20_000 * [{**THETA, "discrepancy": 0.0}]
    sd = np.hypot(THETA["trial_sd"], np.sqrt(e.reading_variance))
    z = e.new_trials(draws, e.settings, np.random.default_rng(0)) / sd
    far = np.mean(np.abs(z) > 5.0)
    assert far == pytest.approx(0.0309 if tails == "heavy" else 0.0, abs=0.003)


def test_many_trials_of_a_setting_are_refused(tmp_path: Path) -> None:
    progression(tmp_path, "heavy")
    lines = (tmp_path / "progression.csv").read_text(encoding="utf-8").splitlines()
    text = "\n".join([*lines, *(MOST_TRIALS * [lines[1]])]) + "\n"
    (tmp_path / "progression.csv").write_text(text, encoding="utf-8")
    fault = str(fault_of(tmp_path))
    assert f"heavy tails need at most {MOST_TRIALS} trials at each setting, {MOST_TRIALS + 3} trials" in fault
    assert "remove tails" in fault
    progression(tmp_path, "normal")
