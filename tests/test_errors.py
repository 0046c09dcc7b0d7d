"""Bad input is a ``ValueError`` in Python, one line with its place; a command prints it in three on a terminal."""

import json
import re
from pathlib import Path

import pytest

import capsule_id
from capsule_id import cli, console
from capsule_id.errors import FolderError, InputError, printable


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


def test_a_terminal_shows_three_lines_for_each_error_and_a_log_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Place and what was found, the rule, what to do. Texts of several lines stay one."""
    error = InputError("x must\nbe positive", "-\n1", "correct\n\nit", "a.csv", 4, 2)
    assert error.shown == "a.csv:4:2: found: - 1\n  rule: x must be positive\n  to do: correct it"
    assert InputError("a", "b", "c").shown == "found: b\n  rule: a\n  to do: c"
    (tmp_path / "rig.toml").write_text('[rig]\nname = "a"\nm1 = { value = -1, unit = "g" }\n', encoding="utf-8")
    place = tmp_path / "rig.toml"
    assert cli.capsule_id(["check", str(tmp_path)]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"{place}:3:16: m1 must be greater than 0, -1, correct the value"
    assert second.startswith(f"{place}:1:1: a rig must have at least one [[experiment]], [], ")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert cli.capsule_id(["check", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        f"{place}:3:16: found: -1\n  rule: m1 must be greater than 0\n  to do: correct the value\n"
        f"{place}:1:1: found: []\n  rule: a rig must have at least one [[experiment]]\n"
        '  to do: add [[experiment]] with kind = "..." and file = "..."\n'
    )


FAULTY = """\
[rig]
name = "a b"
synthetic = 1
m1 = { value = -1, unit = "g" }
mass2 = { value = 1, unit = "g" }
[model]
friction = "dry"
engine = "fast"
[prior]
k1 = { median = 0, factor = 3, unit = "N/m" }
kk = { median = 1, factor = 3, unit = "N/m" }
[[experiment]]
kind = "static_friction"
file = "none.csv"
label = "a b"
direction = "up"
[[experiment]]
kind = "support_spring"
file = "none.csv"
length = { value = 1, unit = "s" }
[[experiment]]
kind = "tilt"
"""


def test_all_errors_of_a_folder_are_listed_once(tmp_path: Path) -> None:
    """Of settings that are faulty and of a file that is missing too (before: the first one of [rig] alone)."""
    (tmp_path / "rig.toml").write_text(FAULTY, encoding="utf-8")
    with pytest.raises(FolderError) as caught:
        capsule_id.read_rig(tmp_path)
    lines = [error.line for error in caught.value.errors]
    # 17: spring is missing; 14 and 19: the file is.
    assert sorted(line or 0 for line in lines) == [2, 3, 4, 5, 7, 8, 10, 11, 14, 15, 16, 17, 19, 20, 22]
    assert str(caught.value).split("\n") == [str(error) for error in caught.value.errors]


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ('name = "a"', 'nam = "a"'),
        ("[[experiment]]", "[[experiments]]"),
        ("[rig]", "[rigs]"),
        ("columns =", "colums ="),
        ('kind = "static_friction"', 'kind = "tilt"'),
        ('spring = "L60"', 'sprin = "L60"'),
        ('spring = "L60"', "spring = 60"),
        ('gain = { sd = 1, unit = "%" }', 'gian = { sd = 1, unit = "%" }'),
    ],
)
def test_one_mistake_is_one_error(tmp_path: Path, right: str, wrong: str) -> None:
    """Nothing that follows from it is listed too."""
    text = (
        '[rig]\nname = "a"\n[prior]\n"k2[L60]" = { median = 1, factor = 3, unit = "N/m" }\n'
        '[[instrument]]\nname = "cell"\ngain = { sd = 1, unit = "%" }\n'
        '[[experiment]]\nkind = "static_friction"\nfile = "tilt.csv"\n'
        'columns = { angle = { from = "alpha", unit = "deg" } }\n'
    )
    text += '[[experiment]]\nkind = "support_spring"\nspring = "L60"\nfile = "a.csv"\nforce_instrument = "cell"\n'
    (tmp_path / "a.csv").write_text("deflection [mm],force [N]\n1,2\n2,4\n3,6\n", encoding="utf-8")
    (tmp_path / "tilt.csv").write_text("alpha\n30\n31\n", encoding="utf-8")
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    capsule_id.read_rig(tmp_path)
    assert right in text
    (tmp_path / "rig.toml").write_text(text.replace(right, wrong, 1), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        capsule_id.read_rig(tmp_path)
    assert "\n" not in str(caught.value)


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
