"""The scripts that measure the package: its size, and faults that the tests must find."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests import faults, size

PACKAGE = {
    "capsule_id/__init__.py": '"""Package."""\n',
    "capsule_id/a.py": '"""First."""\n\nfrom capsule_id.b import f\n\n#: Least share.\nLEAST, FACTOR = 0.3, 1.0\n',
    "capsule_id/b.py": (
        '"""Second."""\n\nfrom typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from capsule_id.c import g\n\n\n'
        'def f(x: list[float], most: int = 7) -> float:\n    """Sum."""\n    # A comment.\n'
        "    return x[0] + 5.0 * x[1] if x[2] < 3.5 else 2.0\n"
    ),
    "capsule_id/c.py": '"""Third."""\n\n\ndef g() -> None:\n    from capsule_id.a import LEAST\n\n    print(LEAST)\n',
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in PACKAGE.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_size_counts_what_stands_there(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size.main([str(tree)])
    shown = capsys.readouterr().out.splitlines()
    assert shown[0] == "statements 10, files 4"
    assert shown[1] == "imports 4 (40.0%)"
    assert shown[3:5] == ["tuned numbers 3", "circles 1"]
    assert shown[5].split() == ["capsule_id.a,", "capsule_id.b,", "capsule_id.c"]
    module = {one.name: one for one in size.modules(tree)}["capsule_id.b"]
    assert module.tuned == [(9, 7.0), (12, 3.5)]
    assert module.characters == len(
        "fromtypingimportTYPE_CHECKINGifTYPE_CHECKING:fromcapsule_id.cimportg"
        "deff(x:list[float],most:int=7)->float:returnx[0]+5.0*x[1]ifx[2]<3.5else2.0"
    )


@pytest.mark.full
def test_faults_are_one_line_each_and_drawn_by_their_seed() -> None:
    """Each fault changes one line of code, which still compiles, and no two change the same line."""
    drawn = faults.drawn()
    assert drawn == faults.drawn() != faults.drawn(seed=1)
    assert len({(one.path, one.line) for one in drawn}) == faults.NUMBER
    for one in drawn:
        lines = (faults.ROOT / one.path).read_text(encoding="utf-8").split("\n")
        assert lines[one.line - 1] == one.before != one.after
        lines[one.line - 1] = one.after
        compile("\n".join(lines), one.path, "exec")


@pytest.mark.parametrize(
    ("operator", "after"),
    [
        ("sign", "(x[0] - 5.0 * x[1])"),
        ("factor 2", "x[0] + (2 * 5.0 * x[1])"),
        ("dropped term", "(x[0])"),
        ("bound", "(x[2] <= 3.5)"),
        ("index", "(x[1]) + 5.0 * x[1]"),
    ],
)
def test_each_operator_acts_on_its_place(
    tree: Path, operator: str, after: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(faults.PARTS, "all", ("*.py",))
    found = [one for one in faults.sites(tree, "all", operator) if one.path.endswith("b.py")]
    (wanted,) = [one for one in found if after in one.after]
    faults.planted(tree, wanted)
    done = subprocess.run([sys.executable, "-c", "import capsule_id.b"], cwd=tree, capture_output=True)
    assert done.returncode == 0
