"""Commands print their own lines alone: no numerical warning, and nothing of a library, whatever the readings."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from capsule_id.cli import capsule_id, fit_params
from tests.cli_tools import DATA, ROOT, environment, message, run, small_rig

CORPUS = ROOT.parent / "shared" / "corpus"
#: A workbook that names two thousand million rows: it is read for more than 400 s, which no line of a library explains.
ENDLESS = "hostile_xlsx_row_2e9"
SETTINGS_OF_LATEX = "text.usetex: True\nfont.family: no such font\nno.such.key: 1\n"


def in_steps(folder: Path, table: str, column: int, steps: float) -> Path:
    """Round a column to ``steps`` reading steps over its range; fewer than 1 leave it constant."""
    path = folder / f"{table}.csv"
    header = path.read_text(encoding="utf-8").partition("\n")[0]
    values = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    step = np.ptp(values[:, column]) / steps
    values[:, column] = np.round(values[:, column] / step) * step
    np.savetxt(path, values, "%.9g", ",", header=header, comments="")
    return folder


@pytest.mark.full
@pytest.mark.parametrize("steps", [1, 3, 1e5], ids=["two levels", "coarse", "fine"])
def test_check_of_runs_whose_accelerometer_has_coarse_steps(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], steps: float
) -> None:
    """(Before: "RuntimeWarning: divide by zero encountered in divide", four times, with two levels.)"""
    shutil.copytree(DATA, tmp_path / "rig")
    assert capsule_id(["check", str(in_steps(tmp_path / "rig", "run_3", 3, steps))]) == 0
    printed = capfd.readouterr()
    assert printed.err == ""
    assert "run_3" in printed.out


@pytest.mark.parametrize(
    ("table", "column", "steps"),
    [
        ("motor_current", 1, 2.0),
        ("motor_current", 0, 0.4),
        ("support_spring_soft", 1, 3.0),
        ("static_friction", 0, 0.4),
    ],
)
def test_fits_of_tables_in_coarse_steps(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], table: str, column: int, steps: float
) -> None:
    folder = in_steps(small_rig(tmp_path / "rig", tables=(table,)), table, column, steps)
    out = str(tmp_path / "out")
    code = fit_params([str(folder), "--no-sample", "--quiet", "--out", out])
    lines = message(capfd.readouterr().err).splitlines()
    assert (code, len(lines)) in ((0, 0), (3, 1), (2, 1)), lines
    assert all(line.startswith(("fit-params: verdict not clean: ", str(folder))) for line in lines)


@pytest.mark.full
def test_the_users_matplotlibrc_has_no_say_in_a_command(tmp_path: Path) -> None:
    """(Before: lines of Matplotlib's log, and an internal failure where LaTeX is missing.)"""
    small_rig(tmp_path / "rig")
    own = run("check", "rig", "--figures", "own", cwd=tmp_path, name="capsule_id")
    (tmp_path / "matplotlibrc").write_text(SETTINGS_OF_LATEX, encoding="utf-8")
    theirs = run("check", "rig", "--figures", "theirs", cwd=tmp_path, name="capsule_id")
    assert (own.returncode, own.stderr, theirs.returncode, theirs.stderr) == (0, "", 0, "")
    picture = "static_friction.png"
    assert (tmp_path / "theirs" / picture).read_bytes() == (tmp_path / "own" / picture).read_bytes()
    fitted = run("rig", "--no-sample", "--quiet", "--out", "out", cwd=tmp_path)
    assert (fitted.returncode, fitted.stderr) == (0, "")


def test_a_warning_of_the_numbers_would_be_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: nothing is silenced; a division by zero in a command ends it here, where warnings are errors."""
    shutil.copytree(DATA, tmp_path / "rig")
    monkeypatch.setattr("capsule_id.records.motion.find_period", lambda *_: np.ones(1) / np.zeros(1))
    assert capsule_id(["check", str(tmp_path / "rig")]) == 1


@pytest.mark.slow
@pytest.mark.skipif(not CORPUS.is_dir(), reason="the corpus is not at hand")
@pytest.mark.parametrize("name", sorted({path.parent.name for path in CORPUS.glob("*/rig.toml")} - {ENDLESS}))
def test_no_line_of_a_library_leaves_a_command(tmp_path: Path, name: str) -> None:
    """Over the corpus: check, and a fit without a sample, where a numerical warning is an error."""
    strict = environment(PYTHONWARNINGS="error::RuntimeWarning")
    words = [str(CORPUS / name), "--no-sample", "--quiet", "--out", str(tmp_path / "out")]
    for command, done in (
        ("capsule-id", run("check", str(CORPUS / name), cwd=CORPUS / name, name="capsule_id", env=strict)),
        ("fit-params", run(*words, cwd=CORPUS / name, env=strict)),
    ):
        assert done.returncode in (0, 2, 3), done.stderr
        allowed = (f"{command}: verdict not clean: ", str(CORPUS / name))
        assert [line for line in message(done.stderr).splitlines() if not line.startswith(allowed)] == []
