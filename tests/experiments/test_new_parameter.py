"""A physical parameter costs three places, as guide/extending.md says: table, model and force. Shown on a copy."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import cli_tools

FIELD = "    viscous: NumberOrBatch = 0.0\n", "    viscous: NumberOrBatch = 0.0\n    rise: NumberOrBatch = 0.0\n"
#: What a contributor adds for ``rise``: friction that grows with the speed, mu N rise |Y2| / v_s.
PLACES: dict[str, list[tuple[str, str]]] = {
    "parameters.py": [
        (
            '        Parameter(\n            "viscous", ',
            '        Parameter(\n            "rise", "1", "rise of friction per Stribeck velocity", r"\\eta", '
            '_lognormal(0.1, 100.0),\n            leaf="capsule", sign="not negative", default=0.0,\n        ),\n'
            '        Parameter(\n            "viscous", ',
        )
    ],
    "physics/model.py": [FIELD],
    "physics/forces.py": [
        FIELD,
        ('        TABLE["viscous"],\n', '        TABLE["viscous"],\n        TABLE["rise"],\n'),
        ("* weakening + self.viscous * speed", "* (weakening + self.rise * speed / self.v_s) + self.viscous * speed"),
        (
            "    def series(self",
            "    def series_of_eq_1(self",
        ),  # the recursion is optional; any law has one by the chain rule
    ],
}
MU, V_S, RISE = 0.6, 0.3, 0.2
SIMULATE = """
import numpy as np, capsule_id as cid
p = dict(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.2, v_s=0.3, G=1e-3)
t, e = np.linspace(0.0, 0.4, 81), cid.Excitation(P_d=4.0, Omega=34.56)
for rise, model in ((0.0, "exact"), (0.5, "exact"), (0.5, "smooth")):
    print(cid.simulate(cid.CapsuleParameters(**p, rise=rise), e, t, model=model).X2[-1])
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package that has the parameter."""
    site = tmp_path_factory.mktemp("site")
    package = site / "capsule_id"
    shutil.copytree(cli_tools.ROOT / "capsule_id", package, ignore=shutil.ignore_patterns("__pycache__"))
    for name, changes in PLACES.items():
        text = (package / name).read_text(encoding="utf-8")
        for old, new in changes:
            assert text.count(old) == 1, (name, old)
            text = text.replace(old, new)
        (package / name).write_text(text, encoding="utf-8")
    return site


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Steady sliding at 12 speeds on a ground with the parameter."""
    folder = tmp_path_factory.mktemp("rig")
    speed = np.geomspace(0.01, 1.5, 12)
    coefficient = MU * (0.5 + 0.5 * np.exp(-speed / V_S) + RISE * speed / V_S)
    coefficient *= 1.0 + 0.003 * np.random.default_rng(1).standard_normal(12)
    rows = "".join(f"{v:.4f},{x:.5f}\n" for v, x in zip(speed, coefficient, strict=True))
    (folder / "s.csv").write_text(f"speed [m/s],coefficient [1]\n{rows}", encoding="utf-8")
    (folder / "rig.toml").write_text(
        '[rig]\nname = "rising"\n[model]\nfree = ["rise"]\n[[experiment]]\nkind = "sliding_friction"\nfile = "s.csv"\n',
        encoding="utf-8",
    )
    return folder


@pytest.mark.full
def test_it_is_fitted_and_reported(site: Path, rig: Path, tmp_path: Path) -> None:
    environment = cli_tools.environment(PYTHONPATH=str(site))
    words = (str(rig), "--no-sample", "--quiet", "--out", str(tmp_path / "out"))
    done = cli_tools.run(*words, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    found = json.loads((tmp_path / "out" / "parameters.json").read_text())["parameters"]
    assert set(found) == {"mu", "v_s", "rise"}
    assert abs(found["rise"]["value"] - RISE) < 4.0 * found["rise"]["sd"] < 0.2 * RISE
    assert "rise of friction per Stribeck velocity" in (tmp_path / "out" / "report.html").read_text()
    described = cli_tools.run("simulate", "--help", cwd=tmp_path, name="capsule_id", env=environment)
    assert "--rise X" in described.stdout


@pytest.mark.slow
def test_both_engines_simulate_it(site: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SIMULATE], cwd=tmp_path, env=cli_tools.environment(PYTHONPATH=str(site)),
        capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    without, exact, smooth = (float(line) for line in done.stdout.split())
    assert smooth == pytest.approx(exact, rel=0.01)
    assert abs(exact - without) > 20.0 * abs(smooth - exact)


@pytest.mark.full
def test_without_the_three_places_it_is_unknown(rig: Path, tmp_path: Path) -> None:
    """The negative control."""
    done = cli_tools.run("check", str(rig), cwd=tmp_path, name="capsule_id")
    assert done.returncode == 2
    assert "free must name optional parameters, 'rise'" in cli_tools.message(done.stderr)
