"""Sessions of a progression: which are parameters, their runs, and the density of trials with the others integrated out."""

from pathlib import Path
from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from capsule_id.api import read_rig
from capsule_id.experiments import make_experiments
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.experiments.progression.groups import TrialGroups, TrialMisfit
from capsule_id.experiments.progression.run_emulator import RunEmulator
from capsule_id.experiments.progression.sessions import NODES, Sessions, parameters_of
from capsule_id.experiments.progression.twin import RobotDesign, synthesize_robot
from tests.experiments.summed_sessions import integrated
from tests.inference.three_settings import THETA


@pytest.mark.parametrize("lone", [(), (0,), (1, 3), (0, 1, 2)])
def test_sums_over_groups_give_the_density_of_the_trials(lone: tuple[int, ...]) -> None:
    """Two settings in two sessions each, of which some are integrated out, against SciPy."""
    rng, scatters, z = np.random.default_rng(5), np.array([[0.1], [0.7]]), np.linspace(-6.0, 6.0, 201)
    b, j = np.repeat([0, 0, 1, 1], [3, 2, 1, 4]), np.repeat([0, 1, 2, 3], [3, 2, 1, 4])
    parameter = np.array([-1 if k in lone else k for k in range(4)])
    sessions = Sessions(np.eye(2)[b], np.eye(4)[j], parameter)
    distance, at_nodes = rng.normal(size=10), rng.normal(size=(4, len(NODES)))
    at_nodes = np.where(sessions.alone[:, None] > 0.0, at_nodes, at_nodes[:, :1])
    groups, discrepancy = TrialGroups(distance, sessions), np.array([0.3, 0.8])
    assert len(groups.grid) == {0: 0, 1: 1, 2: 1, 3: 101}[len(lone)]
    X2 = [make_interp_spline(NODES, x, k=1)(z) if k in lone else x[:1] for k, x in enumerate(at_nodes)]
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


def test_the_scatter_of_a_trial_follows_its_displacement() -> None:
    """A session that is integrated out, with trials near one end of what it can explain."""
    distance, z = np.array([-1.0, -1.04]), np.linspace(-6.0, 6.0, 2001)
    sessions = Sessions(np.ones((2, 1)), np.ones((2, 1)), np.array([-1]))
    X2 = np.array([[0.0, -0.5, -1.2]])
    trials = TrialMisfit(TrialGroups(distance, sessions), X2, 1e-4, 0.05, np.array([0.01]))
    own = make_interp_spline(NODES, X2[0], k=1)(z)
    expected = integrated([distance], [own], [1e-4 + (0.05 * own) ** 2], 1e-4, z)
    assert float(trials.log_density(0.0)) == pytest.approx(expected, abs=0.02)
    constant = integrated([distance], [own], [1e-4 + (0.05 * 0.5) ** 2 + 0.0 * own], 1e-4, z)
    assert abs(constant - expected) > 0.2


def test_runs_between_the_outer_ones_matter(tmp_path: Path) -> None:
    """Sessions that differ by 20 %, against 41 exact runs of each; a line through the outer runs is worse."""
    design = RobotDesign(1e-3 * np.arange(60.0, 120.0, 5.0), np.full(12, 0.3), sessions=12, session_sd=0.2)
    synthesize_robot(tmp_path / "rig", 6, design)
    (e,) = cast(list[Progression], make_experiments(read_rig(tmp_path / "rig")))
    theta, z, fine = {**THETA, "session_sd": 0.2}, np.linspace(-5.0, 5.0, 41), np.linspace(-5.0, 5.0, 401)
    assert e.sessions.symbols == ()
    runs = e.displacements_of_draws([theta], 0.2 * np.tile(z, 12)[None], np.repeat(e.settings, 41, axis=0))
    X2 = np.asarray(e.responses(theta))
    middle = 0.5 * (X2[:, :1] + X2[:, 2:])
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
        np.asarray(e.trials_of(theta, own, np).of_settings(theta["trial_sd"], np)) - expected
        for own in (X2, np.concatenate([X2[:, :1], middle, X2[:, 2:]], axis=1))
    )
    assert np.sqrt(np.mean(with_three**2)) < 0.6
    assert np.sqrt(np.mean(with_two**2)) > 0.9


def test_a_session_with_several_settings_or_a_shared_one_is_a_parameter() -> None:
    """Two settings in session 3, one of them in session 1 too: cases, runs, and what a session changes."""
    setting, session = np.eye(3)[[0, 0, 1, 2, 1]], np.eye(4)[[3, 1, 3, 0, 3]]
    found = parameters_of(setting, session)
    np.testing.assert_array_equal(found, [-1, 0, -1, 1])
    sessions = Sessions(setting, session, found)
    assert sessions.symbols == ("session_1", "session_2")
    np.testing.assert_array_equal(sessions.setting, [0, 0, 1, 2])
    np.testing.assert_array_equal(sessions.alone, [0, 0, 0, 1])
    np.testing.assert_array_equal(np.argmax(sessions.rows, axis=1), [1, 0, 2, 3, 2])
    theta = {"session_sd": 0.1, "session_1": -2.0, "session_2": 3.0}
    np.testing.assert_allclose(sessions.log_friction(theta), [-0.2, 0.3, 0.3, -0.125, 0.0, 0.125], atol=1e-15)
    np.testing.assert_array_equal(sessions.setting_of_run, [0, 0, 1, 2, 2, 2])
    np.testing.assert_array_equal(sessions.responses(np.arange(6.0)), [[0, 0, 0], [1, 1, 1], [2, 2, 2], [3, 4, 5]])
    # No more parameters than there are rows for; the sessions with the most settings have them.
    many = np.repeat(np.arange(10), 2)
    crowded = np.append(many, 9)
    found = parameters_of(np.eye(3)[np.append(np.tile([0, 1], 10), 2)], np.eye(10)[crowded])
    np.testing.assert_array_equal(found, [0, 1, 2, 3, 4, 5, 6, -1, -1, 7])
    # Then those that share their setting with the most.
    found = parameters_of(np.eye(4)[[0, 1, 1, 2, 2, 2, 3]], np.eye(7))
    np.testing.assert_array_equal(found, [-1, 0, 1, 2, 3, 4, -1])


def test_a_run_is_emulated_by_the_friction_of_its_own_session() -> None:
    """Two sessions that are parameters and one that is integrated out, in the order of the runs."""
    rng = np.random.default_rng(2)
    sessions = Sessions(np.eye(3)[[0, 0, 1, 2]], np.eye(4)[[3, 1, 3, 0]], np.array([-1, 0, -1, 1]))
    names = ("k1", "session_sd", *sessions.symbols)
    draws = [dict(zip(names, (1.0 + 0.1 * a, 0.2, b, c), strict=True)) for a, b, c in rng.normal(size=(300, 3))]

    def motions(theta: dict[str, float]) -> np.ndarray:
        s = np.asarray(sessions.log_friction(theta))
        return np.arange(1.0, 1.0 + len(s)) * np.tanh(theta["k1"] * (s + 0.5))

    emulator = RunEmulator(sessions, {"k1": True}, draws, np.stack([motions(draw) for draw in draws]))
    theta = dict(zip(names, (1.05, 0.2, 0.8, -1.1), strict=True))
    found = np.asarray(emulator(theta))
    np.testing.assert_allclose(found, motions(theta), rtol=0.01)
    changed = np.asarray(emulator({**theta, "session_1": 1.5})) != found
    np.testing.assert_array_equal(changed, sessions.own[:, 0] > 0.0)
