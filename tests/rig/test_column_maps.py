"""Column maps: exports of any layout are read as they are, and every remedy of an error works when followed."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from capsule_id import cli
from capsule_id.api import read_rig
from capsule_id.errors import FolderError, InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.rig.model import Rig
from tests.cli_tools import message
from tests.rig.faults import MARK, assert_fault, place_of

TIME = np.arange(12) * 0.01
DISP = np.round(3.0 * np.exp(-2.0 * TIME) * np.cos(60.0 * TIME), 4)  # mm
MAP = 'columns = { time = { from = "Time (s)", unit = "s" }, x_rel = { from = "Disp (mm)", unit = "mm" } }'


def rig_toml(*experiments: str) -> str:
    """A rig of free vibrations with these lines."""
    head = '[rig]\nname = "maps"\nm1 = { value = 0.1, sd = 0.001, unit = "kg" }\n'
    return head + "".join(f'\n[[experiment]]\nkind = "free_vibration"\n{lines}\n' for lines in experiments)


def rig_of(folder: Path, files: dict[str, str | bytes], *experiments: str) -> Rig:
    """Write a folder and read it."""
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "rig.toml").write_text(rig_toml(*experiments), encoding="utf-8")
    return read_rig(folder)


def rows(separator: str, decimal: str = ".", columns: tuple[np.ndarray, ...] = (TIME, DISP)) -> str:
    """The columns as text."""
    return "".join(
        separator.join(repr(float(x)).replace(".", decimal) for x in row) + "\n" for row in np.column_stack(columns)
    )


def assert_read(rig: Rig) -> None:
    (table,) = rig.tables
    np.testing.assert_allclose(table["time"], TIME, rtol=1e-14)
    np.testing.assert_allclose(table["x_rel"], 1e-3 * DISP, rtol=1e-14)


def fault_of(folder: Path, files: dict[str, str | bytes], *experiments: str) -> InputError:
    with pytest.raises(InputError) as caught:
        rig_of(folder, files, *experiments)
    return caught.value


LAB = "Time (s),Disp (mm)\n" + rows(",")


def test_the_proposed_line_reads_the_file(tmp_path: Path) -> None:
    fault = fault_of(tmp_path, {"lab.csv": LAB}, 'file = "lab.csv"')
    assert (fault.line, fault.column) == (1, 1)
    (proposed,) = re.findall(r"columns = \{.*\} \}", fault.remedy)
    assert proposed == MAP
    assert_read(rig_of(tmp_path, {}, f'file = "lab.csv"\n{proposed}'))


def test_the_command_reads_a_raw_export_by_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig_of(tmp_path, {"lab.csv": LAB}, f'file = "lab.csv"\n{MAP}')
    assert cli.capsule_id(["check", str(tmp_path)]) == 0
    assert "free_vibration lab: 12 rows of time [s], x_rel [mm], 100 Hz" in capsys.readouterr().out


def test_an_unknown_column_proposes_a_map(tmp_path: Path) -> None:
    text = "time [s],temperature [K],x_rel [mm]\n" + rows(",", columns=(TIME, 300.0 + TIME, DISP))
    # K is no unit of a rig folder; the map leaves this column out.
    fault = fault_of(tmp_path, {"t.csv": text}, 'file = "t.csv"')
    assert (fault.line, fault.column) == (1, 10)
    (proposed,) = re.findall(r"columns = \{.*\} \}", fault.remedy)
    assert_read(rig_of(tmp_path, {}, f'file = "t.csv"\n{proposed}'))


def test_files_in_another_order_than_time_are_named(tmp_path: Path) -> None:
    text = LAB.splitlines(keepends=True)
    files: dict[str, str | bytes] = {"a.csv": "".join(text[:7]), "b.csv": text[0] + "".join(text[7:])}
    fault = fault_of(tmp_path, files, f'files = ["b.csv", "a.csv"]\n{MAP}')
    assert str(fault).startswith(f"{tmp_path}/a.csv:2:1: ")
    assert fault.remedy == "name the files in the order of time, or make an experiment of each"
    assert_read(rig_of(tmp_path, {}, f'files = ["a.csv", "b.csv"]\n{MAP}'))
    # Within one file the rows are at fault.
    fault = fault_of(tmp_path, {"c.csv": "".join([*text, text[3]])}, f'file = "c.csv"\n{MAP}')
    assert fault.remedy == "delete the repeated rows: line 14"


def test_a_reading_in_volts_needs_a_scale(tmp_path: Path) -> None:
    volts = "Time (s),Disp (V)\n" + LAB.split("\n", 1)[1]
    wrong = 'columns = { time = { from = "Time (s)", unit = "s" }, x_rel = { from = "Disp (V)", unit = "V" } }'
    fault = fault_of(tmp_path, {"lab.csv": volts}, f'file = "lab.csv"\n{wrong}')
    assert fault.rule == "a reading in V needs the sensitivity of its sensor"
    assert "scale = ..." in fault.remedy
    scaled = wrong.replace('unit = "V"', 'unit = "mm", scale = 1.0')
    assert_read(rig_of(tmp_path, {}, f'file = "lab.csv"\n{scaled}'))


EXTRA = np.round(7.0 - TIME, 3)
BY_NUMBER = 'columns = { time = { from = 1, unit = "s" }, x_rel = { from = 3, unit = "mm" } }'
BY_NAME = 'columns = { time = { from = "t", unit = "s" }, x_rel = { from = "x", unit = "mm" } }'
THREE = (TIME, EXTRA, DISP)
LAYOUTS = {
    "semicolons, decimal commas, a row of units": ("t;T;x\ns;K;mm\n" + rows(";", ",", THREE), BY_NAME),
    "tabs and decimal commas": ("t\tT\tx\n" + rows("\t", ",", THREE), BY_NAME),
    "spaces": ("t   T   x\n" + rows("   ", ".", THREE), BY_NAME),
    "spaces, headers of several words": ("a clock   T (K)   x (mm)\n" + rows("   ", ".", THREE), BY_NUMBER),
    "spaces and decimal commas": (rows("  ", ",", THREE), BY_NUMBER),
    "no header": (rows(",", ".", THREE), BY_NUMBER),
    "a comma and a space": ("t, T, x\n" + rows(", ", ".", THREE), BY_NAME),
    "rows of separators alone": ("t;T;x\n;;\n" + rows(";", ".", THREE).replace("\n", "\n;;\n", 3) + ";;\n", BY_NAME),
    "a separator at the end": ("t;T;x;\n" + rows(";", ".", THREE).replace("\n", ";\n"), BY_NAME),
    "a header in a comment, comments between": (
        "# t T x\n" + rows(" ", ".", THREE).replace("\n", "\n# a\n\n", 3),
        BY_NAME,
    ),
    "quoted headers": ('"t","T","x"\n' + rows(",", ".", THREE), BY_NAME),
    "titles with numbers": ("Run 7\nDate;1.2.2024\nt;T;x\n" + rows(";", ".", THREE), f"data_from_line = 4\n{BY_NAME}"),
    "a text column": ("t;T;x\n" + re.sub(r";.*;", ";ok;", rows(";", ".", THREE)), f"data_from_line = 2\n{BY_NAME}"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_layouts(tmp_path: Path, layout: str, ending: str) -> None:
    text, lines = LAYOUTS[layout]
    assert_read(rig_of(tmp_path, {"t.txt": text.replace("\n", ending)}, f'file = "t.txt"\n{lines}'))


def test_combined_columns_and_a_stated_rate(tmp_path: Path) -> None:
    text = "A,B\n" + rows(",", columns=(DISP, EXTRA))
    source = '{ from = "A", minus = "B", unit = "mm", scale = -2, offset = 0.2 }'
    lines = f'file = "t.csv"\ncolumns = {{ time = {{ rate = {{ value = 0.1, unit = "kHz" }} }}, x_rel = {source} }}'
    (table,) = rig_of(tmp_path, {"t.csv": text}, lines).tables
    np.testing.assert_allclose(table["time"], TIME, rtol=1e-14)
    np.testing.assert_allclose(table["x_rel"], 1e-3 * (-2.0 * (DISP - EXTRA) + 0.2), rtol=1e-12)


def test_rows_with_a_missing_reading_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Texts of other kinds are errors until `missing` lists them; before, so were empty cells."""
    lines = LAB.split("\n")
    lines[4], lines[7] = f"{TIME[3]:.2f},over", f"{TIME[6]:.2f},"
    files: dict[str, str | bytes] = {"t.csv": "\n".join(lines)}
    fault = fault_of(tmp_path, files, f'file = "t.csv"\n{MAP}')
    assert (fault.line, fault.column) == (5, lines[4].index("over") + 1)
    assert '"over"' in fault.remedy
    rig = rig_of(tmp_path, files, f'file = "t.csv"\nmissing = ["over"]\n{MAP}')
    (table,) = rig.tables
    assert (len(table.rows), table.missing) == (10, 2)
    np.testing.assert_array_equal(table.rows, np.delete(np.arange(2, 14), [3, 6]))
    kinds = default_registry()
    (found,) = [finding for finding in lint(rig, kinds, rig.tables) if finding.code == "readings.missing"]
    assert (found.level, found.facts["rows"], found.facts["used"]) == ("warn", 2, 10)
    assert cli.capsule_id(["check", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "(2 rows with a missing reading not used)" in out
    assert "the fit drops 2 rows with a missing reading and uses 10" in out


def test_a_missing_reading_keeps_the_times_of_a_stated_rate(tmp_path: Path) -> None:
    text = "x\n" + "".join("--\n" if i == 3 else f"{x!r}\n" for i, x in enumerate(DISP.tolist()))
    rate = 'time = { rate = { value = 100, unit = "Hz" } }'
    lines = f'file = "t.csv"\ncolumns = {{ {rate}, x_rel = {{ from = "x", unit = "mm" }} }}'
    (table,) = rig_of(tmp_path, {"t.csv": text}, lines).tables
    np.testing.assert_allclose(table["time"], np.delete(TIME, 3), rtol=1e-14)


RATE_MAP = 'columns = { time = { rate = { value = 100, unit = "Hz" } }, x_rel = { from = "x", unit = "mm" } }'


def test_a_rate_does_not_close_up_a_lost_row(tmp_path: Path) -> None:
    """Before: every sample behind a blank line was moved, without a word."""
    text = "x\n" + "".join("\n" if i == 3 else f"{x!r}\n" for i, x in enumerate(DISP.tolist()))
    fault = fault_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\n{RATE_MAP}')
    assert (fault.file, fault.line) == (str(tmp_path / "t.csv"), 5)
    mended = text.replace("\n\n", "\nNaN\n")
    (table,) = rig_of(tmp_path, {"t.csv": mended}, f'file = "t.csv"\n{RATE_MAP}').tables
    np.testing.assert_allclose(table["time"], np.delete(TIME, 3), rtol=1e-14)


@pytest.mark.parametrize("lines", ["where = { tau = 1 }", "where = { tau = 2 }", 'split_by = "tau"'])
def test_a_blank_line_between_parts_is_no_lost_row(tmp_path: Path, lines: str) -> None:
    parts = ["".join(f"{name},{x!r}\n" for x in DISP.tolist()) for name in ("ab" if "split" in lines else "12")]
    rig = rig_of(tmp_path, {"t.csv": "tau,x\n" + "\n".join(parts)}, f'file = "t.csv"\n{lines}\n{RATE_MAP}')
    for table in rig.tables:
        np.testing.assert_allclose(table["time"] - table["time"][0], TIME, atol=1e-12)


@pytest.mark.parametrize("between", ["\n\n", "\n# a remark\n"])
def test_blank_lines_between_all_rows_and_remarks_are_no_lost_rows(tmp_path: Path, between: str) -> None:
    text = "x\n" + between.join(repr(x) for x in DISP.tolist()) + "\n"
    (table,) = rig_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\n{RATE_MAP}').tables
    np.testing.assert_allclose(table["time"], TIME, rtol=1e-14)


def test_a_rate_does_not_join_files(tmp_path: Path) -> None:
    """Before: two runs were one continuous record."""
    files: dict[str, str | bytes] = dict.fromkeys(
        ("a.csv", "b.csv"), "x\n" + "".join(f"{x!r}\n" for x in DISP.tolist())
    )
    fault = fault_of(tmp_path, files, f'files = ["a.csv", "b.csv"]\n{RATE_MAP}')
    assert "a rate gives the times of one file" in fault.rule


def test_a_file_of_which_no_column_is_mapped_is_refused(tmp_path: Path) -> None:
    """Before: a second file whose header differed in one letter was dropped without a word."""
    files: dict[str, str | bytes] = {"a.csv": LAB, "b.csv": LAB.replace("Disp", "disp")}
    files["b.csv"] = str(files["b.csv"]).replace("Time", "time")
    fault = fault_of(tmp_path, files, f'files = ["a.csv", "b.csv"]\n{MAP}')
    assert fault.value == "b.csv"
    assert "side by side" in fault.rule


@pytest.mark.parametrize("cell", ["20%", "\u22120.5"])
def test_signs_of_per_cent_and_of_minus(tmp_path: Path, cell: str) -> None:
    """Before: the remedy for both was to drop the row."""
    text = LAB + f"0.5,{cell}\n"
    if "%" in cell:
        fault = fault_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\n{MAP}')
        assert "remove the signs of per cent" in fault.remedy
        return
    (table,) = rig_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\n{MAP}').tables
    assert table["x_rel"][-1] == -0.5e-3


def test_names_of_files_with_one_stem(tmp_path: Path) -> None:
    """Before: what ``init --from run.csv run.txt`` wrote was refused."""
    files: dict[str, str | bytes] = {"run.csv": LAB, "run.txt": LAB.replace("3.0", "3.1")}
    rig = rig_of(tmp_path, files, *(f'file = "{name}"\n{MAP}' for name in files))
    assert [table.label for table in rig.tables] == ["run.csv", "run.txt"]


def test_where_selects_rows_by_header_or_number(tmp_path: Path) -> None:
    both = [(30, DISP), (40, 2.0 * DISP)]
    text = "tau,t,x\n" + "".join(rows(",", columns=(np.full(12, tau), TIME, x)) for tau, x in both)
    for key, factor in (("tau = 30", 1.0), ("1 = 40", 2.0)):
        (table,) = rig_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\nwhere = {{ {key} }}\n{BY_NAME}').tables
        np.testing.assert_allclose(table["x_rel"], 1e-3 * factor * DISP, rtol=1e-14)
        assert table.other == 12
    # Two settings of one file are different readings; one setting read twice is reported.
    settings = [
        f'file = "t.csv"\nlabel = "{label}"\nwhere = {{ tau = {tau} }}\n{BY_NAME}'
        for label, tau in (("a", 30), ("b", 40))
    ]
    kinds = default_registry()
    for texts, repeated in ((settings, 0), ([settings[0], settings[1].replace("40", "30")], 1)):
        rig = rig_of(tmp_path, {}, *texts)
        found = [finding for finding in lint(rig, kinds, rig.tables) if finding.code.startswith("readings.repeated")]
        assert len(found) == repeated


def test_files_with_the_same_headers_are_put_one_below_the_other(tmp_path: Path) -> None:
    head = "Time (s),Disp (mm)\n"
    parts = [head + rows(",", columns=(TIME[:7], DISP[:7])), head + rows(",", columns=(TIME[7:], DISP[7:]))]
    lines = f'files = ["a.csv", "b.csv"]\n{MAP}'
    rig = rig_of(tmp_path, {"a.csv": parts[0], "b.csv": parts[1]}, lines)
    assert_read(rig)
    assert sorted(rig.files) == ["a.csv", "b.csv", "rig.toml"]
    assert (rig.tables[0].label, list(rig.tables[0].rows)) == ("a", list(range(1, 13)))
    fault = fault_of(tmp_path, {"b.csv": parts[0]}, lines)
    assert (fault.file, fault.line, fault.column) == (str(tmp_path / "b.csv"), 2, 1)
    assert "must increase" in fault.rule


def test_matlab_files_are_merged_by_name(tmp_path: Path) -> None:
    tmp_path.mkdir(exist_ok=True)
    y = np.sin(TIME)
    savemat(tmp_path / "s_x.mat", {"t": TIME[:, None], "x": (DISP + y)[:, None], "rate": 100.0, "note": "text"})
    savemat(tmp_path / "s_y.mat", {"t": TIME * (1.0 + 1e-15), "y": y}, do_compression=True)
    source = 'columns = { time = { from = "t", unit = "s" }, x_rel = { from = "x", minus = "y", unit = "mm" } }'
    rig = rig_of(tmp_path, {}, f'files = ["s_x.mat", "s_y.mat"]\n{source}')
    np.testing.assert_allclose(rig.tables[0]["x_rel"], 1e-3 * DISP, atol=1e-15)
    assert {"s_x.mat", "s_y.mat"} < set(rig.files)
    fault = fault_of(tmp_path, {}, 'file = "s_x.mat"')
    (proposed,) = re.findall(r"columns = \{.*\} \}", fault.remedy)
    refused = fault_of(tmp_path, {}, f'file = "s_x.mat"\n{proposed}')
    assert (refused.rule, refused.value) == ("state the unit of the column, which the file does not say", "'?'")
    rig_of(tmp_path, {}, f'file = "s_x.mat"\n{proposed}'.replace("?", "s", 1).replace("?", "mm"))
    savemat(tmp_path / "s_y.mat", {"t": TIME + 1e-6, "y": y})
    fault = fault_of(tmp_path, {}, f'files = ["s_x.mat", "s_y.mat"]\n{source}')
    assert "must be the same" in fault.rule
    savemat(tmp_path / "s_y.mat", {"y": y[:-1]})
    fault = fault_of(tmp_path, {}, f'files = ["s_x.mat", "s_y.mat"]\n{source}')
    assert "equal lengths" in fault.rule
    for content in (b"", (tmp_path / "s_x.mat").read_bytes()[:200]):
        assert fault_of(tmp_path, {"s_x.mat": content}, f'file = "s_x.mat"\n{BY_NAME}').file.endswith("s_x.mat")


def test_a_matrix_and_missing_numbers_of_matlab(tmp_path: Path) -> None:
    data = np.column_stack([TIME, DISP])
    data[4, 1] = np.nan
    savemat(tmp_path / "m.mat", {"data": data})
    source = 'columns = { time = { from = "data(:,1)", unit = "s" }, x_rel = { from = "data(:,2)", unit = "mm" } }'
    (table,) = rig_of(tmp_path, {}, f'file = "m.mat"\n{source}').tables
    assert (table.missing, len(table.rows)) == (1, 11)


X = 'x_rel = { from = "Disp (mm)", unit = "mm" }'
#: A part of the entry, its faulty form with a mark at the place of the error, the rule, a part of the remedy, and the
#: part that follows the remedy.
FAULTS = [
    ('"Disp (mm)"', '‸"Disp [mm]"', "must be a header", 'write "Disp (mm)"', '"Disp (mm)"'),
    ('"Disp (mm)"', "‸3", "one of the 2 columns", "a number from 1 to 2", "2"),
    ('"Disp (mm)"', "‸0", "counted from 1", "write from = 1", "2"),
    ('"Disp (mm)"', "‸true", "must be a header or the number", "from = 1", "2"),
    (X, 'x_rel = ‸{ from = "Disp (mm)" }', "must have a unit", 'add unit = "m"', X),
    (X, 'x_rel = ‸{ unit = "mm" }', "must have a from", 'write { from = "...", unit = "..." }', X),
    ('unit = "mm"', 'unit = ‸"ms"', "dimension of m", "write a unit such as mm", 'unit = "mm"'),
    ('unit = "mm"', 'unit = "mm", scale = ‸0', "must not be 0", "write 1", 'unit = "mm", scale = 1'),
    ('unit = "mm"', 'unit = "mm", offset = ‸inf', "finite number", "without quotes", 'unit = "mm", offset = 0'),
    ('unit = "mm"', 'unit = "mm", ‸sd = 1', "unknown key", "remove it", 'unit = "mm"'),
    (X, 'x_rel = { ‸rate = { value = 1, unit = "Hz" } }', "for times", 'write { from = "...", unit = "..." }', X),
    (MAP, f"columns = ‸{MAP[10:].replace(', ' + X, '')}", "must have a channel beside time", "add one of x_rel", MAP),
    (X, f"‸xx{X[5:]}", "unknown key", "known: time x_rel", X),
    (MAP, "‸missing = []", "needs a column map", MAP, f"missing = []\n{MAP}"),
    (MAP, "columns = ‸{}", "must have columns", f"write {MAP}", MAP),
    (MAP, f"{MAP}\ndata_from_line = ‸0", "counted from 1", "such as 2", f"{MAP}\ndata_from_line = 2"),
    (MAP, f"{MAP}\ndata_to_line = ‸true", "counted from 1", "such as 2", f"{MAP}\ndata_to_line = 13"),
    (
        MAP,
        f"{MAP}\ndata_from_line = 9\ndata_to_line = ‸2",
        "must not be above",
        "exchange",
        f"{MAP}\ndata_to_line = 13",
    ),
    (MAP, f"{MAP}\nmissing = ‸3", "list of texts", 'write missing = ["--", "NaN"]', f'{MAP}\nmissing = ["--", "NaN"]'),
    ('file = "t.csv"', 'file = "t.csv"\n‸files = ["t.csv"]', "file or files", "remove file", 'files = ["t.csv"]'),
    ('file = "t.csv"', 'files = ["t.csv", ‸"t.csv"]', "named once", "remove the second", 'files = ["t.csv"]'),
    ('file = "t.csv"', "files = ‸[]", "list of files", 'write files = ["...", "..."]', 'files = ["t.csv"]'),
]


@pytest.mark.parametrize(("part", "faulty", "rule", "remedy", "followed"), FAULTS)
def test_faults_of_a_map_are_located(
    tmp_path: Path, part: str, faulty: str, rule: str, remedy: str, followed: str
) -> None:
    good = f'file = "t.csv"\n{MAP}'
    bad = good.replace(part, faulty)
    fault = fault_of(tmp_path, {"t.csv": LAB}, bad.replace(MARK, ""))
    assert_fault(fault, tmp_path / "rig.toml", place_of(rig_toml(bad), MARK), rule)
    assert remedy in fault.remedy
    assert_read(rig_of(tmp_path, {}, good.replace(part, followed)))


def test_where_names_the_values_of_its_column(tmp_path: Path) -> None:
    text = "tau,t,x\n" + rows(",", columns=(np.full(12, 30.0), TIME, DISP))
    fault = fault_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\nwhere = {{ tau = 3 }}\n{BY_NAME}')
    assert "must keep a row; column 'tau' holds 30" in fault.rule
    assert_read(rig_of(tmp_path, {}, f'file = "t.csv"\nwhere = {{ tau = 30 }}\n{BY_NAME}'))


def test_remedies_for_the_layout_work(tmp_path: Path) -> None:
    for first, line in (("90, 1000, 5\n", 3), ("Rate;1000\n", 3)):
        text = "a, b, c\n" + first + rows(";")
        lines = 'file = "t.txt"\ncolumns = { time = { from = 1, unit = "s" }, x_rel = { from = 2, unit = "mm" } }'
        fault = fault_of(tmp_path, {"t.txt": text}, lines)
        (stated,) = re.findall(r"data_from_line = \d+", fault.remedy)
        assert stated == f"data_from_line = {line}"
        assert_read(rig_of(tmp_path, {}, f"{stated}\n{lines}"))


def test_a_header_that_occurs_twice_needs_its_number(tmp_path: Path) -> None:
    text = "t,x,x,t\n" + rows(",", columns=(TIME, DISP, EXTRA, DISP))
    fault = fault_of(tmp_path, {"t.csv": text}, f'file = "t.csv"\n{BY_NAME.replace(chr(34) + "t" + chr(34), "1")}')
    assert "from = 2" in fault.remedy
    assert_read(rig_of(tmp_path, {}, f'file = "t.csv"\n{BY_NUMBER.replace("3", "2")}'))
    fault = fault_of(tmp_path, {}, f'file = "t.csv"\nwhere = {{ t = 0 }}\n{BY_NUMBER}')
    assert "1 = ..." in fault.remedy


def test_one_call_prints_the_first_error_of_each_experiment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = [f'file = "{i}.csv"\n{MAP}' for i in range(23)]
    with pytest.raises(FolderError) as caught:
        rig_of(tmp_path, {"good.csv": LAB}, *bad, f'file = "good.csv"\n{MAP}')
    assert len(caught.value.errors) == 23
    assert [error.line for error in caught.value.errors] == sorted({error.line for error in caught.value.errors})
    out = tmp_path / "out"
    for command, words in ((cli.capsule_id, ["check"]), (cli.fit_params, ["--out", str(out)])):
        assert command([*words, str(tmp_path)]) == 2
        lines = message(capsys.readouterr().err).strip().split("\n")
        assert (len(lines), lines[-1]) == (21, "23 errors")
        assert all(str(tmp_path / "rig.toml") in line for line in lines[:-1])
    assert not out.exists()


def test_a_longer_vector_of_the_file_gives_no_rows_to_a_table(tmp_path: Path) -> None:
    """The rows are those of the mapped vectors, and a missing cell among them is left out."""
    for missing in (False, True):
        disp = DISP.copy()
        disp[3] = np.nan if missing else disp[3]
        np.savez(tmp_path / "x.npz", time=TIME, x=disp, temperature=np.arange(30.0))
        maps = 'columns = { time = { from = "time", unit = "s" }, x_rel = { from = "x", unit = "mm" } }'
        stated = '\nmissing = ["NaN"]' if missing else ""
        (table,) = rig_of(tmp_path, {}, f'file = "x.npz"\n{maps}{stated}').tables
        assert len(table.rows) == len(table["time"]) == 12 - missing
