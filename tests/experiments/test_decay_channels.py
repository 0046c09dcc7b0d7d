"""Velocity and acceleration records of free decays, halves of records, and errors of position."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

import capsule_id as cid
from capsule_id.experiments.base import refit
from capsule_id.experiments.free_vibration.experiment import (
    FreeVibration,
    check_drift,
    check_halves,
    check_positions,
    fast_rms,
    graded,
    size_of_residuals,
)
from capsule_id.experiments.free_vibration.lint import lint_decay
from capsule_id.experiments.free_vibration.models import decay
from capsule_id.experiments.free_vibration.readings import CHANNELS, DecayModel
from capsule_id.experiments.free_vibration.record import Screened
from capsule_id.experiments.free_vibration.screening import Screening
from capsule_id.experiments.free_vibration.second_fit import second_models
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.views import Finding
from tests.experiments import bench
from tests.experiments.decay_calibration import twin

#: s; every test shares this number of samples, so that programs compile once.
TIME = np.arange(250) / 500.0
RELEASE, C = 2e-3, 1.0
VISCOUS = {"k1": bench.K1, "c": C, "m1": bench.M1}
DRY = {**VISCOUS, "F_dry": 0.03 * bench.K1 * RELEASE}


def record(channel: str, forces: dict[str, float], seed: int = 1, relative_noise: float = 0.005) -> FreeVibration:
    """A decay from one channel: noise relative to its range, and an offset as of gravity along an inclined axis."""
    motion = decay(TIME, forces, RELEASE, 0.0, 30)[CHANNELS[channel].order]
    size = float(np.ptp(motion))
    noise = relative_noise * size * np.random.default_rng(seed).standard_normal(len(TIME))
    columns = [bench.column("time", TIME), bench.column(channel, np.asarray(motion) + noise + 0.3 * size)]
    table = bench.table("free_vibration", columns, "decay")
    return FreeVibration(table, bench.rig(table))


@pytest.mark.parametrize("channel", CHANNELS)
def test_viscous_decays_of_every_channel_give_k1_and_c(channel: str) -> None:
    own = record(channel, VISCOUS)
    (noise,) = own.scatters
    found = refit(own, {**VISCOUS, noise: 0.005 * float(np.ptp(own.values))}, [])
    for name in ("k1", "c"):
        value, sd = found[name]
        assert abs(value - VISCOUS[name]) < 2.0 * sd
        assert sd < 0.02 * value


@pytest.mark.full
@pytest.mark.parametrize("channel", CHANNELS)
def test_dry_friction_of_every_channel(channel: str) -> None:
    """The force comes out in newtons, so amplitude and turning time refer to x_rel."""
    own = record(channel, DRY)
    found = Screening(own).fit(DecayModel(("dry",)))[0]
    for name in ("k1", "c", "F_dry"):
        assert abs(found.values[name] - DRY[name]) < 3.0 * found.errors[name]
    assert found.errors["F_dry"] < 0.3 * DRY["F_dry"]
    assert found.values["amplitude"] == pytest.approx(RELEASE, rel=0.05)
    assert own.largest_deflection == pytest.approx(RELEASE, rel=0.1)


@pytest.mark.full
@pytest.mark.parametrize("fraction", [0.02, 0.05, 0.1])
def test_the_highest_of_many_maxima_of_dry_friction(fraction: float) -> None:
    """The rod sticks after a whole number of half cycles, so a start by the paper's estimate ends elsewhere."""
    force = fraction * bench.K1 * RELEASE
    own = record("x_rel", {**VISCOUS, "F_dry": force}, 1)
    screening = Screening(own)
    found = screening.fit(DecayModel(("dry",)))[0]
    assert abs(found.values["F_dry"] - force) < 3.0 * found.errors["F_dry"]
    # Negative control: from twice the viscous damping and a fifth of the force.
    elsewhere = screening.fit(DecayModel(("dry",)), screening.scaled({**VISCOUS, "c": 2.0 * C, "F_dry": 0.2 * force}))[
        0
    ]
    assert elsewhere.bic > found.bic + 100.0


def test_a_velocity_called_an_acceleration_gives_another_force() -> None:
    """Negative control of the test above."""
    velocity = record("velocity", DRY)
    columns = [bench.column("time", TIME), bench.column("acceleration", velocity.values)]
    table = bench.table("free_vibration", columns, "decay")
    found = Screening(FreeVibration(table, bench.rig(table))).fit(DecayModel(("dry",)))[0]
    assert abs(found.values["F_dry"] - DRY["F_dry"]) > 4.0 * found.errors["F_dry"]


@pytest.mark.full
@pytest.mark.parametrize(
    "fraction", [pytest.param(0.03, marks=pytest.mark.slow), 0.165, pytest.param(0.19, marks=pytest.mark.slow)]
)
def test_a_second_fit_of_an_acceleration_finds_dry_friction(fraction: float) -> None:
    """The acceleration jumps where the rod turns: no fault of the record. Small peaks after it sticks do not count."""
    force = fraction * bench.K1 * RELEASE
    own = record("acceleration", {**VISCOUS, "F_dry": force})
    assert [found.code for found in lint_decay(own.table, own.rig) if found.level == "fail"] == []
    (second,), _ = second_models([own])
    assert second.model == DecayModel(("dry",))
    found = cast(Screened, second.about.screened)
    assert abs(found.values["F_dry"] - force) < 3.0 * found.errors["F_dry"]


def jumps(forces: dict[str, float], seed: int, lost: slice) -> list[Finding]:
    """Findings on samples lost from an acceleration record without a gap in its times."""
    values = np.delete(record("acceleration", forces, seed).values, lost)
    columns = [bench.column("time", TIME[: len(values)]), bench.column("acceleration", values)]
    table = bench.table("free_vibration", columns, "decay")
    return [found for found in lint_decay(table, bench.rig(table)) if found.code == "readings.jump"]


@pytest.mark.full
@pytest.mark.parametrize("seed", range(5))
def test_lost_samples_of_an_acceleration_are_named(seed: int) -> None:
    """One jump stands alone, also beside those of weak dry friction. A jump at every turn is dry friction."""
    weak = {**VISCOUS, "F_dry": 0.01 * bench.K1 * RELEASE}
    for forces in (VISCOUS, weak):
        (found,) = jumps(forces, seed, slice(50, 65))
        assert (found.level, found.facts["column"]) == ("fail", "acceleration")
        assert abs(found.facts["rows"][0] - 50) <= 9
        assert jumps(forces, seed, slice(0, 0)) == []


@pytest.mark.full
@pytest.mark.parametrize("fraction", [0.03, 0.1, 0.19, 0.24, 0.28, 0.35])
def test_jumps_of_dry_friction_are_no_lost_samples(fraction: float) -> None:
    """From 0.22 on, the rod sticks before a jump recurs."""
    forces = {**VISCOUS, "F_dry": fraction * bench.K1 * RELEASE}
    assert [found for seed in range(5) for found in jumps(forces, seed, slice(0, 0))] == []


def write(folder: Path, header: str, columns: list[np.ndarray], settings: str = "") -> Path:
    """A rig folder with one decay."""
    np.savetxt(folder / "d.csv", np.stack(columns, axis=1), delimiter=",", header=header, comments="", fmt="%.9g")
    entry = f'[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n{settings}\n'
    (folder / "rig.toml").write_text(
        '[rig]\nname = "a"\nm1 = { value = 110, sd = 0.2, unit = "g" }\n' + entry, encoding="utf-8"
    )
    return folder


@pytest.mark.full
def test_displacement_and_acceleration_of_one_file_are_fitted_together(tmp_path: Path) -> None:
    x, acceleration = (record(name, VISCOUS) for name in ("x_rel", "acceleration"))
    header = "time [s],x_rel [mm],acceleration [g_n]"
    rig = cid.read_rig(write(tmp_path, header, [TIME, 1e3 * x.values, acceleration.values / 9.80665]))
    experiments = make_experiments(rig)
    assert [e.label for e in experiments] == ["d", "d_acceleration"]
    np.testing.assert_allclose(experiments[1].observed, acceleration.values, rtol=1e-7)
    result = cid.fit(rig, budget=None)
    assert result.clean, [result.text(f) for f in result.findings if f.level == "fail"]
    rows = result.summary.loc[["k1", "c"]]
    assert np.all(np.abs(rows["map"] - [bench.K1, C]) < 3.0 * rows["standard_error"])
    assert {"noise_sd[d]", "noise_acceleration[d_acceleration]"} <= set(result.nuisances.index)


def test_turning_points_are_displacements(tmp_path: Path) -> None:
    header, settings = "time [s],velocity [m/s]", 'samples = "turning_points"'
    with pytest.raises(cid.InputError, match="needs x_rel and no other channel, velocity"):
        cid.read_rig(write(tmp_path, header, [TIME, np.sin(TIME)], settings))


def halves(forces: dict[str, float], seed: int) -> list[Finding]:
    """Findings of the check at the true values."""
    fit = SimpleNamespace(values={**VISCOUS, "noise_sd[decay]": 1e-5})
    return check_halves([record("x_rel", forces, seed, 0.002)], fit)  # type: ignore[arg-type]  # pyright: ignore


@pytest.mark.parametrize(
    ("z", "number", "level"),
    [(2.9, 1, "ok"), (3.1, 1, "warn"), (4.1, 1, "fail"), (4.4, 500, "ok"), (5.0, 500, "warn"), (5.4, 500, "fail")],
)
def test_a_deviation_counts_by_its_chance_in_all_records(z: float, number: int, level: str) -> None:
    """Before: of 500 clean decays one failed and two were warned of."""
    assert graded(z, matters=True)(number) == level
    assert graded(z, matters=False)(number) == ("warn" if level == "fail" else level)


def test_halves_of_a_viscous_decay_agree() -> None:
    """Two parameters of 40 records: the expected number of z above 3 is 0.2."""
    found = [finding for seed in range(40) for finding in halves(VISCOUS, seed)]
    assert sum(finding.level != "ok" for finding in found) <= 2
    assert len(found) == 40
    assert all(finding.level != "fail" for finding in found)


def test_halves_of_a_decay_with_dry_friction_name_the_damping() -> None:
    """Negative control: the viscous model of such a record."""
    (finding,) = halves(DRY, 1)
    assert (finding.level, finding.facts["name"]) == ("fail", "c")
    assert finding.facts["second"] > finding.facts["first"]


def test_halves_of_a_decay_on_a_hardening_spring_name_the_stiffness_that_falls() -> None:
    (finding,) = halves({**VISCOUS, "k_cubic": 0.05 * bench.K1 / RELEASE**2}, 1)
    assert (finding.level, finding.facts["name"]) == ("fail", "k1")
    assert finding.facts["second"] < finding.facts["first"]


def text(finding: Finding) -> str:
    return finding_text(finding, messages_of(default_registry()))


def sensor_error(x: np.ndarray, size: float) -> np.ndarray:
    """A sensor that reads ``size`` too low below a quarter of the deflection."""
    return x - size * (x < -0.25 * RELEASE)


def positions(values: np.ndarray, first: int = 0, last: int = len(TIME)) -> list[Finding]:
    """Findings of the check at the true values, from the sample ``first`` to ``last``."""
    columns = [bench.column("time", TIME[first:last]), bench.column("x_rel", values[first:last])]
    table = bench.table("free_vibration", columns, "decay")
    fit = SimpleNamespace(values={**VISCOUS, "noise_sd[decay]": 1e-5})
    return check_positions([FreeVibration(table, bench.rig(table))], fit)  # type: ignore[arg-type]  # pyright: ignore


def test_a_sensor_error_is_named_and_smaller_amplitudes_are_free_of_it() -> None:
    x = np.asarray(decay(TIME, VISCOUS, RELEASE, 0.0, 30).x_rel)
    noise = 1e-5 * np.random.default_rng(2).standard_normal(len(x))
    (clear,) = positions(x + noise)
    assert clear.level == "ok"
    faulty = sensor_error(x, 2e-5) + noise
    (found,) = positions(faulty)
    assert (found.code, found.level, found.experiment) == ("decays.position", "fail", "decay")
    assert found.facts["low"] < -0.25 * RELEASE
    # The remedy, followed until the rod no longer gets there.
    starts = []
    while found.level == "fail":
        starts.append(found.facts["start"])
        assert f'add start = {{ value = {starts[-1]:.10g}, unit = "s" }}' in text(found)
        (found,) = positions(faulty, int(np.searchsorted(TIME, starts[-1])))
    assert 1 <= len(starts) <= 2
    # Too few swings are left.
    (short,) = positions(sensor_error(x, 2e-4) + noise, 0, 60)
    assert (short.level, short.facts["start"]) == ("fail", None)
    assert "record again from smaller deflections" in text(short)


def sizes(values: np.ndarray) -> Finding:
    """The finding on the sizes of residuals of a record whose noise a second fit may choose."""
    table = bench.table("free_vibration", [bench.column("time", TIME), bench.column("x_rel", values)], "decay")
    result = cid.fit(bench.rig(table), budget=None)
    (found,) = [f for f in result.findings if f.code == "decays.residuals"]
    return found


@pytest.mark.full
def test_noise_that_follows_the_amplitude_is_no_noise() -> None:
    """Before: an error of the model, fitted as coloured noise, was trusted. Here the rod rubs at random in each stroke."""
    x = np.asarray(decay(TIME, VISCOUS, RELEASE, 0.0, 30).x_rel)
    rng = np.random.default_rng(2)
    coloured = np.convolve(rng.standard_normal(len(x) + 9), np.ones(10) / 3.0, "valid")
    assert sizes(x + 1e-5 * coloured).level == "ok"
    envelope = RELEASE * np.exp(-0.5 * C / bench.M1 * TIME)
    found = sizes(x + 0.01 * envelope * coloured + 2e-6 * rng.standard_normal(len(x)))
    assert (found.level, found.experiment) == ("fail", "decay")
    assert found.facts["ratio"] > 1.3
    assert f"add start = {{ value = {found.facts['start']:.10g}" in text(found)


def test_the_noise_of_a_rod_at_rest_has_no_amplitude() -> None:
    """Before: the amplitude was that of the readings, so it followed the noise that a coarse record at rest consists of."""
    period = 2.0 * np.pi * float(np.sqrt(bench.M1 / bench.K1))
    time = np.arange(3000) * (period / 10.0)
    noise, values = np.random.default_rng(1).standard_normal(len(time)), {**VISCOUS, "c": 6.0, "noise_sd": 1e-5}
    for size, limits in ((1e-5, (0.01, 1.0)), (1e-4 * np.exp(-time / period) + 1e-6, (0.0, 0.001))):
        x = bench.released(time, RELEASE, c=6.0) + size * noise
        table = bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", x)], "decay")
        judged = size_of_residuals(FreeVibration(table, bench.rig(table)), values)
        assert judged is not None
        assert limits[0] <= judged[1] <= limits[1]


def pendulum(release: float) -> np.ndarray:
    """Angle (n,), rad, of a pendulum with some dry friction at ``TIME``; its small swings have the frequency of the bench."""

    def rates(_: float, y: np.ndarray) -> list[float]:
        pull = bench.K1 * np.sin(y[0]) + C * y[1] + 20.0 * np.tanh(y[1] / 0.1)
        return [y[1], -pull / bench.M1]

    found = solve_ivp(rates, (0.0, TIME[-1]), [release, 0.0], t_eval=TIME, rtol=1e-8, atol=1e-8)
    return found.y[0] + 2e-3 * np.random.default_rng(9).standard_normal(len(TIME))


def drift_findings(angle: np.ndarray, damping: tuple[str, ...], cubic: bool) -> list[Finding]:
    """Findings on the drift of a record, fitted with a Gaussian process."""
    time = TIME[: len(angle)]
    table = bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", angle)], "decay")
    own = FreeVibration(table, bench.rig(table))
    model = DecayModel(damping, cubic=cubic, drift="gp")
    found = Screening(own).fit(model)[0]
    again = own.with_model(model, found)
    values = {row.name: found.values.get(row.symbol, found.noise) for row in again.parameters}
    fit = SimpleNamespace(values={"m1": bench.M1, **values})
    return check_drift([again], fit)  # type: ignore[arg-type]  # pyright: ignore


@pytest.mark.full
def test_a_drift_that_swings_with_the_rod_fails() -> None:
    """A pendulum at large angles is no cubic spring. Its twin at small angles, and true drifts, pass."""
    (large,) = drift_findings(pendulum(2.4), ("dry",), True)
    assert (large.code, large.level) == ("decays.drift", "fail")
    assert [found.level for found in drift_findings(pendulum(0.4), ("dry",), True)] == ["ok"]
    for seed in (101, 106):
        assert [found.level for found in drift_findings(twin("drift", seed), (), False)] == ["ok"]
    # The remedy: a start from which the amplitudes are smaller.
    begin = int(np.searchsorted(TIME, large.facts["start"]))
    assert f"start = {{ value = {large.facts['start']:.10g}" in text(large)
    (mended,) = drift_findings(pendulum(2.4)[begin:], ("dry",), True)
    assert mended.level == "ok"


@pytest.mark.full
@pytest.mark.parametrize(("half_cycles", "levels"), [(3.5, []), (5.5, []), (6.5, ["ok"])])
def test_a_drift_is_tested_over_one_period_or_more(half_cycles: float, levels: list[str]) -> None:
    """The filter reads one period to each side, so a record of fewer than six half cycles gives no finding."""
    samples = round(half_cycles * np.pi * np.sqrt(bench.M1 / bench.K1) / TIME[1])
    assert [found.level for found in drift_findings(twin("drift", 101)[:samples], (), False)] == levels


def test_the_rms_at_the_frequency_of_the_motion() -> None:
    """The gain is 1 for a sine of that frequency, 0 for a straight line and 0.52 for white noise."""
    half, time = 0.05, np.arange(40_000) / 2000.0
    sine = 3.0 * np.sin(np.pi * time / half)
    assert fast_rms(time, sine, half) == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-3)
    assert fast_rms(time, 2.0 + 5.0 * time, half) == pytest.approx(0.0, abs=1e-9)
    noise = np.random.default_rng(4).standard_normal(time.size)
    assert fast_rms(time, noise, half) == pytest.approx(np.sqrt(4.375) / 4.0, rel=0.03)


@pytest.mark.parametrize(("samples", "levels"), [(5, []), (9, []), (13, ["ok"])])
def test_a_few_readings_of_a_rod_that_has_not_turned(samples: int, levels: list[str]) -> None:
    """Too few for an interval of position are not tested; readings of one direction do not end in a failure."""
    x = np.asarray(decay(TIME, VISCOUS, RELEASE, 0.0, 30).x_rel)
    assert samples * TIME[1] < np.pi * np.sqrt(bench.M1 / bench.K1)
    noisy = x + 1e-5 * np.random.default_rng(3).standard_normal(len(x))
    assert [found.level for found in positions(noisy, last=samples)] == levels


def test_positions_of_true_models_have_uniform_p_values() -> None:
    x = np.asarray(decay(TIME, VISCOUS, RELEASE, 0.0, 30).x_rel)
    rng = np.random.default_rng(6)
    p = [positions(x + 1e-5 * rng.standard_normal(len(x)))[0].facts["p"] for _ in range(60)]
    assert stats.kstest(p, "uniform").pvalue > 0.01


@pytest.mark.parametrize(
    "model",
    [DecayModel(drift="gp"), DecayModel(noise="ar1"), DecayModel(drift="gp", noise="arma")],
    ids=lambda m: m.name,
)
def test_values_of_a_screening_are_those_of_the_record_it_starts(model: DecayModel) -> None:
    """The record's own whitening at these values gives the deviance of the screening."""
    x = np.asarray(decay(TIME, VISCOUS, RELEASE, 0.0, 30).x_rel)
    drift = 1e-4 * np.sin(8.0 * TIME) + 1e-5 * np.random.default_rng(7).standard_normal(len(x))
    columns = [bench.column("time", TIME), bench.column("x_rel", x + drift)]
    table = bench.table("free_vibration", columns, "decay")
    own = FreeVibration(table, bench.rig(table))
    found = Screening(own).fit(model)[0]
    again = own.with_model(model, found)
    raw, design = again.unwhitened(found.values, np)
    white, basis = (again.whitened(found.values, columns) for columns in (raw, design))
    left = white - basis @ np.linalg.lstsq(basis, white, rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) == pytest.approx(found.noise, rel=2e-3)
    if model.drift == "gp":
        assert again.starts()["drift_ratio[decay]"].centre == found.values["drift_ratio"]
