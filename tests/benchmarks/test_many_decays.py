"""Time and memory of ``capsule-id check`` and ``fit-params`` on many decays, without and with a hold before each.

DECAYS=500 python -m pytest tests/benchmarks/test_many_decays.py -m benchmark -s -n 0
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from tests.cli_tools import argv, peak_memory

pytestmark = pytest.mark.benchmark

DECAYS, ROWS, STEP = int(os.environ.get("DECAYS", "50")), 400, 3e-3
M1, K1, C = 0.5, 1500.0, 2.2
#: Largest report, MB: it draws the panels that fit worst.
LARGEST_REPORT = 6.0


def write(folder: Path, hold: float) -> None:
    """A rig of ``DECAYS`` releases of 3 to 6 mm, held for ``hold`` s, with 0.02 mm of noise."""
    rng, since = np.random.default_rng(6), np.maximum(STEP * np.arange(ROWS) - hold, 0.0)
    gamma = C / (2.0 * M1)
    omega = np.sqrt(K1 / M1 - gamma**2)
    swing = np.exp(-gamma * since) * (np.cos(omega * since) + gamma / omega * np.sin(omega * since))
    lines = ['[rig]\nname = "many"\nm1 = { value = 0.5, sd = 0.0005, unit = "kg" }\n']
    for i in range(DECAYS):
        x = 1e3 * rng.uniform(3e-3, 6e-3) * swing + 0.02 * rng.standard_normal(ROWS)
        readings = np.column_stack([STEP * np.arange(ROWS), x])
        np.savetxt(folder / f"d{i:03d}.csv", readings, "%.6g", ",", header="time [s],x_rel [mm]", comments="")
        lines.append(f'[[experiment]]\nkind = "free_vibration"\nfile = "d{i:03d}.csv"\n')
    (folder / "rig.toml").write_text("\n".join(lines), encoding="utf-8")


@pytest.mark.parametrize("hold", [0.0, 0.2])
def test_many_decays(tmp_path: Path, hold: float) -> None:
    (rig := tmp_path / "rig").mkdir()
    write(rig, hold)
    peak_memory(argv("check", str(rig), name="capsule_id"), f"check of {DECAYS} decays, hold {hold} s")
    peak_memory(argv(str(rig), "--quiet", "--out", str(tmp_path / "out")), f"fit of {DECAYS} decays, hold {hold} s")
    found = json.loads((tmp_path / "out" / "parameters.json").read_text(encoding="utf-8"))
    assert {one["trust"] for one in found["parameters"].values()} == {"trusted"}
    assert abs(found["parameters"]["k1"]["value"] - K1) < 3.0 * found["parameters"]["k1"]["sd"]
    assert (tmp_path / "out" / "report.html").stat().st_size < 1e6 * LARGEST_REPORT
