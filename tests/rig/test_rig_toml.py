"""Places of keys and values, against markers in the text."""

from pathlib import Path

import pytest

from capsule_id.errors import InputError
from capsule_id.rig.toml import KeyPath, parse_toml

# Every way to write TOML that moves a value; each value is unlike all others, so that `find` gives its place.
TEXT = '''\
# comment with [brackets] = "and" 'quotes'
first = 101   # a comment, with , and ]
"quoted key" . 'second part'   =   "text with # and \\" and ] in it"

[ table . "sub.table" ]   # header
inline = { value = 102.5, sd = -1e-3, nest = { deep = "x,}]", list = [ 103, [104, "]"], { a = 105 }] }, last.one = 106 }
dotted.key.here = 1979-05-27 07:32:00
multi = """
line = 1
[[fake]] ""\\""" quote: """"
after = 107
literal = \'\'\'raw \\ "" \'\' \'\'\'\'
path = 'C:\\dir'
array = [
    108, # comment ]
    # [109]
    110,
]

[[experiment]]
kind = "one"
start = { value = 111 }

  [experiment.extra]
  depth = 112
[[experiment]]
kind = "two"
[[experiment.part]]
n = 113
[[experiment.part]]
n = 114
[table.other]
tail = true'''

VALUES: list[tuple[KeyPath, str]] = [
    (("first",), "101"),
    (("quoted key", "second part"), '"text with'),
    (("table", "sub.table", "inline"), "{ value = 102.5"),
    (("table", "sub.table", "inline", "value"), "102.5"),
    (("table", "sub.table", "inline", "sd"), "-1e-3"),
    (("table", "sub.table", "inline", "nest", "deep"), '"x,}]"'),
    (("table", "sub.table", "inline", "nest", "list", 0), "103"),
    (("table", "sub.table", "inline", "nest", "list", 1, 1), '"]"]'),
    (("table", "sub.table", "inline", "nest", "list", 2, "a"), "105"),
    (("table", "sub.table", "inline", "last", "one"), "106"),
    (("table", "sub.table", "dotted", "key", "here"), "1979-05-27"),
    (("table", "sub.table", "multi"), '"""\nline = 1'),
    (("table", "sub.table", "after"), "107"),
    (("table", "sub.table", "literal"), "'''raw"),
    (("table", "sub.table", "path"), "'C:"),
    (("table", "sub.table", "array", 0), "108"),
    (("table", "sub.table", "array", 1), "110"),
    (("experiment", 0, "kind"), '"one"'),
    (("experiment", 0, "start", "value"), "111"),
    (("experiment", 0, "extra", "depth"), "112"),
    (("experiment", 1, "kind"), '"two"'),
    (("experiment", 1, "part", 0, "n"), "113"),
    (("experiment", 1, "part", 1, "n"), "114"),
    (("table", "other", "tail"), "true"),
]


def place_of(offset: int) -> tuple[int, int]:
    before = TEXT[:offset].split("\n")
    return len(before), len(before[-1]) + 1


@pytest.mark.parametrize(("path", "marker"), VALUES, ids=[marker for _, marker in VALUES])
def test_place_of_a_value(path: KeyPath, marker: str) -> None:
    assert TEXT.count(marker) == 1
    assert parse_toml(TEXT, Path("rig.toml")).place(path) == place_of(TEXT.index(marker))


def test_place_of_a_key_and_of_what_is_missing() -> None:
    document = parse_toml(TEXT, Path("rig.toml"))
    assert document.place(("table", "sub.table", "inline", "sd"), of_key=True) == place_of(TEXT.index("sd = -1e-3"))
    assert document.place(("experiment", 1, "file")) == place_of(TEXT.index('[[experiment]]\nkind = "two"'))
    assert document.place(("experiment", 0, "start", "unit")) == place_of(TEXT.index("{ value = 111"))
    assert document.place(("nowhere",)) == (1, 1)


def leaves(node: object, path: KeyPath) -> list[KeyPath]:
    """Paths of all scalars below ``node``."""
    children = (
        list(node.items()) if isinstance(node, dict) else list(enumerate(node)) if isinstance(node, list) else None
    )
    return [path] if children is None else [leaf for key, child in children for leaf in leaves(child, (*path, key))]


def test_every_scalar_is_located() -> None:
    document = parse_toml(TEXT, Path("rig.toml"))
    assert set(leaves(document.data, ())) <= set(document.values)


@pytest.mark.parametrize(
    ("text", "line", "column"),
    [
        ("a = 1\nb = \n", 2, 5),
        ("a = 1\na = 2\n", 2, 6),
        ("[t\n", 1, 3),
        ('a = "open', 1, 10),
        ("a = " + "[" * 5000, 1, 1),
        ("a = " + "9" * 5000, 1, 5005),
    ],
)
def test_what_is_not_toml(text: str, line: int, column: int) -> None:
    with pytest.raises(InputError) as caught:
        parse_toml(text, Path("rig.toml"))
    assert (caught.value.file, caught.value.line, caught.value.column) == ("rig.toml", line, column)
    assert caught.value.rule in ("the file must be valid TOML", "nesting must be shallow")
