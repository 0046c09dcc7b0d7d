"""Runs driven by pulses or by the recorded current: white residuals at the truth, and faults with their remedies."""

from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.experiments.forced_run.experiment import CapsuleRun, growth
from capsule_id.experiments.forced_run.start_state import ROD_DAMPING, ROD_FREQUENCY
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.experiments.lint import lint
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.physics.drives import Pulses, RecordedDrive
from capsule_id.physics.model import CapsuleParameters, Drive
from capsule_id.physics.simulation import simulate
from tests.rig.faults import fault_of

TRUTH = {"m1": 0.11, "m2": 0.53, "k1": 1420.0, "c": 3.89, "mu": 0.3, "v_s": 0.3, "g": 9.81}
P = CapsuleParameters(**TRUTH, k2=0.0, G=np.inf)
PERIOD, DUTY, LAG, PHASE, K = 0.09, 0.4, 0.006, 1.1, 2.0
#: Time since the first sample, and the time of the first sample on its clock, s.
TIME, FIRST = np.arange(600) / 1000.0, 0.25
NOISE = 1e-5
HEAD = '[rig]\nname = "run"\nm1 = { value = 110, unit = "g" }\nm2 = { value = 530, unit = "g" }\n'
RUN = (
    '\n[[experiment]]\nkind = "forced_run"\nfile = "run.csv"\nf = { value = 11.111111, unit = "Hz" }\nstart = "stuck"\n'
)
PULSES = (
    'drive = "pulses"\nduty = { value = 40, unit = "%" }\nP_on = { value = 6, sd = 3, unit = "N" }\n'
    'lag = { value = 6, sd = 2, unit = "ms" }\n'
)


def write(folder: Path, drive: Drive, shift: float, current: np.ndarray | None, settings: str) -> None:
    """A record of x_rel and x_capsule from rest, with noise, and its rig."""
    rng = np.random.default_rng(1)
    t = simulate(P, drive, shift + TIME)
    columns = {"time [s]": FIRST + TIME, "x_rel [m]": np.asarray(t.x_rel), "x_capsule [m]": np.asarray(t.X2)}
    noisy = {
        name: x if name.startswith("time") else x + NOISE * rng.standard_normal(x.size) for name, x in columns.items()
    }
    if current is not None:
        noisy["current [A]"] = current
    rows = zip(*noisy.values(), strict=True)
    (folder / "run.csv").write_text("\n".join([",".join(noisy), *(",".join(f"{x:.9g}" for x in row) for row in rows)]))
    (folder / "rig.toml").write_text(HEAD + RUN + settings)


def run_of(folder: Path) -> CapsuleRun:
    (run,) = make_experiments(read_rig(folder))
    return run


def largest_residual(run: CapsuleRun, own: dict[str, float]) -> float:
    """Largest rms residual of a channel at the truth with ``own``, in units of the noise."""
    start = {"x_start": 0.0, "y_start": 0.0, "noise_x_rel": NOISE, "noise_x_capsule": NOISE}
    records = run.records({**TRUTH, **start, **own})
    return max(float(np.sqrt(np.mean(residuals**2))) for _, residuals in records)


def test_an_accelerometer_sees_the_force_that_moves_the_rod(tmp_path: Path) -> None:
    """Before: the acceleration was that of pulses at another time, off by twice its rms; x_rel and x_capsule were right."""
    drive, shift = Pulses(6.0, PERIOD, DUTY, phase=PHASE, lag=LAG), 50 * PERIOD
    write(tmp_path, drive, shift, None, PULSES)
    columns = np.loadtxt(tmp_path / "run.csv", delimiter=",", skiprows=1)
    t = simulate(P, drive, shift + np.linspace(0.0, TIME[-1], 20 * (len(TIME) - 1) + 1))
    # From the velocities on both sides of each sample, where no pulse begins or ends between them.
    seen = np.gradient(np.asarray(t.Y1), np.asarray(t.times))[::20]
    rows = [",".join(f"{x:.9g}" for x in (*row, a)) for row, a in zip(columns, seen, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["time [s],x_rel [m],x_capsule [m],acceleration_rod [m/s^2]", *rows]))
    run = run_of(tmp_path)
    own = {"P_on": 6.0, "lag": LAG, "phase": PHASE, "x_start": 0.0, "y_start": 0.0}
    predicted = np.asarray(run.predict({**TRUTH, **own}, np)[run.names.index("acceleration_rod")])
    assert np.std(seen) > 15.0
    assert np.quantile(np.abs(predicted - seen), 0.95) < 0.1


@pytest.mark.full
def test_pulses_explain_a_record_of_pulses(tmp_path: Path) -> None:
    shift = 50 * PERIOD
    write(tmp_path, Pulses(6.0, PERIOD, DUTY, phase=PHASE, lag=LAG), shift, None, PULSES)
    # A record that starts from rest within the pulses: the drive acts since long before the first sample.
    run = run_of(tmp_path)
    assert {"P_on", "lag", "phase[run]"} <= {row.name for row in run.parameters}
    own = {"P_on": 6.0, "lag": LAG, "phase": PHASE}
    assert largest_residual(run, own) < 1.15
    assert largest_residual(run, {**own, "lag": 2.0 * LAG}) > 3.0


@pytest.mark.full
def test_the_growth_of_initial_errors_is_that_of_the_motion_under_the_same_pulses(tmp_path: Path) -> None:
    """Pulses of an earlier or later phase let the capsule slide at other times, and give another growth."""
    write(tmp_path, Pulses(6.0, PERIOD, DUTY, phase=PHASE, lag=LAG), 50 * PERIOD, None, PULSES)
    toml = (tmp_path / "rig.toml").read_text()
    stop = '"moving"\nsegment = { value = 30, unit = "ms" }'
    (tmp_path / "rig.toml").write_text(toml.replace('start = "stuck"', f"start = {stop}"))
    run = make_experiments(read_rig(tmp_path))[0]
    own = {"P_on": 6.0, "lag": LAG, "phase": PHASE, "x_start": 1e-3, "y_start": -0.05, "capsule_start": -0.1}
    size = np.array([1.0, run.Omega, run.Omega]) * run.rough.length

    def end(name: str, change: float) -> np.ndarray:
        t = run.motion({**TRUTH, **own, name: own[name] + change}, np)
        return np.array([t.x_rel[-1], t.Y1[-1] - t.Y2[-1], t.Y2[-1]])

    step = 1e-7
    columns = [
        (end(name, step * scale) - end(name, -step * scale)) / (2.0 * step * size)
        for name, scale in zip(("x_start", "y_start", "capsule_start"), size, strict=True)
    ]
    assert growth(run, {**TRUTH, **own}) == pytest.approx(np.linalg.norm(columns, 2), rel=1e-3)


@pytest.mark.full
def test_a_later_part_of_a_record_has_the_pulses_of_the_whole(tmp_path: Path) -> None:
    """All parts share the phase, which counts from the first sample of the record."""
    drive = Pulses(6.0, PERIOD, DUTY, phase=PHASE, lag=LAG)
    write(tmp_path, drive, 50 * PERIOD, None, PULSES)
    toml = (tmp_path / "rig.toml").read_text()
    segment = 'start = "moving"\nsegment = { value = 100, unit = "ms" }'
    (tmp_path / "rig.toml").write_text(toml.replace('start = "stuck"', segment))
    part = make_experiments(read_rig(tmp_path))[1]
    assert (part.time[0] - FIRST) / PERIOD % 1.0 > 0.05
    own = {"P_on": 6.0, "lag": LAG, "phase": PHASE, "x_start": 1e-3, "y_start": -0.05, "capsule_start": -0.1}
    found = part.motion({**TRUTH, **own, "moves": 1.0}, np)
    Y2 = part.moves * -0.1
    exact = simulate(P, drive, 50 * PERIOD + part.time - FIRST, (1e-3, -0.05 + Y2, 0.0, Y2))
    assert np.asarray(found.x_rel) == pytest.approx(np.asarray(exact.x_rel), abs=1e-9)


@pytest.mark.parametrize(("P_on", "duty"), [(6.0, 0.4), (-6.0, 0.4), (6.0, 0.15)])
def test_a_fit_starts_near_the_phase_of_the_pulses(tmp_path: Path, P_on: float, duty: float) -> None:
    """A linear rod under pulses, harmonic by harmonic. (Before: half the duty off, and a square wave 90 degrees.)"""
    phase, n = 1.1, np.arange(1, 40)
    turns, omega = np.linspace(0.0, 1.0, 4096, endpoint=False), 2.0 * np.pi * n / PERIOD
    tones = np.fft.rfft(np.where((turns + phase / (2.0 * np.pi)) % 1.0 < duty, P_on, 0.0))[n] / 2048
    rod = tones / (1.0 + 1j * LAG * omega) / (ROD_FREQUENCY**2 - omega**2 + 2j * ROD_DAMPING * ROD_FREQUENCY * omega)
    x_rel = np.real(np.exp(1j * np.outer(TIME, omega)) @ rod)
    rows = [f"{t:.9g},{x:.9g},0" for t, x in zip(FIRST + TIME, x_rel, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["time [s],x_rel [m],x_capsule [m]", *rows]))
    settings = PULSES.replace("value = 6, sd = 3", f"value = {P_on}, sd = 3").replace("40", f"{100 * duty:g}")
    (tmp_path / "rig.toml").write_text(HEAD + RUN + settings)
    start = run_of(tmp_path).starts()["phase[run]"].centre
    assert abs(np.angle(np.exp(1j * (start - phase)))) < 0.1


def test_the_recorded_current_is_the_drive(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    current = np.interp(TIME, np.arange(0.0, 0.7, 0.05), 2.0 * rng.standard_normal(14))
    write(tmp_path, RecordedDrive(TIME, K * current), 0.0, current, 'drive = "recorded"\n')
    run = run_of(tmp_path)
    assert "current" not in run.names
    assert not {"phase[run]", "I_d[run]"} & {row.name for row in run.parameters}
    assert largest_residual(run, {"K": K}) < 1.15
    assert largest_residual(run, {"K": 1.1 * K}) > 3.0


def test_a_current_that_is_switched_is_no_fault(tmp_path: Path) -> None:
    """Before: "clipped at its upper limit", and "must be smooth; it jumps", in a run whose fit is right."""
    current = np.round(1.5 * (np.sin(2.0 * np.pi * TIME / PERIOD) > 0.3), 2)
    noise = np.round(1e-3 * np.random.default_rng(3).standard_normal(TIME.size), 3)
    for read in (current, current + noise):
        write(tmp_path, RecordedDrive(TIME, K * read), 0.0, read, 'drive = "recorded"\n')
        rig = read_rig(tmp_path)
        assert not [found.code for found in lint(rig, default_registry(), rig.tables) if found.level == "fail"]
    # Negative controls: a smooth current that is clipped; a sample that reads 0 alone is a drop-out.
    clipped = np.clip(1.5 * np.sin(2.0 * np.pi * TIME / PERIOD), -1.0, 1.0)
    write(tmp_path, RecordedDrive(TIME, K * clipped), 0.0, clipped, 'drive = "recorded"\n')
    rig = read_rig(tmp_path)
    assert "readings.clipped" in [found.code for found in lint(rig, default_registry(), rig.tables)]
    read = current + 2.0
    read[[100, 310, 311]] = 0.0
    write(tmp_path, RecordedDrive(TIME, K * read), 0.0, read, 'drive = "recorded"\n')
    rig = read_rig(tmp_path)
    assert "readings.dropouts" in [found.code for found in lint(rig, default_registry(), rig.tables)]


def test_a_lag_near_0_has_a_prior_with_its_mass_there(tmp_path: Path) -> None:
    """Before: a traceback, ZeroDivisionError."""
    write(tmp_path, Pulses(6.0, PERIOD, DUTY), 0.0, None, PULSES.replace("value = 6, sd = 2", "value = 0, sd = 2"))
    target = LogPosterior(read_rig(tmp_path), [run_of(tmp_path)])
    (row,) = [row for row in target.parameters if row.name == "lag"]
    assert row.prior == Prior("halfnormal", 0.0, 2e-3)
    assert np.all(np.isfinite(target.prior_sd))


RECORDED = 'drive = "recorded"\n'


@pytest.mark.parametrize(
    ("settings", "rule", "instead"),
    [
        # Before: read, and without any effect.
        (
            RECORDED + 'current_gain_sd = { value = 5, unit = "%" }\n',
            "current_gain_sd needs a channel that the motion predicts",
            RECORDED,
        ),
        (
            RECORDED + 'acceleration_rod_delay_sd = { value = 1, unit = "ms" }\n',
            "acceleration_rod_delay_sd needs a channel",
            RECORDED + 'x_rel_delay_sd = { value = 1, unit = "ms" }\n',
        ),
        (
            RECORDED + 'current_sd = { value = 5, unit = "mA" }\n',
            "current_sd needs a channel that the motion predicts",
            RECORDED,
        ),
        # Before: pulses that are always on.
        (PULSES.replace('unit = "%"', 'unit = "1"'), "duty must lie between 0 and 100 %, both excluded", PULSES),
        (PULSES.replace("value = 40", "value = 0"), "duty must lie between 0 and 100 %", PULSES),
        (PULSES.replace("value = 40", "value = 100"), "duty must lie between 0 and 100 %", PULSES),
    ],
)
def test_what_would_have_no_effect_is_refused(tmp_path: Path, settings: str, rule: str, instead: str) -> None:
    for own in (settings, instead):
        write(tmp_path, Pulses(6.0, PERIOD, DUTY), 0.0, np.cos(TIME) if own.startswith(RECORDED) else None, own)
        if own == settings:
            assert rule in str(fault_of(tmp_path))
        else:
            read_rig(tmp_path)


@pytest.mark.full
@pytest.mark.parametrize(
    ("settings", "rule", "instead"),
    [
        ('drive = "recorded"\n', 'drive = "recorded" needs the column current', PULSES),
        ('drive = "pulses"\nP_on = { value = 6, unit = "N" }\n', 'drive = "pulses" needs duty', PULSES),
        (PULSES.replace('drive = "pulses"\n', ""), "only pulses and square waves have duty", PULSES),
        (PULSES + 'P_d = { value = 1, unit = "N" }\n', 'drive = "pulses" has no amplitude P_d', PULSES),
    ],
)  # fmt: skip
def test_a_fault_is_named_and_its_remedy_works(tmp_path: Path, settings: str, rule: str, instead: str) -> None:
    write(tmp_path, Pulses(6.0, PERIOD, DUTY), 0.0, None, settings)
    assert rule in str(fault_of(tmp_path))
    (tmp_path / "rig.toml").write_text(HEAD + RUN + instead)
    read_rig(tmp_path)
