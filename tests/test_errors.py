"""Bad input is a ``ValueError`` in Python and one line with its place on the command line."""

from pathlib import Path

import pytest

import capsule_id
from capsule_id.errors import InputError


def test_bad_input_is_a_value_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"rig\.toml") as caught:
        capsule_id.read_rig(tmp_path)
    assert caught.type is InputError


@pytest.mark.parametrize(
    ("place", "line"),
    [
        ((), "x must be positive, -1, correct it"),
        (("a.csv",), "a.csv: x must be positive, -1, correct it"),
        (("a.csv", 4), "a.csv:4: x must be positive, -1, correct it"),
        (("a.csv", 4, 2), "a.csv:4:2: x must be positive, -1, correct it"),
    ],
)
def test_the_message_is_one_line_with_its_place(place: tuple[str, ...], line: str) -> None:
    assert str(InputError("x must\nbe positive", "-1", "correct it", *place)) == line  # type: ignore[arg-type]
