"""The same fit in other surroundings: locale, home, temporary folder, cache, matplotlib's files, path names, streams."""

import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from capsule_id import load
from tests.cli_tools import argv, environment, small_rig

#: Bytes that are no UTF-8.
NO_TEXT = os.fsdecode(b"r\xff")
#: Name -> variables (None: removed), a matplotlibrc in the working folder, folder, streams that a shell changes.
SURROUNDINGS: Mapping[str, tuple[dict[str, str | None], bytes, str, str]] = {
    "everything": (
        {"MPLBACKEND": "nosuch", "MPLCONFIGDIR": "/nonexistent", "LC_ALL": "POSIX", "PYTHONCOERCECLOCALE": "0",
         "PYTHONUTF8": "0", "HOME": "/nonexistent", "XDG_CACHE_HOME": "/dev/null", "TMPDIR": "/nonexistent", "TERM": None},
        b"text.usetex: True\nfont.family: NoSuchFont\n# \xff\n", NO_TEXT, "</dev/null 2>/dev/full",
    ),
    "everything else": (
        {"MPLBACKEND": "tkagg", "DISPLAY": None, "MATPLOTLIBRC": "/nonexistent", "MPLCONFIGDIR": "/dev/null", "HOME": None,
         "USERPROFILE": None, "JAX_COMPILATION_CACHE_DIR": "/dev/null/x", "LC_ALL": "xx_YY.nosuch", "COLUMNS": "0",
         "PYTHONIOENCODING": "ascii:strict", "PYTHONOPTIMIZE": "2"},
        b"\xff\xfe\n", "Prüf $stand ü", "</dev/null",
    ),
    "no such backend": ({"MPLBACKEND": "nosuch"}, b"", "rig", ""),
    "a backend with windows": ({"MPLBACKEND": "tkagg", "DISPLAY": None}, b"", "rig", ""),
    "LaTeX": ({}, b"text.usetex: True\n", "rig", ""),
    "no such font": ({}, b"font.family: NoSuchFont\nmathtext.fontset: nosuch\n", "rig", ""),
    "a matplotlibrc that is no text": ({}, b"\xff\xfe\n", "rig", ""),
    "another place of matplotlibrc": ({"MATPLOTLIBRC": "/nonexistent", "MPLCONFIGDIR": "/dev/null"}, b"", "rig", ""),
    "a folder that is no text": ({}, b"", NO_TEXT, ""),
    "a folder with odd letters": ({}, b"", "Prüf $stand ü", ""),
    "no home": ({"HOME": None, "USERPROFILE": None}, b"", "rig", ""),
    "a home that is none": ({"HOME": "/nonexistent"}, b"", "rig", ""),
    "a home that is a file": ({"HOME": "/dev/null"}, b"", "rig", ""),
    "no temporary folder": ({"TMPDIR": "/nonexistent"}, b"", "rig", ""),
    "a cache that is a file": ({"XDG_CACHE_HOME": "/dev/null"}, b"", "rig", ""),
    "JAX's cache in no folder": ({"JAX_COMPILATION_CACHE_DIR": "/dev/null/x"}, b"", "rig", ""),
    "locale C": ({"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}, b"", "rig", ""),
    "no such locale": ({"LC_ALL": "xx_YY.nosuch"}, b"", "rig", ""),
    "ASCII streams": ({"PYTHONIOENCODING": "ascii:strict"}, b"", "Prüfstand", ""),
    "no terminal": ({"TERM": None, "COLUMNS": "0"}, b"", "rig", "</dev/null"),
    "no streams": ({}, b"", "rig", "<&- >&- 2>&-"),
    "errors on a full disk": ({}, b"", "rig", "2>/dev/full"),
    "warnings as errors": ({"PYTHONWARNINGS": "error"}, b"", "rig", ""),
    "without docstrings": ({"PYTHONOPTIMIZE": "2"}, b"", "rig", ""),
}  # fmt: skip
#: Tried in the full tier. "everything" and "everything else" hold the others; where one of the two fails, the slow tests
#: say which variable it is. matplotlib looks into MATPLOTLIBRC where the working folder has no matplotlibrc only.
FULL = {
    "everything else",
    "another place of matplotlibrc",
    "a home that is a file",
    "no streams",
    "warnings as errors",
}


def fitted(here: Path, name: str, *words: str) -> subprocess.CompletedProcess[bytes]:
    """Run ``fit-params`` in surroundings of ``SURROUNDINGS`` to its end."""
    variables, matplotlibrc, folder, streams = SURROUNDINGS[name]
    small_rig(here / folder)
    if matplotlibrc:
        (here / "matplotlibrc").write_bytes(matplotlibrc)
    command = argv(folder, "--out", f"{folder}.out", "--max-steps", "60", *words)
    shell = ["sh", "-c", f'exec "$@" {streams}', "sh", *command]
    return subprocess.run(shell, cwd=here, env=environment(**variables), capture_output=True, timeout=300, check=False)


@pytest.mark.parametrize(
    "name",
    [
        "everything",
        *(
            pytest.param(name, marks=pytest.mark.full if name in FULL else pytest.mark.slow)
            for name in SURROUNDINGS
            if name != "everything"
        ),
    ],
)
def test_a_fit_ends_with_its_result(tmp_path: Path, name: str) -> None:
    """Each of these ended in an internal failure after the fit, or could have."""
    done = fitted(tmp_path, name, "--no-sample", "--quiet")
    assert done.returncode == 0, done.stderr
    assert done.stderr == b"" or b"the cache of compiled programs cannot be used" in done.stderr
    folder = SURROUNDINGS[name][2]
    found = load(tmp_path / f"{folder}.out")
    written = json.loads((tmp_path / f"{folder}.out" / "parameters.json").read_text(encoding="utf-8"))
    assert written["parameters"]["mu"]["value"] == found.summary.loc["mu", "value"] == pytest.approx(0.65, abs=0.02)
    assert "<html" in (tmp_path / f"{folder}.out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.full
@pytest.mark.parametrize("name", ["everything", pytest.param("no such backend", marks=pytest.mark.slow)])
def test_figures_are_the_same_in_all_surroundings(tmp_path: Path, name: str) -> None:
    """The style and the backend are those of the package; a sample too is drawn and read back."""
    pictures, draws = [], []
    for surroundings in ("no home", name):
        (tmp_path / surroundings).mkdir()
        assert fitted(tmp_path / surroundings, surroundings).returncode == 0
        folder = tmp_path / surroundings / f"{SURROUNDINGS[surroundings][2]}.out"
        pictures.append({path.name: path.read_bytes() for path in (folder / "figures").glob("*.png")})
        draws.append(load(folder).posterior.draws)
    assert pictures[0]
    assert pictures[0] == pictures[1]
    np.testing.assert_array_equal(*draws)


@pytest.mark.full
def test_a_wrong_word_has_its_code_where_errors_cannot_be_printed(tmp_path: Path) -> None:
    command = ["sh", "-c", 'exec "$@" 2>/dev/full', "sh", *argv("nosuch")]
    assert subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, check=False).returncode == 2
