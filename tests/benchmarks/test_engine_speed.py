"""How fast the exact engine is, beside SciPy in the same run: the work unit and the bars of the project's speed study.

    python -m pytest tests/benchmarks/test_engine_speed.py -m benchmark -s
    XLA_FLAGS=--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000 python -m pytest ...

Work unit: ten periods of k2 = 18.96 kN/m, P_d = 4 N, Omega = 34.56 rad/s, G = 1 mm from rest (164 events); batches
spread k1, k2, c, mu and v_s by 3 %. Rows are timed in turn, round by round, and the least time of each row counts.
"""

import os
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate
from tests.scipy_capsule import simulate_scipy

pytestmark = pytest.mark.benchmark

LEAVES = {"m1": 0.11, "m2": 0.53, "k1": 1420.0, "k2": 18960.0, "c": 3.89, "mu": 0.66, "v_s": 0.3, "G": 1e-3}
DRIVE = Excitation(P_d=4.0, Omega=34.56)
END = 20.0 * np.pi / 34.56
SAMPLED, ENDS = np.linspace(0.0, END, 1000), np.array([0.0, END])
TANGENTS = ("k1", "k2", "c", "mu", "v_s", "P_d")
COMMAND_FLAGS = "small_while_loop_byte_threshold" in os.environ.get("XLA_FLAGS", "")
ROUNDS = 7


def spread(n: int) -> dict[str, float | np.ndarray]:
    rng = np.random.default_rng(0)
    return LEAVES | {k: LEAVES[k] * (1.0 + 0.03 * rng.standard_normal(n)) for k in ("k1", "k2", "c", "mu", "v_s")}


def engine(leaves: dict[str, float | np.ndarray], times: np.ndarray) -> Callable[[], object]:
    p = CapsuleParameters(**leaves)
    return lambda: jax.block_until_ready(simulate(p, DRIVE, times))


def traced(leaves: dict[str, float | np.ndarray], tangents: bool) -> Callable[[], object]:
    """The jitted motion, alone or with six tangents; a batch where the leaves are."""

    def positions(x: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        e = Excitation(x["P_d"], DRIVE.Omega)
        t = simulate(CapsuleParameters(**{k: v for k, v in x.items() if k != "P_d"}), e, SAMPLED)
        return t.X1, t.X2

    def with_tangents(x: dict[str, jax.Array]) -> object:
        along = [{k: jnp.full_like(v, float(k == name)) for k, v in x.items()} for name in TANGENTS]
        stacked = jax.tree.map(lambda *leaf: jnp.stack(leaf), *along)
        return jax.vmap(lambda v: jax.jvp(positions, (x,), (v,)), out_axes=((None, None), (0, 0)))(stacked)

    x = {k: jnp.asarray(v, float) for k, v in (leaves | {"P_d": 4.0}).items()}
    call = jax.jit(with_tangents if tangents else positions)
    return lambda: jax.block_until_ready(call(x))


def scipy_run() -> object:
    q = LEAVES | {"g": 9.81, "P_d": 4.0, "Omega": 34.56}
    return simulate_scipy(q, ENDS, rtol=1e-8, atol=1e-11)


ROWS: dict[str, tuple[Callable[[], Callable[[], object]], int]] = {
    "SciPy DOP853, end": (lambda: scipy_run, 1),
    "single, 1000 samples": (lambda: engine(LEAVES, SAMPLED), 1),
    "batch 256, 1000 samples": (lambda: engine(spread(256), SAMPLED), 256),
    "batch 1024, 1000 samples": (lambda: engine(spread(1024), SAMPLED), 1024),
    "batch 1024, end": (lambda: engine(spread(1024), ENDS), 1024),
    "traced single, 1000 samples": (lambda: traced(LEAVES, tangents=False), 1),
    "traced single, six tangents": (lambda: traced(LEAVES, tangents=True), 1),
    "traced batch 64, 1000 samples": (lambda: traced(spread(64), tangents=False), 64),
    "traced batch 64, six tangents": (lambda: traced(spread(64), tangents=True), 64),
}


@pytest.mark.parametrize("row", ROWS)
def test_row(benchmark: BenchmarkFixture, row: str) -> None:
    make, runs = ROWS[row]
    call = make()
    call()
    benchmark.extra_info["runs"] = runs
    benchmark.pedantic(call, rounds=5)


def interleaved() -> dict[str, float]:
    """Least time of every row in ms per run."""
    calls = {row: (make(), runs) for row, (make, runs) in ROWS.items()}
    for call, _ in calls.values():
        call()
    best = dict.fromkeys(calls, np.inf)
    for _ in range(ROUNDS):
        for row, (call, runs) in calls.items():
            begin = time.perf_counter()
            call()
            best[row] = min(best[row], 1e3 * (time.perf_counter() - begin) / runs)
    return best


def test_bars() -> None:
    """The table, and every bar in one assertion, so that a failure shows all of them."""
    ms = interleaved()
    scipy = ms["SciPy DOP853, end"]
    print(f"\n{'XLA_FLAGS of the command' if COMMAND_FLAGS else 'default XLA_FLAGS'}, {os.cpu_count()} cores\n")
    print("| row | ms per run | x SciPy |\n|---|---|---|")
    for row, value in ms.items():
        print(f"| {row} | {value:.3g} | {scipy / value:.3g} |")
    single = ms["traced single, six tangents"] / ms["traced single, 1000 samples"]
    batch = ms["traced batch 64, six tangents"] / ms["traced batch 64, 1000 samples"]
    print(f"| six tangents / primal: single, batch 64 | {single:.2g}, {batch:.2g} | |")
    bars = {
        "single": scipy / ms["single, 1000 samples"] / (100.0 if COMMAND_FLAGS else 25.0),
        "batch, sampled": scipy / min(ms["batch 256, 1000 samples"], ms["batch 1024, 1000 samples"]) / 500.0,
        "batch, end": scipy / ms["batch 1024, end"] / 1500.0,
        "tangents, single": 3.5 / single,
        "tangents, batch": 8.0 / batch,
    }
    assert min(bars.values()) >= 1.0, {name: f"{part:.2f} of the bar" for name, part in bars.items()}
