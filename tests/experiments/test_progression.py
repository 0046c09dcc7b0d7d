"""Progressions: the likelihood against SciPy, sessions, the start on its own, faults of a folder with their remedies."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.progression.declaration import KIND
from capsule_id.experiments.progression.density import INNER, NODES
from capsule_id.experiments.progression.experiment import Progression, check_discrepancy
from capsule_id.inference.joint_fit import _rescaled
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.result import PointFit
from capsule_id.inference.tables import check_engine
from capsule_id.inference.target import LogPosterior
from capsule_id.physics.drives import Pulses
from capsule_id.physics.model import CapsuleParameters
from capsule_id.physics.simulation import TOGETHER, simulate
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.synthetic import ROBOT, RobotDesign, synthesize_robot
from tests.capsule_cases import jit_quickly
from tests.experiments.summed_sessions import integrated
from tests.rig.faults import fault_of

PERIODS = 1e-3 * np.array([60.0, 80.0, 100.0])
SMALL = RobotDesign(PERIODS, np.full(3, 0.3), sessions=2)
#: Values that are no parameter of the twin.
SCATTERS = {"session_sd": 0.05, "trial_scatter": 0.04, "trial_sd": 1e-3, "discrepancy": 2e-4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("robot") / "rig"
    synthesize_robot(path, 1, SMALL)
    return path


def progression(folder: Path) -> Progression:
    (experiment,) = make_experiments(read_rig(folder))
    return cast(Progression, experiment)


#: The first session has two settings and is a parameter, the second has one.
THETA = {**ROBOT, "g": 9.81, "session_1": 0.7, **SCATTERS}


def plain_displacement(s: float, period: float, count: float) -> float:
    """X2 by a plain run, friction multiplied by exp(s)."""
    own = {name: ROBOT[name] for name in ("m1", "m2", "k1", "c", "v_s", "ratio")}
    p = CapsuleParameters(**own, mu=ROBOT["mu"] * np.exp(s), k2=0.0, G=np.inf)
    drive = Pulses(ROBOT["P_on"], period, 0.3, lag=ROBOT["lag"], reaction=1.0)
    return float(simulate(p, drive, np.array([0.0, period * count])).X2[-1])


def test_the_likelihood_is_that_of_plain_runs(folder: Path) -> None:
    """One session is a parameter, the other is integrated out, with lines between its runs."""
    e = progression(folder)
    table, sd, z = e.table, SCATTERS["session_sd"], np.linspace(-6.0, 6.0, 401)
    expected = 0.0
    for period in PERIODS:
        own = table["period"] == period
        count, (session,) = float(table["periods"][own][0]), set(table["session"][own])
        nodes = NODES[INNER] if session == 2.0 else 0.7 * np.ones(1)
        runs = [plain_displacement(sd * node, period, count) for node in nodes]
        X2 = make_interp_spline(nodes, runs, k=1)(z) if session == 2.0 else np.array(runs)
        noise = 5e-4**2 + SCATTERS["trial_sd"] ** 2 + (SCATTERS["trial_scatter"] * X2) ** 2
        shared = (SCATTERS["discrepancy"] * period * count) ** 2
        expected += integrated([table["distance"][own]], [X2], [noise], shared, z)
    log_likelihood = jit_quickly(e.log_likelihood)
    assert float(log_likelihood(THETA)) == pytest.approx(expected, abs=0.02)
    assert e.profile(THETA)(SCATTERS) == pytest.approx(float(log_likelihood(THETA)), abs=1e-6)
    other = {**SCATTERS, "discrepancy": 1e-3}
    assert e.profile(THETA)(other) == pytest.approx(float(log_likelihood({**THETA, **other})), abs=1e-6)
    # The motion is approximate at other sds of the sessions, and the logarithm of the density has a slope there.
    for session_sd, error in ((0.065, 0.2), (0.02, 0.4)):
        other = {**SCATTERS, "session_sd": session_sd}
        changed = float(log_likelihood({**THETA, **other}))
        assert abs(changed - expected) > 0.05
        assert e.profile(THETA)(other) == pytest.approx(changed, abs=error * abs(changed - expected))


@pytest.mark.full
def test_the_smoothed_engine_moves_the_trials_as_the_exact_one_does(folder: Path) -> None:
    """Within the 2 % that the widths are certified for. Much wider ones move them by more: the negative control."""
    text = (folder / "rig.toml").read_text(encoding="utf-8")
    (folder.parent / "smooth").mkdir()
    (folder.parent / "smooth" / "rig.toml").write_text(text.replace("[model]", '[model]\nengine = "smooth"'), "utf-8")
    shutil.copy(folder / "progression.csv", folder.parent / "smooth")
    smooth, exact = progression(folder.parent / "smooth"), progression(folder)
    assert exact.smoothing is None
    assert smooth.smoothing == Smoothing()
    still = np.zeros(len(exact.settings))
    X2, certified, wide = (
        np.asarray(e.displacements(THETA, still, e.settings))
        for e in (exact, smooth, smooth.with_smoothing(Smoothing(velocity=0.1)))
    )
    assert 0.0 < np.max(np.abs(certified / X2 - 1.0)) < 0.02
    assert np.max(np.abs(wide / X2 - 1.0)) > 0.2
    # A draw without a normal force has no motion, and is no error of the others.
    assert np.isnan(smooth.displacements({**THETA, "g": -9.81}, still, smooth.settings)).all()


@pytest.mark.full
def test_a_progression_with_the_smoothed_engine_carries_a_bound_of_its_bias(folder: Path) -> None:
    """The norm of the difference of the residuals, of the certified widths and of much wider ones."""
    rig = read_rig(folder)
    rig = replace(rig, model=replace(rig.model, engine="smooth"))
    (e,) = make_experiments(rig)
    bounds = []
    for own in (e.with_smoothing(None), e, e.with_smoothing(Smoothing(velocity=0.1))):
        target = LogPosterior(rig, [own])
        u = target.unconstrain(np.array([THETA[name.split("[")[0]] for name in target.names]))
        (found,) = check_engine(SampledFit(target, cast(PointFit, SimpleNamespace(u=u)), None, {}))
        bounds.append(found.facts["largest"])
        assert (found.level == "ok") == (found.parameters == ()) == (bounds[-1] <= 0.2)
    assert bounds[0] == 0.0
    assert 0.0 < bounds[1] < 1.0
    assert found.level == "fail"
    assert {"k1", "c", "mu"} <= set(found.parameters)


@pytest.mark.full
def test_a_scatter_and_what_it_scales_move_together(tmp_path: Path) -> None:
    """Two sessions whose frictions differ by the same, with a session sd that is five times too small."""
    synthesize_robot(tmp_path / "rig", 1, RobotDesign(1e-3 * np.array([60.0, 80.0, 100.0, 120.0]), np.full(4, 0.3)))
    rig = read_rig(tmp_path / "rig")
    target = LogPosterior(rig, [progression(tmp_path / "rig")])
    known = {**THETA, "session_1": 6.0, "session_2": -4.0, "session_sd": 0.02}
    values = np.array([known[name.split("[")[0]] for name in target.names])
    u = target.unconstrain(values)
    moved = target.mapping(target.theta(_rescaled(target, u)))
    for name in ("session_1[progression]", "session_2[progression]"):
        assert moved["session_sd"] * moved[name] == pytest.approx(0.02 * known[name.split("[")[0]])
    assert 0.05 < moved["session_sd"] < 0.2
    assert np.all(_rescaled(target, _rescaled(target, u)) == pytest.approx(_rescaled(target, u), abs=0.16))


@pytest.mark.full
@pytest.mark.parametrize(("sessions", "warned"), [(8, False), (9, True)])
def test_more_sessions_than_parameters_are_named(tmp_path: Path, sessions: int, warned: bool) -> None:
    periods = 1e-3 * np.linspace(60.0, 100.0, 2 * sessions)
    synthesize_robot(tmp_path / "rig", 1, RobotDesign(periods, np.full(2 * sessions, 0.3), sessions=sessions))
    rig = read_rig(tmp_path / "rig")
    found = [one.facts for one in KIND.lint[0](rig.tables[0], rig) if one.code == "progression.sessions"]
    assert found == ([{"several": 9, "most": 8}] if warned else [])
    assert len(progression(tmp_path / "rig").sessions.symbols) == 8


def test_new_values_and_other_settings_need_no_new_program(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    e, traced = progression(folder), []

    def counted(*given: Any, **words: Any) -> Any:
        traced.append(given)
        return simulate(*given, **words)

    monkeypatch.setattr("capsule_id.physics.simulation.simulate", counted)
    before = e.responses({**THETA, "mu": 0.2})[0]
    traced.clear()  # The first program may be older than this test.
    after = e.responses({**THETA, "mu": 0.3})[0]
    assert np.all(np.asarray(before) != np.asarray(after))
    draws = [{**THETA, "mu": mu} for mu in np.linspace(0.2, 0.3, 400)]
    many = e.motions_of_draws(draws)
    assert not traced
    assert len(many) * many.shape[1] > TOGETHER
    # Wherever a lane stands, it has the motion that it has alone.
    for draw in (0, 171, 399):
        np.testing.assert_array_equal(many[draw], e.motions_of_draws(draws[draw : draw + 1])[0])


def test_without_a_column_a_session_is_a_block_of_equal_settings(folder: Path, tmp_path: Path) -> None:
    e = progression(folder)
    np.testing.assert_array_equal(np.argmax(e.session, axis=1), e.table["session"] - 1.0)
    (tmp_path / "rig.toml").write_text((folder / "rig.toml").read_text())
    lines = (folder / "progression.csv").read_text().splitlines()
    repeated = [*lines, lines[1]]
    (tmp_path / "progression.csv").write_text("\n".join(line.rsplit(",", 1)[0] for line in repeated) + "\n")
    blocks = progression(tmp_path)
    np.testing.assert_array_equal(np.argmax(blocks.session, axis=1), [0, 0, 0, 1, 1, 1, 2, 2, 2, 3])
    assert blocks.setting.shape == (10, 3)
    assert blocks.sessions.symbols == ()
    # The first setting has two sessions.
    assert np.sum(blocks.sessions.shared) == 2


def test_the_sampler_integrates_the_absolute_scatter_alone(folder: Path) -> None:
    target = LogPosterior(read_rig(folder), [progression(folder)])
    assert [name for name, one in zip(target.names, target.integrated, strict=True) if one] == ["trial_sd[progression]"]
    assert {"P_on", "lag", "ratio", "session_sd"} <= set(target.names)
    assert not target.positive[target.names.index("P_on")]


@pytest.mark.parametrize(
    ("setting", "rule", "instead"),
    [
        ("", "must have one amplitude", 'P_on = { value = 1, unit = "N" }'),
        ('drive = "harmonic"\nP_d = { value = 1, unit = "N" }', "a harmonic drive has", 'P_on = { value = 1, unit = "N" }'),
        ('P_d = { value = 1, unit = "N" }', "has the amplitude P_on", 'P_on = { value = 1, unit = "N" }'),
        # Before: read, and without effect.
        ('P_on = { value = 1, unit = "N" }\nduty_sd = { value = 5, unit = "%" }', "duty_sd has no effect",
         'P_on = { value = 1, sd = 0.1, unit = "N" }'),
        ('P_on = { value = 1, unit = "N" }\nlag = { value = 5, sd = 1, unit = "ms" }\n\n[prior]\n'
         'lag = { median = 50, factor = 3, unit = "ms" }', "the prior of lag is that of the experiments, which state it",
         'P_on = { value = 1, unit = "N" }\nlag = { value = 5, sd = 1, unit = "ms" }'),
        ('P_on = { value = 1, unit = "N" }\nlag = { value = -1, unit = "s" }', "lag must be 0 or greater",
         'P_on = { value = 1, unit = "N" }\nlag = { value = 1, unit = "ms" }'),
    ],
)  # fmt: skip
def test_a_fault_is_named_and_its_remedy_works(
    folder: Path, tmp_path: Path, setting: str, rule: str, instead: str
) -> None:
    text = (folder / "rig.toml").read_text()
    head = text[: text.index('drive = "pulses"')]
    (tmp_path / "progression.csv").write_text((folder / "progression.csv").read_text())
    (tmp_path / "rig.toml").write_text(head + setting + "\n")
    assert rule in str(fault_of(tmp_path))
    (tmp_path / "rig.toml").write_text(head + instead + "\n")
    read_rig(tmp_path)


@pytest.mark.parametrize(("relative", "level"), [(0.01, "ok"), (0.2, "warn"), (0.4, "fail")])
def test_the_discrepancy_is_compared_with_scatter_and_motion(folder: Path, relative: float, level: str) -> None:
    e = progression(folder)
    rms = float(np.sqrt(np.mean((e.distance / (e.setting @ e.time)) ** 2)))
    values = {
        **ROBOT,
        **SCATTERS,
        "session_1[progression]": 0.7,
        "trial_sd[progression]": 1e-3,
        "discrepancy[progression]": relative * rms,
    }
    (finding,) = check_discrepancy([e], cast(Any, SimpleNamespace(values={**values, "g": 9.81}, draws=[])))
    assert (finding.code, finding.level, finding.experiment) == ("progression.discrepancy", level, e.label)
    assert finding.facts["size"] == pytest.approx(1e3 * relative * rms)
    assert finding.facts["rms"] == pytest.approx(1e3 * rms)
    assert 0.01 * 1e3 * rms < finding.facts["scatter"] < 0.2 * 1e3 * rms


@pytest.mark.parametrize(
    ("periods", "rule", "value"),
    [
        ("66.5", "be a whole number between 1 and 100000", "66.5 1"),
        ("1e9", "be a whole number between 1 and 100000", r"1e\+09 1"),
        ("100001", "be a whole number between 1 and 100000", "100001 1"),
        ("0", "be a whole number between 1 and 100000", "0 1"),
    ],
)
def test_periods_that_no_trial_has_are_refused(
    folder: Path, tmp_path: Path, periods: str, rule: str, value: str
) -> None:
    (tmp_path / "rig.toml").write_text((folder / "rig.toml").read_text())
    lines = (folder / "progression.csv").read_text().splitlines()
    cells = lines[1].split(",")
    lines[1] = ",".join([*cells[:2], periods, *cells[3:]])
    (tmp_path / "progression.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=rf"progression.csv:2:.*periods must {rule}, {value}, "):
        read_rig(tmp_path)
    lines[1] = ",".join([*cells[:2], "100000", *cells[3:]])
    (tmp_path / "progression.csv").write_text("\n".join(lines) + "\n")
    read_rig(tmp_path)


def test_a_duty_in_per_cent_under_a_header_without_unit_is_refused(folder: Path, tmp_path: Path) -> None:
    """A duty of 30 would count as 1: the drive limits it to a share."""
    (tmp_path / "rig.toml").write_text((folder / "rig.toml").read_text())
    text = (folder / "progression.csv").read_text()
    assert "duty [%]" in text
    (tmp_path / "progression.csv").write_text(text.replace("duty [%]", "duty [1]"))
    with pytest.raises(InputError, match=r"progression.csv:2:.*duty must lie between 0 and 100 %"):
        read_rig(tmp_path)
