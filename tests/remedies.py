"""A small interpreter of remedies: it applies the printed text of a message to a folder, to the letter, and no more."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import capsule_id as cid
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry, rough_values
from capsule_id.experiments.lint import lint, lint_settings
from capsule_id.report.messages import finding_text, messages_of
from tests.remedies_list import Folder

KINDS = default_registry()
#: Words of a remedy that is a measurement.
MEASURE = re.compile(
    r"[Ss]ample faster|[Rr]epeat|[Rr]ecord (again|for longer|faster|more)|[Mm]easure|export them with more"
)
_ROUNDS = 6


def messages(folder: Path) -> list[str]:
    """What ``capsule-id check`` prints: the errors of the folder, else its findings with their levels."""
    try:
        rig = cid.read_rig(folder)
        found = (*lint(rig, KINDS, rig.tables), *lint_settings(rig, KINDS, rough_values(rig, KINDS)))
    except InputError as error:
        return str(error).replace(f"{folder}/", "").splitlines()
    return [f"{one.level}: {finding_text(one, messages_of(KINDS))}" for one in found if one.level != "ok"]


def _place(text: str) -> tuple[str, int]:
    """The file and the 0-based line of a message."""
    found = re.search(r"(?:^|\s)([^\s:]+\.(?:csv|toml)):(\d+):", text)
    return (found[1], int(found[2]) - 1) if found else ("", 0)


def _lines(folder: Folder, name: str) -> list[str]:
    return folder.toml if name == "rig.toml" else folder.tables[name]


def _word(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Write another word for the one quoted, on its line."""
    name, line = _place(text)
    own = _lines(folder, name)
    assert found[1] in own[line], (found[1], own[line])
    own[line] = own[line].replace(found[1], found[2].strip('"'), 1)


def _add(folder: Folder, line: str) -> None:
    """Add a line to the experiment, in place of one with the same key."""
    key = line.partition(" = ")[0]
    folder.toml = [one for one in folder.toml if not one.startswith(f"{key} = ")] + [line]


def _exchange(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Exchange two headers."""
    lines = _lines(folder, _place(text)[0])
    headers = lines[0].split(",")
    one, other = (next(i for i, h in enumerate(headers) if h.startswith(f"{found[k]} [")) for k in (1, 2))
    headers[one], headers[other] = headers[other], headers[one]
    lines[0] = ",".join(headers)


def _delete(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Delete the lines named."""
    lines = _lines(folder, _place(text)[0])
    for line in sorted({int(number) for number in re.findall(r"\d+", found[1])}, reverse=True):
        del lines[line - 1]


def _sort(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Sort the rows by the first column, the time."""
    name = _place(text)[0]
    first, *body = _lines(folder, name)
    assert first.startswith(f"{found[1]} [")
    folder.tables[name] = [first, *sorted(body, key=lambda line: float(line.split(",")[0]))]


def _another(folder: Folder, name: str, lines: list[str], more: str = "") -> None:
    """An experiment like the last one, of another file."""
    begin = max(i for i, line in enumerate(folder.toml) if line == "[[experiment]]")
    other = f"{name.removesuffix('.csv')}_{len(folder.tables)}.csv"
    copied = [line.replace(name, other) if line.startswith("file = ") else line for line in folder.toml[begin:]]
    folder.tables[other] = lines
    folder.toml += [*copied, *([more] if more else [])]


def _split(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Write a file of each record."""
    name = _place(text)[0]
    lines, places = folder.tables[name], [int(number) - 1 for number in found[1].split()]
    first = lines[0]
    folder.tables[name] = lines[: places[0]]
    for begin, end in zip(places, [*places[1:], len(lines)], strict=True):
        _another(folder, name, [first, *lines[begin:end]])


def _direction(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Move the rows with a minus sign to a file of their own, without it."""
    del found
    name = _place(text)[0]
    first, *body = folder.tables[name]
    back = [line for line in body if line.startswith("-")]
    folder.tables[name] = [first, *(line for line in body if line not in back)]
    _another(folder, name, [first, *(line.replace("-", "") for line in back)], 'direction = "backward"')


def _unit(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Write the unit that is meant, where the message says to check it."""
    assert text
    of, unit = found[1], found[2]
    if "." not in of:
        folder.toml = [re.sub(rf'^({of} = .*unit = ")[^"]*', rf"\g<1>{unit}", line) for line in folder.toml]
        return
    label, _, column = of.partition(".")
    lines = folder.tables[f"{label}.csv"]
    lines[0] = re.sub(rf"\b{column} \[[^\]]*\]", f"{column} [{unit}]", lines[0])


def _prior(folder: Folder, text: str, found: re.Match[str]) -> None:
    """State a prior."""
    assert text
    place = next(i for i, line in enumerate(folder.toml) if line == "[[experiment]]")
    folder.toml[place:place] = ["[prior]", found[1]]


def _row(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Delete the row of the message."""
    del found
    name, line = _place(text)
    del _lines(folder, name)[line]


def _map(folder: Folder, text: str, found: re.Match[str]) -> None:
    """Add a column map, and the texts of cells without a reading."""
    assert text
    _add(folder, found[1])
    if found[2]:
        json.loads(found[2].partition(" = ")[2])
        _add(folder, found[2])


_QUANTITY = r'\{ (?:[a-z_]+ = "?[^,}"]+"?(?:, )?)+ \}'
#: Patterns of remedies that are edits, each with what it does.
EDITS: list[tuple[str, Callable[[Folder, str, re.Match[str]], None]]] = [
    (r"unknown unit symbol \S+, '([^']+)', write (?!a unit)(.+)$", _word),
    (r"unknown key, '([^']+)', write (\w+)", _word),
    (r"'([^']+)', write (\"[^\"]+\")$", _word),
    (r"exchange the headers of (\w+) and (\w+)", _exchange),
    (r"add .*?(columns = \{ .*? \} \})(?: and (missing = \[.*?\]))?", _map),
    (r"delete the (?:repeated rows|rows with a repeated time): line ([\d ]+)$", _delete),
    (r"Delete (?:these rows|the rows|lines?)[^:]*: lines? ([\d ]+)\.", _delete),
    (r"sort the rows by (\w+)", _sort),
    (r"\(line ([\d ]+)\): write a file of each record", _split),
    (r"move the rows with \w+ < 0 to a file of their own without the minus signs", _direction),
    (r"Check the unit of ([\w.]+)\. If the (?:times are|number is) in (\w+), write that unit", _unit),
    (rf"(reject = {_QUANTITY})", lambda folder, text, found: _add(folder, found[1])),
    (rf"((?:start|stop) = {_QUANTITY})", lambda folder, text, found: _add(folder, found[1])),
    (rf"Or, where another measurement gives about this k1, write (k1 = {_QUANTITY}) in \[prior\]", _prior),
    (r"Delete its row", _row),
]


def edit(folder: Folder, texts: list[str]) -> str | None:
    """Apply the first remedy of ``texts`` that is an edit; the message, None where there is none. Fails come first."""
    for text in sorted(texts, key=lambda text: not text.startswith("fail")):
        for pattern, apply in EDITS:
            if found := re.search(pattern, text):
                apply(folder, text, found)
                return text
    return None


def follow(folder: Folder, place: Path) -> tuple[list[str], list[str], Path]:
    """Follow the remedies of ``check`` until it has none: all messages that were followed, those left, and the folder."""
    followed: list[str] = []
    for number in range(_ROUNDS):
        written = folder.write(place / str(number))
        left = messages(written)
        text = edit(folder, left)
        if text is None:
            break
        followed.append(text)
    return followed, left, written
