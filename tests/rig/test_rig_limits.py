"""Files of absurd size or nesting end in a located error, at once; white space inside a table is no part of a number."""

import gzip
import re
import time
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id.api import _check_numbers
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.rig import guess
from capsule_id.rig.formats import EXPORTS, raw
from capsule_id.rig.formats import text as texts
from capsule_id.rig.formats.layouts import read_csv
from capsule_id.rig.formats.raw import MOST_COLUMNS, NO_READING, Layout, TextFile
from capsule_id.rig.toml import DEEPEST_KEY, LARGEST_TEXT, closest, parse_toml
from tests.cli_tools import small_rig

TOML, TABLE = Path("rig.toml"), Path("table.csv")
#: Longest time until an error, s.
LONGEST = 2.0


def table_of(columns: int) -> bytes:
    return f"{','.join(f'c{i} [1]' for i in range(columns))}\n{','.join('1' * columns)}\n".encode()


def test_a_header_of_many_columns_is_read_at_once() -> None:
    began = time.process_time()
    assert len(read_csv(table_of(MOST_COLUMNS), TABLE).names) == MOST_COLUMNS
    with pytest.raises(InputError, match=f"table.csv:1:1: a table must have at most {MOST_COLUMNS} columns, 20000, "):
        read_csv(table_of(20_000), TABLE)
    assert time.process_time() - began < LONGEST


@pytest.mark.parametrize("text", ["#" + "a" * 10_000_000, "#\n" * 5_000_000, f"a = [{'1, ' * 3_000_000}]"])
def test_a_large_rig_file_is_refused_at_once(text: str) -> None:
    began = time.process_time()
    with pytest.raises(InputError, match=f"^rig.toml:1:1: the file must hold at most {LARGEST_TEXT} characters, "):
        parse_toml(text, TOML)
    assert time.process_time() - began < LONGEST
    parse_toml(text[:1000].rpartition(",")[0] + "]" if text.startswith("a") else text[:1000], TOML)  # the remedy


@pytest.mark.parametrize("depth", [DEEPEST_KEY + 1, 2000])
def test_deep_keys_are_refused_with_their_place(depth: int) -> None:
    key = ".".join("a" * depth)
    for text in (f"b = 1\n{key} = 1\n", f"b = 1\n[{key}]\n"):
        with pytest.raises(InputError, match=r"^rig.toml:2:\d+: nesting must be shallow, "):
            parse_toml(text, TOML)
    parse_toml(f"{'.'.join('a' * DEEPEST_KEY)} = 1\n", TOML)


@pytest.mark.parametrize("mark", ["\f", "\v", "\x1c", "\u2003"])
@pytest.mark.parametrize("cell", ["{}1", "1{}", "1{}5"])
def test_other_white_space_is_no_part_of_a_number(mark: str, cell: str) -> None:
    with pytest.raises(InputError, match=r"^table.csv:2:1: a cell must be a number, "):
        read_csv(f"x [m]\n{cell.format(mark)}\n".encode(), TABLE)
    assert read_csv(b"x [m]\n 1\t\n", TABLE).columns[0] == 1.0  # spaces and tabs stay allowed


@pytest.mark.parametrize("folder", [b"data", ["data"], None, 3])
def test_a_rig_is_named_by_a_path(folder: object) -> None:
    with pytest.raises(InputError, match="the rig must be a path"):
        capsule_id.read_rig(folder)  # type: ignore[arg-type]


def test_a_fit_takes_a_rig_its_folder_or_its_file(tmp_path: Path) -> None:
    """Before, only a rig. What is no rig and no path is refused by name; so is a file that is no folder."""
    folder = small_rig(tmp_path / "rig")
    for given in (folder, str(folder), folder / "rig.toml"):
        assert capsule_id.read_rig(given).files == capsule_id.read_rig(folder).files
    values = [
        capsule_id.fit(given, budget=None).summary["value"].to_list()
        for given in (folder / "rig.toml", capsule_id.read_rig(folder))
    ]
    assert values[0] == values[1]
    with pytest.raises(InputError, match=r"the rig must be a path \(str or Path\), NoneType"):
        capsule_id.fit(None)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    for given, found in ((folder / "rig.csv", "a file"), (folder / "absent", "no such folder")):
        (folder / "rig.csv").write_text("1", encoding="utf-8")
        with pytest.raises(InputError, match=f"the rig must be a folder, {found}"):
            capsule_id.fit(given)


def test_a_rig_in_utf_16_is_read(tmp_path: Path) -> None:
    """As an editor of Windows saves it; before: "a binary file"."""
    folder = small_rig(tmp_path / "rig")
    text, expected = (folder / "rig.toml").read_text(encoding="utf-8"), capsule_id.read_rig(folder)
    for codec in ("utf-16", "utf-16-be"):
        mark = b"\xfe\xff" if codec == "utf-16-be" else b""
        (folder / "rig.toml").write_bytes(mark + text.encode(codec))
        assert capsule_id.read_rig(folder).name == expected.name
    (folder / "rig.toml").write_bytes(text.encode("utf-16-le"))  # without its mark
    with pytest.raises(
        InputError, match=r"the file must be text, a binary file \(NUL byte\), export it as text, in UTF-8"
    ):
        capsule_id.read_rig(folder)


def test_the_name_of_a_file_in_another_case_is_proposed(tmp_path: Path) -> None:
    folder = small_rig(tmp_path / "rig")
    (file,) = folder.glob("*.csv")
    file.rename(folder / file.name.upper())
    with pytest.raises(InputError, match=f'file must exist, .*, write "{file.name.upper()}"'):
        capsule_id.read_rig(folder)


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("spring_back", None), ("k2_back", None), ("m3", None), ("x_rel_noise", None), ("stiffness", None),
        ("mass1", "m1"), ("M1", "m1"), ("m_1", "m1"), ("uncertaint", "sd"), ("uncertainty", "sd"), ("error", "sd"),
        ("free-vibration", "free_vibration"), ("normalforce", "normal_force"), ("lenght_is", "length_is"),
        ("x_rel_sdd", "x_rel_sd"), ("colums", "columns"), ("sprng", "spring"), ("directon", "direction"),
    ],
)  # fmt: skip
def test_a_proposed_word_has_the_meaning_of_the_written_one(written: str, meant: str | None) -> None:
    known = (
        "kind", "file", "label", "columns", "missing", "spring", "gap", "mu_back", "k2", "sd", "value", "unit", "m1", "m2",
        "g", "free_vibration", "normal_force", "direction", "length_is", "x_rel_sd", "x_rel_resolution",
    )  # fmt: skip
    assert closest(written, known) == meant


@pytest.mark.parametrize("seed", [-1, 1.5, "1", None])
def test_a_seed_is_a_whole_number(seed: object) -> None:
    rig = capsule_id.read_rig(Path(__file__).parents[2] / "data")
    with pytest.raises(InputError, match="seed must be a whole number, not negative"):
        capsule_id.fit(rig, seed=seed)  # type: ignore[arg-type]


def test_numbers_of_a_fit_may_be_those_of_numpy_and_are_whole() -> None:
    _check_numbers(np.int64(3), np.int64(100), 1000.0)  # type: ignore[arg-type]  # pyright: ignore
    with pytest.raises(InputError, match=r"budget must be a positive whole number, 100\.5"):
        _check_numbers(0, 100.5, 1000.0)  # type: ignore[arg-type]  # pyright: ignore


def test_the_length_of_one_board_is_stated_as_the_template_says(tmp_path: Path) -> None:
    """Before: "scale must not be 0", and no other place for a length that no column holds."""
    kind = default_registry()["static_friction"]
    (line,) = re.findall(r"#: (columns = \{ height .*\})", kind.template)
    head = '[rig]\nname = "board"\n[[experiment]]\nkind = "static_friction"\nfile = "tilt.csv"\nlength_is = "board"\n'
    (tmp_path / "tilt.csv").write_text("height [mm]\n178\n181\n190\n", encoding="utf-8")
    (tmp_path / "rig.toml").write_text(f"{head}{line}\n", encoding="utf-8")
    (table,) = capsule_id.read_rig(tmp_path).tables
    np.testing.assert_allclose(table["length"], 0.95, rtol=1e-12)
    np.testing.assert_allclose(table["height"], [0.178, 0.181, 0.190], rtol=1e-12)
    # A column of zeros is still refused, and the error says how a constant is stated.
    (tmp_path / "rig.toml").write_text(f"{head}{line.replace('offset = 950', 'offset = 0')}\n", encoding="utf-8")
    with pytest.raises(
        InputError, match=r"scale must not be 0, 0, write 1, or -1 .*; for a constant, state it as offset"
    ):
        capsule_id.read_rig(tmp_path)


def test_a_compressed_text_counts_its_rows_and_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: an ordinary text of 74 MB was refused, and one of 33 million short rows took 2.7 GB."""
    monkeypatch.setattr(raw, "SMALL_CONTENT", 4000)
    long = "time [s],x_rel [mm]\n" + "".join(f"{k / 1000:.17f},{k % 7:.17f}\n" for k in range(150))
    dense = "x_rel [mm]\n" + "1\n" * 900
    packed = [gzip.compress(text.encode()) for text in (long, dense)]
    assert len(long) > 4000 > len(dense)
    with pytest.raises(InputError, match=r"a \.gz file of this size must hold at most"):
        read_csv(gzip.compress(dense.replace("\n", "\r").encode()), Path("table.csv.gz"))
    assert len(read_csv(packed[0], Path("table.csv.gz")).columns[0]) == 150
    with pytest.raises(InputError, match=r"a \.gz file of this size must hold at most"):
        read_csv(packed[1], Path("table.csv.gz"))
    with pytest.raises(InputError, match=r"a \.gz file of this size must hold at most"):
        read_csv(gzip.compress((long + " " * 4000).encode()), Path("table.csv.gz"))


def test_a_table_with_missing_cells_is_read_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: 16 MB of 2000 columns, one of them without readings, took 15 s: every cell was read by itself."""
    seen = list[str]()
    number_in = texts.number_in
    monkeypatch.setattr(texts, "number_in", lambda cell, *mark: seen.append(cell) or number_in(cell, *mark))
    row = ",".join(["1"] * 99) + ",--\n"
    with pytest.raises(InputError, match=r"^table.csv:2:199: a cell must not be empty"):
        read_csv((",".join(f"c{i} [1]" for i in range(100)) + "\n" + row * 50).encode(), TABLE)
    assert len([cell for cell in seen if cell not in NO_READING]) < 10  # none of the markers may be a number


def test_the_reader_in_c_reads_the_blocks_without_missing_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: one missing cell or a line below the readings sent all blocks to the slow reader."""
    monkeypatch.setattr(raw, "BLOCK", 400)
    slow = list[int]()
    read_column = texts.read_column
    monkeypatch.setattr(texts, "read_column", lambda cells, *rest: slow.append(len(cells)) or read_column(cells, *rest))
    rows = "".join(f"{k}.5,{k}\n" for k in range(1000)) + "1.5,--\n"
    export = EXPORTS[".csv"](("t [s],x [mm]\n" + rows).encode(), TABLE, Layout(missing=("--",)))
    np.testing.assert_array_equal(export.values(1), [*range(1000), np.nan])
    np.testing.assert_array_equal(export.values(0), [*(np.arange(1000) + 0.5), 1.5])
    assert sum(slow) < 400


def test_a_remedy_names_a_few_of_many_rows(tmp_path: Path) -> None:
    """Before: an error of 31 MB that named four million rows. Rows repeated at once are dropped; these are a second copy."""
    time = np.arange(40) / 100.0
    one = [f"{t:.2f},{x:.5f}\n" for t, x in zip(time, np.cos(30.0 * time), strict=True)]
    rows = "".join([*one[:31], *one[10:31], *one[31:]])
    (tmp_path / "d.csv").write_text(f"time [s],x_rel [mm]\n{rows}", encoding="utf-8")
    entry = '[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n'
    (tmp_path / "rig.toml").write_text(f'[rig]\nname = "twice"\n{entry}', encoding="utf-8")
    with pytest.raises(InputError, match=r"delete the repeated rows: line 33( [0-9]+){19} …") as caught:
        capsule_id.read_rig(tmp_path)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("last", ["", "1.5,--\n", '# "the end"\n'])
@pytest.mark.parametrize("size", [400, 1 << 20])
def test_a_marker_that_is_a_number_is_no_reading(monkeypatch: pytest.MonkeyPatch, last: str, size: int) -> None:
    """Before: -999 was a reading in every block of numbers alone; a block of comments alone ended in an IndexError."""
    monkeypatch.setattr(raw, "BLOCK", size)
    rows = "".join(f"{k}.5,{-999 if k % 40 == 7 else k}\n" for k in range(200))
    export = EXPORTS[".csv"](("t [s],x [mm]\n" + rows + last).encode(), TABLE, Layout(missing=("--", "-999")))
    expected = np.where(np.arange(200) % 40 == 7, np.nan, np.arange(200.0))
    np.testing.assert_array_equal(export.values(1), np.append(expected, [np.nan] * ("--" in last)))


def test_a_text_of_different_lines_is_not_searched_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: every different line was kept, whatever their number."""
    monkeypatch.setattr(guess, "_MOST_RUNS", 100)
    lines = [f"{''.join(map(chr, (97 + k // 26, 97 + k % 26)))},k" for k in range(500)]
    table = [f"{k},{k}" for k in range(30)]
    assert guess._blocks(TextFile("\n".join([*table, *lines, *table]).encode(), TABLE), Layout()) == ()
    assert len(guess._blocks(TextFile("\n".join([*table, *lines[:50], *table]).encode(), TABLE), Layout())) == 2
