"""Experiments on a slope, with a pressing force: independent solutions, recovery of mu, starts at equilibrium."""

from dataclasses import replace
from typing import Any, cast

import jax
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import root_scalar

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.capsule_experiment import CapsuleDecay
from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.physics.drives import Pulses
from capsule_id.physics.forces import equilibrium
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate
from capsule_id.rig.model import Quantity, Table
from tests.capsule_cases import jit_quickly
from tests.experiments import bench

SLOPE, N0 = np.deg2rad(6.0), 1.5
MASS, WEIGHT = bench.M1 + bench.M2, (bench.M1 + bench.M2) * bench.G
NORMAL = WEIGHT * np.cos(SLOPE) + N0
MU, V_S = 0.45, 0.3
GROUND = {"slope": SLOPE, "N0": N0}
STATED = {name: Quantity(value) for name, value in GROUND.items()}
THETA = {
    "m1": bench.M1, "m2": bench.M2, "g": bench.G, "k1": bench.K1, "c": bench.C, "mu": MU, "v_s": V_S,
    "pull_scatter": 0.02, "push_scatter": 0.02, "sliding_scatter": 0.02,
}  # fmt: skip
CAPSULE = {name: THETA[name] for name in ("m1", "m2", "g", "k1", "c", "mu", "v_s")}


def slid(speed: float, sign: float, mu: float = MU) -> float:
    """Distance of a locked slide, by quadrature of the paper's law and the weight along the slope."""

    def per_speed(v: float) -> float:
        friction = 0.5 * mu * (1.0 + np.exp(-v / V_S)) * NORMAL
        return MASS * v / (friction + sign * WEIGHT * np.sin(SLOPE))

    return quad(per_speed, 0.0, speed)[0]


def readings(direction: str, rng: np.random.Generator, **ground: Quantity) -> list[Table]:
    """Pulls, pushes and steady sliding with a relative scatter of mu of 2 %."""
    sign = 1.0 if direction == "forward" else -1.0
    along = sign * WEIGHT * np.sin(SLOPE)
    mu = MU * (1.0 + 0.02 * rng.standard_normal((3, 8)))
    speed = np.linspace(0.2, 1.0, 8)
    distance = [slid(v, sign, m) for v, m in zip(speed, mu[1], strict=True)]
    steady = 0.5 * mu[2] * (1.0 + np.exp(-speed / V_S)) * NORMAL + along
    settings = {"direction": direction, **ground}
    return [
        bench.table("static_friction", [bench.column("force", mu[0] * NORMAL + along)], **settings),
        bench.table("dynamic_friction", [bench.column("speed", speed), bench.column("distance", distance)], **settings),
        bench.table("sliding_friction", [bench.column("speed", speed), bench.column("force", steady)], **settings),
    ]


def posterior_of_mu(experiment: Experiment) -> tuple[float, float]:
    """Mean and sd of mu, all other values known, on a grid."""
    grid = np.linspace(0.1, 1.2, 1101)
    value = np.asarray(jit_quickly(jax.vmap(lambda mu: experiment.log_likelihood({**THETA, "mu": mu})))(grid))
    weight = np.exp(value - value.max())
    mean = float(np.average(grid, weights=weight))
    return mean, float(np.sqrt(np.average((grid - mean) ** 2, weights=weight)))


@pytest.mark.parametrize("direction", ["forward", "backward"])
@pytest.mark.parametrize("kind", [0, 1, 2])
def test_mu_is_recovered_on_a_slope_and_not_without_it(direction: str, kind: int) -> None:
    (experiment,) = make_experiments(bench.rig(readings(direction, np.random.default_rng(3), **STATED)[kind]))
    mean, sd = posterior_of_mu(experiment)
    assert abs(mean - MU) < 3.0 * sd
    # Negative control: the same readings, taken as on level ground.
    (level,) = make_experiments(bench.rig(readings(direction, np.random.default_rng(3), N0=Quantity(N0))[kind]))
    mean, sd = posterior_of_mu(level)
    assert abs(mean - MU) > 4.0 * sd


def test_points_of_the_paper_show_mu_without_the_weight_along_the_slope() -> None:
    pulls, pushes, sliding = make_experiments(bench.rig(*readings("backward", np.random.default_rng(3), **STATED)))
    kinetic = 0.5 * MU * (1.0 + np.exp(-np.linspace(0.2, 1.0, 8) / V_S))
    assert np.allclose(pulls.paper_points()[1], MU, rtol=0.06)  # pyright: ignore[reportAttributeAccessIssue]
    assert np.allclose(sliding.paper_points()[1], kinetic, rtol=0.06)  # pyright: ignore[reportAttributeAccessIssue]
    assert np.all(pushes.paper_points()[1] > 0.93 * kinetic)  # pyright: ignore[reportAttributeAccessIssue]
    assert np.all(pushes.paper_points()[1] < 1.07 * MU)  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("k_cubic", [pytest.param(0.0, marks=pytest.mark.full), 4e8])
def test_the_equilibrium_balances_the_weight(k_cubic: float) -> None:
    p = CapsuleParameters(**CAPSULE, k2=0.0, G=np.inf, slope=0.3, k_cubic=k_cubic)
    load = bench.M1 * bench.G * np.sin(0.3)
    balance = root_scalar(lambda r: bench.K1 * r + k_cubic * r**3 + load, bracket=(-1e-3, 0.0), xtol=1e-15)
    expected = balance.root
    assert equilibrium(p) == pytest.approx(expected, rel=1e-10)
    still = simulate(replace(p, mu=5.0), Excitation(0.0, 1.0), np.linspace(0.0, 0.5, 5), (expected, 0.0, 0.0, 0.0))
    assert np.allclose(still.x_rel, expected, atol=1e-12)


@pytest.mark.full
def test_a_progression_on_a_slope_starts_at_equilibrium() -> None:
    columns = {"period": [0.06, 0.08], "duty": [0.3, 0.3], "periods": [4.0, 3.0], "distance": [1e-3, 2e-3]}
    table = bench.table(
        "progression",
        [bench.column(name, values) for name, values in columns.items()],
        drive="pulses", P_on=Quantity(6.0), slope=Quantity(SLOPE), N0=Quantity(N0),
    )  # fmt: skip
    (only,) = make_experiments(bench.rig(table))
    e = cast(Progression, only)
    X2 = np.asarray(e.displacements(THETA, np.zeros(2), e.settings))
    p = CapsuleParameters(**CAPSULE, k2=0.0, G=np.inf, **GROUND)
    r0 = -bench.M1 * bench.G * np.sin(SLOPE) / bench.K1

    def plain(row: np.ndarray, start: float, capsule: CapsuleParameters) -> float:
        times = np.array([0.0, row[0] * row[1]])
        return float(simulate(capsule, Pulses(6.0, row[0], row[2]), times, (start, 0.0, 0.0, 0.0)).X2[-1])

    assert np.allclose(X2, [plain(row, r0, p) for row in e.settings], atol=1e-8)
    # Negative control: neither the unstretched start nor level ground gives these displacements.
    assert not np.allclose(X2, [plain(row, 0.0, p) for row in e.settings], atol=1e-7)
    assert not np.allclose(X2, [plain(row, r0, replace(p, slope=0.0)) for row in e.settings], atol=1e-5)


def run_table(**settings: Any) -> Table:
    time = np.linspace(0.0, 0.4, 200)
    x = 1e-3 * np.cos(35.0 * time)
    return bench.table(
        "forced_run",
        [bench.column("time", time), bench.column("x_rel", x), bench.column("x_capsule", 0.3 * x)],
        Omega=35.0, P_d=Quantity(4.0), **settings,
    )  # fmt: skip


def test_a_forced_run_on_a_slope_is_that_of_simulate() -> None:
    (only,) = make_experiments(bench.rig(run_table(**STATED, start="stuck")))
    run = cast(ForcedRun, only)
    theta = {**THETA, "phase": 0.4, "x_start": 2e-4, "y_start": 0.05}
    p = CapsuleParameters(**CAPSULE, k2=0.0, G=np.inf, **GROUND)
    drive = Excitation(4.0, 35.0, 0.4)
    expected = simulate(p, drive, run.time, (2e-4, 0.05, 0.0, 0.0))
    motion = run.motion(theta)
    assert np.allclose(motion.X2, expected.X2, atol=1e-12)
    assert np.allclose(motion.x_rel, expected.x_rel, atol=1e-12)
    # Negative control: the capsule moves elsewhere downhill.
    other = simulate(replace(p, slope=-p.slope), drive, run.time, (2e-4, 0.05, 0.0, 0.0))
    assert np.max(np.abs(other.X2 - expected.X2)) > 1e-4


@pytest.mark.full
def test_a_free_decay_on_a_slope_is_that_of_simulate() -> None:
    time = np.linspace(0.0, 0.3, 300)
    columns = [bench.column("time", time), bench.column("x_rel", bench.released(time, 5e-3))]
    table = bench.table(
        "free_vibration", columns, capsule="free", forward="capsule", slope=Quantity(SLOPE), N0=Quantity(N0)
    )
    e = cast(CapsuleDecay, make_experiments(bench.rig(table))[0])
    p = CapsuleParameters(**CAPSULE, k2=0.0, G=1e3, **GROUND)
    expected = simulate(p, Excitation(0.0, 1.0), e.time, (5e-3, 0.0, 0.0, 0.0))
    found = e.values - np.asarray(e.unwhitened({**THETA, "x_start": 5e-3, "y_start": 0.0}, np)[0])
    assert np.allclose(found, expected.x_rel, atol=1e-12)
    assert not np.allclose(
        found, simulate(replace(p, slope=0.0), Excitation(0.0, 1.0), e.time, (5e-3, 0.0, 0.0, 0.0)).x_rel, atol=1e-6
    )
