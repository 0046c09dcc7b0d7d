"""Springs on both sides of the rod, compressed springs and square waves: engines, runs, progressions and their faults."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import fit, read_rig
from capsule_id.commands.bifurcate import overlay
from capsule_id.errors import InputError
from capsule_id.experiments.capsule_experiment import stated_parameters
from capsule_id.experiments.forced_run.drives import _groups, _portrait
from capsule_id.experiments.forced_run.experiment import CapsuleRun
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference import tuning
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.target import LogPosterior
from capsule_id.inference.tuning import operating_points, tune
from capsule_id.physics.drives import Pulses
from capsule_id.physics.model import CapsuleParameters
from capsule_id.physics.simulation import simulate
from capsule_id.records.motion import measured_motion
from capsule_id.rig.model import Quantity
from tests.experiments.test_foreign_law import Hertz
from tests.inference.test_tuning import fit_of
from tests.rig.faults import fault_of
from tests.scipy_general import Values, pulses, simulate_general

LEAVES = ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "G", "g", "k2_back", "G_back")
ABSENT = {"g": 9.81, "k_cubic": 0.0, "c2": 0.0, "slope": 0.0, "N0": 0.0, "ratio": 0.5, "viscous": 0.0, "reaction": 0.0}
TRUTH = {
    "m1": 0.11, "m2": 0.53, "k1": 1420.0, "k2": 9000.0, "c": 3.89, "mu": 0.3, "v_s": 0.3, "G": -2e-4, "k2_back": 5000.0,
    "G_back": 8e-4, "mu_back": 0.3, **ABSENT,
}  # fmt: skip
NOISE, TIME = 1e-5, np.arange(600) / 1000.0
P_D, OMEGA, PHASE = 8.0, 60.0, 0.4
PERIOD, LAG = 0.09, 0.004
HEAD = '[rig]\nname = "run"\nm1 = { value = 110, unit = "g" }\nm2 = { value = 530, unit = "g" }\n'
RUN = '\n[[experiment]]\nkind = "forced_run"\nfile = "run.csv"\nstart = "stuck"\n'
SPRINGS = (
    'spring = "a"\ngap = { value = -0.2, sd = 0.02, unit = "mm" }\n'
    'spring_back = "b"\ngap_back = { value = 0.8, sd = 0.02, unit = "mm" }\n'
)
HARMONIC = 'Omega = { value = 60, unit = "rad/s" }\nP_d = { value = 8, sd = 0.2, unit = "N" }\n'
SQUARE = (
    'drive = "square"\nf = { value = 11.111111, unit = "Hz" }\nP_on = { value = 6, sd = 2, unit = "N" }\n'
    'lag = { value = 4, sd = 1, unit = "ms" }\n'
)


def cases() -> Iterator[tuple[Values, np.ndarray, np.ndarray]]:
    """Drawn capsules with a square wave, times, and states by SciPy where two tolerances agree: it may miss an event."""
    rng = np.random.default_rng(6)
    while True:
        low = {
            "m1": 0.08,
            "m2": 0.3,
            "k1": 800,
            "k2": 2e3,
            "c": 1.0,
            "mu": 0.1,
            "v_s": 0.05,
            "k2_back": 2e3,
            "G_back": -5e-4,
        }
        high = {
            "m1": 0.2,
            "m2": 0.8,
            "k1": 2e3,
            "k2": 3e4,
            "c": 6.0,
            "mu": 0.5,
            "v_s": 0.5,
            "k2_back": 3e4,
            "G_back": 2e-3,
        }
        q = {name: float(rng.uniform(low[name], high[name])) for name in low}
        q |= {
            **ABSENT,
            "mu_back": q["mu"],
            "G": float(rng.uniform(-5e-4, 1.5e-3)),
            "P_on": float(rng.uniform(2.0, 8.0)),
        }
        q |= {
            "P_off": -q["P_on"],
            "period": 2.0 * np.pi / rng.uniform(20, 90),
            "duty": 0.5,
            "lag": rng.uniform(1e-3, 6e-3),
        }
        times = np.linspace(0.0, 4.0 * q["period"], 80)
        wave, steps = pulses(q, times[-1]), ((1e-9, 5e-4), (1e-11, 3e-4))
        rough, fine = (simulate_general(q, wave, times, tol, tol / 100, max_step=step)[0] for tol, step in steps)
        if np.all(np.abs(rough - fine)[:, [0, 2]] < 1e-8):
            yield q, times, fine


@pytest.mark.full
def test_the_exact_engine_against_scipy() -> None:
    """Twenty cases; the core has the engine with both springs in the likelihood below."""
    compressed = False
    for q, times, expected in islice(cases(), 20):
        drive = Pulses(q["P_on"], q["period"], 0.5, q["P_off"], lag=q["lag"])
        t = simulate(CapsuleParameters(**{name: q[name] for name in LEAVES}), drive, times)
        assert np.max(np.abs(np.stack([t.X1, t.X2], axis=1) - expected[:, [0, 2]])) < 1e-8
        compressed |= min(q["G"], q["G_back"]) < 0.0
    assert compressed


def harmonic(q: Values) -> np.ndarray:
    return simulate_general(q, (lambda t, on: P_D * np.cos(OMEGA * t + PHASE), []), TIME, 1e-10, 1e-12)[0]


def write(folder: Path, states: np.ndarray, settings: str, seed: int = 1) -> None:
    """A record of x_rel and x_capsule with noise, and its rig."""
    rng = np.random.default_rng(seed)
    x = np.stack([states[:, 0] - states[:, 2], states[:, 2]], axis=1) + NOISE * rng.standard_normal((len(TIME), 2))
    rows = [f"{t:.4f},{a:.9g},{b:.9g}" for t, (a, b) in zip(TIME, x, strict=True)]
    (folder / "run.csv").write_text("\n".join(["time [s],x_rel [m],x_capsule [m]", *rows]))
    (folder / "rig.toml").write_text(HEAD + RUN + settings)


def run_of(folder: Path) -> CapsuleRun:
    (run,) = make_experiments(read_rig(folder))
    return run


def largest_residual(run: CapsuleRun, own: Values) -> float:
    """Largest rms residual of a channel, in units of the noise."""
    start = {"x_start": 0.0, "y_start": 0.0, "noise_x_rel": NOISE, "noise_x_capsule": NOISE, "phase": PHASE}
    return max(float(np.sqrt(np.mean(left**2))) for _, left in run.records({**TRUTH, **start, **own}))


@pytest.mark.full
def test_a_record_with_two_springs_is_white_at_the_truth_alone(tmp_path: Path) -> None:
    write(tmp_path, harmonic(TRUTH), HARMONIC + SPRINGS)
    run = run_of(tmp_path)
    assert {"k2[a]", "k2[b]", "G[run]", "G_back[run]"} <= {row.name for row in run.parameters}
    assert largest_residual(run, {"P_d": P_D}) < 1.15
    for changed in ({"k2_back": 5300.0}, {"G_back": 7.5e-4}, {"G": -1.5e-4}):
        assert largest_residual(run, {"P_d": P_D, **changed}) > 1.5


def test_the_compiled_likelihood_has_both_springs(tmp_path: Path) -> None:
    write(tmp_path, harmonic(TRUTH), HARMONIC + SPRINGS)
    known = {**TRUTH, "k2[a]": 9000.0, "k2[b]": 5000.0, "x_start[run]": 0.0, "y_start[run]": 0.0, "phase[run]": PHASE}
    known |= {
        "G[run]": -2e-4,
        "G_back[run]": 8e-4,
        "P_d[run]": P_D,
        "noise_x_rel[run]": NOISE,
        "noise_x_capsule[run]": NOISE,
    }
    run = run_of(tmp_path)
    target = LogPosterior(run.rig, [run])
    u = target.unconstrain(np.array([known[name] for name in target.names]))
    residuals, jacobian = linearised(target, u)
    own = np.concatenate([left for _, left in run.records(run.local({**known, "g": 9.81}))])
    np.testing.assert_allclose(residuals[: len(own)], own, atol=1e-6)
    # SciPy made the record: at its values nothing but the noise is left.
    assert np.sqrt(np.mean(own**2)) < 1.15
    assert np.abs(jacobian[:, [target.names.index("k2[a]"), target.names.index("k2[b]")]]).max(axis=0).min() > 1.0


def test_springs_are_told_apart_by_name(tmp_path: Path) -> None:
    """One spring may stand on both sides; without a spring in front k2 is 0."""
    write(tmp_path, harmonic(TRUTH), HARMONIC + SPRINGS)
    values = {"k2[a]": 9000.0, "k2[b]": 5000.0}
    run = run_of(tmp_path)
    known = {row.name: 1.0 for row in run.parameters} | values
    assert {name: run.local(known)[name] for name in ("k2", "k2_back")} == {"k2": 9000.0, "k2_back": 5000.0}
    toml = (tmp_path / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(toml.replace('spring_back = "b"', 'spring_back = "a"'))
    same = run_of(tmp_path)
    assert [row.name for row in same.parameters if row.symbol == "k2"] == ["k2[a]"]
    assert same.local(known)["k2_back"] == 9000.0
    behind = "".join(line for line in SPRINGS.splitlines(keepends=True) if "_back" in line)
    (tmp_path / "rig.toml").write_text(HEAD + RUN + HARMONIC + behind)
    assert "k2" not in run_of(tmp_path).local(known)


def with_springs(folder: Path, run: str) -> Path:
    """The run, and the test of each spring."""
    rng = np.random.default_rng(2)
    write(folder, harmonic(TRUTH), HARMONIC + run)
    entries = ""
    for name, k2 in (("a", TRUTH["k2"]), ("b", TRUTH["k2_back"])):
        x = np.linspace(0.2, 2.0, 10)
        rows = [f"{d:.3f},{1e-3 * k2 * d + 0.02 * rng.standard_normal():.4f}" for d in x]
        (folder / f"{name}.csv").write_text("\n".join(["deflection [mm],force [N]", *rows]))
        entries += f'\n[[experiment]]\nkind = "support_spring"\nspring = "{name}"\nfile = "{name}.csv"\n'
    (folder / "rig.toml").write_text(HEAD + RUN + HARMONIC + run + entries)
    return folder


@pytest.mark.full
def test_a_fit_finds_both_springs_and_gaps(tmp_path: Path) -> None:
    result = fit(read_rig(with_springs(tmp_path, SPRINGS)), budget=None)
    truth = {"k2[a]": 9000.0, "k2[b]": 5000.0, "k1": 1420.0, "mu": 0.3}
    for name, value in truth.items():
        assert abs(result[name].value - value) < 4.0 * result[name].sd
    assert result["k2[b]"].sd < 0.02 * TRUTH["k2_back"]


@pytest.mark.slow
def test_a_fit_without_the_spring_behind_the_rod_fails(tmp_path: Path) -> None:
    in_front = "".join(line for line in SPRINGS.splitlines(keepends=True) if "_back" not in line)
    assert not fit(read_rig(with_springs(tmp_path, in_front)), budget=None).clean


def square(q: Values, times: np.ndarray, begin: float = 0.0) -> np.ndarray:
    """States under a square wave that began at 0, from rest at ``begin``."""
    wave = {"P_on": 6.0, "P_off": -6.0, "period": PERIOD, "duty": 0.5, "lag": LAG}
    force, switches = pulses({**q, **wave}, begin + times[-1])
    early = sum(s <= begin for s in switches)
    later = [s - begin for s in switches if s > begin]
    return simulate_general(q, (lambda t, on: force(t + begin, on + early), later), times, 1e-10, 1e-12)[0]


@pytest.mark.full
def test_a_square_wave_explains_a_record(tmp_path: Path) -> None:
    begin = 50 * PERIOD + 0.013
    write(tmp_path, square(TRUTH, TIME, begin), SQUARE + SPRINGS)
    own = {"P_on": 6.0, "lag": LAG, "phase": 2.0 * np.pi * 0.013 / PERIOD}
    run = run_of(tmp_path)
    assert largest_residual(run, own) < 1.15
    assert largest_residual(run, {**own, "P_on": 6.3}) > 3.0


def test_a_progression_under_a_square_wave(tmp_path: Path) -> None:
    q = {**TRUTH, "k2": 0.0, "G": np.inf, "k2_back": 0.0, "G_back": np.inf}
    wave = {"P_on": 6.0, "P_off": -6.0, "duty": 0.35, "lag": LAG}
    rows = []
    for period in (0.06, 0.09):
        end = np.array([0.0, 10 * period])
        X2 = simulate_general(q, pulses({**q, **wave, "period": period}, end[-1]), end, 1e-10, 1e-12)[0][-1, 2]
        rows.append((1e3 * period, 35, 10, X2))
    text = ["period [ms],duty [%],periods [1],distance [m]", *(f"{a:g},{b},{n},{x:.9g}" for a, b, n, x in rows)]
    (tmp_path / "progression.csv").write_text("\n".join(text))
    entry = '\n[[experiment]]\nkind = "progression"\nfile = "progression.csv"\ndrive = "square"\n'
    entry += 'P_on = { value = 6, unit = "N" }\nlag = { value = 4, unit = "ms" }\n'
    (tmp_path / "rig.toml").write_text(HEAD + entry)
    (trials,) = make_experiments(read_rig(tmp_path))
    found = np.asarray(trials.displacements(q, np.zeros(2), trials.settings))
    assert found.ravel() == pytest.approx([row[-1] for row in rows], abs=1e-6)
    assert abs(found.ravel()).min() > 1e-3


@pytest.mark.parametrize(
    ("settings", "rule", "instead"),
    [
        (HARMONIC + 'spring_back = "b"\n', "spring_back and gap_back must stand together", HARMONIC + SPRINGS),
        (HARMONIC + SPRINGS.replace('spring = "a"\n', ""), "spring and gap must stand together", HARMONIC + SPRINGS),
        (SQUARE.replace("P_on", "P_d"), "has no amplitude P_d", SQUARE),
        (SQUARE.replace('P_on = { value = 6, sd = 2, unit = "N" }\n', ""), 'drive = "square" needs P_on', SQUARE),
        (HARMONIC + 'lag = { value = 4, unit = "ms" }\n', "only pulses and square waves have lag", SQUARE),
    ],
)
def test_a_fault_is_named_and_its_remedy_works(tmp_path: Path, settings: str, rule: str, instead: str) -> None:
    write(tmp_path, np.zeros((len(TIME), 4)), settings)
    assert rule in str(fault_of(tmp_path))
    (tmp_path / "rig.toml").write_text(HEAD + RUN + instead)
    read_rig(tmp_path)


def test_a_contact_of_ones_own_stands_in_front_of_the_rod(tmp_path: Path) -> None:
    write(tmp_path, np.zeros((len(TIME), 4)), HARMONIC + SPRINGS.replace('"b"', '"a"'))
    with pytest.raises(InputError, match="remove spring_back and gap_back"):
        make_experiments(read_rig(tmp_path, contact=Hertz), contact=Hertz)


def test_a_run_on_another_ground_is_no_point_of_a_level_diagram(tmp_path: Path) -> None:
    write(tmp_path, harmonic(TRUTH), HARMONIC + SPRINGS.partition("spring_back")[0])
    rig, fitted, diagram = read_rig(tmp_path), {"k2[a]": 9e3}, {**TRUTH, "P_d": 8.0, "Omega": 60.0}
    for own, left_out in (({"slope": Quantity(0.05)}, True), ({"normal_force": 3.0}, True), ({}, False)):
        tables = [replace(table, settings=replace(table.settings, **own)) for table in rig.tables]
        said = overlay(replace(rig, tables=tuple(tables)), "Omega", (20.0, 90.0), diagram, fitted)[1]
        assert ("another slope, pressing force or load" in said) == left_out


def test_a_gap_within_four_sd_of_0_may_be_negative() -> None:
    for symbol in ("G", "G_back"):
        for value, kind in ((1.9e-4, "normal"), (2.1e-4, "positive_normal"), (-2e-4, "normal")):
            (row,) = stated_parameters(symbol, Quantity(value, 5e-5))
            assert row.prior is not None
            assert row.prior.kind == kind
    (row,) = stated_parameters("P_d", Quantity(1.9, 0.5))
    assert row.prior is not None
    assert row.prior.kind == "positive_normal"


def test_runs_with_a_spring_behind_the_rod_are_tuned_and_drawn_with_it_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, harmonic(TRUTH), HARMONIC + SPRINGS)
    rig, chosen = read_rig(tmp_path), {"k2[a]": np.array([9e3, 9.1e3]), "k2[b]": np.array([5e3, 5.1e3])}
    ((_, settings, _),) = operating_points(fit_of({}, rig=rig), chosen, "harmonic")
    assert settings["k2_back"] is chosen["k2[b]"]
    assert settings["G_back"] == 8e-4
    assert "a spring behind the rod" in overlay(rig, "Omega", (20.0, 90.0), {**TRUTH, "P_d": 8.0}, chosen)[1]
    own = replace(rig.tables[0].settings, spring_back=None, gap_back=None)
    other = replace(rig, tables=(*rig.tables, replace(rig.tables[0], label="other", settings=own)))
    values = {"k1": 1420.0, "c": 3.9, "mu": 0.3, "v_s": 0.3, "k2[a]": 9e3, "k2[b]": 5e3}
    with pytest.raises(InputError, match="do not have the same spring behind the rod"):
        tune(fit_of(values, rig=other), {"P_d": (4.0, 8.0)}, {"Omega": 60.0, "G": 1e-3}, spring="a")
    # The remedy works, and each operating point has the spring behind the rod that it had when it was measured.
    asked = list[dict[str, np.ndarray]]()
    monkeypatch.setattr(
        tuning._Model, "velocity", lambda model, settings, how: asked.append(settings) or np.zeros((3, 2))
    )
    many = {**chosen, **{name: np.full(2, x) for name, x in values.items() if name not in chosen}}
    leaves = tuning._leaves(
        fit_of(values, rig=other), many, "harmonic", {"P_d"}, {"k2_back": 0.0, "Omega": 60.0, "G": 1e-3}, "a"
    )
    points = operating_points(fit_of(values, rig=other), many, "harmonic")
    table = tuning._table(tuning._Model(leaves, "harmonic", 2), {"P_d": 5.0}, points, {}, None, "trusted")
    assert list(table["k2_back [N/m]"]) == [0.0, 5050.0, 0.0]
    assert list(table["G_back [m]"]) == [np.inf, 8e-4, np.inf]
    np.testing.assert_array_equal(asked[0]["k2_back"][1], chosen["k2[b]"])
    # Which spring stands in front: a alone, and a where it stands on both sides.
    given = {"Omega": 60.0, "G": 1e-3}
    both = replace(rig.tables[0], settings=replace(rig.tables[0].settings, spring_back="a"))
    for tables, back in ((rig.tables, "b"), ((both,), "a")):
        own_rig = replace(rig, tables=tables)
        found = tuning._leaves(fit_of(values, rig=own_rig), {**many}, "harmonic", {"P_d"}, given, None)
        assert found["k2"] is many["k2[a]"]
        assert found["k2_back"] is many[f"k2[{back}]"]
        many.pop("k2[b]", None)
    write(tmp_path, np.zeros((len(TIME), 4)), SQUARE + SPRINGS)
    with pytest.raises(InputError, match=r"tune needs P_off .* give P_off: one value"):
        tune(fit_of(values, rig=read_rig(tmp_path)), {"P_on": (4.0, 8.0)}, {"period": 0.1, "duty": 0.5, "G": 1e-3})
    assert "no harmonic force" in overlay(read_rig(tmp_path), "Omega", (20.0, 90.0), {**TRUTH, "P_d": 8.0}, chosen)[1]


def test_a_rod_that_never_leaves_a_compressed_spring_has_no_count_of_contacts(tmp_path: Path) -> None:
    """The model counts closings, 0; one stretch of contact in each period is none. Control: a gap that opens."""
    x = np.zeros((len(TIME), 4))
    x[:, 0] = 1e-3 * np.cos(OMEGA * TIME)
    for gap, said in ((-3.0, True), (0.5, False)):
        write(tmp_path, x, HARMONIC + SPRINGS.replace("value = -0.2", f"value = {gap}"))
        motion = measured_motion(read_rig(tmp_path).tables[0])
        assert ("contacts: the rod does not leave the spring" in motion.evidence.reasons) == said
        assert (motion.evidence.contacts.count is None) == said


def test_the_acceleration_counts_contacts_where_no_spring_stands_behind_the_rod(tmp_path: Path) -> None:
    x = np.zeros((len(TIME), 4))
    x[:, 0] = 1e-3 * np.cos(OMEGA * TIME)
    gap = SPRINGS.replace("value = -0.2", "value = 0.9")
    for springs, counted in ((gap, False), (gap.partition("spring_back")[0], True)):
        write(tmp_path, x, HARMONIC + springs)
        table = read_rig(tmp_path).tables[0]
        noise = np.random.default_rng(2).standard_normal(len(TIME))
        column = replace(table.columns["x_rel"], name="acceleration_rod", values=noise - OMEGA**2 * x[:, 0])
        table = replace(table, columns={**table.columns, "acceleration_rod": column})
        contacts = measured_motion(table).evidence.contacts
        assert contacts is not None
        assert bool(contacts.spikes) == counted


def test_the_portrait_has_a_line_for_each_spring(tmp_path: Path) -> None:
    write(tmp_path, harmonic(TRUTH), HARMONIC + SPRINGS)
    start = {"x_start": 0.0, "y_start": 0.0, "noise_x_rel": NOISE, "noise_x_capsule": NOISE, "phase": PHASE, "P_d": P_D}
    (panel,) = _portrait(run_of(tmp_path), {**TRUTH, **start})
    places = {curve.label: float(curve.x[0]) for curve in panel.curves[1:]}
    # In the unit of the column; the offset of the sensor is near 0.
    assert places == pytest.approx({"support spring a": -2e-4, "back spring b": -8e-4}, abs=2e-5)


def test_the_groups_of_a_run_hold_those_of_the_spring_behind_the_rod(tmp_path: Path) -> None:
    write(tmp_path, harmonic(TRUTH), HARMONIC + SPRINGS)
    found = _groups(run_of(tmp_path), {**TRUTH, "phase": PHASE, "P_d": P_D})
    assert (found["k2/k1 [a]"], found["k2/k1 [b]"]) == pytest.approx((9000 / 1420, 5000 / 1420))
    F_b = TRUTH["mu"] * (TRUTH["m1"] + TRUTH["m2"]) * TRUTH["g"]
    assert found["G_back k1/F_b [run]"] == pytest.approx(8e-4 * 1420 / F_b)


def test_a_square_wave_is_the_pulse_and_its_opposite_for_equal_times(tmp_path: Path) -> None:
    """Where no duty is stated; of a run and of a progression, whose pulses are on all the time without one."""
    write(tmp_path, np.zeros((len(TIME), 4)), SQUARE + SPRINGS)
    drive = run_of(tmp_path).capsule({**TRUTH, "P_on": 6.0, "phase": 0.3, "lag": LAG})[1]
    assert (drive.P_on, drive.P_off, drive.duty, drive.lag) == (6.0, -6.0, 0.5, LAG)
    (tmp_path / "progression.csv").write_text("period [ms],periods [1],distance [m]\n60,10,0.01\n90,10,0.02\n")
    entry = '\n[[experiment]]\nkind = "progression"\nfile = "progression.csv"\ndrive = "square"\n'
    (tmp_path / "rig.toml").write_text(HEAD + entry + 'P_on = { value = 6, unit = "N" }\n')
    (trials,) = make_experiments(read_rig(tmp_path))
    drive = trials.capsule(TRUTH, trials.settings)[1]
    np.testing.assert_array_equal(drive.duty, 0.5)
    np.testing.assert_array_equal(drive.P_off, -drive.P_on)


def test_a_free_decay_that_reaches_the_spring_behind_the_rod_fails(tmp_path: Path) -> None:
    x = 2e-3 * np.exp(-17.0 * TIME) * np.cos(112.0 * TIME) + NOISE * np.random.default_rng(5).standard_normal(len(TIME))
    rows = [f"{t:.4f},{a:.9g}" for t, a in zip(TIME, x, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["time [s],x_rel [m]", *rows]))
    for gap, level in ((0.4, ["fail"]), (4.0, [])):
        words = (
            f'spring_back = "b"\ngap_back = {{ value = {gap}, unit = "mm" }}\ndamping = "viscous"\nnoise = "white"\n'
        )
        entry = '\n[[experiment]]\nkind = "free_vibration"\nfile = "run.csv"\nstiffness = "linear"\ndrift = "none"\n'
        (tmp_path / "rig.toml").write_text(HEAD + entry + words)
        found = [one for one in fit(read_rig(tmp_path), budget=None).findings if one.code == "decays.contact"]
        assert [one.level for one in found] == level
        assert all(one.facts["reach"] < one.facts["gap"] < 0.0 for one in found)


@pytest.mark.full
def test_a_decay_of_the_capsule_model_meets_the_spring_behind_the_rod(tmp_path: Path) -> None:
    x = simulate_general(TRUTH, (lambda t, on: 0.0, []), TIME, 1e-10, 1e-12, start=(-2e-3, 0.0, 0.0, 0.0))[0]
    write(tmp_path, x, HARMONIC)
    entry = '\n[[experiment]]\nkind = "free_vibration"\nfile = "run.csv"\nforward = "capsule"\ncapsule = "free"\n'
    entry += 'start = { value = 0, unit = "s" }\nstop = { value = 0.6, unit = "s" }\n'
    text = (tmp_path / "run.csv").read_text().splitlines()
    (tmp_path / "run.csv").write_text("\n".join(line.rpartition(",")[0] for line in text))
    (tmp_path / "rig.toml").write_text(HEAD + entry + SPRINGS)
    (decay,) = make_experiments(read_rig(tmp_path))
    names = {"k2[a]", "k2[b]", "G[run]", "G_back[run]"}
    assert names <= {row.name for row in decay.parameters}
    values = {**TRUTH, "x_start": -2e-3, "y_start": 0.0, "noise_sd": NOISE}
    assert np.sqrt(np.mean(np.asarray(decay.residuals(values, np)) ** 2)) < 1.15
    assert np.sqrt(np.mean(np.asarray(decay.residuals({**values, "k2_back": 5500.0}, np)) ** 2)) > 1.5
