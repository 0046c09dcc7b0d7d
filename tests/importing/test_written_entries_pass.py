"""What `init --from` writes for a table of each kind in each format passes `check` once masses and units are stated."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from capsule_id import cli
from capsule_id.api import read_rig
from capsule_id.experiments.kind import default_registry
from tests.cli_tools import message
from tests.rig.formats.writers import Columns, csv_gz, hdf5, lvm, mat_5, npz, parquet_file, tdms, text_rows, txt, xlsx

DATA = Path(__file__).parents[2] / "data"
#: A table of the shipped twin for each kind, and one of the kinds without twin.
FILES = {
    "free_vibration": "free_vibration_1.csv",
    "static_friction": "static_friction.csv",
    "dynamic_friction": "dynamic_friction.csv",
    "motor_current": "motor_current.csv",
    "support_spring": "support_spring_stiff.csv",
    "forced_run": "run_1.csv",
}
OTHERS: Mapping[str, Columns] = {
    "sliding_friction": {"speed [m/s]": np.array([0.1, 0.2, 0.4]), "force [N]": np.array([3.1, 2.9, 2.7])},
    "transducer": {"reading [1]": np.array([10.0, 110.0, 212.0]), "force [N]": np.array([0.0, 1.0, 2.0])},
    "progression": {
        "period [ms]": np.array([40.0, 50.0, 60.0]),
        "periods [1]": np.array([100.0, 100.0, 100.0]),
        "distance [mm]": np.array([3.0, 8.0, 15.0]),
        "duty [1]": np.array([0.3, 0.3, 0.3]),
        "P_on [N]": np.array([8.0, 8.0, 8.0]),
    },
}
FORMATS: Mapping[str, Callable[[Columns], bytes]] = {
    "csv": lambda columns: (",".join(columns) + "\n" + text_rows(columns, ",")).encode(),
    "tsv": lambda columns: ("\t".join(columns) + "\n" + text_rows(columns, "\t")).encode(),
    "csv.gz": csv_gz,
    "txt": txt,
    "lvm": lvm,
    "tdms": tdms,
    "mat": mat_5,
    "h5": hdf5,
    "npz": npz,
    "xlsx": xlsx,
    "parquet": parquet_file,
}
#: Formats whose first channel is a time, and those whose names are identifiers, without units.
CLOCKED, BARE = ("lvm", "tdms"), ("mat",)
#: Each kind from one format in the core, from another one in full.
TIERS = {0: [], 5: pytest.mark.full}
CASES = [
    pytest.param(kind, suffix, marks=TIERS.get((j - k) % len(FORMATS), pytest.mark.slow))
    for k, kind in enumerate([*FILES, *OTHERS])
    for j, suffix in enumerate(FORMATS)
]


def columns_of(kind: str) -> Columns:
    """The table of a kind by header."""
    if kind in OTHERS:
        return OTHERS[kind]
    header, *rows = (DATA / FILES[kind]).read_text(encoding="utf-8").splitlines()
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows[:2000]])
    return dict(zip(header.split(","), values.T, strict=True))


def completed(text: str, units: Mapping[str, str]) -> str:
    """The masses stated, and each ``?`` filled with the unit of the column, or the frequency of the drive."""
    text = re.sub(r"^# (m[12] = )", r"\1", text, flags=re.MULTILINE)
    for name, unit in units.items():
        text = re.sub(rf'^(columns.{name} = .*unit = )"\?"', rf'\1"{unit}"', text, flags=re.MULTILINE)
    return text.replace('f = { value = "?"', "f = { value = 5.5")


def test_every_kind_has_a_table() -> None:
    assert {*FILES, *OTHERS} == set(default_registry())


@pytest.mark.parametrize(("kind", "suffix"), CASES)
def test_the_written_entry_passes_check(
    kind: str, suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: `start`, which a forced run has not, and a unit in SI where the file states none, which passed."""
    table = columns_of(kind)
    units = {header.split(" [")[0]: header.split("[")[1][:-1] for header in table}
    written = {name.split(" [")[0] if suffix in BARE else name: values for name, values in table.items()}
    if suffix in CLOCKED and "time [s]" not in table:
        written = {"time [s]": np.arange(float(len(next(iter(table.values()))))), **written}
    file = tmp_path / f"a.{suffix}"
    file.write_bytes(FORMATS[suffix](written))
    assert cli.capsule_id(["init", str(tmp_path / "rig"), "--from", str(file)]) == 0
    text = (tmp_path / "rig" / "rig.toml").read_text(encoding="utf-8")
    assert ('"?"' in text) == (suffix in BARE and any(unit != "1" for unit in units.values()))
    (tmp_path / "rig" / "rig.toml").write_text(completed(text, units), encoding="utf-8")
    capsys.readouterr()
    assert cli.capsule_id(["check", str(tmp_path / "rig")]) == 0, capsys.readouterr()
    (read,) = read_rig(tmp_path / "rig").tables
    assert read.kind == kind
    assert set(read.columns) == set(units)
    for name, values in table.items():
        found = read.columns[name.split(" [")[0]]
        np.testing.assert_allclose(found.values * found.to_display, values, rtol=1e-9, atol=2e-9)
        assert found.unit == name.split("[")[1][:-1]


def test_an_unfilled_unit_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Negative control: the same entry before its ``?`` are filled."""
    columns = {name.split(" [")[0]: values for name, values in columns_of("motor_current").items()}
    (tmp_path / "a.mat").write_bytes(mat_5(columns))
    assert cli.capsule_id(["init", str(tmp_path / "rig"), "--from", str(tmp_path / "a.mat")]) == 0
    capsys.readouterr()
    assert cli.capsule_id(["check", str(tmp_path / "rig")]) == 2
    assert "state the unit of the column, which the file does not say, '?', write a unit such as N" in message(
        capsys.readouterr().err
    )
