"""Time and memory of ``capsule-id check`` on a text of five channels of which two are used, beside pandas.

TEXT_MB=1000 python -m pytest tests/benchmarks/test_long_text.py -m benchmark -s -n 0
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.cli_tools import argv, peak_memory

pytestmark = pytest.mark.benchmark

SIZE_MB = float(os.environ.get("TEXT_MB", "200"))
RATE, FREQUENCY, BYTES_PER_ROW, PART = 20_000.0, 17.6, 63.9, 200_000
#: Peak memory of ``check`` per size of the text, above that of an empty one, MB; CPU time of reading relative to pandas.
MOST_MEMORY, EMPTY_MB, MOST_TIME = 4.0, 300.0, 2.0
#: Modules that the measured parts import, so that their time does not count.
READ = """
import sys, time, pandas, pyarrow.csv, capsule_id.rig.formats.layouts
from pathlib import Path
from capsule_id.rig.formats import EXPORTS
from capsule_id.rig.formats.raw import Layout
path = Path(sys.argv[1])
begin = time.process_time()
{}
print(time.process_time() - begin)
"""
OURS = 'EXPORTS[".csv"](path.read_bytes(), path, Layout(columns=("Time (s)", "x_rel (mm)")))'


def write(folder: Path) -> Path:
    """A rig with one long decay; its text."""
    rng, rows = np.random.default_rng(0), int(SIZE_MB * 1e6 / BYTES_PER_ROW)
    with (folder / "d.csv").open("w", encoding="utf-8", newline="\n") as file:
        file.write("Time (s),x_rel (mm),x_capsule (mm),acc (m/s^2),current (A)\n")
        for first in range(0, rows, PART):
            time = np.arange(first, min(first + PART, rows)) / RATE
            x = 8.0 * np.exp(-6.0 * time * RATE / rows) * np.cos(2.0 * np.pi * FREQUENCY * time)
            noise = rng.standard_normal((len(time), 4)) * (0.005, 0.01, 0.1, 0.001)
            columns = np.column_stack([time, x, np.zeros_like(x), -12.2 * x, np.zeros_like(x)])
            columns[:, 1:] += noise
            np.savetxt(file, columns, fmt=["%.5f", *["%.6e"] * 4], delimiter=",")
    (folder / "rig.toml").write_text(
        '[rig]\nname = "long"\nm1 = { value = 0.11, sd = 0.0005, unit = "kg" }\n'
        '[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\nx_rel_sd = { value = 0.005, unit = "mm" }\n'
        'columns = { time = { from = "Time (s)", unit = "s" }, x_rel = { from = "x_rel (mm)", unit = "mm" } }\n',
        encoding="utf-8",
    )
    return folder / "d.csv"


def cpu(path: Path, statement: str) -> float:
    """CPU seconds of a statement about the file."""
    words = [sys.executable, "-c", READ.format(statement), str(path)]
    return min(float(subprocess.run(words, capture_output=True, text=True, check=True).stdout) for _ in range(2))


def test_a_long_text(tmp_path: Path) -> None:
    text = write(tmp_path)
    ours, pandas = cpu(text, OURS), cpu(text, 'pandas.read_csv(path, engine="pyarrow")')
    resident = peak_memory(argv("check", str(tmp_path), name="capsule_id"), "check")
    print(f"{text.stat().st_size / 1e6:.0f} MB: reading {ours:.1f} s, pandas {pandas:.1f} s")
    assert resident < EMPTY_MB + MOST_MEMORY * SIZE_MB
    assert ours < MOST_TIME * pandas
