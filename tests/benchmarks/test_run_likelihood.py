"""What a walker costs: the log-posterior of ``data/``, bench and four runs, beside the same coded with SciPy.

    python -m pytest tests/benchmarks/test_run_likelihood.py -m benchmark -s -n 0
    XLA_FLAGS=--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000 python -m pytest ...

The second line sets the option that the command sets for itself; the bar stands for it. SciPy computes one walker
(DOP853 with events, NumPy densities) between two batches of 64.
"""

import os
import time

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.marginal import density_of
from capsule_id.inference.target import LogPosterior
from tests.cli_tools import DATA
from tests.forced_runs import NOISE, TRUTH, recorded
from tests.inference.stub import log_prior
from tests.scipy_capsule import simulate_scipy

pytestmark = pytest.mark.benchmark

WALKERS, ROUNDS = 64, 5
COMMAND_FLAGS = "small_while_loop_byte_threshold" in os.environ.get("XLA_FLAGS", "")
BAR = 300.0


def truth_of(target: LogPosterior) -> np.ndarray:
    """(d,) u at the truth of every parameter; scatters where their experiments would start them."""
    values = {name: start.centre for name, start in target.starts().items()} | TRUTH
    for number, run in enumerate(recorded(), start=1):
        t = run.truth
        own = {"G": t.G, "I_d": t.current_amplitude, "phase": t.phase, "x_start": t.x_rel, "y_start": t.Y1 - t.Y2}
        values |= {f"{symbol}[run_{number}]": x for symbol, x in (own | {"capsule_start": t.Y2} | NOISE).items()}
    return target.unconstrain(np.array([values[name] for name in target.names]))


def density_of_run(run: ForcedRun, theta: ValuesBySymbol) -> float:
    """log-density of one record: DOP853, Newton's second law, normal noise with a normal offset a channel."""
    drive = theta["K"] * theta["I_d"]
    names = ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "g", "G", "phase")
    q = {name: float(theta[name]) for name in names} | {"P_d": float(drive), "Omega": run.Omega}
    Y2 = float(theta.get("capsule_start", 0.0))
    start = np.array([theta["x_start"], theta["y_start"] + Y2, 0.0, Y2])
    states, _ = simulate_scipy(q, run.time, rtol=1e-8, atol=1e-11, start=start)
    x_rel, rate = states[:, 0] - states[:, 2], states[:, 1] - states[:, 3]
    cosine = np.cos(run.Omega * run.time + q["phase"])
    spring = q["k1"] * x_rel + q["c"] * rate + q["k2"] * np.maximum(x_rel - q["G"], 0.0)
    channels = {
        "x_rel": x_rel,
        "x_capsule": states[:, 2],
        "acceleration_rod": (q["P_d"] * cosine - spring) / q["m1"],
        "current": theta["I_d"] * cosine,
    }
    total = 0.0
    for channel in run.channels:
        name = channel.name
        r, n = channel.values - channels[name], len(run.time)
        variance, offset = theta[f"noise_{name}"] ** 2 + channel.reading_variance, channel.width**2
        quadratic = (r @ r - offset * np.sum(r) ** 2 / (variance + n * offset)) / variance
        total -= 0.5 * (quadratic + n * np.log(2.0 * np.pi * variance) + np.log1p(n * offset / variance))
    return float(total)


def test_a_walker_of_bench_and_four_runs() -> None:
    rig = read_rig(DATA)
    target = LogPosterior(rig, make_experiments(rig))
    u = truth_of(target)
    # As far from each other as the walkers of the posterior: a part in a thousand.
    walkers = u + 1e-3 * np.random.default_rng(0).standard_normal((WALKERS, len(u))) * target.positive
    walkers[0] = u
    density = np.asarray(density_of(target)(walkers))
    values = target.mapping(target.theta(u))
    ours, theirs = [], []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        np.asarray(density_of(target)(walkers))
        ours.append((time.perf_counter() - begin) / WALKERS)
        begin = time.perf_counter()
        own = log_prior(target, u)
        for e in target.experiments:
            local = e.local(values)
            own += density_of_run(e, local) if isinstance(e, ForcedRun) else float(e.log_likelihood(local, np))
        theirs.append(time.perf_counter() - begin)
        assert own == pytest.approx(density[0], abs=0.05)
    ratio = min(theirs) / min(ours)
    print(f"\n{'XLA_FLAGS of the command' if COMMAND_FLAGS else 'default XLA_FLAGS'}, {os.cpu_count()} cores\n")
    print("| log-posterior of bench and four runs | ms a walker |\n|---|---|")
    print(
        f"| batch of {WALKERS} | {1e3 * min(ours):.2f} |\n| SciPy | {1e3 * min(theirs):.0f} |\n| ratio | {ratio:.0f} x |"
    )
    assert ratio >= (BAR if COMMAND_FLAGS else 0.5 * BAR)
