"""Any value at any key of an experiment, and any text as a table: read, or refused in one located line."""

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from capsule_id.api import read_rig
from capsule_id.errors import InputError, collecting
from capsule_id.rig.formats import EXPORTS, READERS
from capsule_id.rig.formats.raw import Layout

#: The same examples in every run.
QUICK = settings(derandomize=True, database=None, deadline=None, max_examples=40)
KEYS = (
    "columns", "data_from_line", "data_to_line", "missing", "decimal", "where", "files", "reject", "clock", "plateaus", "label",
    "file", "kind", "x_rel_sd", "start", "stop", "spring", "gap", "damping", "smoothing_window", "capsule",
)  # fmt: skip
WORDS = (
    "time", "x_rel", "from", "minus", "unit", "scale", "offset", "rate", "value", "sd", "s", "mm", "Hz", "hampel", "rule",
    "window", "n_sd", "50 ms", "levels", "guard", "drift", "ppm", "t.csv", "../t.csv", "b", "tau", "--", "NaN", "", ",",
)  # fmt: skip
TABLE = "t,x,tau\n" + "".join(f"{i / 100},{(-0.8) ** i:.4f},{30 + i % 2}\n" for i in range(20))
HEAD = (
    '[rig]\nname = "any"\nm1 = { value = 0.1, unit = "kg" }\n[[experiment]]\nkind = "free_vibration"\nfile = "t.csv"\n'
)
MAP = 'columns = { time = { from = "t", unit = "s" }, x_rel = { from = "x", unit = "mm" } }\n'

Value = bool | int | float | str | list["Value"] | dict[str, "Value"]


def values() -> SearchStrategy[Value]:
    """Values of TOML: words of the schema, numbers, nested lists and tables."""
    numbers = st.integers(-3, 60) | st.integers() | st.floats(allow_nan=True)
    scalars: SearchStrategy[Value] = st.booleans() | numbers | st.sampled_from(WORDS) | st.text(max_size=8)
    names = st.sampled_from(WORDS) | st.text(max_size=4)
    return st.recursive(
        scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(names, inner, max_size=5), max_leaves=12
    )


def toml(value: Value) -> str:
    """A value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(toml(each) for each in value) + "]"
    if isinstance(value, float):
        return repr(value) if "e" not in repr(value) else f"{value:.17e}"
    return json.dumps(value)


def assert_located(error: InputError, folder: Path) -> None:
    assert all(line.isprintable() for line in str(error).split("\n"))
    assert all((error.rule, error.value, error.remedy))
    if error.file.endswith("rig.toml") and error.line is not None:
        lines = (folder / "rig.toml").read_bytes().decode("utf-8", "replace").replace("\r\n", "\n").split("\n")
        assert 1 <= error.line <= len(lines) + 1


@pytest.mark.full
@QUICK
@given(entries=st.dictionaries(st.sampled_from(KEYS), values(), min_size=1, max_size=3), mapped=st.booleans())
def test_any_value_at_any_key(
    tmp_path_factory: pytest.TempPathFactory, entries: dict[str, Value], mapped: bool
) -> None:
    folder = tmp_path_factory.mktemp("any", numbered=True)
    (folder / "t.csv").write_text(TABLE, encoding="utf-8")
    text = HEAD + (MAP if mapped else "")
    for key, value in entries.items():
        text = "".join(line for line in text.splitlines(True) if not line.startswith(f"{key} ="))
        text += f"{key} = {toml(value)}\n"
    (folder / "rig.toml").write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        read_rig(folder)
    except InputError as error:
        assert_located(error, folder)


CELLS = st.sampled_from(
    ["1", "-2.5", "3,25", "1e3", "", "--", "NaN", "x", "time [s]", "x_rel [mm]", '"q"', "#", "1e999", " "]
)
LAYOUTS = st.builds(
    Layout,
    data_from_line=st.none() | st.integers(1, 6),
    data_to_line=st.none() | st.integers(1, 9),
    missing=st.lists(st.sampled_from(["", "--", "NaN", "x"]), max_size=3, unique=True).map(tuple),
    decimal=st.sampled_from([None, ".", ","]),
)
ROWS = st.lists(st.lists(CELLS | st.text(max_size=4), max_size=5), max_size=8)


@QUICK
@given(
    rows=ROWS,
    separator=st.sampled_from([",", ";", "\t", " "]),
    ending=st.sampled_from(["\n", "\r\n", "\r"]),
    layout=LAYOUTS,
)
def test_any_text_as_a_table(rows: list[list[str]], separator: str, ending: str, layout: Layout) -> None:
    content = ending.join(separator.join(row) for row in rows).encode("utf-8", "surrogatepass")
    path, errors = Path("t.csv"), list[InputError]()
    with collecting(errors):
        READERS[".csv"](content, path)
    with collecting(errors):
        export = EXPORTS[".csv"](content, path, layout)
        for column in range(export.width):
            export.place(None, column)
            assert len(export.values(column)) == len(export.lines)
    assert all(str(error).isprintable() for error in errors)
