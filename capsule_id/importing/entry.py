"""Writes the entry of ``rig.toml`` that reads an export, with a comment and a confidence at every guess."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Kind
from capsule_id.experiments.registry import default_registry
from capsule_id.importing.guess import Guess, are_turning_points, disordered_times, free_part, guess
from capsule_id.rig.filters import dominant_frequency
from capsule_id.rig.formats.text.any_layout import delimiter_of
from capsule_id.rig.formats.text.blocks import TextFile
from capsule_id.rig.maps.columns import TIME, is_constant, readings_of, source_of
from capsule_id.rig.maps.headers import fits_name, name_and_unit, unit_of
from capsule_id.rig.maps.layout import FoundLayout, find_layout, used_layout
from capsule_id.rig.schema import QuantityRule
from capsule_id.rig.units import UNKNOWN
from capsule_id.views import counted

#: Columns of a tilt, which is its own slope.
TILT = {"angle", "height"}
_SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas", None: "spaces"}


def dimensions_of(kinds: Mapping[str, Kind]) -> tuple[str, ...]:
    """The SI units of all columns of all kinds."""
    return tuple(sorted({rule.si for kind in kinds.values() for rule in kind.columns.values()}))


def propose_entry(file: str | Path) -> str:
    """The lines of ``rig.toml`` that read an export; a comment gives the confidence and the reason of each guess.

    The lines name the file without its folder: put the file beside ``rig.toml``. ``capsule-id import`` prints them too.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    path = Path(file)
    return entry_of(read_file(path), path, path.name, default_registry())[0]


def read_file(path: Path) -> bytes:
    """The bytes of a regular file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        if not path.is_file():
            found = "a directory" if path.is_dir() else "no such file"
            raise InputError("FILE must be a regular file", found, "correct the name", path)
        return path.read_bytes()
    except OSError as error:
        raise InputError("FILE must be readable", str(error.strerror), "check its permissions", path) from None


def entry_of(content: bytes, path: Path, file: str, kinds: Mapping[str, Kind]) -> tuple[str, Guess | None]:
    """The lines of ``[[experiment]]`` for one export, and the guess; without a guess the lines are comments.

    Parameters
    ----------
    content, path : the bytes of the file, and its name for error lines
    file : its name in ``rig.toml``
    kinds : the kinds of experiments

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    found = find_layout(content, path, dimensions_of(kinds))
    guessed, unread = guess(found, kinds), list(_unread_lines(found, dimensions_of(kinds)))
    if guessed is None:
        words = " ".join(kinds)
        headers = ", ".join(name for name in found.names if name) or "none"
        times = disordered_times(found)
        lines = [
            f"#: {file}: unsure. No kind fits its headers: {headers}.",
            *(
                [
                    f"#: Times must increase; {times[0]!r} does not at line {times[1]}. "
                    "Export times with more digits, or correct the headers."
                ]
                if times
                else []
            ),
            *unread,
            f"#: Write one of {words}, and the columns of that kind.",
            "# [[experiment]]",
            '# kind = "..."',
            f"# file = {json.dumps(file)}",
            *(f"# {line}" for line in _layout_lines(found, replace(found.layout, missing=()))),
            '# columns = { ... = { from = 1, unit = "..." } }',
        ]
        return "\n".join(lines) + "\n", None
    kind = kinds[guessed.kind]
    lines = [*unread, "[[experiment]]", _commented(f'kind = "{guessed.kind}"', guessed.confidence, guessed.reason)]
    lines += [_commented(f"file = {json.dumps(file)}", "sure", _description(found, content))]
    lines += _layout_lines(found, used_layout(found, content, [column.index for column in guessed.columns.values()]))
    lines += _setting_lines(found, guessed, kind, file)
    lines += ["[experiment.columns]", *_column_lines(found, guessed)]
    return "\n".join(lines) + "\n", guessed


def _unread_lines(found: FoundLayout, dimensions: Sequence[str]) -> Iterable[str]:
    """A comment on every column with the unit of a reading, or the name of a time, whose cells are not all numbers."""
    for index, error in found.unread.items():
        name, text = name_and_unit(found.names[index], dimensions)
        text = text or found.units[index]
        if fits_name(name, TIME) <= 0 and (not text or unit_of(text, dimensions) is None):
            continue
        remedy = "Correct the cell or delete the row, or list its text in missing."
        if ":" in error.value and fits_name(name, TIME) > 0:
            remedy = "Export times as seconds, or state the sampling rate."
        yield f"#: {found.names[index]!r} is not read: line {error.line} has {' '.join(error.value.split())}. {remedy}"


def _commented(line: str, confidence: str, reason: str) -> str:
    """A line with the confidence of its guess as a comment."""
    return f"{line}  # {confidence}: {' '.join(reason.split())}"


def _description(found: FoundLayout, content: bytes) -> str:
    """Rows and separator of a file in words."""
    rows = len(found.export.lines)
    text = counted(rows, "row")
    if found.path.suffix.lower() not in (".csv", ".txt", ".tsv", ".dat"):
        return text
    line = TextFile(content, found.path).line(int(found.export.lines[0]) - 1)
    return f"{text}, {_SEPARATORS[delimiter_of(line, found.layout)]} between the cells"


def _layout_lines(found: FoundLayout, used: Any) -> Iterable[str]:
    """The keys of the layout that differ from the default."""
    if used.data_from_line is not None:
        yield _commented(f"data_from_line = {used.data_from_line}", "sure", "the first row of readings")
    if used.data_to_line is not None:
        reason = "the last row of readings"
        if len(found.blocks) > 1:
            blocks = ", ".join(f"{first} to {last}" for first, last in found.blocks)
            reason = f"the end of the longest of {len(found.blocks)} blocks of readings, lines {blocks}"
        yield _commented(f"data_to_line = {used.data_to_line}", "likely", reason)
    if used.decimal is not None:
        reason = "one column with a comma in every number"
        if used.decimal == ".":
            reason = "the header has a name for every number between commas"
        yield _commented(f'decimal = "{used.decimal}"', "likely", reason)
    if used.missing:
        texts = json.dumps(list(used.missing), ensure_ascii=False)
        yield _commented(f"missing = {texts}", "likely", "texts of cells without a reading; their rows are not used")


def _setting_lines(found: FoundLayout, guessed: Guess, kind: Kind, file: str) -> Iterable[str]:
    """Settings that the record or the name of the file suggests."""
    for key in kind.required:
        stem = "".join(mark if mark.isalnum() or mark in "._-" else "_" for mark in Path(file).name.split(".")[0])
        yield _commented(f'{key} = "{stem}"', "unsure", "from the name of the file")
    constant = _constant_settings(found, guessed, kind)
    yield from constant.values()
    channel = next((name for name in guessed.columns if name != TIME), None)
    if TIME not in kind.columns or channel is None:
        return
    time, values = times_of_guess(found, guessed), found.columns[guessed.columns[channel].index]
    here = np.isfinite(values) & np.isfinite(time)
    time, values = time[here], values[here]
    if "samples" in kind.setting_rules and are_turning_points(values):
        reason = "each row is smaller than the one before; remove this line if the rows are a record of the motion"
        yield _commented('samples = "turning_points"', "unsure", reason)
        return
    driven = "f" in kind.setting_rules and "f" not in constant
    if guessed.columns[TIME].unit == UNKNOWN if TIME in guessed.columns else guessed.rate is None:
        if driven:
            yield _commented(f'f = {{ value = "{UNKNOWN}", unit = "Hz" }}', "unsure", "state the set value")
        return
    if isinstance(kind.setting_rules.get("start"), QuantityRule) and (part := free_part(time, values)) is not None:
        start, stop = part
        yield _commented(f'start = {{ value = {start:.6g}, unit = "s" }}', "likely", "the free decay begins here")
        if stop is not None:
            yield _commented(f'stop = {{ value = {stop:.6g}, unit = "s" }}', "likely", "another excitation begins here")
    if driven:
        even = np.linspace(time[0], time[-1], len(time))
        try:
            frequency = dominant_frequency(even, np.interp(even, time, values))
        except InputError:
            return
        line = f'f = {{ value = {frequency:.4g}, unit = "Hz" }}'
        yield _commented(line, "unsure", f"the strongest frequency of {channel}; state the set value")


def _constant_settings(found: FoundLayout, guessed: Guess, kind: Kind) -> dict[str, str]:
    """A line for each setting that a column outside the map holds, the same in every row."""
    lines, free = dict[str, str](), set(found.columns) - {column.index for column in guessed.columns.values()}
    for (key, rule), index in product(kind.setting_rules.items(), sorted(free)):
        if (
            isinstance(rule, QuantityRule)
            and is_constant(found, index)
            and not (key == "slope" and TILT & set(guessed.columns))
        ):
            name, text = name_and_unit(found.names[index], [rule.si])
            unit = unit_of(text or found.units[index], [rule.si])
            if unit is not None and fits_name(name, key) > 0:
                lines[key] = _commented(
                    f'{key} = {{ value = {np.nanmax(found.columns[index]):.10g}, unit = "{unit}" }}',
                    "unsure",
                    f"{found.names[index]!r} is the same in every row{'; + uphill' * (key == 'slope')}",
                )
    return lines


def times_of_guess(found: FoundLayout, guessed: Guess) -> np.ndarray:
    """The times of a record, (n,) s, or in the unit of the file; sample numbers where times and rate are unknown."""
    if TIME in guessed.columns:
        return readings_of(found, guessed.columns[TIME], "s")
    return np.arange(len(next(iter(found.columns.values())))) / (guessed.rate or 1.0)


def _column_lines(found: FoundLayout, guessed: Guess) -> Iterable[str]:
    """A line for each column of the map; as comments, one for each column of the file, where the user must choose."""
    if TIME not in guessed.columns and guessed.rate is not None:
        line = f'{TIME} = {{ rate = {{ value = {guessed.rate:g}, unit = "Hz" }} }}'
        yield _commented(line, "likely", "the file states this rate and no times")
    elif TIME not in guessed.columns and guessed.confidence == "unsure" and "sampling rate" in guessed.reason:
        yield _commented(
            f'{TIME} = {{ rate = {{ value = "{UNKNOWN}", unit = "Hz" }} }}', "unsure", "the file states no rate"
        )
    for name, column in guessed.columns.items():
        for each in (column, *column.rivals):
            factor = "" if each.scale is None else f", scale = {each.scale:.10g}"
            source = f'{{ from = {source_of(found, each.index)}, unit = "{each.unit}"{factor} }}'
            reason = column.reason if each is column else "or this one"
            yield _commented(f"{'# ' * column.asked}{name} = {source}", column.confidence, reason)
