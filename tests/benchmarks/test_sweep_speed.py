"""How fast a bifurcation diagram is, beside SciPy in the same run: 500 points over k2, 300 + 48 periods each.

    python -m pytest tests/benchmarks/test_sweep_speed.py -m benchmark -s -n 0
    XLA_FLAGS=--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000 python -m pytest ...

The second line sets the option that the command sets for itself; the bar stands for it. SciPy computes three of the
points, one after the other between two diagrams, and gives nothing but the states once a period.
"""

import os
import time

import numpy as np
import pytest

from capsule_id.motions.response import DROPPED, OBSERVED
from capsule_id.motions.sweep import diagram
from capsule_id.parameters import STANDING
from capsule_id.physics.model import CapsuleParameters, Excitation
from tests.scipy_capsule import simulate_scipy

pytestmark = pytest.mark.benchmark

LEAVES = {"m1": 0.11, "m2": 0.53, "k1": 1420.0, "k2": 18960.0, "c": 3.89, "mu": 0.66, "v_s": 0.3, "G": 1e-3}
P_d, Omega = 4.0, 34.56
K2 = np.linspace(1e3, 55e3, 500)
COMPARED = (50, 250, 450)
COMMAND_FLAGS = "small_while_loop_byte_threshold" in os.environ.get("XLA_FLAGS", "")
BAR = 500.0


def scipy_point(k2: float) -> tuple[float, float]:
    """(seconds, mean velocity) of one point."""
    q = LEAVES | {"k2": k2, "g": 9.81, "P_d": P_d, "Omega": Omega}
    T = 2.0 * np.pi / Omega
    times = T * np.concatenate([[0.0], np.arange(DROPPED, DROPPED + OBSERVED + 1)])
    begin = time.perf_counter()
    states, _ = simulate_scipy(q, times, rtol=1e-8, atol=1e-11)
    return time.perf_counter() - begin, float((states[-1, 2] - states[1, 2]) / (OBSERVED * T))


def test_a_diagram_of_500_points() -> None:
    p, e = CapsuleParameters(**LEAVES), Excitation(P_d, Omega)
    diagram(p, e, "k2", K2[:65])
    ours, theirs = [], {}
    for i in (*COMPARED, None):
        begin = time.perf_counter()
        data = diagram(p, e, "k2", K2)
        ours.append((time.perf_counter() - begin) / len(K2))
        if i is not None:
            theirs[i] = scipy_point(float(K2[i]))
    per_point, scipy = min(ours), np.mean([seconds for seconds, _ in theirs.values()])
    print(f"\n{'XLA_FLAGS of the command' if COMMAND_FLAGS else 'default XLA_FLAGS'}, {os.cpu_count()} cores\n")
    print("| 300 + 48 periods | s per point |\n|---|---|")
    print(f"| diagram of 500 points, one call ({500.0 * per_point:.2f} s) | {per_point:.5f} |")
    for i, (seconds, _) in theirs.items():
        print(f"| SciPy, k2 = {K2[i] / 1e3:.2f} kN/m | {seconds:.2f} |")
    print(f"| mean of SciPy / diagram | {scipy / per_point:.0f} x |")
    # The same motion, so that the same is timed: SciPy's tolerance leaves this much in the mean velocity.
    T = 2.0 * np.pi / Omega
    for i, (_, velocity) in theirs.items():
        assert abs(velocity - float(data["mean_velocity"][0, i])) < max(0.02 * abs(velocity), STANDING / T)
    assert scipy / per_point >= (BAR if COMMAND_FLAGS else 0.4 * BAR)
