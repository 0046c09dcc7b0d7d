"""Synthetic forced runs with known truth: samples of the exact model after its transient, with sensor errors."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.forced_run.declaration import RUN_SPRINGS, SETTLING_PERIODS
from capsule_id.experiments.kind import Twin, TwinTable, Values
from capsule_id.parameters import FIG_6, QUANTILE_975
from capsule_id.physics.model import CapsuleParameters, Excitation, Status, rod_acceleration, status_message
from capsule_id.physics.simulation import simulate


@dataclass(frozen=True)
class RunSetup:
    """Settings of one run, SI: the spring by name, the drive, the gap, and the sampling."""

    spring: str
    Omega: float
    P_d: float
    G: float
    samples: int
    step: float = 0.35e-3


#: Run of the paper's Fig. 10, and all of the synthetic rig: one near its Fig. 6, one of its Fig. 11, two of its Fig. 10.
#: The shortest contact has 11 samples, and 8 excitation periods follow the transient.
HARD = RunSetup("hard", 26.58, 2.5, 1.5e-3, 6100)
RUNS = (
    RunSetup("medium", **FIG_6, samples=2850, step=0.6e-3),
    RunSetup("stiff", 73.58, 1.2, 1.0e-3, 2650),
    HARD,
    replace(HARD, Omega=46.0, samples=3800),
)
#: Factor of the prior of springs without a static test, dimensionless.
SPRING_FACTOR = 1.5
#: Noise level of each channel, SI (m, m, m/s^2, A).
NOISE_SD = {"x_rel": 10e-6, "x_capsule": 5e-6, "acceleration_rod": 1.0, "current": 5e-3}
#: Standard deviation of the channels' zero errors, SI. x_capsule has none, because it is zero at the first sample.
OFFSET_SD = {"x_rel": 20e-6, "acceleration_rod": 0.5, "current": 20e-3}
#: Standard deviation of the measured gap, m.
GAP_SD = 0.02e-3


@dataclass(frozen=True)
class SyntheticRun:
    """A measured run: ``time`` and ``channels`` (n,) SI, the measured gap, and the truth.

    ``truth`` has the true values, SI: spring, G, P_d, Omega, phase, current_amplitude, offsets and noise_sd by channel,
    and x_rel, Y1, Y2, the state at the first sample, where X2 = 0.
    """

    time: np.ndarray
    channels: dict[str, np.ndarray]
    stated_gap: float
    truth: SimpleNamespace

    def table(self) -> dict[str, np.ndarray]:
        """Columns of the file, in the order and units of its header, rounded to digits above the noise."""
        return {
            "time [s]": self.time,
            "x_rel [mm]": np.round(1e3 * self.channels["x_rel"], 5),
            "x_capsule [mm]": np.round(1e3 * self.channels["x_capsule"], 5),
            "acceleration_rod [m/s^2]": np.round(self.channels["acceleration_rod"], 3),
            "current [A]": np.round(self.channels["current"], 5),
        }

    def settings(self) -> tuple[str, ...]:
        """Lines of its entry in ``rig.toml``."""
        gap = f'gap = {{ value = {1e3 * self.stated_gap:.3f}, sd = {1e3 * GAP_SD:g}, unit = "mm" }}'
        return f'spring = "{self.truth.spring}"', gap, f'Omega = {{ value = {self.truth.Omega:g}, unit = "rad/s" }}'


def measure(values: Values, seed: int) -> Twin:
    """Simulate the runs, with priors of springs without a static test and the truth of every run by label.

    Raises
    ------
    InputError
        If the model cannot complete a run with these values.
    """
    runs = {f"run_{number}": run for number, run in enumerate(make_runs(values, seed), start=1)}
    tables = tuple(TwinTable(f"{label}.csv", run.table(), run.settings()) for label, run in runs.items())
    return Twin(tables, spring_priors(values, seed), {label: vars(run.truth) for label, run in runs.items()})


def make_runs(parameters: Mapping[str, float], seed: int, runs: tuple[RunSetup, ...] = RUNS) -> list[SyntheticRun]:
    """Simulate and measure every run; each has its own random generator, independent of the bench tests.

    Parameters
    ----------
    parameters : true values by name, SI: m1 m2 k1 c mu v_s g K, and k2[spring] of every spring of the runs
    seed : seed of the rig
    runs : settings; the current is set so that K times its amplitude is P_d

    Raises
    ------
    InputError
        If the model cannot complete a run with these parameters.
    """
    generators = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(len(runs))]
    # A record starts at a random phase of its settled motion.
    cuts = np.array([SETTLING_PERIODS + rng.uniform() for rng in generators])
    T = np.array([2.0 * np.pi / run.Omega for run in runs])
    time = np.arange(max(run.samples for run in runs)) * np.array([[run.step] for run in runs])
    start = (cuts * T)[:, None]
    k2 = np.array([parameters[f"k2[{run.spring}]"] for run in runs])
    p = _capsule(parameters, k2, np.array([run.G for run in runs]))
    e = Excitation(np.array([run.P_d for run in runs]), np.array([run.Omega for run in runs]))
    t = simulate(p, e, np.concatenate([np.zeros_like(start), start + time], axis=1))
    if not all(Status(int(code)).usable for code in np.asarray(t.status)):
        raise InputError("every run must be complete", "a run was given up", status_message(t.status))
    states = np.stack([np.asarray(x)[:, 1:] for x in (t.X1, t.Y1, t.X2, t.Y2)], axis=1)
    return [
        _measure(rng, parameters, run, at[: run.samples], state[:, : run.samples], 2.0 * np.pi * (cut % 1.0))
        for rng, run, at, state, cut in zip(generators, runs, time, states, cuts, strict=True)
    ]


def _capsule(parameters: Mapping[str, float], k2: float | np.ndarray, G: float | np.ndarray) -> CapsuleParameters:
    shared: dict[str, Any] = {name: parameters[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s", "g")}
    return CapsuleParameters(**shared, k2=k2, G=G)


def _measure(
    rng: np.random.Generator,
    parameters: Mapping[str, float],
    run: RunSetup,
    time: np.ndarray,
    state: np.ndarray,
    phase: float,
) -> SyntheticRun:
    """Apply the sensors to one run; state (4, n) is the exact motion from the first sample on."""
    X1, Y1, X2, Y2 = state
    x_rel, e = X1 - X2, Excitation(run.P_d, run.Omega, phase)
    p = _capsule(parameters, parameters[f"k2[{run.spring}]"], run.G)
    amplitude = run.P_d / parameters["K"]
    exact = {
        "x_rel": x_rel,
        "x_capsule": X2 - X2[0],
        "acceleration_rod": rod_acceleration(p, e, time, x_rel, Y1 - Y2),
        "current": amplitude * e.cosine(time),
    }
    offsets = {name: float(sd * rng.standard_normal()) for name, sd in OFFSET_SD.items()}
    stated_gap = run.G + GAP_SD * float(rng.standard_normal())
    channels = {
        name: values + offsets.get(name, 0.0) + NOISE_SD[name] * rng.standard_normal(len(time))
        for name, values in exact.items()
    }
    truth = SimpleNamespace(
        spring=run.spring,
        G=run.G,
        P_d=run.P_d,
        Omega=run.Omega,
        phase=phase,
        current_amplitude=amplitude,
        x_rel=float(x_rel[0]),
        Y1=float(Y1[0]),
        Y2=float(Y2[0]),
        offsets=offsets,
        noise_sd=dict(NOISE_SD),
    )
    return SyntheticRun(time, channels, stated_gap, truth)


def spring_priors(parameters: Mapping[str, float], seed: int) -> tuple[str, ...]:
    """Lines of ``[prior]`` for springs without a static test; medians scatter about the truth by the prior's factor."""
    spread = np.log(SPRING_FACTOR) / QUANTILE_975
    # A key that no run uses makes the priors independent of the number of runs.
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2**20,)))
    scattered = {f"k2[{spring}]": np.exp(spread * rng.standard_normal()) for spring in RUN_SPRINGS}
    return tuple(
        f'"{name}" = {{ median = {1e-3 * parameters[name] * factor:.3g}, factor = {SPRING_FACTOR:g}, unit = "kN/m" }}'
        for name, factor in scattered.items()
    )
