"""What stands among readings and is none: rows of statistics, codes for a missing reading, readings in two units.

Before, all of it was read: a friction of 0.6234 ± 0.0091 from a table whose last rows were its mean and its sd.
"""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xlsxwriter

import capsule_id
from capsule_id import cli
from capsule_id.experiments.kind import default_registry
from capsule_id.importing import dimensions_of
from capsule_id.rig.guess import code_in, find_layout, is_statistic, statistics_below
from capsule_id.rig.model import Rig

ANGLES = np.array([31.5, 32.4, 30.9, 33.1, 31.8])
TRIALS = [f"{k + 1},{angle}" for k, angle in enumerate(ANGLES)]
HEAD = '[rig]\nname = "a"\nm1 = { value = 0.11, unit = "kg" }\nm2 = { value = 0.53, unit = "kg" }\n'
TILT = '[[experiment]]\nkind = "static_friction"\nfile = "t.csv"\n'
BY_NUMBER = 'columns = { angle = { from = 2, unit = "deg" } }'
LABELS = ["Mean", "SD", "Sum", "Average", "Mittelwert", "Stdev", "Summe", "Moyenne", "Standardabweichung", "Écart-type"]
LABELS += ["Promedio", "Media", "Avg:", "Std. Dev.", '"Mean value"', "standard deviation", "MAX"]
# Words below the numbers of the trials, whatever they are. Before: "Literature" was read as a trial.
LABELS += ["St. dev.", "Uncertainty", "Literature"]


def read(folder: Path, table: str, entry: str = TILT + BY_NUMBER) -> Rig:
    folder.mkdir(exist_ok=True)
    (folder / "t.csv").write_text(table, encoding="utf-8")
    (folder / "rig.toml").write_text(HEAD + entry, encoding="utf-8")
    return capsule_id.read_rig(folder)


def entered(folder: Path, file: Path) -> Rig:
    """The rig that ``init --from`` makes of a file, unedited."""
    assert (
        cli.capsule_id(["init", str(folder), "--m1", "110", "0.5", "g", "--m2", "530", "1", "g", "--from", str(file)])
        == 0
    )
    return capsule_id.read_rig(folder)


def angles_of(rig: Rig) -> np.ndarray:
    return np.degrees(rig.tables[0]["angle"])


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize("gap", ["", "\n"])
def test_labelled_statistics_are_refused_and_the_remedy_works(tmp_path: Path, label: str, gap: str) -> None:
    table = "\n".join(["Trial,Angle (deg)", *TRIALS]) + f"\n{gap}{label},31.9\n"
    with pytest.raises(capsule_id.InputError, match="a row of statistics must not be read as a trial") as caught:
        read(tmp_path, table)
    assert caught.value.line == 7 + len(gap)
    assert "state data_to_line = 6" in caught.value.remedy
    np.testing.assert_allclose(angles_of(read(tmp_path, table, f"{TILT}data_to_line = 6\n{BY_NUMBER}")), ANGLES)


def test_an_unknown_word_below_a_known_one_is_left_out_too(tmp_path: Path) -> None:
    """Before: no data_to_line, and a remedy that left the sd among the readings: mu was 11 % too small."""
    (tmp_path / "t.csv").write_text("\n".join(["Trial,Angle (deg)", *TRIALS, "Mean,31.9", "St. dev.,0.8", ""]))
    np.testing.assert_allclose(angles_of(entered(tmp_path / "a", tmp_path / "t.csv")), ANGLES)


def test_statistics_between_groups_are_refused(tmp_path: Path) -> None:
    rows = ["Trial,Angle (deg)", *TRIALS, "mean,31.94", *TRIALS]
    with pytest.raises(capsule_id.InputError, match=r"t\.csv:7:1: .*statistics.* 'mean', delete the row"):
        read(tmp_path, "\n".join(rows))
    del rows[6]
    assert len(angles_of(read(tmp_path, "\n".join(rows)))) == 10


@pytest.mark.parametrize(
    "tail", [["Mean,31.94", "SD,0.84"], ["", "Mittelwert,31.94"], [",31.94", ",0.84"], ["Sum,159.7"]]
)
@pytest.mark.parametrize("book", [False, True])
def test_init_leaves_statistics_out(tmp_path: Path, tail: list[str], book: bool) -> None:
    rows = ["Trial,Angle (deg)", *TRIALS, *tail]
    file = tmp_path / ("tilt.xlsx" if book else "tilt.csv")
    if book:
        with xlsxwriter.Workbook(file) as made:
            sheet = made.add_worksheet()
            for k, row in enumerate(rows):
                for column, cell in enumerate(row.split(",")):
                    sheet.write(k, column, float(cell) if re.fullmatch("[0-9.]+", cell) else cell)
    else:
        file.write_text("\n".join(rows), encoding="utf-8")
    np.testing.assert_allclose(angles_of(entered(tmp_path / "rig", file)), ANGLES)


def test_numbers_that_are_statistics_are_asked_about(tmp_path: Path) -> None:
    plain = "angle [deg]\n" + "".join(f"{angle}\n" for angle in ANGLES)
    (tmp_path / "plain").mkdir()
    with pytest.raises(capsule_id.InputError, match=r"t\.csv:7:1: .* statistics") as caught:
        read(tmp_path / "plain", plain + "31.94\n0.84\n", TILT)
    assert "data_to_line = 6, or data_to_line = 8 if these are readings, in the experiment with columns" in str(
        caught.value
    )
    columns = re.search(r"columns = \{.*\} \}", caught.value.remedy)
    assert columns is not None
    for last, count in ((6, 5), (8, 7)):
        entry = f"{TILT}data_to_line = {last}\n{columns[0]}"
        assert len(angles_of(read(tmp_path / "plain", plain + "31.94\n0.84\n", entry))) == count


def test_tables_of_means_and_selected_rows_are_read(tmp_path: Path) -> None:
    means = "Statistic,Angle (deg)\n" + "".join(f"mean,{angle}\n" for angle in ANGLES)
    assert len(angles_of(read(tmp_path, means))) == 5
    both = "Statistic,Angle (deg)\n" + "".join(f"mean,{angle}\nsd,0.{k}1\n" for k, angle in enumerate(ANGLES))
    where = f'{TILT}where = {{ Statistic = "mean" }}\n{BY_NUMBER}'
    np.testing.assert_allclose(angles_of(read(tmp_path, both, where)), ANGLES)


def test_extremes_that_are_remarks_are_read(tmp_path: Path) -> None:
    table = "Remark,Angle (deg)\n" + "".join(f"{'max' if k == 3 else ''},{angle}\n" for k, angle in enumerate(ANGLES))
    np.testing.assert_allclose(angles_of(read(tmp_path, table)), ANGLES)
    with pytest.raises(capsule_id.InputError, match="'Max', state data_to_line = 6"):
        read(tmp_path, "\n".join(["Trial,Angle (deg)", *TRIALS, "Max,33.1", "Mean,31.94", "Min,30.9"]))


@pytest.mark.parametrize("number", [1000, pytest.param(4000, marks=pytest.mark.full)])
def test_labels_and_numbers_of_statistics(number: int) -> None:
    assert not any(
        map(is_statistic, ["", "steel", "mean surface", "ok", "standard", "s", "n", "max. load reached", "3"])
    )
    rng = np.random.default_rng(5)
    tables = [rng.normal([0.6, 3.0], [0.02, 0.4], (8, 2)).round(3) for _ in range(number)]
    assert sum(statistics_below([*table.T]) > 0 for table in tables) == 0
    assert sum(statistics_below([table[:, 0]]) > 0 for table in tables) <= number / 2000
    loads = np.arange(1.0, 7.0)
    assert statistics_below([loads, 0.7 * loads]) == 0
    assert statistics_below([np.array([10.0, 20, 30, 20, 10]), np.array([1.0, 2, 3, 2, 1])]) == 0  # loaded and unloaded
    for below in ([np.mean], [np.mean, lambda c: np.std(c, ddof=1)], [np.sum]):
        rows = np.vstack([tables[0], *([one(column) for column in tables[0].T] for one in below)])
        assert statistics_below([*rows.T]) == len(below)


TIME = np.arange(400) / 1000.0
DECAY = 2500.0 * np.exp(-5.0 * TIME) * np.cos(90.0 * TIME)
DECAY_ENTRY = '[[experiment]]\nkind = "free_vibration"\nfile = "t.csv"\n'
BY_HEADER = 'columns = { time = { from = "Time (s)", unit = "s" }, x_rel = { from = 2, unit = "um" } }'


@pytest.mark.parametrize("code", ["-9999", "-99999", "9999.0", "1e30", "1E+38", "-9999.99", "32767"])
def test_codes_of_missing_readings_are_stated(tmp_path: Path, code: str) -> None:
    cells = [f"{x:.1f}" for x in DECAY]
    cells[250] = cells[251] = code
    table = "Time (s),Disp (um)\n" + "".join(f"{t:.3f},{x}\n" for t, x in zip(TIME, cells, strict=True))
    rule = "far from all others, which programs write for no reading"
    with pytest.raises(capsule_id.InputError, match=rf"t\.csv:252:7: .*{rule}.* in 2 rows") as caught:
        read(tmp_path, table, DECAY_ENTRY + BY_HEADER)
    stated = re.search(r'add ("[^"]+") to missing', caught.value.remedy)
    assert stated is not None
    (decay,) = read(tmp_path, table, f"{DECAY_ENTRY}missing = [{stated[1]}]\n{BY_HEADER}").tables
    assert (len(decay["x_rel"]), len(decay.lost)) == (398, 2)
    (tmp_path / "log.csv").write_text(table, encoding="utf-8")
    (decay,) = entered(tmp_path / "rig", tmp_path / "log.csv").tables
    assert (len(decay["x_rel"]), len(decay.lost)) == (398, 2)


def test_codes_of_arrays_and_plain_tables(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", time_s=TIME, x_um=np.where(np.arange(400) % 150 == 20, -9999.0, DECAY))
    assert len(entered(tmp_path / "rig", tmp_path / "a.npz").tables[0].lost) == 3
    table = "angle [deg]\n31.5\n32.4\n-999.00\n33.1\n-999.00\n"
    with pytest.raises(
        capsule_id.InputError, match=r't\.csv:4:1: .* add "-999" to missing = .* with columns = '
    ) as caught:
        read(tmp_path / "plain", table, TILT)
    columns = re.search(r"columns = \{.*\} \}", caught.value.remedy)
    assert columns is not None
    assert len(angles_of(read(tmp_path / "plain", table, f'{TILT}missing = ["-999"]\n{columns[0]}'))) == 3


@pytest.mark.parametrize(
    "values", [[1, 2, 5, 10, 99.9], [500, 999, 1200], [0, 999, 1999, 2998], [-999.0] * 5, [0.0, 99.0]]
)
def test_readings_that_look_like_codes(values: list[float]) -> None:
    assert code_in(np.array(values, float)) is None


def test_segments_of_a_labview_file_have_one_unit(tmp_path: Path) -> None:
    head = "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\n***End_of_Header***\n\n"
    part = "Channels\t1\nSamples\t3\nY_Unit_Label\t{}\nX0\t0\nDelta_X\t1\n***End_of_Header***\nX_Value\tLaser\n{}\n"
    rows = "".join(f"{k}\t{k % 2}\n" for k in range(60))
    for units in (["mm", "mm"], ["mm", ""]):
        (tmp_path / "a.lvm").write_text(head + "".join(part.format(unit, rows) for unit in units), encoding="utf-8")
        assert len(find_layout((tmp_path / "a.lvm").read_bytes(), tmp_path / "a.lvm", ["s", "m"]).export.lines) == 120
    content = (head + part.format("mm", rows) + part.format("um", rows)).encode()
    with pytest.raises(capsule_id.InputError, match=r"same units, not mm and um.*export a file of each segment"):
        find_layout(content, Path("a.lvm"), ["s", "m"])


def test_a_row_of_units_that_contradicts_the_headers_is_asked_about(tmp_path: Path) -> None:
    rows = "".join(f"{t:.3f},{x:.1f}\n" for t, x in zip(TIME, DECAY, strict=True))
    (tmp_path / "log.csv").write_text(f"Time (s),Disp (mm)\ns,um\n{rows}", encoding="utf-8")
    proposed = capsule_id.propose_entry(tmp_path / "log.csv")
    assert 'unit = "?" }  # unsure: the header says mm, the row of units um' in proposed
    assert 'time = { from = "Time (s)", unit = "s" }' in proposed


def test_marks_of_plain_tables_are_asked_about(tmp_path: Path) -> None:
    """Before: "1,000" of a table with headers `name [unit]` was 1, of any other table a question."""
    kraft = '[[experiment]]\nkind = "motor_current"\nfile = "t.csv"\n'
    table = "current [mA];force [N]\n500;1\n1,000;2\n1,500;3\n2,000;4\n2,500;5\n"
    with pytest.raises(capsule_id.InputError, match="whether a mark parts thousands or decimals") as caught:
        read(tmp_path, table, kraft)
    columns = re.search(r"columns = \{.*\} \}", caught.value.remedy)
    assert columns is not None
    (table_,) = read(tmp_path, table, f'{kraft}decimal = "."\n{columns[0]}').tables
    np.testing.assert_allclose(table_["current"], [0.5, 1.0, 1.5, 2.0, 2.5])


def test_a_plain_table_has_one_decimal_mark(tmp_path: Path) -> None:
    """A point beside commas of another column is a damaged cell, or parts thousands, which is asked about."""
    head, entry = "speed [m/s];distance [mm]\n0,1;12\n", '[[experiment]]\nkind = "dynamic_friction"\nfile = "t.csv"\n'
    for cell, rule in (("1.5", "a cell must be a number, '1.5'"), ("1.500", "whether a mark parts thousands")):
        with pytest.raises(capsule_id.InputError, match=rf"t\.csv:3:5: {rule}"):
            read(tmp_path, f"{head}0,2;{cell}\n", entry)
    (table,) = read(tmp_path, f"{head}0,2;1,5\n", entry).tables
    np.testing.assert_allclose(table["distance"], [0.012, 0.0015])


def test_rows_of_separators_alone_are_counted(tmp_path: Path) -> None:
    entry = '[[experiment]]\nkind = "dynamic_friction"\nfile = "t.csv"\n'
    (table,) = read(tmp_path, "speed [m/s],distance [mm]\n0.1,1\n,\n0.2,4\n,\n", entry).tables
    assert (len(table["speed"]), table.lost.tolist()) == (2, [3, 5])


def test_thousands_without_decimals_are_read(tmp_path: Path) -> None:
    """Before: IndexError, where all that shows the decimal mark is how the thousands are parted."""
    entry = '[[experiment]]\nkind = "motor_current"\nfile = "t.csv"\n'
    columns = 'columns = { current = { from = 1, unit = "uA" }, force = { from = 2, unit = "N" } }'
    table = "Strom (uA);Kraft (N)\n500.000;1\n1.000.000;2\n1.500.000;3\n"
    np.testing.assert_allclose(read(tmp_path, table, entry + columns).tables[0]["current"], [0.5, 1.0, 1.5])


@pytest.mark.parametrize("suffix", ["log", "asc"])
@pytest.mark.parametrize("unit", ["mils", "thou"])
def test_logs_in_mils_enter(tmp_path: Path, suffix: str, unit: str) -> None:
    rows = "".join(f"{t:.3f}\t{x / 25.4:.4f}\n" for t, x in zip(TIME, DECAY, strict=True))
    (tmp_path / f"a.{suffix}").write_text(f"Time (s)\tDisp ({unit})\n{rows}", encoding="utf-8")
    np.testing.assert_allclose(
        entered(tmp_path / "rig", tmp_path / f"a.{suffix}").tables[0]["x_rel"], 1e-6 * DECAY, atol=2e-9
    )


def test_a_layout_that_init_cannot_take_is_stated_by_hand(tmp_path: Path) -> None:
    """Before: "state data_from_line = 1", for which ``init --from`` has no option."""
    (tmp_path / "t.csv").write_text("Run 3\nA;B\nx;1,5 mm\ny;2 mm\n", encoding="utf-8")
    with pytest.raises(capsule_id.InputError, match="in the entry that you write: capsule-id init DIR"):
        capsule_id.propose_entry(tmp_path / "t.csv")


def test_no_table_of_the_repository_is_asked_about() -> None:
    for file in sorted((Path(__file__).parents[2] / "data").rglob("*.csv")):
        found = find_layout(file.read_bytes(), file, dimensions_of(default_registry()))
        assert found.layout.data_to_line is None, file
        assert "-999" not in found.layout.missing


def test_an_entry_can_be_extended_at_its_end(tmp_path: Path) -> None:
    """Before: ``reject`` below ``[experiment.columns]`` was a column of that table."""
    file = tmp_path / "tilt.csv"
    file.write_text(
        "\n".join(["Height (mm),Board (mm)", *(f"{h},1200" for h in (612, 598, 605, 620))]), encoding="utf-8"
    )
    with pytest.raises(capsule_id.InputError, match="length_is must say"):
        entered(tmp_path / "rig", file)
    toml = tmp_path / "rig" / "rig.toml"
    toml.write_text(toml.read_text(encoding="utf-8") + 'length_is = "base"\n', encoding="utf-8")
    assert tomllib.loads(toml.read_text(encoding="utf-8"))["experiment"][0]["length_is"] == "base"
    assert capsule_id.read_rig(tmp_path / "rig").tables[0].settings.length_is == "base"
