"""Bad input is a ``ValueError`` in Python and one line with its place on the command line."""

import json
import re
from pathlib import Path

import pytest

import capsule_id
from capsule_id import console
from capsule_id.errors import InputError, printable


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


#: Texts that command a terminal or reverse what follows: ESC, BEL, OSC, C1, bidirectional and hidden marks.
COMMANDS = "\x1b[31m\x07\x1b]0;evil\x07\x9b2J\x7f\r\u202e\u2066\u200b\ufeff\udcff\U000e0041"


def test_what_is_printed_commands_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Before: ``report`` printed the texts of a result as they stood. Texts without such marks stay as they are."""
    plain = "µ₂ = 0.23 ± 0.01\tm\u00a0s⁻¹\n日本"
    assert printable(plain) == plain
    assert json.loads(f'"{printable(COMMANDS)}"') == COMMANDS
    console.say(COMMANDS)
    console.complain(COMMANDS)
    with console.Progress(enabled=True) as progress:
        progress.note(COMMANDS)
    shown = capsys.readouterr()
    for text in (shown.out, shown.err, str(InputError(COMMANDS, COMMANDS, COMMANDS, COMMANDS))):
        assert "evil" in text
        assert text.replace("\n", "").isprintable()


def test_every_line_is_printed_by_the_console() -> None:
    places = Path(capsule_id.__file__).parent.rglob("*.py")
    others = [
        place.name for place in places if re.search(r"(?<!\w)print\(|\.std(out|err)\.write\(", place.read_text("utf-8"))
    ]
    assert others == ["console.py"]
