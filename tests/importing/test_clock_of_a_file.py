"""The clock of a logger: estimated by the command, stated in rig.toml, applied to times alone."""

import re
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id import cli
from capsule_id.errors import InputError

OFFSET, DRIFT = -0.75, 40e-6
TIME, OTHER = np.arange(0.0, 8.0, 2e-3), np.arange(0.0, 9.0, 5e-3)
ENTRY = '[[experiment]]\nkind = "free_vibration"\nfile = "b.csv"\n'
HEAD = '[rig]\nname = "clocks"\nm1 = { value = 0.1, sd = 0.001, unit = "kg" }\n'


def signal(t: np.ndarray) -> np.ndarray:
    return np.exp(-0.3 * t) * np.cos(30.0 * t + 3.0 * np.sin(0.7 * t))


def files(folder: Path) -> tuple[Path, Path]:
    """The same signal by two loggers."""
    rng = np.random.default_rng(1)
    for name, time, values in (("a", TIME, signal(TIME)), ("b", OTHER, signal(OFFSET + (1.0 + DRIFT) * OTHER))):
        noisy = values + 0.002 * rng.standard_normal(len(time))
        rows = "".join(f"{t:.6f},{x:.6f}\n" for t, x in zip(time, noisy, strict=True))
        (folder / f"{name}.csv").write_text(f"time [s],x_rel [mm]\n{rows}", encoding="utf-8")
    return folder / "a.csv", folder / "b.csv"


def test_the_estimated_line_puts_the_times_on_one_clock(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = files(tmp_path)
    assert cli.capsule_id(["import", str(b), "--clock-of", str(a), "--common", "x_rel [mm]"]) == 0
    line = capsys.readouterr().out.strip()
    found = re.search(r"value = (\S+), sd = (\S+), .* value = (\S+), sd = (\S+), ", line)
    assert found is not None, line
    offset, offset_sd, drift, drift_sd = map(float, found.groups())
    assert abs(offset - OFFSET) < 4 * offset_sd < 1e-3
    assert abs(1e-6 * drift - DRIFT) < 4e-6 * drift_sd < 1e-3
    readings = {}
    for own in ("", line):
        (tmp_path / "rig.toml").write_text(f"{HEAD}{ENTRY}{own}\n", encoding="utf-8")
        (table,) = capsule_id.read_rig(tmp_path).tables
        np.testing.assert_allclose(table["time"], offset + (1.0 + 1e-6 * drift) * OTHER if own else OTHER, atol=1e-9)
        stated = (1e-6 * drift, 1e-6 * drift_sd) if own else (0.0, 0.0)
        assert (table.drift.value, table.drift.sd) == pytest.approx(stated)
        readings[own] = table["x_rel"]
    np.testing.assert_array_equal(readings[""], readings[line])  # no reading is interpolated


@pytest.mark.parametrize(
    ("clock", "rule"),
    [
        ('{ drift = { value = 20, sd = 200000, unit = "ppm" } }', "sd of drift must lie between"),
        ('{ drift = { value = 20, sd = -1, unit = "ppm" } }', "sd of drift must be 0 or greater"),
        ("{}", "must have an offset or a drift"),
        ('{ drift = { value = 20, unit = "1" } }', "drift must lie between"),
        ('{ offset = { value = 1e20, unit = "s" } }', "offset must lie between"),
        ('{ offset = { value = 20, unit = "ppm" } }', "dimension of s"),
        ('{ shift = { value = 20, unit = "s" } }', "unknown key"),
    ],
)
def test_faults_of_a_clock(tmp_path: Path, clock: str, rule: str) -> None:
    files(tmp_path)
    (tmp_path / "rig.toml").write_text(f"{HEAD}{ENTRY}clock = {clock}\n", encoding="utf-8")
    with pytest.raises(InputError, match=rule):
        capsule_id.read_rig(tmp_path)


def test_files_without_a_common_signal_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = files(tmp_path)
    for words, part in (
        (["--clock-of", str(a), "--common", "trigger"], "must have the column trigger"),
        (["--clock-of", str(a)], "must stand together"),
        (["--clock-of", str(b), "--common", "x_rel [mm]"], "name another file"),
    ):
        assert cli.capsule_id(["import", str(b), *words]) == 2
        assert part in capsys.readouterr().err
