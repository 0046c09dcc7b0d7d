"""The general capsule under pulses with a lag, beside SciPy in the same run.

    XLA_FLAGS=--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000 \\
    python -m pytest tests/benchmarks/test_general_speed.py -m benchmark -n 0 -s

Work unit: ten periods from rest with 100 samples a period, every term of the capsule and the drive not zero; the batch
spreads k1, k2, c, mu and duty by 3 %.
"""

import os
import time

import jax
import numpy as np
import pytest

from capsule_id.physics.drives import Pulses
from capsule_id.physics.model import CapsuleParameters, Status
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import states_of
from tests.scipy_general import pulses, simulate_general

pytestmark = pytest.mark.benchmark

CAPSULE = {
    "m1": 0.106, "m2": 0.52, "k1": 1100.0, "k2": 12e3, "c": 3.0, "mu": 0.5, "v_s": 0.25, "G": 7e-4, "g": 9.81,
    "k_cubic": 2e8, "c2": 6.0, "k2_back": 9e3, "G_back": 9e-4, "slope": -0.04, "N0": 0.8, "mu_back": 0.7, "ratio": 0.7,
    "viscous": 0.6,
}  # fmt: skip
DRIVE = {"P_on": 8.0, "period": 0.17, "duty": 0.55, "P_off": -1.5, "lag": 0.012, "reaction": 0.6}
TIMES = np.linspace(0.0, 10.0 * DRIVE["period"], 1001)
SIZE = 256
COMMAND_FLAGS = "small_while_loop_byte_threshold" in os.environ.get("XLA_FLAGS", "")


def test_batch_of_pulses_beside_scipy() -> None:
    rng = np.random.default_rng(0)
    spread = {name: x * (1.0 + 0.03 * rng.standard_normal(SIZE)) for name, x in {**CAPSULE, **DRIVE}.items()
              if name in ("k1", "k2", "c", "mu", "duty")}  # fmt: skip
    p = CapsuleParameters(**{name: spread.get(name, x) for name, x in CAPSULE.items()})
    e = Pulses(**{name: spread.get(name, x) for name, x in DRIVE.items()})
    t = jax.block_until_ready(simulate(p, e, TIMES))
    assert (np.asarray(t.status) == Status.OK).all()
    mine, scipy = [], []
    for lane in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(simulate(p, e, TIMES))
        mine.append((time.perf_counter() - begin) / SIZE)
        q = {**CAPSULE, **DRIVE, **{name: float(x[lane]) for name, x in spread.items()}}
        begin = time.perf_counter()
        expected, contacts = simulate_general(q, pulses(q, TIMES[-1]), TIMES)
        scipy.append(time.perf_counter() - begin)
        # Other lanes graze: at this tolerance SciPy misses contacts there, 8 of 19 in lane 3.
        if lane == 0:
            assert np.abs(states_of(t)[lane] - expected)[:, [0, 2]].max() < 1e-7
            assert int(t.contacts[lane]) == contacts
    ratio = np.median(scipy) / np.median(mine)
    print(f"\n{1e3 * np.median(mine):.3f} ms a run, SciPy {1e3 * np.median(scipy):.0f} ms: {ratio:.0f} x")
    # The goal is 500 with the command's flags; it is not reached (capsule_id/guide/benchmarks.md).
    assert ratio > (200.0 if COMMAND_FLAGS else 40.0)
