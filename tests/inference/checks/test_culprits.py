"""A bench test at fault is named by the comparison with a forced run; its remedy removes the disagreement.

Bench tests and run are fitted apart by least squares, with their own likelihoods; ``disagreement`` compares them, with
the normal tails of a sample of the bench. Without a sample 120 samples of a run only warn of the clock.
"""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference.checks.posterior import agreement, disagreement
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.report.messages import FIT_MESSAGES, finding_text
from capsule_id.rig.model import Table
from capsule_id.views import Finding
from tests import forced_runs
from tests.experiments import bench
from tests.inference.stub import plain_residuals

TRUTH = forced_runs.TRUTH
RUN = 0


def decay(clock: float = 1.0) -> Table:
    """A decay of 1.5 mm whose clock runs fast by the factor ``clock``."""
    time = np.arange(400) / 1000.0
    x_rel = bench.released(time, 1.5e-3, TRUTH["k1"], TRUTH["c"], TRUTH["m1"])
    noise = 1e-5 * np.random.default_rng(1).standard_normal(len(time))
    words = {"damping": "viscous", "stiffness": "linear", "noise": "white", "drift": "none"}
    return bench.table(
        "free_vibration", [bench.column("time", clock * time), bench.column("x_rel", x_rel + noise)], **words
    )


def motor(gain: float = 1.0) -> Table:
    """Force and current; the amplifier of the current shows ``gain`` times the current."""
    force = np.linspace(0.5, 5.0, 10)
    current = gain * force / TRUTH["K"] + 5e-3 * np.random.default_rng(2).standard_normal(10)
    columns = [bench.column("force", force, 0.01), bench.column("current", current, 5e-3)]
    return bench.table("motor_current", columns)


def spring(k2: float) -> Table:
    """Deflections of the spring that the run names."""
    deflection = np.linspace(0.2e-3, 2e-3, 10)
    force = k2 * deflection * (1.0 + 5e-3 * np.random.default_rng(3).standard_normal(10))
    name = forced_runs.recorded()[RUN].truth.spring
    columns = [bench.column("deflection", deflection, 1e-6), bench.column("force", force, 0.05)]
    return bench.table("support_spring", columns, spring=name)


def own(name: str = "medium") -> float:
    return TRUTH[f"k2[{name}]"]


def estimate(target: LogPosterior) -> tuple[np.ndarray, np.ndarray]:
    """Located entries of u at the maximum near the truth, and their covariance."""
    values = {
        **{name: start.centre for name, start in target.starts().items()},
        **TRUTH,
        **named(forced_runs.theta(RUN)),
    }
    u = target.unconstrain(np.array([values[name] for name in target.names]))

    def residuals(v: np.ndarray) -> np.ndarray:
        moved = u.copy()
        moved[target.located] = v
        return plain_residuals(target, moved)

    found = least_squares(residuals, u[target.located], x_scale="jac", diff_step=1e-6, max_nfev=20)
    return found.x, np.linalg.inv(found.jac.T @ found.jac)


def named(values: dict[str, float]) -> dict[str, float]:
    return {f"{symbol}[run_{RUN + 1}]": value for symbol, value in values.items()}


def experiments(table: Table) -> list[Experiment]:
    return list(make_experiments(bench.rig(table), "all", default_registry()))


def comparison(table: Table) -> Finding:
    """The finding for one bench test and one forced run."""
    run, test = forced_runs.table(RUN), experiments(table)
    runs = LogPosterior(bench.rig(run), experiments(run))
    alone = LogPosterior(bench.rig(table), test)
    (u, covariance), (v, other) = estimate(runs), estimate(alone)
    names = tuple(alone.names[i] for i in alone.located)
    none = np.zeros(0)
    fit = PointFit(names, v, {}, other, {}, none, none, none, none, none)
    sds = np.sqrt(np.diag(covariance))
    found = {runs.names[i]: (u[k], sds[k]) for k, i in enumerate(runs.located)}
    shared = [name for name in names if name in found]
    return agreement(disagreement(shared, found, fit, None), True, {name: [table.label] for name in shared})


@pytest.mark.parametrize(
    ("make", "wrong", "right", "name"),
    [
        pytest.param(decay, 1.02, 1.0, "k1", marks=pytest.mark.full),
        (motor, 1.1, 1.0, "K"),
        pytest.param(spring, TRUTH["k2[stiff]"], own(), "k2[medium]", marks=pytest.mark.full),
    ],
    ids=["clock 2 % fast", "gain of the current 10 % off", "springs swapped"],
)
def test_the_bench_test_at_fault_is_named(
    make: Callable[[float], Table], wrong: float, right: float, name: str
) -> None:
    table = make(wrong)
    found = comparison(table)
    assert found.level == "fail"
    text = finding_text(found, FIT_MESSAGES)
    assert f"largest disagreement in {name} " in text
    assert f"Check units, clock and calibration of {table.label} and repeat it" in text
    # Its remedy: the test repeated with the right clock, gain or spring.
    assert comparison(make(right)).level == "ok"
