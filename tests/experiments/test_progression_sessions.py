"""Sessions of a progression: which are parameters, their runs, and the density of trials with the others integrated out."""

from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import cast

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special as jax_special
import numpy as np
import pandas as pd
import pytest
import scipy.special as scipy_special
from scipy.interpolate import make_interp_spline
from scipy.stats import multivariate_normal, norm

from capsule_id.api import read_rig
from capsule_id.experiments.base import Fitted
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.progression.density import (
    INNER,
    MIDDLE,
    NODES,
    RunEmulator,
    Sessions,
    TrialGroups,
    TrialMisfit,
    _log_probability,
    parameters_of,
)
from capsule_id.experiments.progression.experiment import Progression, session_table
from capsule_id.inference.checks.settings import outliers
from capsule_id.synthetic import RobotDesign, synthesize_robot
from tests.experiments.summed_sessions import integrated, linear_misfit
from tests.inference.three_settings import THETA, three_settings


@pytest.mark.full
@pytest.mark.parametrize("lone", [(), (0,), (1, 3), pytest.param((0, 1, 2), marks=pytest.mark.slow)])
def test_sums_over_groups_give_the_density_of_the_trials(lone: tuple[int, ...]) -> None:
    """Two settings in two sessions each, of which some are integrated out, against SciPy."""
    rng, scatters, z = (
        np.random.default_rng(5),
        np.array([[0.1], [0.7]]),
        np.linspace(-6.0, 6.0, 201 if len(lone) == 3 else 1001),
    )
    b, j = np.repeat([0, 0, 1, 1], [3, 2, 1, 4]), np.repeat([0, 1, 2, 3], [3, 2, 1, 4])
    parameter = np.array([-1 if k in lone else k for k in range(4)])
    sessions = Sessions(np.eye(2)[b], np.eye(4)[j], parameter)
    distance, at_nodes = rng.normal(size=10), 0.4 * rng.normal(size=(4, len(NODES)))
    at_nodes = np.asarray(sessions.responses(at_nodes.ravel()[: len(sessions.case)]))
    groups, discrepancy = TrialGroups(distance, sessions), np.array([0.3, 0.8])
    assert tuple(map(len, groups.members[1:])) == (len(lone) % 2 if len(lone) != 2 else 2, 2 * (len(lone) == 3))
    X2 = [make_interp_spline(NODES, x, k=1)(z) if k in lone else x[[MIDDLE]] for k, x in enumerate(at_nodes)]
    expected = [
        [
            integrated(
                [distance[j == k] for k in own], [X2[k] for k in own], [0.04 + t**2 + 0.0 * X2[k] for k in own], d**2, z
            )
            for own, d in zip(([0, 1], [2, 3]), discrepancy, strict=True)
        ]
        for t in scatters[:, 0]
    ]
    for xp in (np, jnp):
        trials = TrialMisfit(groups, at_nodes, 0.04, 0.0, discrepancy)
        np.testing.assert_allclose(np.asarray(trials.of_settings(scatters, xp))[:, 0], expected, rtol=1e-4)
        found = np.asarray(trials.log_density(scatters, xp))
        np.testing.assert_allclose(found, np.sum(expected, axis=1, keepdims=True), rtol=1e-4)


@pytest.mark.full
def test_the_scatter_of_a_trial_follows_its_displacement() -> None:
    """A session that is integrated out, with trials near one end of what it can explain."""
    distance, z = np.array([-1.0, -1.04]), np.linspace(-6.0, 6.0, 2001)
    sessions = Sessions(np.ones((2, 1)), np.ones((2, 1)), np.array([-1]))
    X2 = np.array([[0.5, 0.0, -0.5, -1.2, -1.9]])
    trials = TrialMisfit(TrialGroups(distance, sessions), X2, 1e-4, 0.05, np.array([0.01]))
    own = make_interp_spline(NODES, X2[0], k=1)(z)
    expected = integrated([distance], [own], [1e-4 + (0.05 * own) ** 2], 1e-4, z)
    assert float(trials.log_density(0.0)) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("xp", [np, jnp])
def test_probabilities_in_both_tails_are_accurate(xp: ModuleType) -> None:
    lower = np.array([-60.0, -39.0, -12.0, -2.0, 0.0, 3.0, 10.0, 30.0, 50.0])
    upper = lower + np.array([2.0, 1.5, 1.0, 5.0, 1.0, 1.2, 9.0, 2.0, 4.0])
    near, far = np.where(lower > 0.0, -lower, upper), np.where(lower > 0.0, -upper, lower)
    expected = norm.logcdf(near) + np.log1p(-np.exp(norm.logcdf(far) - norm.logcdf(near)))
    special = scipy_special if xp is np else jax_special
    found = _log_probability(xp.asarray(lower), xp.asarray(upper), special, xp)
    np.testing.assert_allclose(np.asarray(found), expected, atol=1e-3)


@pytest.mark.full
def test_readings_that_no_friction_explains_have_the_density_of_the_tail() -> None:
    """A capsule that stays where friction is higher, and trials on the other side; probabilities are 0 as numbers."""
    z, at_nodes = np.linspace(-6.0, 6.0, 2001), np.array([[0.2, 0.1, 0.0, 0.0, 0.0]])
    X2 = make_interp_spline(NODES, at_nodes[0], k=1)(z)
    sessions = Sessions(np.ones((2, 1)), np.ones((2, 1)), np.array([-1]))
    for place in (-0.02, -0.5):
        distance = place + np.array([0.0, 1e-3])
        trials = TrialMisfit(TrialGroups(distance, sessions), at_nodes, 2.5e-7, 0.0, np.zeros(1))
        expected = integrated([distance], [X2], [2.5e-7 + 0.0 * z], 0.0, z)
        assert expected < -700.0
        assert float(trials.log_density(0.0)) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("discrepancy", [0.03, 0.3, 3.0])
def test_sessions_share_the_discrepancy_of_their_setting(discrepancy: float) -> None:
    """Straight lines and four sessions: the trials are jointly normal, with sds of 0.1 and 0.05 to 0.2 by session."""
    rng, j = np.random.default_rng(1), np.repeat(np.arange(4), 3)
    slope = np.array([0.05, 0.1, 0.15, 0.2])
    sessions = Sessions(np.ones((12, 1)), np.eye(4)[j], np.full(4, -1))
    covariance = 0.01 * np.eye(12) + discrepancy**2 + (j[:, None] == j) * np.outer(slope[j], slope[j])
    distance = rng.multivariate_normal(np.zeros(12), covariance)
    trials = TrialMisfit(TrialGroups(distance, sessions), slope[:, None] * NODES, 0.01, 0.0, np.array([discrepancy]))
    expected = multivariate_normal(np.zeros(12), covariance).logpdf(distance)
    assert float(trials.log_density(np.zeros(()), np)) == pytest.approx(expected, abs=1e-3)
    if discrepancy > 0.1:
        alone = multivariate_normal(np.zeros(12), covariance - (j[:, None] != j) * discrepancy**2).logpdf(distance)
        assert abs(alone - expected) > 0.1


@pytest.mark.full
def test_a_misfit_stays_where_no_friction_explains_the_readings(tmp_path: Path) -> None:
    (e,) = cast(list[Progression], make_experiments(three_settings(tmp_path / "rig")))
    (lone,) = np.flatnonzero(e.sessions.alone)
    own = e.sessions.rows[:, lone] > 0.0
    place = float(np.mean(e.distance[own]))
    X2 = np.asarray(e.responses(THETA)).copy()
    theta = {**THETA, "discrepancy": 1e-6, "trial_scatter": 0.0}

    def residuals(at_nodes: list[float]) -> np.ndarray:
        X2[lone] = place * np.array(at_nodes)
        misfit = linear_misfit(e, theta, X2).at(theta["trial_sd"], np)
        assert misfit.design.shape[1] == 1 + len(e.settings)
        return np.abs(misfit.at_nuisance_mean(np)[0][own])

    assert np.max(residuals([1.4, 1.2, 1.0, 0.8, 0.6])) < 5.0
    assert np.min(residuals([-1.0, -0.5, 0.0, 0.0, 0.0])) > 5.0
    assert np.min(residuals([-1.0, -0.5, 0.0, -0.5, -1.0])) > 5.0


@pytest.mark.full
def test_a_misfit_is_about_the_z_that_is_most_probable(tmp_path: Path) -> None:
    """Lines of 20 and 2 mm per sd of a session, and trials that scatter by 10 mm: the least cost by a fine sum over z."""
    three_settings(tmp_path)
    header, *rows = [line.rsplit(",", 1)[0] for line in (tmp_path / "progression.csv").read_text().splitlines()]
    (tmp_path / "progression.csv").write_text("\n".join([header, *rows, *rows[:3]]) + "\n")
    (e,) = cast(list[Progression], make_experiments(read_rig(tmp_path)))
    own, z = e.sessions.rows[:, 0] > 0.0, np.linspace(-6.0, 6.0, 24_001)
    assert e.sessions.shared[0] == 1.0
    theta = {**THETA, "discrepancy": 1e-9, "trial_scatter": 0.0, "trial_sd": 0.01}
    variance = theta["trial_sd"] ** 2 + e.reading_variance
    X2 = np.asarray(e.responses(theta)).copy()
    for away in (-0.015, 0.01, 0.02, 0.025, 0.026, 0.04):
        X2[0] = np.mean(e.distance[own]) - away + np.array([-0.0275, -0.025, 0.0, 0.025, 0.0275])
        at = make_interp_spline(NODES, X2[0], k=1)(z)
        least = np.min(z**2 + np.sum((e.distance[own][:, None] - at) ** 2, axis=0) / variance)
        rest, nuisances = linear_misfit(e, theta, X2).at(theta["trial_sd"], np).at_nuisance_mean(np)
        # On the outer line z is about 1.25 and held: its own cost is not among the nuisances.
        held = 1.25**2 if nuisances[0] == 0.0 else nuisances[0] ** 2
        assert np.sum(rest[own] ** 2) + held == pytest.approx(least, rel=1e-2)


@pytest.mark.full
@pytest.mark.parametrize("sessions", [2, pytest.param(11, marks=pytest.mark.slow)])
def test_an_outlying_trial_is_found(tmp_path: Path, sessions: int) -> None:
    """The columns of discrepancies span those of the parameters, which must not hide the trial."""
    design = RobotDesign(1e-3 * np.arange(60.0, 170.0, 10.0), np.full(11, 0.3), sessions=sessions)
    synthesize_robot(tmp_path / "rig", 3, design)
    (e,) = cast(list[Progression], make_experiments(read_rig(tmp_path / "rig")))
    theta = {**THETA, "session_2": 0.3}
    for row, size in ((None, 0.0), (13, 0.06), (31, 0.3)):
        distance = e.distance + size * (np.arange(e.n) == row)
        found = outliers(eqx.tree_at(lambda one: one.distance, e, distance), theta, 0.001)
        assert [one.row for one in found] == ([] if row is None else [row])


@pytest.mark.full
def test_an_outlying_trial_is_found_where_no_parameter_has_an_effect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A capsule that moves alike whatever its parameters are: their columns are 0."""
    (e,) = cast(list[Progression], make_experiments(three_settings(tmp_path / "rig")))
    monkeypatch.setattr(Progression, "responses", lambda *_: jnp.full((3, len(NODES)), 0.1))
    distance = 0.1 + 1e-3 * np.random.default_rng(0).standard_normal(e.n)
    distance[4] += 0.1
    (found,) = outliers(eqx.tree_at(lambda one: one.distance, e, distance), THETA, 0.01)
    assert found.row == 4


@pytest.mark.full
def test_a_known_session_moves_the_discrepancy_of_the_others() -> None:
    """One known session and two that are integrated out at one setting, another setting, and each of them left out."""
    rng, z = np.random.default_rng(3), np.linspace(-6.0, 6.0, 201)
    b, j = np.repeat([0, 0, 0, 1, 1], 2), np.repeat([0, 1, 2, 3, 0], 2)
    sessions = Sessions(np.eye(2)[b], np.eye(4)[j], parameters_of(np.eye(2)[b], np.eye(4)[j]))
    np.testing.assert_array_equal(sessions.shared, [0, 1, 1, 0, 0])
    distance = 0.3 * rng.normal(size=10) + 0.5
    at_nodes = np.asarray(sessions.responses(0.3 * rng.normal(size=len(sessions.case))))
    known = sessions.alone == 0.0
    trials = TrialMisfit(TrialGroups(distance, sessions), at_nodes, 0.04, 0.0, np.array([0.4, 0.6]))
    X2 = [x[[MIDDLE]] if own else make_interp_spline(NODES, x, k=1)(z) for own, x in zip(known, at_nodes, strict=True)]
    cases = [distance[own > 0.0] for own in sessions.rows.T]
    expected = [
        integrated([cases[k] for k in own], [X2[k] for k in own], [0.04 + 0.0 * X2[k] for k in own], d**2, z)
        for own, d in (([0, 1, 2], 0.4), ([3, 4], 0.6))
    ]
    np.testing.assert_allclose(np.asarray(trials.of_settings(0.0)), expected, rtol=1e-4)


@pytest.mark.full
def test_runs_between_the_outer_ones_matter(tmp_path: Path) -> None:
    """Sessions that differ by 20 %, against 41 exact runs of each; a line through the outer runs is worse."""
    design = RobotDesign(1e-3 * np.arange(60.0, 120.0, 5.0), np.full(12, 0.3), sessions=12, session_sd=0.2)
    synthesize_robot(tmp_path / "rig", 6, design)
    (e,) = cast(list[Progression], make_experiments(read_rig(tmp_path / "rig")))
    theta, z, fine = {**THETA, "session_sd": 0.2}, np.linspace(-5.0, 5.0, 41), np.linspace(-5.0, 5.0, 401)
    assert e.sessions.symbols == ()
    runs = np.asarray(e.displacements(theta, 0.2 * np.tile(z, 12), np.repeat(e.settings, 41, axis=0)))
    X2 = np.asarray(e.responses(theta))
    straight = X2[:, MIDDLE, None] + (X2[:, [3]] - X2[:, [1]]) / (NODES[3] - NODES[1]) * NODES
    expected = [
        integrated(
            [e.distance[own > 0.0]],
            [x],
            [e.reading_variance + theta["trial_sd"] ** 2 + (theta["trial_scatter"] * x) ** 2],
            (theta["discrepancy"] * time) ** 2,
            fine,
        )
        for own, time, x in zip(
            e.setting.T, e.time, make_interp_spline(z, runs.reshape(12, 41).T, k=1)(fine).T, strict=True
        )
    ]
    with_three, with_two = (
        np.asarray(e.trials_of(theta, own, np).of_settings(theta["trial_sd"], np)) - expected for own in (X2, straight)
    )
    assert np.sqrt(np.mean(with_three**2)) < 0.6
    assert np.sqrt(np.mean(with_two**2)) > 0.9


def test_a_session_with_several_settings_is_a_parameter() -> None:
    """Two settings in session 3, one of them in sessions 1 and 4 too: cases, runs, and what a session changes."""
    setting, session = np.eye(3)[[0, 0, 1, 2, 1, 0]], np.eye(5)[[3, 1, 3, 0, 3, 4]]
    found = parameters_of(setting, session)
    np.testing.assert_array_equal(found, [-1, -1, -1, 0, -1])
    sessions = Sessions(setting, session, found)
    assert sessions.symbols == ("session_1",)
    np.testing.assert_array_equal(sessions.setting, [0, 0, 0, 1, 2])
    np.testing.assert_array_equal(sessions.alone, [1, 0, 1, 0, 1])
    np.testing.assert_array_equal(sessions.shared, [1, 0, 1, 0, 0])
    np.testing.assert_array_equal(np.argmax(sessions.rows, axis=1), [1, 0, 3, 4, 3, 2])
    theta = {"session_sd": 0.1, "session_1": -2.0}
    five, three = 0.1 * NODES, 0.1 * NODES[INNER]
    np.testing.assert_allclose(sessions.log_friction(theta), [*five, -0.2, *five, -0.2, *three], atol=1e-15)
    np.testing.assert_array_equal(sessions.setting_of_run, np.repeat([0, 1, 2], [11, 1, 3]))
    X2 = sessions.responses(np.arange(15.0) ** 2)
    np.testing.assert_array_equal(X2[0], [0, 1, 4, 9, 16])
    np.testing.assert_array_equal(X2[1], np.full(5, 25))
    np.testing.assert_array_equal(X2[4], [119, 144, 169, 196, 223])
    # No more parameters than there are rows for; the sessions with the most settings have them.
    many = np.repeat(np.arange(10), 2)
    crowded = np.append(many, 9)
    found = parameters_of(np.eye(3)[np.append(np.tile([0, 1], 10), 2)], np.eye(10)[crowded])
    np.testing.assert_array_equal(found, [0, 1, 2, 3, 4, 5, 6, -1, -1, 7])


@pytest.mark.full
def test_a_run_is_emulated_by_the_friction_of_its_own_session() -> None:
    """Two sessions that are parameters and one that is integrated out, in the order of the runs."""
    rng = np.random.default_rng(2)
    sessions = Sessions(np.eye(3)[[0, 0, 1, 2]], np.eye(4)[[3, 1, 3, 0]], np.array([-1, 1, -1, 0]))
    names = ("k1", "session_sd", *sessions.symbols)
    draws = [
        dict(zip(names, (1.0 + 0.1 * a, 0.2 * np.exp(0.3 * b), c, d), strict=True))
        for a, b, c, d in rng.normal(size=(1000, 4))
    ]

    def motions(theta: dict[str, float]) -> np.ndarray:
        s = np.asarray(sessions.log_friction(theta))
        return np.arange(1.0, 1.0 + len(s)) * np.tanh(theta["k1"] * (s + 0.5))

    emulator = RunEmulator(sessions, {"k1": True}, draws, np.stack([motions(draw) for draw in draws]))
    theta = dict(zip(names, (1.05, 0.2, 0.8, -1.1), strict=True))
    found = np.asarray(emulator(theta))
    np.testing.assert_allclose(found, motions(theta), rtol=0.01)
    changed = np.asarray(emulator({**theta, "session_1": 1.5})) != found
    np.testing.assert_array_equal(changed, sessions.own[:, 0] > 0.0)


@pytest.mark.full
def test_the_table_of_sessions_has_the_numbers_of_the_file(tmp_path: Path) -> None:
    """The parameters are numbered from 1; the file's own sessions are not."""
    folder = tmp_path / "rig"
    synthesize_robot(folder, 1, RobotDesign(1e-3 * np.array([60.0, 80.0, 100.0, 120.0]), np.full(4, 0.3)))
    file = next(folder.glob("*.csv"))
    rows = pd.read_csv(file)
    (column,) = (name for name in rows.columns if name.startswith("session"))
    rows[column] = np.where(rows[column] == 1, 20240116, 20240115)
    rows.to_csv(file, index=False)
    (e,) = cast(tuple[Progression], make_experiments(read_rig(folder)))
    assert e.sessions.symbols == ("session_1", "session_2")
    own = {symbol: 1.0 + k for k, symbol in enumerate(e.sessions.symbols)}
    values = {row.name: {**THETA, **own}[row.symbol] for row in e.parameters} | THETA
    draws = [{**values, "session_sd": sd} for sd in (0.1, 0.3)]
    (table,) = session_table([e], cast(Fitted, SimpleNamespace(values=values, draws=draws)))
    assert table.frame["session"].tolist() == ["20240115", "20240116"]
    assert table.frame["trials"].tolist() == [6, 6]
    factors = np.exp(np.outer([0.1, 0.3], [1.0, 2.0]))
    np.testing.assert_allclose(table.frame["friction"], np.mean(factors, axis=0), atol=1e-4)
    np.testing.assert_allclose(table.frame["its sd"], np.std(factors, axis=0), atol=1e-4)
    (point,) = session_table([e], cast(Fitted, SimpleNamespace(values=values, draws=[])))
    assert point.frame["friction"].iloc[0] == pytest.approx(np.exp(0.05), abs=1e-4)
    assert np.isnan(point.frame["its sd"].to_numpy()).all()
