"""Exports of independent programs enter by one command, without an edit: kind, columns, units and readings are right."""

from pathlib import Path

import numpy as np
import pytest

from capsule_id import cli
from capsule_id.api import fit, read_rig
from capsule_id.experiments.kind import default_registry
from capsule_id.rig.units import factor_to_si
from tests.cli_tools import message
from tests.importing.published_exports import EXPORTS, K1, MASSES, SIGNALS, Written, X

KINDS = default_registry()
#: Rows of the table in the core, and those that are fitted.
CORE = {"versuch.tdms", "run.txt", "excel_us.csv", "monitor.txt", "pushes.txt"}
FITTED = {"run.txt", "stempel.tdms", "excel_us.csv", "decay.csv"}
CASES = [pytest.param(one, id=one.file, marks=[] if one.file in CORE else pytest.mark.full) for one in EXPORTS]


def entered(one: Written, folder: Path) -> None:
    """Enter the export by one command, without an edit, and compare what is read with what was written."""
    (folder / one.file).write_bytes(one.content)
    assert cli.capsule_id(["init", str(folder / "rig"), *MASSES, "--from", str(folder / one.file)]) == 0
    (read,) = read_rig(folder / "rig").tables
    assert read.kind == one.kind
    assert set(read.columns) == set(one.columns)
    for name, (values, unit, step) in one.columns.items():
        found, factor = read.columns[name].values, factor_to_si(unit, KINDS[one.kind].columns[name].si)
        shift = factor * values[0] - found[0] if name == "time" else 0.0
        np.testing.assert_allclose(found + shift, factor * values, rtol=0, atol=1.001 * factor * step + 1e-12)


def test_the_table_is_what_it_says() -> None:
    assert len(EXPORTS) >= 30
    assert sum(not one.own for one in EXPORTS) >= 10
    assert len({one.file for one in EXPORTS}) == len({one.source for one in EXPORTS}) == len(EXPORTS)
    assert {one.file for one in EXPORTS} >= CORE | FITTED


@pytest.mark.parametrize("one", CASES)
def test_an_export_enters_without_an_edit(one: Written, tmp_path: Path) -> None:
    entered(one, tmp_path)
    if one.file in FITTED:
        k1 = fit(tmp_path / "rig", budget=None)["k1"]
        assert abs(k1.value - K1) < 3.0 * k1.sd
        assert k1.sd < 5.0


@pytest.mark.parametrize(("source", "file", "text", "edits"), SIGNALS, ids=[row[1] for row in SIGNALS])
def test_a_signal_is_refused_until_its_sensitivity_is_stated(
    source: str,
    file: str,
    text: str,
    edits: tuple[tuple[str, str, str], ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The file cannot say how many mm a volt is; the entry is right but for that, and each remedy works when followed."""
    (tmp_path / file).write_text(text, encoding="utf-8")
    assert cli.capsule_id(["init", str(tmp_path / "rig"), *MASSES, "--from", str(tmp_path / file)]) == 0, source
    capsys.readouterr()
    toml = tmp_path / "rig" / "rig.toml"
    for said, old, new in edits:
        assert cli.capsule_id(["check", str(tmp_path / "rig")]) == 2
        assert said in message(capsys.readouterr().err)
        entry = toml.read_text(encoding="utf-8")
        assert old in entry
        toml.write_text(entry.replace(old, new), encoding="utf-8")
    (table,) = read_rig(tmp_path / "rig").tables
    np.testing.assert_allclose(table["x_rel"], 1e-3 * X, rtol=0, atol=4e-8)
    np.testing.assert_allclose(np.diff(table["time"]), 1e-3)
