"""The drift of a clock with an sd: a parameter that stretches the record, against re-timed records and twins."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import NO_DRIFT, Quantity, Table
from tests.experiments import bench
from tests.experiments.test_slope import CAPSULE, THETA

TRUE, SD = 3e-3, 4e-3
#: Values of the nuisances of a run; the drive's phase is meant at the middle of the record.
RUN = {**THETA, "phase": 0.4, "x_start": 2e-4, "y_start": 0.05, "noise_x_rel": 1e-5, "noise_x_capsule": 1e-5, "K": 2.0}
TIME = np.linspace(0.0, 0.6, 400)


def decay_table(time: np.ndarray, noise: float = 0.0, **settings: Any) -> Table:
    x = bench.released(time, 5e-3) + noise * np.random.default_rng(0).standard_normal(len(time))
    return bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", x)], **settings)


def turning_table(time: np.ndarray) -> Table:
    del time
    turning = np.pi / np.sqrt(bench.K1 / bench.M1 - (bench.C / 2.0 / bench.M1) ** 2) * np.arange(12.0)
    columns = [bench.column("time", turning), bench.column("x_rel", bench.released(turning, 5e-3))]
    return bench.table("free_vibration", columns, samples="turning_points")


def run_table(time: np.ndarray, **settings: Any) -> Table:
    x = 1e-3 * np.cos(35.0 * time)
    channels = {"time": time, "x_rel": x, "x_capsule": 0.3 * x}
    if settings.get("drive") == "recorded":
        channels["current"] = 2.0 * np.cos(35.0 * time)
    if settings.get("drive") == "base":
        channels["x_base"] = 2e-3 * np.sin(35.0 * time)
    else:
        settings = {"P_d": None if "current" in channels else Quantity(4.0), **settings}
    columns = [bench.column(name, values) for name, values in channels.items()]
    return bench.table("forced_run", columns, Omega=35.0, start="stuck", **settings)


CASES = {
    "decay": decay_table,
    "decay with a cubic spring": lambda time: decay_table(time, stiffness="cubic", damping=("viscous", "dry")),
    "decay of a free capsule": lambda time: decay_table(time, capsule="free", forward="capsule"),
    "turning points": turning_table,
    "run": run_table,
    "run with a recorded drive": lambda time: run_table(time, drive="recorded"),
    "run of a shaken base": lambda time: run_table(time, drive="base"),
}  # fmt: skip
#: One of each way to read the times.
CORE = ("decay", "turning points", "run")


def restated(table: Table, drift: Quantity) -> Table:
    """The table as read with another clock, about the middle of its record."""
    time = table.columns["time"]
    middle = 0.5 * (time.values[0] + time.values[-1]) if table.kind == "forced_run" else time.values[0]
    values = middle + (1.0 + drift.value) * (time.values - middle)
    return replace(table, columns={**table.columns, "time": replace(time, values=values)}, drift=drift)


def only(table: Table) -> Experiment:
    (experiment,) = make_experiments(bench.rig(table))
    return experiment


def theta_of(e: Experiment) -> dict[str, float]:
    """Values of every parameter near the record, by symbol."""
    starts = {name.split("[")[0]: start.centre for name, start in e.starts().items()}
    return {
        **starts,
        **{name: value for name, value in RUN.items() if name in starts or name in CAPSULE or e.time_series},
    }


@pytest.mark.parametrize(
    "name", [*CORE, *(pytest.param(one, marks=pytest.mark.full) for one in CASES if one not in CORE)]
)
def test_the_drift_stretches_the_record(name: str) -> None:
    """The likelihood at a drift is that of the record whose times were read with this drift, stated as exact."""
    table = CASES[name](TIME)
    loose, exact = only(restated(table, Quantity(0.5 * TRUE, SD))), only(restated(table, Quantity(TRUE)))
    theta = theta_of(exact)
    # The noise of the times of turning points is that of the times as read.
    scaled = {"time_sd": theta["time_sd"] * (1.0 + TRUE) / (1.0 + 0.5 * TRUE)} if "time_sd" in theta else {}
    value = float(exact.log_likelihood({**theta, **scaled}))
    tolerance = 2e-4 if scaled else 1e-6
    assert float(loose.log_likelihood({**theta, "clock_drift": TRUE})) == pytest.approx(value, rel=tolerance)
    # Negative control: without the drift the likelihood is another one.
    assert float(loose.log_likelihood({**theta, "clock_drift": 0.0})) != pytest.approx(value, rel=tolerance)


def decay_fit(*drifts: Quantity) -> PointFit:
    """Point fit of a decay for each clock."""
    tables = [replace(decay_table(TIME, 2e-5), label=f"d{i}", drift=drift) for i, drift in enumerate(drifts)]
    rig = bench.rig(*tables)
    return point_fit(LogPosterior(rig, make_experiments(rig)), 0, 1)


@pytest.mark.full
def test_k1_follows_the_clock_twice_and_c_once() -> None:
    """k1 = m1 (omega^2 + gamma^2), c = 2 m1 gamma: relative sds of 2 and 1 times that of the clock are added."""
    exact, loose = decay_fit(NO_DRIFT), decay_fit(Quantity(0.0, SD))
    for name, times in (("k1", 2.0), ("c", 1.0)):
        expected = np.hypot(exact.standard_errors[name], times * SD * exact.values[name])
        assert loose.standard_errors[name] == pytest.approx(expected, rel=0.02)
    assert loose.standard_errors["k1"] > 5.0 * exact.standard_errors["k1"]
    assert loose.standard_errors["clock_drift[d0]"] == pytest.approx(SD, rel=0.01)


@pytest.mark.full
def test_models_of_a_record_with_a_clock_are_screened() -> None:
    noisy = replace(decay_table(np.arange(2000) / 2000.0, 2e-5), drift=Quantity(0.0, SD))
    record = only(noisy)
    (kept,), findings = type(record).second_models([record])
    assert kept is record, findings
    assert "clock_drift[free_vibration]" in {row.name for row in kept.parameters}


@pytest.mark.full
def test_records_of_one_clock_do_not_average_its_error() -> None:
    one, same, two = decay_fit(Quantity(0.0, SD)), decay_fit(*[Quantity(0.0, SD)] * 2), decay_fit(
        Quantity(0.0, SD), Quantity(1e-9, SD)
    )  # fmt: skip
    assert [name for name in same.names if "clock" in name] == ["clock_drift[d0]"]
    assert same.standard_errors["k1"] == pytest.approx(one.standard_errors["k1"], rel=0.02)
    # Negative control: two clocks do.
    assert [name for name in two.names if "clock" in name] == ["clock_drift[d0]", "clock_drift[d1]"]
    assert two.standard_errors["k1"] == pytest.approx(one.standard_errors["k1"] / np.sqrt(2.0), rel=0.02)


@pytest.mark.full
def test_the_drive_of_a_long_run_gives_the_drift() -> None:
    """Twenty twins of 60 s: least squares over drift, phase and initial state, all other values known."""
    time, noise, drift = np.arange(6000) / 100.0, 20e-6, 20e-6
    channels = [bench.column("time", time), bench.column("x_rel", 1e-3 * np.sin(time))]
    drive = {"Omega": 34.56, "P_d": Quantity(4.0), "start": "stuck", "spring": "hard", "gap": Quantity(1e-3)}
    run = cast(ForcedRun, only(replace(bench.table("forced_run", channels, **drive), drift=Quantity(0.0, 1e-3))))
    truth = {**THETA, "mu": 0.66, "k2": 18960.0, "phase": 0.4, "x_start": 0.0, "y_start": 0.0, "clock_drift": drift}
    steps = {"clock_drift": 1e-7, "phase": 1e-5, "x_start": 1e-7, "y_start": 1e-6}

    def seen(**values: float) -> np.ndarray:
        return np.asarray(run.predict({**truth, **values}, np)[0])

    columns = [(seen(**{n: truth[n] + h}) - seen(**{n: truth[n] - h})) / (2.0 * h) for n, h in steps.items()]
    design = np.stack([*columns, np.ones(len(time))], axis=1)
    sd = noise * float(np.sqrt(np.linalg.inv(design.T @ design)[0, 0]))
    errors = noise * np.random.default_rng(0).standard_normal((len(time), 20))
    z = np.linalg.lstsq(design, errors, rcond=None)[0][0] / sd
    assert sd < 5e-6
    assert np.sum(np.abs(z) <= 3.0) >= 19
    # Negative control: the clock taken as exact leaves much more than the noise, whatever the phase.
    left = seen() - seen(clock_drift=0.0)
    left = left - design[:, 1:] @ np.linalg.lstsq(design[:, 1:], left, rcond=None)[0]
    assert np.sum((left / noise) ** 2) > 100.0
