"""Rows selected by a text or a range of a column."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from capsule_id.api import read_rig
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.report.messages import finding_text, messages_of
from tests.rig.test_column_maps import BY_NAME, DISP, TIME, assert_read, fault_of, rig_of, rows


def test_where_selects_rows_by_a_text(tmp_path: Path) -> None:
    """Breakaway and constant pulls in one file, told apart by a letter (before: "write a number without quotes")."""
    both = [("B", "a day", DISP), ("C", "a day", 2.0 * DISP), ("B", "", 3.0 * DISP)]
    lines = [
        f"{float(t)!r},{letter},{float(x)!r},{day}\n"
        for letter, day, column in both
        for t, x in zip(TIME, column, strict=True)
    ]
    stated = f'file = "t.csv"\ndata_from_line = 2\n{BY_NAME}\nwhere = '
    files: dict[str, str | bytes] = {"t.csv": "t,kind,x,day\n" + "".join(lines)}
    for keys, factor, missing in (
        ('kind = "B", day = "a day"', 1.0, 12),
        ('2 = "C"', 2.0, 0),
        ('kind = "B", day = ""', 3.0, 0),
    ):
        (table,) = rig_of(tmp_path, files, f"{stated}{{ {keys} }}").tables
        np.testing.assert_allclose(table["x_rel"], 1e-3 * factor * DISP, rtol=1e-14)
        assert (len(table.rows), table.missing, table.other) == (12, missing, 24 - missing)
    fault = fault_of(tmp_path, {}, f'{stated}{{ kind = "D" }}')
    assert "column 'kind' holds 'B' 'C'" in fault.rule
    assert fault.value == "'D'"
    savemat(tmp_path / "m.mat", {"t": TIME, "x": DISP})
    fault = fault_of(tmp_path, {}, f'file = "m.mat"\n{BY_NAME}\nwhere = {{ x = "B" }}')
    assert "takes numbers" in fault.rule


def test_a_text_column_of_files_side_by_side_must_be_the_same(tmp_path: Path) -> None:
    """As a column of numbers must; before, that of the first file was taken."""
    kinds = ["B"] * 12 + ["C"] * 3
    x, t = np.append(DISP, DISP[:3]), np.append(TIME, TIME[:3])
    files: dict[str, str | bytes] = {
        "a.csv": "t,kind\n" + "".join(f"{float(a)!r},{kind}\n" for a, kind in zip(t, kinds, strict=True)),
        "b.csv": "x,kind\n" + "".join(f"{float(a)!r},{kind}\n" for a, kind in zip(x, kinds, strict=True)),
    }
    stated = f'files = ["a.csv", "b.csv"]\ndata_from_line = 2\n{BY_NAME}\nwhere = {{ kind = "B" }}'
    assert_read(rig_of(tmp_path, files, stated))
    files["b.csv"] = str(files["b.csv"]).replace("C", "B", 1)
    fault = fault_of(tmp_path, files, stated)
    assert "must be the same" in fault.rule
    assert fault.value == "'C' and 'B'"


@pytest.mark.parametrize(
    ("stated", "kept"),
    [
        ("min = 0.3, max = 1.0", slice(3, 11)),
        ("min = 0.3", slice(3, None)),
        ("max = 0.7", slice(0, 8)),
    ],
)
def test_where_selects_a_range(tmp_path: Path, stated: str, kept: slice) -> None:
    """Both ends count, and 0.1 + 0.2 is 0.3."""
    load = np.cumsum(np.append(0.0, np.full(11, 0.1)))
    files: dict[str, str | bytes] = {"t.csv": "load,t,x\n" + rows(",", columns=(load, TIME, DISP))}
    (table,) = rig_of(tmp_path, files, f'file = "t.csv"\nwhere = {{ load = {{ {stated} }} }}\n{BY_NAME}').tables
    np.testing.assert_allclose(table["x_rel"], 1e-3 * DISP[kept], rtol=1e-14)
    assert table.other == 12 - len(DISP[kept])


@pytest.mark.parametrize(
    ("stated", "rule", "remedy"),
    [
        ("{ }", "a range must have min or max", "min = 2"),
        ("{ min = 2, max = 1 }", "min must not exceed max", "exchange"),
        ("{ min = 2, most = 3 }", "most", "max"),
        ('{ min = "2" }', "min must be a finite number", "without quotes"),
        ("{ min = 5 }", "where must keep a row; column 'tau' holds 3 to 3", "widen the range"),
        ("{ min = 2, max = inf }", "max must be a finite number", "leave it out"),
        (f"{{ max = {10**400} }}", "max must be a finite number", "number without"),
    ],
)
def test_ranges_that_mean_nothing_are_refused(tmp_path: Path, stated: str, rule: str, remedy: str) -> None:
    text = "tau,t,x\n" + rows(",", columns=(np.full(12, 3.0), TIME, DISP))
    fault = fault_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\nwhere = {{ tau = {stated} }}\n{BY_NAME}')
    assert rule in f"{fault.rule} {fault.value}"
    assert remedy in fault.remedy
    assert_read(rig_of(tmp_path, {}, f'file = "t.csv"\nwhere = {{ tau = {{ min = 2, max = 4 }} }}\n{BY_NAME}'))


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6])
def test_times_since_1970_keep_their_digits(tmp_path: Path, unit: float) -> None:
    """Before: 1e-9 of such a time is 1.7 s, and rows at both ends of a range were taken too."""
    epoch = np.round(unit * (1.7e9 + 0.1 * np.arange(12)), 1)
    files: dict[str, str | bytes] = {"t.csv": "clock,t,x\n" + rows(",", columns=(epoch, TIME, DISP))}
    for stated, kept in (
        (f"{{ min = {float(epoch[1])!r}, max = {float(epoch[10])!r} }}", slice(1, 11)),
        (f"{{ min = {float(epoch[2])!r} }}", slice(2, None)),
    ):
        (table,) = rig_of(tmp_path, files, f'file = "t.csv"\nwhere = {{ clock = {stated} }}\n{BY_NAME}').tables
        np.testing.assert_allclose(table["x_rel"], 1e-3 * DISP[kept], rtol=1e-14)
    between = f"{float(epoch[3] - 0.04 * unit)!r}"
    fault = fault_of(tmp_path, {}, f'file = "t.csv"\nwhere = {{ clock = {between} }}\n{BY_NAME}')
    assert f"{epoch[0]:.15g} {epoch[1]:.15g}" in fault.rule
    beyond = f"{{ min = {float(epoch[-1] + unit)!r} }}"
    fault = fault_of(tmp_path, {}, f'file = "t.csv"\nwhere = {{ clock = {beyond} }}\n{BY_NAME}')
    assert f"{epoch[0]:.15g} to {epoch[-1]:.15g}" in fault.rule
    assert fault.value == f"{{'min': {float(epoch[-1] + unit)!r}}}"


def test_ranges_that_overlap_are_named_with_a_remedy_that_works(tmp_path: Path) -> None:
    """Before: "lines 6 to 10 repeat lines 6 to 10 ... Delete the repeated rows", which deletes the only copy."""
    force = np.round(1.0 + np.random.default_rng(0).uniform(size=12), 4)
    text = "load,force\n" + rows(",", columns=(np.arange(12.0), force))
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    head = '[rig]\nname = "t"\nm1 = { value = 1, sd = 0.01, unit = "kg" }\nm2 = { value = 1, sd = 0.01, unit = "kg" }\n'
    entry = '[[experiment]]\nkind = "static_friction"\nlabel = "%s"\nfile = "t.csv"\nwhere = { load = { %s } }\n'
    columns = 'columns = { force = { from = "force", unit = "N" } }\n'
    for second, named in (("min = 4", True), ("min = 7.5", False)):
        entries = (entry % ("low", "max = 7") + columns, entry % ("high", second) + columns)
        (tmp_path / "rig.toml").write_text(head + "".join(entries), encoding="utf-8")
        rig = read_rig(tmp_path)
        found = [f for f in lint(rig, default_registry(), rig.tables) if f.code == "readings.repeated"]
        assert bool(found) == named
        if named:
            said = finding_text(found[0], messages_of(default_registry()))
            assert "two experiments use lines 6 to 9" in said
            assert "Delete" not in said
