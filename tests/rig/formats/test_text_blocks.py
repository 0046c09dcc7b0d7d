"""Texts are read in blocks: the size of a block, the encoding and the parser change nothing but time and memory."""

import codecs
import gzip
import tracemalloc
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.cli import capsule_id
from capsule_id.errors import InputError
from capsule_id.rig.formats import EXPORTS, READERS
from capsule_id.rig.formats import raw as blocks
from capsule_id.rig.formats.raw import Layout, TextFile
from capsule_id.rig.formats.text import Shape, plain_block

#: Texts with every layout and every fault that depends on more than one line.
TEXTS = [
    "time [s],x_rel [mm]\n0,1.5\n1,2.5\n2,-3e-4\n",
    "time [s];x_rel [mm]\r\n0;1\r\n1;2,5\r\n2;3,25\r\n\r\n  \r\n",
    "\ufefftime [s]\tx_rel [mm]\r0\t1\r1\t2\r",
    "time [s],x_rel [mm]\n0,1\n\n1,2\n",
    "time [s],x_rel [mm]\n\n",
    "\n\ntime [s],x_rel [mm]\n0,1\n",
    "",
    " \n\t\n",
    "Logger 7\n# a comment\nt;x\ns;mm\n0;1,5\n1;--\n% another\n2;3,5\n\n3;4,5",
    "t x y\n0  1.5 2\n 1\t2.5 3 \n2 3.5 4\n",
    "t,x,\n0,1.5,\n1,2.5,\n2,3.5,\n",
    "t,x,\n0,1.5,\n1,2.5,\n2,3.5,4\n",
    "t,x\n0,1.5\n1,2.5,7\n2,3.5\n",
    "t,x\n0,1.5\n1\n2,3.5,4\n",
    "t;x\n0;1\n1;2,5\n2;3.5\n",
    "1,25\n1,50\n",
    "".join(f"{k},{k % 7}\n" for k in range(60)),
    "".join(f"{k},{k % 7}\n" for k in [*range(60), 3]),
    "no numbers at all\nnor here\n",
    "t,x\n0,1e400\n1,2\n",
    "t,x\n0,1\n1,0.2E-0400\n2,0e-400\n",
    "t,x\n0,1\n1,2 3\n",
    "t,x µm\n0,1\n1,nan\n2,3\n",
    "0,1.5\n" * 40 + "0,x\n",
]
SIZES = [1, 3, 16, 1000]


def outcome(text: str, suffix: str, layout: Layout | None) -> list[str]:
    """All that a reader says about a text, or its error."""
    path = Path(f"f{suffix}")
    try:
        if layout is None:
            raw = READERS[suffix](text.encode(), path)
            return [
                repr(
                    (
                        raw.names,
                        raw.units,
                        [c.tolist() for c in raw.columns],
                        raw.rows.tolist(),
                        raw.place(0, 0),
                        raw.encoding,
                    )
                )
            ]
        export = EXPORTS[suffix](text.encode(), path, layout)
    except InputError as error:
        return [str(error)]
    found = [
        repr((export.headers, export.lines.tolist(), export.place(None, 0), export.place(len(export.lines) - 1, 0)))
    ]
    for column in range(export.width):
        try:
            found.append(repr(export.values(column).tolist()))
        except InputError as error:
            found.append(str(error))
    return found


LAYOUTS = [None, Layout(missing=("--", "")), Layout(data_from_line=2), Layout(data_to_line=3), Layout(decimal=",")]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_blocks_of_any_size_read_the_same(monkeypatch: pytest.MonkeyPatch, layout: Layout | None) -> None:
    wanted = [outcome(text, ".csv", layout) for text in TEXTS]
    assert sum(len(found) > 1 or found[0].startswith("(") for found in wanted) >= 3
    for size in SIZES:
        monkeypatch.setattr(blocks, "BLOCK", size)
        for text, expected in zip(TEXTS, wanted, strict=True):
            assert outcome(text, ".csv", layout) == expected, (size, text)


def test_numbers_are_rounded_correctly_and_other_cells_refused() -> None:
    rng = np.random.default_rng(3)
    values = rng.standard_normal((2000, 3)) * 10.0 ** rng.integers(-300, 300, (2000, 3))
    for delimiter, decimal in ((",", "."), (";", ","), ("\t", "."), (None, ".")):
        text = "".join((delimiter or "  ").join(map(repr, row)) + "\n" for row in values.tolist())
        shape = Shape(0, delimiter, 3, decimal)
        found = plain_block((text if decimal == "." else text.replace(".", ",")).encode(), shape, [2, 0])
        np.testing.assert_array_equal(cast(np.ndarray, found), values[:, [2, 0]])
    for cell in ("", " ", "1e", "e5", ".", "+", "--1", "+-1", "1.5.2", "1 2", "1e5.5", "1e999", "-", "1+1"):
        assert plain_block(f"1,2\n{cell},4\n".encode(), Shape(0, ",", 2, "."), [0, 1]) is None, cell
    for cell in ("1.", ".5", "+1", "-0", " 7\t", "1E5", "0001", "1" * 400 + "e-400"):
        found = plain_block(f"1,2\n{cell},4\n".encode(), Shape(0, ",", 2, "."), [0])
        assert cast(np.ndarray, found)[1, 0] == float(cell)
    for text in ("1,2\n1\n", "1,2\n1,2,3\n", "1,2\n1\n1,2,3\n", "1,2\n\n1,2\n"):
        assert plain_block(text.encode(), Shape(0, ",", 2, "."), [0]) is None, text


def test_columns_that_are_not_named_are_not_kept() -> None:
    text = ("time (s),x (mm),spare\n" + "0,1,2\n" * 10).encode()
    export = EXPORTS[".csv"](text, Path("f.csv"), Layout(columns=("time (s)", 2)))
    assert (export.width, export.headers[0]) == (3, ("time (s)", "x (mm)", "spare"))
    assert (export.values(0)[0], export.values(1)[0]) == (0.0, 1.0)
    with pytest.raises(KeyError):
        export.values(2)


@pytest.mark.parametrize("suffix", [".txt", ".txt.gz"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_encodings_of_laboratories(
    tmp_path: Path, encoding: str, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "Prüfstand\r\nZeit (ms);Weg (µm)\r\n" + "".join(
        f"{k};{(k % 5) * 0.5:g}\r\n".replace(".", ",") for k in range(20)
    )
    content = text.encode(encoding)
    (tmp_path / f"d{suffix}").write_bytes(gzip.compress(content) if suffix.endswith(".gz") else content)
    (tmp_path / "rig.toml").write_text(
        f'[rig]\nname = "d"\nm1 = {{ value = 0.1, sd = 0.001, unit = "kg" }}\n'
        f'[[experiment]]\nkind = "free_vibration"\nfile = "d{suffix}"\n'
        'columns = { time = { from = "Zeit (ms)", unit = "ms" }, x_rel = { from = "Weg (µm)", unit = "µm" } }\n',
        encoding="utf-8",
    )
    (table,) = read_rig(tmp_path).tables
    np.testing.assert_array_equal(table["x_rel"], np.array([(k % 5) * 0.5 for k in range(20)]) / 1e6)
    assert capsule_id(["check", str(tmp_path)]) == 0
    said = f"d{suffix} is read as Windows-1252" in capsys.readouterr().out
    assert said == (encoding == "cp1252")


def test_every_file_in_another_encoding_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of several files put one below the other, the finding named the first, whichever it was."""
    rows = "".join(f"{k / 10:g};{k}\n" for k in range(8))
    for name, encoding in (("a.txt", "utf-8"), ("b.txt", "cp1252"), ("c.txt", "cp1252")):
        (tmp_path / name).write_bytes(f"Weg (µm);Kraft (N)\n{rows}".encode(encoding))
    (tmp_path / "rig.toml").write_text(
        '[rig]\nname = "d"\n[[experiment]]\nkind = "support_spring"\nspring = "s"\nfiles = ["a.txt", "b.txt", "c.txt"]\n'
        'columns = { deflection = { from = "Weg (µm)", unit = "um" }, force = { from = "Kraft (N)", unit = "N" } }\n',
        encoding="utf-8",
    )
    capsule_id(["check", str(tmp_path)])
    said = capsys.readouterr().out
    assert [name for name in "abc" if f"{name}.txt is read as Windows-1252" in said] == ["b", "c"]


@pytest.mark.parametrize("blanks", ["\t\t", "\t", " \t"])
@pytest.mark.parametrize("row", [0, 2])
def test_blanks_behind_a_row_count_as_cells_in_the_last_row_too(tmp_path: Path, blanks: str, row: int) -> None:
    rows = ["0.0\t0.0", "0.1\t1.0", "0.2\t2.0"]
    rows[row] += blanks
    path = tmp_path / "d.csv"
    path.write_text("\n".join(["deflection [mm]\tforce [N]", *rows, " ", ""]), encoding="utf-8")
    with pytest.raises(InputError, match="a row must have 2 cells") as caught:
        READERS[".csv"](path.read_bytes(), path)
    assert caught.value.line == row + 2


@pytest.mark.parametrize(
    ("content", "place", "value"),
    [
        ("é [s]\n1\n2".encode() + b"\xe9\n", "3:2", "byte 0xe9"),  # UTF-8 that is damaged
        (b"a [s]\n1\n\x81\n", "3:1", "byte 0x81"),
        (b"a [s]\n1\n\xe9\x8d\n", "3:2", "byte 0x8d"),
        (b"a [s]\n1\n\xc3", "3:1", "byte 0xc3"),
        (b"a [s]\n1\n2\x00\n", "3:2", "NUL"),
    ],
)
def test_what_is_no_text_is_located(content: bytes, place: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for size in (1, 4, 1 << 22):
        monkeypatch.setattr(blocks, "BLOCK", size)
        if value == "byte 0xc3":
            assert TextFile(content, Path("f.csv")).encoding == "Windows-1252"
            continue
        with pytest.raises(InputError, match=rf"^f\.csv:{place}: the file must be .*{value}"):
            TextFile(content, Path("f.csv"))


@pytest.mark.parametrize("end", [b"1", b"1\0\x00\xdc2\0"])
def test_damaged_utf_16_is_located(monkeypatch: pytest.MonkeyPatch, end: bytes) -> None:
    content = codecs.BOM_UTF16_LE + "a [s]\r\n1\r\n2".encode("utf-16-le") + end
    for size in (2, 5, 1 << 22):
        monkeypatch.setattr(blocks, "BLOCK", size)
        with pytest.raises(
            InputError, match=r"^f\.csv:3:[23]: the file must be text, damaged UTF-16, save it as UTF-8"
        ):
            READERS[".csv"](content, Path("f.csv"))


def test_memory_is_a_small_multiple_of_the_file(tmp_path: Path) -> None:
    """Eleven columns of which two are kept."""
    line, count = "0.5," + ",".join(["1.23456789"] * 10), 240_000
    path = tmp_path / "d.csv"
    path.write_text("t," + ",".join(f"x{k}" for k in range(10)) + f"\n{line}\n" + f"{line}\n" * (count - 1))
    tracemalloc.start()
    export = EXPORTS[".csv"](path.read_bytes(), path, Layout(columns=("t", "x3")))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(export.values(0)) == count
    assert peak < 3.0 * path.stat().st_size


@pytest.mark.parametrize("written", ["1e-400", "-0.02E-0500", "1e-324", "0,3e-400"])
@pytest.mark.parametrize("layout", [None, Layout(), Layout(missing=("--",))])
def test_a_number_below_the_smallest_float_is_named(written: str, layout: Layout | None) -> None:
    """Before, it was read as 0, in whichever way the text is read; a 0 with an exponent stays one."""
    mark = "," if "," in written else "."
    text = f"t [s];x [mm]\n0;1{mark}5\n1;{{}}\n2;3{mark}5\n"
    (error,) = {line for line in outcome(text.format(written), ".csv", layout) if "float64" in line}
    assert error.startswith("f.csv:3:3: a cell must be a number that float64 holds")
    assert error.endswith("write 0: float64 begins at 5e-324")
    for kept in (f"0{mark}00e-400", "5e-324"):
        assert "float64" not in str(outcome(text.format(kept), ".csv", layout))
