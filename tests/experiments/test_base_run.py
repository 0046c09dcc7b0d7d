"""Runs whose base moves as recorded, against SciPy; stated normal forces, runs without a spring, and the error texts."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from capsule_id.api import fit
from capsule_id.errors import InputError
from capsule_id.experiments.forced_run.drives import BaseRun, ForcedRun, feasibility
from capsule_id.experiments.forced_run.start_state import slides
from capsule_id.inference.joint_fit import choose_starts
from capsule_id.inference.target import LogPosterior
from capsule_id.records.motion import measured_motion
from capsule_id.rig.model import Quantity, Rig
from tests.experiments import bench
from tests.forced_runs import table, theta
from tests.inference.stub import plain_residuals
from tests.measured.folders import Entry, make_rig, quantity
from tests.scipy_general import simulate_general

M2, N = 0.53, 2.0
TRUTH = {"k1": 400.0, "c": 1.5, "mu": 0.3, "v_s": 0.05}
NOISE = 4e-6
BASE = {"drive": '"base"', "start": '"stuck"', "normal_force": quantity(N, "N")}


def base(t: np.ndarray | float, n: int = 0) -> np.ndarray | float:
    """n-th derivative of 4 mm at 2 Hz with a third harmonic."""
    angle = 4.0 * np.pi * t
    return (
        4e-3
        * (4.0 * np.pi) ** n
        * (np.cos(angle + 0.5 * n * np.pi) + 0.1 * 3**n * np.sin(3.0 * angle + 0.5 * n * np.pi))
    )


@cache
def record() -> tuple[np.ndarray, np.ndarray]:
    """Time (n,), s, and the noise-free position of the capsule, m: DOP853 from rest, normal force N alone."""
    time = np.arange(200) / 100.0
    absent = dict.fromkeys(("m1", "k2", "c2", "k_cubic", "k2_back", "slope", "reaction", "viscous"), 0.0)
    far = {"G": 1e3, "G_back": 1e3, "ratio": 0.5, "mu_back": TRUTH["mu"], "m2": M2, "g": 9.81, "N0": N - M2 * 9.81}
    states, _ = simulate_general({**TRUTH, **absent, **far}, (lambda t, on: 0.0, ()), time, rod=base)
    return time, states[:, 2]


def entry(drop: str = "", **settings: str) -> Entry:
    time, X2 = record()
    rng = np.random.default_rng(1)
    seen = {
        "time [s]": time,
        "x_base [m]": base(time) + 0.01,
        "x_capsule [m]": X2 - 3e-3 + NOISE * rng.standard_normal(len(time)),
    }
    return Entry("forced_run", "shaken", {k: v for k, v in seen.items() if k != drop}, {**BASE, **settings})


def rig(folder: Path, **settings: str) -> Rig:
    return make_rig(folder, entry(**settings), head={"m2": quantity(M2, "kg")})


def estimate(shaken: Rig) -> tuple[dict[str, float], dict[str, float]]:
    """Values and sds of the symbols of TRUTH: least squares of the whole posterior from 10 % away."""
    target = LogPosterior(shaken, [BaseRun(shaken.tables[0], shaken)])
    own = [i for i in target.located if target.names[i] != "m2"]
    starts = {**TRUTH, "x_start[shaken]": float(base(0.0)), "noise_x_capsule[shaken]": NOISE, "m2": M2}
    u0 = target.unconstrain(np.array([starts[name] for name in target.names]))

    def residuals(v: np.ndarray) -> np.ndarray:
        u = u0.copy()
        u[own] = v
        return plain_residuals(target, u)

    away = u0[own] + np.where(target.positive[own], 0.1, 1e-4)
    found = least_squares(residuals, away, x_scale="jac", diff_step=1e-6)
    assert found.success
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    names = [target.names[i] for i in own]
    values = {name: float(np.exp(x)) for name, x in zip(names, found.x, strict=True) if name in TRUTH}
    return values, {
        name: values[name] * float(np.sqrt(covariance[i, i])) for i, name in enumerate(names) if name in TRUTH
    }


@pytest.mark.full
def test_a_shaken_capsule_is_identified(tmp_path: Path) -> None:
    shaken = rig(tmp_path / "right")
    values, sds = estimate(shaken)
    for name, truth in TRUTH.items():
        assert abs(values[name] - truth) < 3.5 * sds[name], name
        assert sds[name] < 0.05 * truth


@pytest.mark.full
def test_the_portrait_of_a_shaken_run_needs_no_mass_of_the_rod(tmp_path: Path) -> None:
    """With a spring in reach, and a normal force that makes the mass of the rod unknown."""
    own = entry(spring='"L60"', gap=quantity(20.0, "mm"))
    columns = {**own.columns, "x_rel [m]": own.columns["x_base [m]"] - own.columns["x_capsule [m]"]}
    shaken = make_rig(tmp_path, replace(own, columns=columns), head={"m2": quantity(M2, "kg")})
    run = BaseRun(shaken.tables[0], shaken)
    values = {row.symbol: 0.0 for row in run.parameters} | TRUTH | {"k2": 2e3, "m2": M2, "g": 9.81}
    values |= {row.symbol: NOISE for row in run.parameters if row.symbol.startswith("noise")}
    assert any("phase_portrait" in panel.label for panel in run.comparisons(values, []))


def test_the_stated_normal_force_replaces_the_weight(tmp_path: Path) -> None:
    values = {**TRUTH, "m2": M2, "g": 9.81, "x_start": 0.0, "noise_x_capsule": NOISE}
    tables = [
        make_rig(tmp_path / str(k), entry(normal_force=quantity(k * N, "N")), head={"m2": quantity(M2, "kg")})
        for k in (1, 2)
    ]
    single, double = (BaseRun(r.tables[0], r) for r in tables)
    seen = single.predict(values, np)[0]
    assert np.allclose(double.predict({**values, "mu": 0.5 * TRUTH["mu"]}, np)[0], seen, rtol=0.0, atol=1e-12)
    # negative control
    assert np.max(np.abs(double.predict(values, np)[0] - seen)) > 1e-4
    # It holds N0 too. Before: N0 was sampled and acted nowhere.
    pressed = make_rig(tmp_path / "N0", entry(N0=quantity(1.0, "N", 0.1)), head={"m2": quantity(M2, "kg")})
    assert not [row.name for row in BaseRun(pressed.tables[0], pressed).parameters if row.symbol == "N0"]


def test_a_shaken_record_is_labelled_by_its_relative_motion(tmp_path: Path) -> None:
    time = np.arange(1500) / 250.0
    noise = NOISE * np.random.default_rng(0).standard_normal((2, 1500))
    columns = {"time [s]": time, "x_base [m]": base(time) + noise[0], "x_capsule [m]": base(time - 0.1) + noise[1]}
    shaken = make_rig(tmp_path, Entry("forced_run", "shaken", columns, BASE), head={"m2": quantity(M2, "kg")})
    motion = measured_motion(shaken.tables[0])
    assert (motion.label, motion.evidence.Omega) == ("P-1", pytest.approx(4.0 * np.pi, rel=1e-3))
    assert "spring and gap are not stated" in motion.evidence.reasons


@pytest.mark.parametrize(
    ("wrong", "remedy", "words"),
    [
        ({"P_d": quantity(1.0, "N")}, {}, "remove P_d"),
        ({"start": '"settled"'}, {"start": '"auto"'}, 'write start = "auto"'),
        ({"spring": '"L60"'}, {"spring": '"L60"', "gap": quantity(20.0, "mm")}, "add gap, or remove spring"),
        ({"drive": '"harmonic"'}, {"drive": '"base"'}, 'add drive = "base"'),
    ],
)
def test_a_wrong_setting_names_its_remedy(
    tmp_path: Path, wrong: dict[str, str], remedy: dict[str, str], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        rig(tmp_path / "wrong", **wrong)
    assert rig(tmp_path / "right", **remedy).tables[0].settings.drive == "base"


def test_columns_and_masses_are_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs a column x_base"):
        make_rig(tmp_path / "1", entry("x_base [m]"), head={"m2": quantity(M2, "kg")})
    with pytest.raises(InputError, match="must have a channel beside time"):
        make_rig(tmp_path / "2", entry("x_capsule [m]"), head={"m2": quantity(M2, "kg")})
    with pytest.raises(InputError, match="forced_run needs m2"):
        make_rig(tmp_path / "3", entry())


def test_an_unevenly_sampled_base_needs_a_frequency(tmp_path: Path) -> None:
    even = entry()
    uneven = Entry(even.kind, even.label, {k: np.delete(v, [3, 50]) for k, v in even.columns.items()}, even.settings)
    head = {"m2": quantity(M2, "kg")}
    with pytest.raises(InputError, match="add f = "):
        make_rig(tmp_path / "1", uneven, head=head)
    stated = Entry(uneven.kind, uneven.label, uneven.columns, {**uneven.settings, "f": quantity(2.0, "Hz")})
    shaken = make_rig(tmp_path / "2", stated, head=head)
    assert BaseRun(shaken.tables[0], shaken).Omega == pytest.approx(4.0 * np.pi)


@pytest.mark.full
def test_a_run_without_spring_is_one_whose_spring_is_far_away() -> None:
    own = table(1, without=("acceleration_rod",))
    far = replace(own.settings, gap=Quantity(1e3))
    near, free = (replace(own, settings=s) for s in (far, replace(own.settings, spring=None, gap=None)))
    values = {name: value for name, value in theta(1).items() if name != "G"}
    runs = [ForcedRun(t, bench.rig(t)) for t in (near, free)]
    assert "k2" not in {row.symbol for row in runs[1].parameters}
    one, other = (run.predict(v, np) for run, v in zip(runs, (values, {**values, "k2": 0.0}), strict=True))
    for x, y in zip(one, other, strict=True):
        assert np.allclose(x, y, rtol=0.0, atol=1e-12)
    assert feasibility(free, values, 1.0) == [
        f for f in feasibility(near, {**values, "k2": 1.0}, 1.0) if f.code != "runs.contact"
    ]


def test_the_slides_of_a_record_give_starting_values(tmp_path: Path) -> None:
    """Friction is constant there. c has a dispersion of 0.5; mu follows with the prior's v_s, 0.3 m/s for 0.05 m/s."""
    shaken = rig(tmp_path).tables[0]
    found = BaseRun(shaken, rig(tmp_path)).starts()
    for name, largest in {"k1": 0.05, "mu": 0.35, "c": 1.0}.items():
        assert abs(np.log(found[name].centre / TRUTH[name])) < largest, name
    assert abs(found["x_start[shaken]"].centre - float(base(0.0))) < 1e-5
    r, X2 = shaken["x_base"] - shaken["x_capsule"], shaken["x_capsule"]
    # negative control: a spring that pushes where it should pull, a base at rest, a capsule at rest
    for wrong in ((-r, X2), (0.0 * r, X2), (r, 0.0 * X2)):
        assert slides(shaken["time"], *wrong, 0.5, M2) is None


@pytest.mark.parametrize("name", ["slope", "N0"])
def test_a_ground_with_an_sd_has_starting_values_too(tmp_path: Path, name: str) -> None:
    stated = {"slope": '{ value = 0.1, sd = 0.1, unit = "deg" }', "N0": '{ value = 0.1, sd = 0.1, unit = "N" }'}
    exact, loose = (rig(tmp_path / sd, **{name: stated[name].replace("sd = 0.1", sd)}) for sd in ("sd = 0", "sd = 0.1"))
    starts = [BaseRun(each.tables[0], each).starts() for each in (exact, loose)]
    for symbol in ("k1", "c", "mu"):
        assert starts[1][symbol].centre == pytest.approx(starts[0][symbol].centre, rel=1e-9)


@pytest.mark.full
def test_the_fit_of_a_shaken_capsule_begins_near_its_maximum(tmp_path: Path) -> None:
    shaken = rig(tmp_path)
    target = LogPosterior(shaken, [BaseRun(shaken.tables[0], shaken)])
    candidates = choose_starts(target, {}, 0, {})
    k1, mu = (target.theta(candidates)[:, target.names.index(name)] for name in ("k1", "mu"))
    assert np.max(np.abs(np.log(k1 / TRUTH["k1"]))) < 0.3
    assert np.max(np.abs(np.log(mu / TRUTH["mu"]))) < 0.5
    # Copies of one start would agree without a proof.
    assert len(np.unique(candidates, axis=0)) == len(candidates)


@pytest.mark.slow
def test_a_shaken_capsule_is_fitted(tmp_path: Path) -> None:
    shaken = rig(tmp_path)
    result = fit(shaken, budget=None)
    for name, truth in TRUTH.items():
        row = result.summary.loc[name]
        assert abs(row["value"] - truth) < 3.5 * row["sd"], name
        assert row["sd"] < 0.05 * truth
