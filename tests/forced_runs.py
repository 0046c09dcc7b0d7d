"""The twin's forced runs in memory: tables, experiments, true values, and the channels without noise."""

from dataclasses import replace
from functools import cache

import numpy as np

from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.forced_run.twin import RUNS, SyntheticRun, make_runs
from capsule_id.experiments.kind import default_registry
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate
from capsule_id.rig.model import Quantity, Table
from capsule_id.synthetic import Truth
from tests.experiments import bench

SAMPLES = 120
#: Samples of the records that these runs are the beginnings of.
RECORDED = 2000
NOISE = {"noise_x_rel": 1.1e-5, "noise_x_capsule": 5.2e-6, "noise_acceleration_rod": 0.9, "noise_current": 4.8e-3}
TRUTH = Truth().with_kinds([default_registry()["forced_run"]])


@cache
def recorded() -> tuple[SyntheticRun, ...]:
    """The twin's four runs at 1 kHz; at seed 0 the first starts with the capsule moving, the others with it stuck."""
    return tuple(make_runs(TRUTH, 0, tuple(replace(run, samples=RECORDED, step=1e-3) for run in RUNS)))


def table(number: int = 0, samples: int = SAMPLES, without: tuple[str, ...] = (), **settings: object) -> Table:
    run = recorded()[number]
    columns = [bench.column("time", run.time[:samples])]
    columns += [bench.column(name, run.channels[name][:samples]) for name in run.channels if name not in without]
    given = {"spring": run.truth.spring, "gap": Quantity(run.stated_gap, 2e-5), "Omega": run.truth.Omega}
    return bench.table("forced_run", columns, f"run_{number + 1}", **given, **settings)


def make(number: int = 0, **options: object) -> ForcedRun:
    own = table(number, **options)  # type: ignore[arg-type]
    return ForcedRun(own, bench.rig(own))


def theta(number: int = 0) -> dict[str, float]:
    """The truth as one experiment sees it, with noise near the recorded one."""
    truth = recorded()[number].truth
    shared = {name: TRUTH[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s", "g", "K")}
    drive = {"G": truth.G, "I_d": truth.current_amplitude, "P_d": truth.P_d, "phase": truth.phase}
    start = {"x_start": truth.x_rel, "y_start": truth.Y1 - truth.Y2, "capsule_start": truth.Y2}
    return {**shared, **drive, **start, **NOISE, "k2": TRUTH[f"k2[{truth.spring}]"]}


def channels(number: int, samples: int = SAMPLES) -> list[np.ndarray]:
    """Noise-free x_rel, x_capsule, acceleration, current, from one call of the model and Newton's second law."""
    truth, values = recorded()[number].truth, theta(number)
    time = recorded()[number].time[:samples]
    p = CapsuleParameters(*(values[name] for name in ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "G", "g")))
    t = simulate(p, Excitation(truth.P_d, truth.Omega, truth.phase), time, (truth.x_rel, truth.Y1, 0.0, truth.Y2))
    x_rel, rate = np.asarray(t.X1 - t.X2), np.asarray(t.Y1 - t.Y2)
    force = values["k1"] * x_rel + values["c"] * rate + values["k2"] * np.clip(x_rel - truth.G, 0.0, None)
    cosine = np.cos(truth.Omega * time + truth.phase)
    acceleration = (truth.P_d * cosine - force) / values["m1"]
    return [x_rel, np.asarray(t.X2), acceleration, truth.current_amplitude * cosine]
