"""Describes an export, guesses its kind and columns, and writes the entry of ``rig.toml`` that reads it."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError, printable, refusing
from capsule_id.experiments.kind import Kind, default_registry
from capsule_id.records.release import find_free_decay, find_releases
from capsule_id.records.tones import estimate_clock, frequency_of
from capsule_id.rig.filters import FEWEST_SAMPLES, clock_starts
from capsule_id.rig.formats import TEXTS
from capsule_id.rig.formats.binary import sheets_of
from capsule_id.rig.formats.layouts import delimiter_of
from capsule_id.rig.formats.raw import NO_READING, TextFile
from capsule_id.rig.guess import (
    HANGS,
    TIME,
    Assignment,
    ColumnGuess,
    Confidence,
    FoundLayout,
    assignments,
    find_layout,
    fits_name,
    increases,
    is_constant,
    lines_of_labels,
    readings_of,
    score_of,
    source_of,
    times_of,
    times_of_trace,
    unit_of,
)
from capsule_id.rig.maps import LAYOUT
from capsule_id.rig.schema import SHORTEST_RECORD, QuantityRule
from capsule_id.rig.times import evened
from capsule_id.rig.units import SIGNALS, UNKNOWN, factor_to_si, symbol_named
from capsule_id.views import counted

# guess: Guesses the kind of experiment of an export, and which of its columns and units are those of the kind.


#: Smallest lead of the score of a kind that is sure, and number of columns that make it so whatever others there are.
LEAD, MANY = 1.0, 3
#: A record whose last fifth has less than this fraction of the amplitude of its largest part decays; above the second
#: fraction it is driven.
DECAYS, DRIVEN = 0.5, 0.8
#: A record whose last part has at least this fraction of its largest one is no decay.
STEADY = 0.97
_PARTS = 5
#: SI unit of a displacement, a velocity or an acceleration -> that of the same quantity of an angle.
ANGULAR = {"m": "rad", "m/s": "rad/s", "m/s^2": "rad/s^2"}


@dataclass(frozen=True)
class Guess:
    """What an export holds.

    Attributes
    ----------
    kind : name of the most probable kind
    columns : by name of the kind's column
    rate : sampling rate of a record without times, Hz
    confidence, reason : of the kind, and of the rate where there is one
    """

    kind: str
    columns: Mapping[str, ColumnGuess]
    rate: float | None
    confidence: Confidence
    reason: str


def guess(found: FoundLayout, kinds: Mapping[str, Kind]) -> Guess | None:
    """The most probable kind and columns of an export; None where no kind fits."""
    # Sets within larger ones need a line of [model].
    candidates = [
        one
        for kind in kinds.values()
        for one in assignments(found, kind)
        if not one.missing
        and not any(set(one.wanted) < set(larger) for larger in kind.sets)
        and (TIME not in one.wanted or _is_record(found, one.columns[TIME].index if TIME in one.columns else None))
    ]
    if not any(TIME in candidate.kind.columns for candidate in candidates):
        by_angle = _by_angle(found, kinds)
        if by_angle is not None:
            used = {column.index for column in by_angle.columns.values()}
            beside = [one for one in candidates if not used >= {column.index for column in one.columns.values()}]
            return replace(by_angle, confidence="unsure") if beside else by_angle
    if not candidates:
        return _without_names(found, kinds)
    best = max(candidate.score for candidate in candidates)
    leading = [candidate for candidate in candidates if candidate.score > best - LEAD]
    names = sorted({candidate.kind.name for candidate in leading})
    chosen = max(leading, key=lambda candidate: candidate.score)
    confidence, reason = _doubt(found, chosen, leading, kinds)
    if len(names) == 1:
        return _guess(found, chosen, confidence, reason)
    by_motion = _by_motion(found, leading)
    if by_motion is not None:
        return _guess(found, *(by_motion if confidence == "sure" else (by_motion[0], confidence, reason)))
    return _guess(found, chosen, "unsure", f"the columns fit {' and '.join(names)}")


def _doubt(
    found: FoundLayout, chosen: Assignment, leading: list[Assignment], kinds: Mapping[str, Kind]
) -> tuple[Confidence, str]:
    """Whether other columns leave the kind of the chosen candidate sure, and why."""
    used, kind = {column.index for column in chosen.columns.values()}, chosen.kind
    readings = (k for k in found.unread if unit_of(found.header(k, every := dimensions_of(kinds))[1], every))
    if (unread := next(readings, None)) is not None:
        return "unsure", f"column {unread + 1}, {found.names[unread]!r}, has a cell that is no number"
    if TIME not in kind.columns and any(_is_record(found, i) for i in times_of(found) if i not in used):
        return "unsure", f"the file is a record in time, {kind.name} a table of trials"
    own = [one.columns for one in leading if one.kind is kind]
    if any(not used >= {column.index for column in one.values()} for one in own):
        return "unsure", f"the columns fit {' and '.join(map(' with '.join, own))}"
    # A column under an unknown name may make it another kind: a force and a current are no list of pulls.
    known = {kind.columns[name].si for name in (kind.columns if TIME in kind.columns else chosen.columns)}
    stated = {rule.si for rule in kind.setting_rules.values() if isinstance(rule, QuantityRule)}
    dimensions = {rule.si for each in kinds.values() for rule in each.columns.values()} - known
    for index in sorted(set(found.columns) - used) if len(chosen.columns) < MANY else ():
        text = found.header(index, sorted(dimensions))[1]
        others = sorted(dimensions - stated if is_constant(found, index) else dimensions)
        # A number of a trial is no reading, nor is a mass, or a percentage.
        label = found.columns[index] == np.clip(np.rint(found.columns[index]), 0, len(found.columns[index]))
        unnamed = not text and len(chosen.columns) == 1 and not label.all()
        if unnamed or (unit_of(text, others) not in (None, "%") and unit_of(text, ["kg"]) is None):
            return "unsure", f"column {index + 1}, {found.names[index]!r}, is not used"
    if any(column.reason.endswith(HANGS) for column in chosen.columns.values()):
        return "unsure", "a mass is read as a force"
    return "sure", "the columns fit no other kind as well"


def _guess(found: FoundLayout, candidate: Assignment, confidence: Confidence, reason: str) -> Guess:
    """The guess of a candidate; a missing time column needs a stated rate."""
    needs_rate = TIME in candidate.kind.columns and TIME not in candidate.columns
    if needs_rate and found.rate is None:
        confidence, reason = "unsure", f"{reason}; the file states no times and no sampling rate"
    return Guess(candidate.kind.name, candidate.columns, found.rate if needs_rate else None, confidence, reason)


def _by_angle(found: FoundLayout, kinds: Mapping[str, Kind]) -> Guess | None:
    """A guess for a record of an angle, its rate or its acceleration, as arm times angle; None for another file."""
    times = [index for index in times_of(found) if len(found.columns[index]) >= FEWEST_SAMPLES]
    candidates = []
    for kind in (kind for kind in kinds.values() if times and TIME in kind.columns):
        channel = next(filter(None, (_angle(found, kind, name) for name in kind.channels)), None)
        time = score_of(found, times[0], TIME, kind)
        columns = {} if time is None else {TIME: time[1]}
        candidates += [] if channel is None else [Assignment(kind, {**columns, channel[0]: channel[1]})]
    if not candidates:
        return None
    by_motion = _by_motion(found, candidates)
    return _guess(found, *(by_motion or (candidates[0], "unsure", "the file is a record in time")))


def _angle(found: FoundLayout, kind: Kind, name: str) -> tuple[str, ColumnGuess] | None:
    """The channel ``name`` of a kind with the column that holds it as an angle; None without such a column."""
    si = kind.columns[name].si
    if si not in ANGULAR:
        return None
    remedy = "multiply scale by the arm in m, or enter the moment of inertia in kg m^2 as the mass in kg"
    for index in found.columns:
        stem, text = found.header(index, [*ANGULAR, *ANGULAR.values()])
        unit = unit_of(text, [ANGULAR[si]])
        angle = name == "x_rel" and fits_name(stem, "angle") > 0
        if unit is not None and (angle or fits_name(stem, name) > 0):
            reason = f"{found.names[index]!r} times an arm of 1 m; {remedy}"
            return name, ColumnGuess(index, si, "unsure", reason, factor_to_si(unit, ANGULAR[si]))
        if angle and not text:
            reason = f"an angle without unit: write {si} and scale = 1 for rad, 0.01745329252 for degrees"
            return name, ColumnGuess(index, UNKNOWN, "unsure", f"{reason}; {remedy}")
    return None


def _is_record(found: FoundLayout, time: int | None) -> bool:
    """Whether a file is a record in time: long enough, with increasing times."""
    rows = len(next(iter(found.columns.values())))
    return rows >= FEWEST_SAMPLES if time is None else rows >= SHORTEST_RECORD and increases(found.columns[time])


def _by_motion(found: FoundLayout, leading: list[Assignment]) -> tuple[Assignment, Confidence, str] | None:
    """Of kinds with the same columns, the bench test where the record decays, the other where it is driven."""
    records = [each for each in leading if TIME in each.kind.columns]
    if {each.kind.bench for each in records} != {True, False} or len(records) < len(leading):
        return None
    sample = next(iter(records))
    index = next(column.index for name, column in sample.columns.items() if name != TIME)
    starts = clock_starts(found.columns[sample.columns[TIME].index]) if TIME in sample.columns else []
    values = found.columns[index][: starts[0] if len(starts) else None]
    parts = [np.ptp(part) for part in np.array_split(values[np.isfinite(values)], _PARTS)]
    ratio = float(parts[-1] / max(*parts, 1e-300))
    bench = ratio < 0.5 * (DECAYS + DRIVEN)
    chosen = max((each for each in records if each.kind.bench == bench), key=lambda each: each.score)
    # A push near the end of a decay makes its last part as large as the first ones.
    least = float(np.min(parts[int(np.argmax(parts)) :]) / max(*parts, 1e-300))
    # A lightly damped decay has lost little at its end, but each part is smaller than the one before.
    falls = bool(np.all(np.diff(parts) < 0.0)) and ratio < STEADY
    clear = ratio < DECAYS or (least > DRIVEN and not falls)
    reason = f"the motion {'decays' if bench else 'is driven'}: its amplitude ends at {ratio:.0%} of its largest"
    return chosen, "sure" if clear else "unsure", reason


def _without_names(found: FoundLayout, kinds: Mapping[str, Kind]) -> Guess | None:
    """A guess for a record whose headers say nothing: times that increase evenly, and one channel."""
    rows = len(next(iter(found.columns.values()), ()))
    steps = {index: np.diff(values) for index, values in found.columns.items()}
    times = [index for index, each in steps.items() if np.all(each > 0.0) and np.all(each < 3.0 * np.median(each))]
    channels = [index for index in found.columns if index not in times]
    if rows < FEWEST_SAMPLES or len(times) > 1 or len(channels) != 1:
        return None
    reason = "no header names the column"
    dimensions, candidates = dimensions_of(kinds), []
    for kind in (kind for kind in kinds.values() if TIME in kind.columns):
        names = [name for name in (*kind.sets[0], *kind.channels) if name != TIME]
        wanted = [(channels[0], names), *((index, [TIME]) for index in times)]
        units = [_first_with_unit(found, index, names, kind, dimensions) for index, names in wanted]
        columns = {
            pair[0]: ColumnGuess(index, pair[1], "unsure", reason)
            for (index, _), pair in zip(wanted, units, strict=True)
            if pair is not None
        }
        if times and (named := score_of(found, times[0], TIME, kind)) is not None:
            columns[TIME] = named[1]
        if len(columns) == len(wanted):
            candidates.append(Assignment(kind, columns))
    by_motion = _by_motion(found, candidates)
    return None if by_motion is None else _guess(found, by_motion[0], "unsure", f"{reason}; {by_motion[2]}")


def _first_with_unit(
    found: FoundLayout, index: int, names: list[str], kind: Kind, dimensions: Sequence[str]
) -> tuple[str, str] | None:
    """The first of the ``names`` that the unit in the file allows, and that unit."""
    text = found.header(index, dimensions)[1]
    unknown = None if unit_of(text, dimensions) else UNKNOWN
    units = ((name, unit_of(text, [kind.columns[name].si]) or unknown) for name in names)
    return next(((name, unit) for name, unit in units if unit is not None), None)


def are_turning_points(values: np.ndarray) -> bool:
    """Whether the few readings of a table can be the amplitudes of a decay, on one side or on both sides in turn."""
    if len(values) >= FEWEST_SAMPLES:  # of a long record the next lines take more memory than its readings
        return False
    sizes, signs = np.abs(values), np.sign(values)
    sides = signs[1:] * signs[:-1]
    falls = bool(np.all(np.diff(sizes) <= 0.0)) and sizes[-1] < sizes[0]
    return falls and bool(np.all(sides == sides[0])) and sides[0] != 0.0


def free_part(time: np.ndarray, values: np.ndarray) -> tuple[float, float | None] | None:
    """Start and stop of the free decay in a record, s; None where all of it is free or nothing swings."""
    decay = find_free_decay(time, values)
    if decay is None or np.any(np.diff(time) <= 0.0) or (decay.rest == 0.0 and decay.stop is None):
        return None
    return decay.start, decay.end


# entry: Writes the entry of ``rig.toml`` that reads an export, with a comment and a confidence at every guess.


_SHOWN_COLUMNS = 20
#: Columns of a tilt, which is its own slope.
TILT = {"angle", "height"}
_DECIMALS = {
    ".": "the header has a name for every number between commas",
    ",": "one column with a comma in every number",
}
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
    return entry_of(read_file(path), path, default_registry())[0]


def read_file(path: Path) -> bytes:
    """The bytes of a regular file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with refusing("FILE must be readable", "check its permissions", path):
        if not path.is_file():
            raise InputError(
                "FILE must be a regular file",
                "a directory" if path.is_dir() else "no such file",
                "correct the name",
                path,
            )
        return path.read_bytes()


def entry_of(content: bytes, path: Path, kinds: Mapping[str, Kind]) -> tuple[str, Guess | None]:
    """The lines of ``[[experiment]]`` for one export, and the guess; without a guess the lines are comments.

    A workbook has such lines for each of its sheets with numbers, an interrupted text for each of its long blocks. The guess
    is that of the first ones.

    Parameters
    ----------
    content, path : the bytes of the file, and its path; ``rig.toml`` names it without the folder
    kinds : the kinds of experiments

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    entries, guesses, faults = list[str](), list[Guess | None](), list[InputError]()
    parts: list[tuple[str | None, tuple[int, int] | None]] = [
        (sheet, None) for sheet in sheets_of(content, path) or (None,)
    ]
    blocks: tuple[tuple[int, int], ...] = ()
    for number, (sheet, block) in enumerate(parts, 1):  # it grows by the further blocks of a text
        try:
            found = find_layout(content, path, dimensions_of(kinds), sheet, block)
        except InputError as error:
            faults.append(error)
            what = f"Sheet {sheet!r} is" if block is None else f"Lines {block[0]} to {block[1]} are"
            entries.append(f"#: {what} not read: {error.rule}, {' '.join(error.value.split())}.\n")
        else:
            blocks = found.blocks or blocks
            found = replace(found, blocks=blocks)
            guesses.append(guess(found, kinds))
            entries.append(_entry(found, guesses[-1], content, kinds, number))
            long = [one for one in found.blocks if one[1] - one[0] >= FEWEST_SAMPLES]
            parts += [(sheet, one) for one in long if block is None and one[0] != found.layout.data_from_line]
    if not guesses:
        error = faults[0]
        by_hand = f"{error.remedy}, in the entry that you write: capsule-id init DIR makes a rig.toml with examples"
        remedy = by_hand if any(f"{key} = " in error.remedy for key in LAYOUT) else error.remedy
        raise InputError(error.rule, error.value, remedy, error.file, error.line, error.column)
    return "\n".join(entries), guesses[0]


def _entry(found: FoundLayout, guessed: Guess | None, content: bytes, kinds: Mapping[str, Kind], number: int) -> str:
    """The lines of ``[[experiment]]`` for an export with its guess, the ``number``-th entry of its file."""
    unread, file = list(_unread_lines(found, dimensions_of(kinds))), found.export.path.name
    if guessed is None:
        headers = ", ".join(name for name in found.names if name) or "none"
        heads = {index: found.header(index, ["s"]) for index in found.columns}
        times = [index for index, (name, text) in heads.items() if fits_name(name, TIME) > 0 and unit_of(text, ["s"])]
        falls = [
            f"#: Times must increase; {found.names[index]!r} does not at line {found.export.lines[row + 1]}. "
            "Export times with more digits, or correct the headers."
            for index in times
            for row in np.flatnonzero(np.diff(found.columns[index]) <= 0.0)[:1]
        ]
        lines = [
            f"#: {file}: unsure. No kind fits its headers: {headers}.",
            *falls[:1],
            *unread,
            f"#: Write one of {' '.join(kinds)}, and the columns of that kind.",
            "# [[experiment]]",
            '# kind = "..."',
            f"# file = {json.dumps(file, ensure_ascii=False)}",
            *(f"# {line}" for line in _layout_lines(found, number)),
            '# columns = { ... = { from = 1, unit = "..." } }',
        ]
        return "\n".join(lines) + "\n"
    kind = kinds[guessed.kind]
    labels = (
        _commented(line, "unsure" if UNKNOWN in line else "likely", why) for line, why in lines_of_labels(found, kind)
    )
    lines = [
        *unread,
        *_unused_lines(found, guessed, kind),
        "[[experiment]]",
        _commented(f'kind = "{guessed.kind}"', guessed.confidence, guessed.reason),
        _commented(f"file = {json.dumps(file, ensure_ascii=False)}", "sure", _description(found, content)),
        *_layout_lines(found, number),
        *labels,
        *_setting_lines(found, guessed, kind),
        *_column_lines(found, guessed, kind),
        *_load_lines(found, guessed, kind),
    ]
    return "\n".join(lines) + "\n"


def _unread_lines(found: FoundLayout, dimensions: Sequence[str]) -> Iterable[str]:
    """A comment on every column with the unit of a reading, or the name of a time, whose cells are not all numbers."""
    for index, error in found.unread.items():
        name, text = found.header(index, dimensions)
        if fits_name(name, TIME) <= 0 and (not text or unit_of(text, dimensions) is None):
            continue
        stamps = ":" in error.value and fits_name(name, TIME) > 0
        remedy = printable("export times as seconds, or state the sampling rate" if stamps else error.remedy)
        value = f"line {error.line} has {' '.join(error.value.split())}"
        yield f"#: {found.names[index]!r} is not read: {value}. {remedy[0].upper()}{remedy[1:]}."


def _unused_lines(found: FoundLayout, guessed: Guess, kind: Kind) -> Iterable[str]:
    """A comment that names the columns which the entry does not use."""
    columns = [each for column in guessed.columns.values() for each in (column, *column.rivals)]
    used = {column.index for column in columns}
    names = [repr(name) for index, name in enumerate(found.names) if name and index not in used]
    more = f" and {counted(len(names) - _SHOWN_COLUMNS, 'more column')}" if len(names) > _SHOWN_COLUMNS else ""
    if names:
        yield f"#: Not used: {', '.join(names[:_SHOWN_COLUMNS])}{more}."


def _load_lines(found: FoundLayout, guessed: Guess, kind: Kind) -> Iterable[str]:
    """A line to be decided where a mass beside forces of friction may be what presses the capsule down."""
    used = {each.index for column in guessed.columns.values() for each in (column, *column.rivals)}
    weighed = [(i, unit_of(found.header(i, ["kg"])[1], ["kg"])) for i in found.columns if i not in used]
    index, unit = next(((i, unit) for i, unit in weighed if unit in ("kg", "g", "lb")), (0, None))
    if unit and "normal_force" in kind.optional and "normal_force" not in guessed.columns:
        line = f'columns.normal_force = {{ from = {source_of(found, index)}, unit = "{UNKNOWN}" }}'
        yield _commented(line, "unsure", f'write "{unit}f" if this mass presses on the track, else remove the line')


def _commented(line: str, confidence: str, reason: str) -> str:
    """A line with the confidence of its guess as a comment."""
    return f"{line}  # {confidence}: {' '.join(reason.split())}"


def _description(found: FoundLayout, content: bytes) -> str:
    """Rows and separator of a file in words."""
    text = counted(len(found.export.lines), "row")
    if found.export.path.suffix.lower() not in TEXTS:
        return text
    line = TextFile(content, found.export.path).line(int(found.export.lines[0]) - 1)
    return f"{text}, {_SEPARATORS[delimiter_of(line, found.layout)]} between the cells"


def _layout_lines(found: FoundLayout, number: int) -> Iterable[str]:
    """The keys of the layout that differ from the default."""
    used, blocks = found.layout, ", ".join(f"{first} to {last}" for first, last in found.blocks)
    part = used.sheet or (used.data_from_line if len(found.blocks) > 1 else None)
    stem = found.export.path.stem if used.sheet else found.export.path.name
    part = number if used.sheet and not used.sheet.isascii() else part  # names in other letters would be equal
    label = re.sub(r"[^A-Za-z0-9._-]+", "_", f"{stem}_{part}") if part else None
    codes = [text for text in used.missing if text not in NO_READING]
    several, one = len(found.blocks) > 1, f"the end of one of {len(found.blocks)} blocks of readings, lines {blocks}"
    first = "the first row of a block: check that the headers are those of its columns"
    for key, value, confidence, reason in (
        (
            "data_from_line",
            used.data_from_line,
            "unsure" if several else "sure",
            first if several else "the first row of readings",
        ),
        (
            "data_to_line",
            used.data_to_line,
            "likely",
            f"{one}; those of {FEWEST_SAMPLES} rows or fewer have no entry" if several else "the last row of readings",
        ),
        ("missing", codes or None, "likely", "far from all other numbers of their column: codes for no reading"),
        ("decimal", used.decimal, "likely", _DECIMALS.get(used.decimal or "", "")),
        ("sheet", used.sheet, "sure", "several sheets hold numbers, each has an entry"),
        ("label", label, "sure", "names of experiments differ"),
    ):
        if value is not None:
            yield _commented(f"{key} = {json.dumps(value, ensure_ascii=False)}", confidence, reason)


def _setting_lines(found: FoundLayout, guessed: Guess, kind: Kind) -> Iterable[str]:
    """Settings that the record or the name of the file suggests."""
    for key in kind.required:
        stem = re.sub(r"[^A-Za-z0-9._-]", "_", found.export.path.name.split(".")[0])
        yield _commented(f'{key} = "{stem}"', "unsure", "from the name of the file")
    constant = _constant_settings(found, guessed, kind)
    yield from constant.values()
    channel = next((name for name in guessed.columns if name != TIME), None)
    if TIME not in kind.columns or channel is None:
        return
    time, values = times_of_guess(found, guessed), found.columns[guessed.columns[channel].index]
    here = np.isfinite(values) & np.isfinite(time)
    time, values = time[here], values[here]
    time = time if (done := evened(time)) is None else done.times
    if "samples" in kind.setting_rules and are_turning_points(values):
        reason = "each row is smaller than the one before; remove this line if the rows are a record of the motion"
        yield _commented('samples = "turning_points"', "unsure", reason)
        return
    driven = "f" in kind.setting_rules and "f" not in constant and len(time) > 1
    if guessed.columns[TIME].unit == UNKNOWN if TIME in guessed.columns else guessed.rate is None:
        if driven:
            yield _commented(f'f = {{ value = "{UNKNOWN}", unit = "Hz" }}', "unsure", "state the set value")
        return
    if isinstance(kind.setting_rules.get("start"), QuantityRule) and (part := free_part(time, values)) is not None:
        if "releases" in kind.setting_rules and (several := find_releases(time, values, channel == "x_rel")):
            yield _commented('releases = "all"', "likely", f"{len(several)} releases, each of which is fitted")
            return
        start, stop = part
        yield _commented(f'start = {{ value = {start:.6g}, unit = "s" }}', "likely", "the free decay begins here")
        if stop is not None:
            yield _commented(f'stop = {{ value = {stop:.6g}, unit = "s" }}', "likely", "another excitation begins here")
    if driven:
        line = f'f = {{ value = {frequency_of(time, values):.4g}, unit = "Hz" }}'
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
            name, text = found.header(index, [rule.si])
            unit = unit_of(text, [rule.si])
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


def _column_lines(found: FoundLayout, guessed: Guess, kind: Kind) -> Iterable[str]:
    """A line for each column of the map; as comments, one for each column of the file, where the user must choose."""
    if TIME in kind.columns and TIME not in guessed.columns:
        rate, confidence, reason = f'"{UNKNOWN}"', "unsure", "the file states no rate"
        if guessed.rate is not None:
            rate, confidence, reason = f"{guessed.rate:g}", "likely", "the file states this rate and no times"
        yield _commented(f'columns.{TIME} = {{ rate = {{ value = {rate}, unit = "Hz" }} }}', confidence, reason)
    for index in times_of_trace(found, kind)[:1]:  # check refuses it: no sample of a trace may pass for a trial
        source = f'{{ from = {source_of(found, index)}, unit = "{unit_of(found.header(index, ["s"])[1], ["s"]) or UNKNOWN}" }}'
        yield _commented(
            f"columns.{TIME} = {source}", "unsure", f"a record in time: read the trials of {kind.name} off it"
        )
    for name, column in guessed.columns.items():
        for each in (column, *column.rivals):
            factor = "" if each.scale is None else f", scale = {each.scale:.10g}"
            signal = symbol_named(found.header(each.index, ["s"])[1])  # check then asks for the sensitivity
            unit = signal if each.unit == UNKNOWN and signal in SIGNALS else each.unit
            source = f'{{ from = {source_of(found, each.index)}, unit = "{unit}"{factor} }}'
            reason = column.reason if each is column else "or this one"
            yield _commented(f"{'# ' * column.asked}columns.{name} = {source}", column.confidence, reason)


# clock: Puts a file on the clock of another one.


def clock_line(files: Mapping[Path, bytes], common: str, kinds: Mapping[str, Kind]) -> str:
    """The line ``clock = ...`` with sds that puts the second of two files on the clock of the first one.

    Parameters
    ----------
    files : two files with their bytes
    common : header of the signal that both hold

    Raises
    ------
    InputError
        If a file has no times or no such header, or the signals are not the same.
    """
    records = []
    for path, content in files.items():
        found = find_layout(content, path, dimensions_of(kinds))
        guessed = guess(found, kinds)
        if guessed is None or TIME not in guessed.columns or guessed.columns[TIME].unit == UNKNOWN:
            raise InputError("a file must hold times with their unit", "none", "head them `time [s]`", path)
        index = next((index for index in found.columns if found.names[index] == common), None)
        if index is None:
            raise InputError(
                f"a file must have the column {common}",
                ", ".join(found.names[index] for index in found.columns),
                "name a column of both files",
                path,
            )
        records += [times_of_guess(found, guessed), found.columns[index]]
    clock = estimate_clock(*records)
    offset = f'{{ value = {clock.offset:.9g}, sd = {clock.offset_sd:.2g}, unit = "s" }}'
    drift = f'{{ value = {1e6 * clock.drift:.6g}, sd = {1e6 * clock.drift_sd:.2g}, unit = "ppm" }}'
    return f"clock = {{ offset = {offset}, drift = {drift} }}  # {clock.explained:.1%} of the signal explained"
