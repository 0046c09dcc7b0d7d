"""One column with decimal commas, and two columns of whole numbers, look the same without a header."""

import re
from pathlib import Path

import numpy as np
import pytest

from capsule_id.importing import propose_entry
from capsule_id.rig.formats import raw
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
    """Cut at the comma, the second column would be the decimals of the first."""
    cells = [(f"{t:.2f}".replace(".", ","), f"{x:.4f}".replace(".", ",")) for t, x in zip(TIME, DISP, strict=True)]
    lines = f'file = "x.csv"\n{MAP_BY_NUMBER}'
    for mark in ",;":
        assert_read(rig_of(tmp_path, {"x.csv": "".join(f'"{t}"{mark}"{x}"\n' for t, x in cells)}, lines))


def test_quoted_commas_that_may_separate_thousands_are_refused(tmp_path: Path) -> None:
    """Nothing says whether "1,234" is 1234 or 1.234; one cell with both marks does."""
    lines = f'file = "x.csv"\n{MAP_BY_NUMBER}'
    ambiguous = "".join(f'"{i},234","{i},5{i:02}"\n' for i in range(1, 13))
    fault = fault_of(tmp_path, {"x.csv": ambiguous}, lines)
    assert (fault.file, fault.line) == (str(tmp_path / "x.csv"), 1)
    assert "quotation marks" in fault.rule
    assert "semicolons" in fault.remedy
    (table,) = rig_of(tmp_path, {"x.csv": ambiguous + '"13,000","1,234.5"\n'}, lines).tables
    np.testing.assert_allclose(table["time"][[0, -1]], [1234.0, 13000.0])
    np.testing.assert_allclose(table["x_rel"][[0, -1]], [1.501, 1.2345])
    mixed = ambiguous + '"13,5","1,234.5"\n'
    assert "quotation marks" in fault_of(tmp_path, {"x.csv": mixed}, lines).rule


@pytest.mark.parametrize("mark", ["\u00a0", "\u202f", "'", "\u2019"])
def test_a_hard_space_or_an_apostrophe_separates_thousands(tmp_path: Path, mark: str) -> None:
    text = "".join(f"{i}{mark}234,5 {i}\n" for i in range(1, 13))
    (table,) = rig_of(tmp_path, {"x.txt": text}, f'file = "x.txt"\n{MAP_BY_NUMBER}').tables
    np.testing.assert_allclose(table["time"], 1000.0 * np.arange(1, 13) + 234.5)


def test_points_or_commas_separate_thousands_where_a_cell_shows_it(tmp_path: Path) -> None:
    """Negative control: a column with both marks that shows nothing is refused, and a lone 1.234 is what it was."""
    lines = f'file = "x.csv"\n{MAP_BY_NUMBER}'

    def text(*cells: str) -> dict[str, str | bytes]:
        return {"x.csv": "".join(f"{k},5;{cell}\n" for k, cell in enumerate((*cells, *["7"] * 8)))}

    (table,) = rig_of(tmp_path, text("999,5", "1.000", "1.001,5"), lines).tables
    np.testing.assert_allclose(table["x_rel"][:3], [0.9995, 1.0, 1.0015])
    alone = {"x.csv": "".join(f"{k};{1 + k / 100:.3f}\n" for k in range(12))}
    (table,) = rig_of(tmp_path, alone, lines).tables
    np.testing.assert_allclose(table["x_rel"][:2], [1e-3, 1.01e-3])
    for cells in (("0.5", "1,234"), ("999,5", "1.234"), ("1,5", "1,234.5,6")):
        assert "must be a number" in fault_of(tmp_path, text(*cells), lines).rule
    # Whole numbers stand among many of three decimals.
    text = "".join(f"{k};{985 + k:,}\n" for k in range(60))
    (table,) = rig_of(tmp_path, {"x.csv": text}, lines).tables
    assert 0.98 < table["x_rel"].min() <= table["x_rel"].max() < 1.06


@pytest.mark.parametrize(("decimal", "other"), [(",", "."), (".", ",")])
def test_a_lone_mark_before_three_digits_is_ambiguous(tmp_path: Path, decimal: str, other: str) -> None:
    """Before: the decimal mark of another column made 1.234 a thousand, and nothing said so."""
    file = {"x.csv": "".join(f"{k / 8:.3f};1{other}{k:03}\n".replace(".", decimal, 1) for k in range(30))}
    lines = f'file = "x.csv"\n{MAP_BY_NUMBER}'
    fault = fault_of(tmp_path, file, lines)
    assert (fault.line, fault.column, fault.value) == (1, 7, f"'1{other}000'")
    (stated,) = re.findall('decimal = "[.,]"', fault.remedy)
    assert stated == f'decimal = "{decimal}"'
    (table,) = rig_of(tmp_path, {}, f"{lines}\n{stated}").tables
    np.testing.assert_allclose(table["x_rel"][:2], [1.0, 1.001])
    content = (f"Zeit (s);Weg (mm)\n{file['x.csv']}").encode()
    (tmp_path / "y.csv").write_bytes(content)
    assert f"'Weg (mm)' is not read: line 2 has '1{other}000'. State {stated}" in propose_entry(tmp_path / "y.csv")


@pytest.mark.parametrize(("decimal", "other"), [(",", "."), (".", ",")])
def test_whole_numbers_above_all_decimals_show_thousands(tmp_path: Path, decimal: str, other: str) -> None:
    """Before: 2.501 beside -930 in one column was 2.501, and nothing said so. Control: 42.501 beside 42 is a decimal."""
    lines = f'file = "x.txt"\n{MAP_BY_NUMBER}'
    whole = np.round(2500 * np.cos(0.2 * np.arange(200)))
    text = "".join(f"{k}\t{x:,.0f}\n".replace(",", other) for k, x in enumerate(whole))
    (table,) = rig_of(tmp_path, {"x.txt": text}, lines).tables
    np.testing.assert_allclose(table["x_rel"], 1e-3 * whole)
    few = "".join(f"{x:,}\t{k}\n".replace(",", other) for k, x in enumerate(range(500, 6500, 500)))
    fault = fault_of(tmp_path, {"x.txt": few}, lines)
    assert (fault.line, fault.value) == (2, f"'1{other}000'")
    for stated, time in zip(re.findall('decimal = "[.,]"', fault.remedy), (1000.0, 1.0), strict=True):
        (table,) = rig_of(tmp_path, {"x.txt": few.replace("500\t0\n", "")}, f"{lines}\n{stated}").tables
        assert table["time"][0] == pytest.approx(time)
    plain = "".join(f"{k}\t{42501 - 7 * k:,}\n".replace(",", decimal) for k in range(60))
    (table,) = rig_of(tmp_path, {"x.txt": f"{plain}60\t42\n"}, lines).tables
    np.testing.assert_allclose(table["x_rel"][[0, -1]], [0.042501, 0.042])


def test_an_ambiguous_column_is_named_where_later_blocks_show_no_mark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: an internal failure at the first block of whole numbers."""
    monkeypatch.setattr(raw, "BLOCK", 300)
    text = "".join(f"{k / 8:.3f};{f'1.{k:03}' if k < 60 else '1'}\n".replace(".", ",", 1) for k in range(200))
    fault = fault_of(tmp_path, {"x.csv": text}, f'file = "x.csv"\n{MAP_BY_NUMBER}')
    assert (fault.line, fault.value) == (1, "'1.000'")


def test_the_points_of_a_date_are_no_decimal_marks(tmp_path: Path) -> None:
    """Before: beside such stamps 1,234 was a thousand."""
    text = "".join(f"01.03.2024 12:34:{k:02},5;1,{k:03}\n" for k in range(30))
    mapped = 'columns = { time = { from = 1, unit = "stamp" }, x_rel = { from = 2, unit = "mm" } }'
    (table,) = rig_of(tmp_path, {"x.csv": text}, f'file = "x.csv"\n{mapped}').tables
    np.testing.assert_allclose(table["x_rel"][:2], [1e-3, 1.001e-3])


def test_an_arrow_is_a_tab_behind_a_time_stamp_alone(tmp_path: Path) -> None:
    """Before: the arrow of any header or note parted a cell in two."""
    text = "".join(f"{t};{x};a -> b\n" for t, x in zip(TIME, DISP, strict=True))
    columns = 'columns = { time = { from = "t", unit = "s" }, x_rel = { from = "x -> y", unit = "mm" } }'
    assert_read(rig_of(tmp_path, {"x.csv": f"t;x -> y;note\n{text}"}, f'file = "x.csv"\n{columns}'))
