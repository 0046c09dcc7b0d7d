"""CSV dialects: written numbers are read back bit by bit in every dialect."""

import itertools
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.rig.formats.layouts import read_csv
from capsule_id.rig.formats.raw import NO_READING, TextFile
from capsule_id.rig.formats.text import Shape, plain_block, rows_of

DIALECTS = [
    (delimiter, decimal, ending, mark)
    for delimiter, decimal, ending, mark in itertools.product(",;\t", ".,", ("\n", "\r\n", "\r"), ("", "\ufeff"))
    if (delimiter, decimal) != (",", ",")
]


def numbers(rows: int, columns: int, seed: int) -> np.ndarray:
    """Numbers of all sizes and both signs, whole and subnormal ones too."""
    generator = np.random.default_rng(seed)
    values = generator.normal(size=(rows, columns)) * 10.0 ** generator.integers(-12, 12, size=(rows, columns))
    values[0], values[1, 0] = 0.0, -5e-324
    return values


@pytest.mark.parametrize(("delimiter", "decimal", "ending", "mark"), DIALECTS)
@pytest.mark.parametrize("columns", [1, 3])
def test_round_trip(delimiter: str, decimal: str, ending: str, mark: str, columns: int) -> None:
    values = numbers(40, columns, seed=7)
    header = delimiter.join(f'"c{i} [mm]"' if i % 2 else f" c{i}  [ N/m ] " for i in range(columns))
    rows = [delimiter.join(repr(float(cell)).replace(".", decimal) for cell in row) for row in values]
    if columns == 1 and decimal == ",":
        # A single header gives no evidence of semicolons: the comma separates cells.
        with pytest.raises(InputError, match="a row must have 1 cell, as the header has, 2 cells"):
            read_csv(ending.join([mark + header, *rows]).encode(), Path("t.csv"))
        return
    table = read_csv(ending.join([mark + header, *rows, "", "  ", ""]).encode(), Path("t.csv"))
    assert table.names == tuple(f"c{i}" for i in range(columns))
    assert table.units == tuple("mm" if i % 2 else "N/m" for i in range(columns))
    np.testing.assert_array_equal(np.column_stack(table.columns), values)
    np.testing.assert_array_equal(table.rows, np.arange(2, 42))


def test_cell_by_cell_reading_agrees_with_the_fast_one() -> None:
    values = numbers(500, 2, seed=8)
    values = values[np.abs(values).min(axis=1) > 1e-300]  # below it the cells are always read one by one
    lines = ["a [m];b [s]", *(f"{a!r}; +{abs(b)!r} " for a, b in values.tolist())]
    shape = Shape(1, ";", 2, ".")
    fast = cast(np.ndarray, plain_block("\n".join([*lines[1:], ""]).encode(), shape, [0, 1]))
    file = TextFile("\n".join(lines).encode(), Path("t.csv"))
    slow = rows_of(file, shape, [0, 1], (*NO_READING, "-999"))  # with a code: no block is read by the reader in C
    np.testing.assert_array_equal(fast, np.column_stack([slow.column(0), slow.column(1)]))


def test_places_are_line_and_first_character_of_the_cell() -> None:
    table = read_csv(b"aa [m], b [s]\n1.5,  2\n10 ,3\n", Path("t.csv"))
    assert [table.place(row, column)[1:] for row in (None, 0, 1) for column in (0, 1)] == [
        (1, 1),
        (1, 9),
        (2, 1),
        (2, 7),
        (3, 1),
        (3, 5),
    ]


def test_a_fault_at_the_end_of_a_large_file_is_found() -> None:
    text = "a [m],b [s]\n" + "".join(f"{i},{i / 7}\n" for i in range(100_000))
    table = read_csv(text.encode(), Path("t.csv"))
    np.testing.assert_array_equal(table.columns[1], np.arange(100_000) / 7)
    with pytest.raises(InputError, match=r"^t\.csv:100002:3: a cell must be a number, 'x', correct"):
        read_csv((text + "1,x\n").encode(), Path("t.csv"))


@pytest.mark.parametrize(
    "cell",
    [
        "1_000",
        "0x10",
        "١",
        "1 2",
        "--1",
        "1e",
        "e5",
        ".",
        "+",
        "1,5",
        "1.5.2",
        "TRUE",
        '"1"',
        "1e5.5",
        "#",
        "=1+1",
        "NAN0",
        "over",
    ],
)
def test_what_is_not_a_number(cell: str) -> None:
    with pytest.raises(InputError, match=r"^t\.csv:3:1: a (cell|row) must be (a number|numbers), "):
        read_csv(f"a [m];b [m]\n1.5;2\n{cell};4\n".encode(), Path("t.csv"))
