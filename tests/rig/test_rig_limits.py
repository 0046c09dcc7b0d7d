"""Files of absurd size or nesting end in a located error, at once; white space inside a table is no part of a number."""

import time
from pathlib import Path

import pytest

import capsule_id
from capsule_id.errors import InputError
from capsule_id.rig.formats.text.csv import read_csv
from capsule_id.rig.toml_document import DEEPEST_KEY, LARGEST_TEXT, parse_toml

TOML, TABLE = Path("rig.toml"), Path("table.csv")
#: Longest time until an error, s.
LONGEST = 2.0


def test_a_header_of_100000_columns_is_read_at_once() -> None:
    header = ",".join(f"c{i} [1]" for i in range(100_000))
    began = time.process_time()
    table = read_csv(f"{header}\n{','.join('1' * 100_000)}\n".encode(), TABLE)
    assert time.process_time() - began < LONGEST
    assert len(table.names) == 100_000


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
    assert read_csv(b"x [m]\n 1\t\n", TABLE).values == 1.0  # spaces and tabs stay allowed


@pytest.mark.parametrize("folder", [b"data", ["data"], None, 3])
def test_a_rig_is_named_by_a_path(folder: object) -> None:
    with pytest.raises(InputError, match="the rig must be a path"):
        capsule_id.read_rig(folder)  # type: ignore[arg-type]


@pytest.mark.parametrize("rig", ["data", Path("data"), None])
def test_what_is_fitted_is_a_rig(rig: object) -> None:
    with pytest.raises(InputError, match=r"the rig must be one that read_rig returns.*fit\(read_rig\(folder\)\)"):
        capsule_id.fit(rig)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [-1, 1.5, "1", None])
def test_a_seed_is_a_whole_number(seed: object) -> None:
    rig = capsule_id.read_rig(Path(__file__).parents[2] / "data")
    with pytest.raises(InputError, match="seed must be a whole number, not negative"):
        capsule_id.fit(rig, seed=seed)  # type: ignore[arg-type]
