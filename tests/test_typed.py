"""Scripts as users write them: pyright finds nothing in strict mode, and finds mistakes."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli_tools import ROOT, environment

FIT = """
import capsule_id as cid

rig = cid.read_rig("data/").without("run_2").cut("run_1", stop=2.0)
result = cid.fit(rig, seed=1, experiments="bench")
k1 = result["k1"]
low: float = k1.value - 2.0 * k1.sd
word: str = k1.trust
print(k1, low, word, result.verdict, result.trust, k1.lower, k1.upper, k1.unit)
for name, parameter in result.parameters.items():
    print(name.upper(), parameter.value + 1.0)
if not result.clean:
    print(", ".join(result.failed))
result.write("results/again")
"""

SIMULATE = """
import numpy as np

import capsule_id as cid

p = cid.CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
drives = cid.Excitation(P_d=4.0, f=np.linspace(5.0, 6.0, 3))
t = cid.simulate(p, drives, np.linspace(0.0, 1.0, 500))
print(np.max(np.asarray(t.X1)), np.asarray(t.x_rel).shape, cid.status_message(t.status))
r = cid.response(p, cid.Excitation(P_d=4.0, Omega=34.56))
print(r.label, r.mean_velocity)
"""

COMPARE = """
import capsule_id as cid

one, other = cid.load("results/a"), cid.load("results/b")
try:
    print(one["k9"].value)
except cid.InputError as error:
    print(error.remedy)
for name in one:
    if name in other:
        a, b = one[name], other[name]
        print(f"{name}: {a.quoted}, {b.quoted}", (b.value - a.value) / (a.sd**2 + b.sd**2) ** 0.5)
one.plot_comparison("motor_current")
"""

WRONG = """
import capsule_id as cid

result = cid.load("results/a")
print(result["k1"].values, cid.Excitation(P_d="4"))
result.trust = "trusted"
"""


@pytest.mark.full
def test_scripts_of_users_are_typed(tmp_path: Path) -> None:
    for name, text in (("fit", FIT), ("simulate", SIMULATE), ("compare", COMPARE), ("wrong", WRONG)):
        (tmp_path / f"{name}.py").write_text(f"# pyright: strict\n{text}", encoding="utf-8")
    settings = {"pythonVersion": "3.11", "extraPaths": [str(ROOT)]}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings), encoding="utf-8")
    pyright = shutil.which("pyright", path=str(Path(sys.executable).parent))
    assert pyright is not None
    words = [pyright, "--pythonpath", sys.executable, "-p", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, env=environment(), cwd=tmp_path, check=False)
    errors = [line for line in done.stdout.splitlines() if " - error: " in line]
    assert [line for line in errors if "wrong.py" not in line] == []
    assert all(f'"{word}"' in "".join(errors) for word in ("values", "P_d", "trust")), done.stdout
