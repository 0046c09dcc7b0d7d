"""Rows selected by a text of a column."""

from pathlib import Path

import numpy as np
from scipy.io import savemat

from tests.rig.test_column_maps import BY_NAME, DISP, TIME, assert_read, fault_of, rig_of


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
