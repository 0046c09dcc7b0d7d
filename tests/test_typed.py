"""Scripts as users write them: pyright finds nothing in strict mode, and finds mistakes."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli_tools import ROOT, environment

GUIDE = ROOT / "capsule_id" / "guide"
#: Scripts of the page by title.
SCRIPTS = dict(re.findall(r"^## (.*?)\n\n```python\n(.*?)^```", (GUIDE / "scripts.md").read_text("utf-8"), re.M | re.S))

WRONG = """
import capsule_id as cid

result = cid.load("results/a")
print(result["k1"].values, cid.Excitation(P_d="4"))
result.trust = "trusted"
"""


@pytest.mark.parametrize(
    ("title", "printed"),
    [
        ("Simulate three drives at once", "P-1-F-3"),
        pytest.param("A second spring behind the rod", "55 22 2.39", marks=pytest.mark.full),
        ("Pulses in the place of a cosine", "duty 50%: 24."),
        pytest.param("Make a rig folder from arrays", "trusted", marks=pytest.mark.full),
    ],
)
def test_scripts_without_a_folder_run(
    title: str, printed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(SCRIPTS[title], title, "exec"), {"__name__": "__main__"})
    assert printed in capsys.readouterr().out


@pytest.mark.full
def test_scripts_of_users_are_typed(tmp_path: Path) -> None:
    assert len(SCRIPTS) == 10
    for name, text in [*((f"script_{i}", own) for i, own in enumerate(SCRIPTS.values())), ("wrong", WRONG)]:
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
