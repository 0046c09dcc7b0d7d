"""One column with decimal commas, and two columns of whole numbers, look the same without a header."""

import re
from pathlib import Path

import numpy as np

from tests.rig.test_column_maps import DISP, TIME, assert_read, fault_of, rig_of, rows


def test_a_decimal_comma_in_a_single_column_must_be_stated(tmp_path: Path) -> None:
    text = rows("", ",", (DISP,))
    assert "," in text
    rate = 'time = { rate = { value = 100, unit = "Hz" } }'
    lines = f'file = "x.txt"\ncolumns = {{ {rate}, x_rel = {{ from = 1, unit = "mm" }} }}'
    fault = fault_of(tmp_path, {"x.txt": text}, lines)
    assert (fault.file, fault.line) == (str(tmp_path / "x.txt"), 1)
    assert "comma between digits" in fault.rule
    (stated,) = re.findall(r'decimal = ","', fault.remedy)
    for head in ("", "Disp\n"):
        assert_read(rig_of(tmp_path, {"x.txt": head + text}, f"{lines}\n{stated}"))
    whole = "".join(f"{i},{i * i}\n" for i in range(12))  # two columns of whole numbers
    lines = 'file = "x.txt"\ncolumns = { time = { from = 1, unit = "s" }, x_rel = { from = 2, unit = "mm" } }'
    assert "comma between digits" in fault_of(tmp_path, {"x.txt": whole}, lines).rule
    (table,) = rig_of(tmp_path, {}, f'{lines}\ndecimal = "."').tables
    np.testing.assert_allclose(table["x_rel"], 1e-3 * np.arange(12.0) ** 2)
    # Times and counts in many rows are no decimal numbers.
    many = "".join(f"{20 * i},{i * i}\n" for i in range(60))
    (table,) = rig_of(tmp_path, {"x.txt": many}, lines).tables
    np.testing.assert_allclose(table["time"], 20.0 * np.arange(60))


MAP_BY_NUMBER = 'columns = { time = { from = 1, unit = "s" }, x_rel = { from = 2, unit = "mm" } }'


def test_quoted_decimal_commas_are_not_cut_in_two(tmp_path: Path) -> None:
    """Cut at the comma, the second column would be the decimals of the first; the remedy gives the right numbers."""
    cells = [(f"{t:.2f}".replace(".", ","), f"{x:.4f}".replace(".", ",")) for t, x in zip(TIME, DISP, strict=True)]
    quoted = "".join(f'"{t}","{x}"\n' for t, x in cells)
    lines = f'file = "x.csv"\n{MAP_BY_NUMBER}'
    fault = fault_of(tmp_path, {"x.csv": quoted}, lines)
    assert (fault.file, fault.line) == (str(tmp_path / "x.csv"), 1)
    assert "quotation marks" in fault.rule
    assert "semicolons" in fault.remedy
    assert_read(rig_of(tmp_path, {"x.csv": "".join(f'"{t}";"{x}"\n' for t, x in cells)}, lines))


def test_a_hard_space_separates_nothing(tmp_path: Path) -> None:
    """A number with a thousands space is refused and never two numbers."""
    text = "".join(f"{i}\u00a0234,5 {i}\n" for i in range(1, 13))
    fault = fault_of(tmp_path, {"x.txt": text}, f'file = "x.txt"\n{MAP_BY_NUMBER}')
    assert "rows of numbers" in fault.rule
