"""Guesses the kind of experiment of an export, and which of its columns and units are those of the kind."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Kind
from capsule_id.records.faults.release import find_free_decay
from capsule_id.rig.filters import clock_starts
from capsule_id.rig.maps.columns import (
    FEWEST_SAMPLES,
    TIME,
    Assignment,
    ColumnGuess,
    Confidence,
    assignments,
    increases,
    is_constant,
    score_of,
    times_of,
)
from capsule_id.rig.maps.headers import fits_name, name_and_unit, unit_of
from capsule_id.rig.maps.layout import FoundLayout
from capsule_id.rig.schema import QuantityRule
from capsule_id.rig.units import UNKNOWN, factor_to_si

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

    @property
    def unsure(self) -> bool:
        """Whether the kind or any column is a guess without a reason."""
        return "unsure" in (self.confidence, *(column.confidence for column in self.columns.values()))


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
        text = name_and_unit(found.names[index], sorted(dimensions))[1] or found.units[index]
        others = sorted(dimensions - stated if is_constant(found, index) else dimensions)
        # A number of a trial is no reading, nor is a mass, or a percentage.
        label = found.columns[index] == np.clip(np.rint(found.columns[index]), 0, len(found.columns[index]))
        unnamed = not text and len(chosen.columns) == 1 and not label.all()
        if unnamed or (unit_of(text, others) not in (None, "%") and unit_of(text, ["kg"]) is None):
            return "unsure", f"column {index + 1}, {found.names[index]!r}, is not used"
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
        stem, text = name_and_unit(found.names[index], [*ANGULAR, *ANGULAR.values()])
        text = (text if text is not None else found.units[index]).strip()
        unit = unit_of(text, [ANGULAR[si]])
        known = max(fits_name(stem, name), fits_name(stem, "angle") if name == "x_rel" else 0) > 0
        if known and unit is not None:
            reason = f"{found.names[index]!r} times an arm of 1 m; {remedy}"
            return name, ColumnGuess(index, si, "unsure", reason, factor_to_si(unit, ANGULAR[si]))
        if name == "x_rel" and not text and fits_name(stem, "angle") > 0:
            reason = f"an angle without unit: write {si} and scale = 1 for rad, 0.01745329252 for degrees"
            return name, ColumnGuess(index, UNKNOWN, "unsure", f"{reason}; {remedy}")
    return None


def _is_record(found: FoundLayout, time: int | None) -> bool:
    """Whether a file is a record in time: long enough, with increasing times."""
    rows = len(next(iter(found.columns.values())))
    return rows >= FEWEST_SAMPLES if time is None else rows >= 8 and increases(found.columns[time])


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
    dimensions = sorted({rule.si for kind in kinds.values() for rule in kind.columns.values()})
    candidates = []
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
    found: FoundLayout, index: int, names: list[str], kind: Kind, dimensions: list[str]
) -> tuple[str, str] | None:
    """The first of the ``names`` that the unit in the file allows, and that unit."""
    text = name_and_unit(found.names[index], dimensions)[1] or found.units[index]
    unknown = None if unit_of(text, dimensions) else UNKNOWN
    units = ((name, unit_of(text, [kind.columns[name].si]) or unknown) for name in names)
    return next(((name, unit) for name, unit in units if unit is not None), None)


def disordered_times(found: FoundLayout) -> tuple[str, int] | None:
    """Header of a column of times that do not increase, and the first line where they do not; None without one."""
    for index, values in found.columns.items():
        name, text = name_and_unit(found.names[index], ["s"])
        if fits_name(name, TIME) > 0 and unit_of(text or found.units[index], ["s"]) is not None:
            for row in np.flatnonzero(np.diff(values) <= 0.0):
                return found.names[index], int(found.export.lines[row + 1])
    return None


def are_turning_points(values: np.ndarray) -> bool:
    """Whether the few readings of a table can be the amplitudes of a decay, on one side or on both sides in turn."""
    sizes, signs = np.abs(values), np.sign(values)
    sides = signs[1:] * signs[:-1]
    falls = bool(np.all(np.diff(sizes) <= 0.0)) and sizes[-1] < sizes[0]
    return len(values) < FEWEST_SAMPLES and falls and bool(np.all(sides == sides[0])) and sides[0] != 0.0


def free_part(time: np.ndarray, values: np.ndarray) -> tuple[float, float | None] | None:
    """Start and stop of the free decay in a record, s; None where all of it is free or nothing swings."""
    try:
        decay = find_free_decay(time, values)
    except InputError:
        return None
    if decay is None or np.any(np.diff(time) <= 0.0) or (decay.rest == 0.0 and decay.stop is None):
        return None
    return decay.start, decay.end
