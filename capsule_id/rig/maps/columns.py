"""Guesses which columns of a file are those of one kind, and their units; proposes a column map for error lines."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from capsule_id.rig.filters import clock_starts
from capsule_id.rig.maps.headers import fits_name, meaning, name_and_unit, unit_of
from capsule_id.rig.maps.layout import FoundLayout
from capsule_id.rig.schema import KindRule
from capsule_id.rig.units import UNKNOWN, factor_to_si, scale

Confidence = Literal["sure", "likely", "unsure"]
TIME = "time"
#: Fewest rows of a record in time.
FEWEST_SAMPLES = 50
#: Score of a unit that fits a column, of the word for the friction that a kind takes, of a column that is left out, and of
#: one that is the same in every row.
UNIT_SCORE, MEANT_SCORE, LEFT_OUT, CONSTANT = 1.0, 0.5, -0.25, -2.0
#: Weight of the range of a column, relative to the largest one, which decides between equal scores only; score of a column
#: whose name does not fit.
TIE, _NO_NAME = 1e-3, -1e3
_LONGEST_HEADER = 40  # characters; a column with a longer header is named by its number
#: Columns that may be the same in every row, beside those that a kind calls optional.
SETTINGS = ("length", "speed", "period", "f", "periods")


@dataclass(frozen=True)
class ColumnGuess:
    """A column of the kind: index in the file, unit, what the guess rests on, and the factor to write beside it.

    ``rivals`` fit too and hold other numbers. ``asked``: which of them is meant, the user must say.
    """

    index: int
    unit: str
    confidence: Confidence
    reason: str
    scale: float | None = None
    rivals: tuple["ColumnGuess", ...] = ()
    asked: bool = False


@dataclass(frozen=True)
class Assignment:
    """Columns of a file as those of a kind.

    Attributes
    ----------
    columns : by name of the kind's column
    score : how well all fit
    wanted : the set of columns of the kind
    missing : columns that the kind needs and the file does not have; a time may be stated as a rate
    """

    kind: KindRule
    columns: Mapping[str, ColumnGuess]
    score: float = 0.0
    wanted: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


def assignments(found: FoundLayout, kind: KindRule) -> Iterable[Assignment]:
    """The best assignment of file columns to each set of columns of a kind."""
    for columns in kind.sets:
        optional = [name for name in kind.optional if name != "normal_force" or "force" in columns]
        wanted = [*columns, *kind.channels, *optional]
        scores = np.full((len(wanted), len(found.columns)), _NO_NAME)
        ranges = np.zeros_like(scores)
        guesses = {}
        for (i, name), (j, index) in product(enumerate(wanted), enumerate(found.columns)):
            scored = score_of(found, index, name, kind)
            if scored is not None:
                scores[i, j], guesses[i, j] = scored
                ranges[i, j] = np.ptp(readings_of(found, scored[1], kind.columns[name].si, finite=True))
        # Of columns that fit as well, such as the axes of an accelerometer, the one with the largest motion.
        largest = np.maximum(np.max(ranges, axis=1, keepdims=True, initial=0.0), np.finfo(float).tiny)
        rows, places = linear_sum_assignment(scores + TIE * ranges / largest, maximize=True)
        pairs = [(i, j) for i, j in zip(rows.tolist(), places.tolist(), strict=True) if scores[i, j] > _NO_NAME]
        unused = [j for j in range(len(found.columns)) if j not in {j for _, j in pairs}]
        chosen = {
            wanted[i]: _with_rivals(
                found,
                guesses[i, j],
                float(scores[i, j]),
                [(guesses[i, k], float(scores[i, k])) for k in unused if (i, k) in guesses],
                kind.columns[wanted[i]].si,
            )
            for i, j in pairs
        }
        for (i, k), other in guesses.items():
            named = (
                wanted[i] not in optional
                or wanted[i] in chosen
                or meaning(found.names[other.index], "force", kind.meant)
            )
            if k in unused and not named:  # a normal force under another name would change the number
                reason = f"{other.reason}; remove the # if it is the {wanted[i]}"
                chosen[wanted[i]] = replace(other, confidence="unsure", reason=reason, asked=True)
        channel = () if not kind.channels or set(kind.channels) & set(chosen) else kind.channels[:1]
        missing = (*(name for name in columns if name not in chosen and name != TIME), *channel)
        score = sum(float(scores[pair]) for pair in pairs) + LEFT_OUT * len(set(columns) - set(chosen))
        yield Assignment(kind, chosen, score, columns, missing)


def readings_of(found: FoundLayout, column: ColumnGuess, si: str, *, finite: bool = False) -> np.ndarray:
    """The readings of a column in SI, (n,); as they are where their unit is unknown."""
    values = found.columns[column.index]
    values = values[np.isfinite(values)] if finite else values
    return values if column.unit == UNKNOWN else scale(values, factor_to_si(column.unit, si))


def increases(values: np.ndarray) -> bool:
    """Whether times increase; a clock may start anew."""
    values = values[np.isfinite(values)]
    return int(np.sum(np.diff(values) <= 0.0)) == len(clock_starts(values))


def times_of(found: FoundLayout) -> list[int]:
    """Columns that are named as times and increase from row to row."""
    named = ((index, name_and_unit(found.names[index], ["s"])[0]) for index in found.columns)
    return [index for index, name in named if fits_name(name, TIME) > 0 and increases(found.columns[index])]


def is_constant(found: FoundLayout, index: int) -> bool:
    """Whether a column of several rows is the same in all of them."""
    return len(values := found.columns[index]) > 1 and bool(np.nanmax(values) == np.nanmin(values))


def _with_rivals(
    found: FoundLayout, column: ColumnGuess, score: float, others: Sequence[tuple[ColumnGuess, float]], si: str
) -> ColumnGuess:
    """The guess with its score beside the ``others`` that may be meant, with theirs; equal numbers are no rivals."""
    own = readings_of(found, column, si)
    rivals = [
        each
        for each in others
        if not np.allclose(readings_of(found, each[0], si), own, rtol=1e-9, atol=0, equal_nan=True)
    ]
    if not rivals:
        return column
    # The end of a word says no more than another name.
    least = _NO_NAME if score <= 1.0 + UNIT_SCORE else score
    alike = tuple(other for other, its in rivals if its + UNIT_SCORE * (other.unit == UNKNOWN) >= least)
    columns = [f"column {other.index + 1}, {found.names[other.index]!r}," for other, _ in rivals]
    reason = f"{column.reason}; {' '.join(columns)} fits {'as well' if alike else 'less well'}"
    confidence = "unsure" if alike else "likely" if column.confidence == "sure" else column.confidence
    return replace(column, confidence=confidence, reason=reason, rivals=alike, asked=column.asked or bool(alike))


def score_of(found: FoundLayout, index: int, name: str, kind: KindRule) -> tuple[float, ColumnGuess] | None:
    """How well a column of the file fits the column ``name`` of a kind; None where it cannot be."""
    rule = kind.columns[name]
    stem, text = name_and_unit(found.names[index], sorted({each.si for each in kind.columns.values()}))
    text = (text if text is not None else found.units[index]).strip()
    unit = unit_of(text, [rule.si]) if text else None
    constant = is_constant(found, index)
    named, meant = fits_name(stem, name), meaning(stem, name, kind.meant)
    said = f"the file says {found.names[index]!r}"
    if (text and unit is None) or named < 0 or (constant and rule.varies):
        return None
    by_name = named + MEANT_SCORE * meant if named or name == "force" else 0.0
    if by_name <= 0.0 or meant < 0:
        other = (constant and name not in kind.optional) or not (unit or named) or rule.si == "1"
        return None if other else (_NO_NAME, ColumnGuess(index, unit or UNKNOWN, "unsure", said))
    if constant and name not in (*SETTINGS, *kind.optional):
        reason = f"{said}, the same in every row: a setting, or a coarse reading"
        return by_name + CONSTANT, ColumnGuess(index, unit or UNKNOWN, "unsure", reason, asked=True)
    if unit is None and rule.si == "1":
        return by_name, ColumnGuess(index, "1", "likely", "a number without unit")
    if unit is None:
        return by_name, ColumnGuess(index, UNKNOWN, "unsure", "the file states no unit")
    reason = said if unit == text else f"{said}, read as {unit}"
    return by_name + UNIT_SCORE, ColumnGuess(index, unit, "likely" if unit == "g_n" else "sure", reason)


def source_of(found: FoundLayout, index: int) -> str:
    """The header of a column, or its number where the header is not unique, long or absent."""
    header = found.names[index]
    everything = [name for row in found.export.headers for name in row]
    usable = header and header.isprintable() and len(header) <= _LONGEST_HEADER and everything.count(header) == 1
    return json.dumps(header, ensure_ascii=False) if usable else str(index + 1)


def proposal(kind: KindRule, found: FoundLayout | None) -> str:
    """The text ``columns = { ... }`` that reads a file as a table of ``kind``; ``?`` is what the file does not say.

    ``found`` is the file (None: unknown).
    """
    best, record = Assignment(kind, {}, 0.0, kind.sets[0], kind.channels[:1]), False
    if found is not None:
        best = max(assignments(found, kind), key=lambda one: (-len(one.missing), one.score))
        # A reading of a calibration is a row of a record; a trial is not.
        record = not any(rule.varies for rule in kind.columns.values()) and any(
            len(found.columns[index]) >= FEWEST_SAMPLES for index in times_of(found)
        )
    texts, words = [], []
    for name in dict.fromkeys((*best.wanted, *best.columns, *best.missing)):
        column = best.columns.get(name)
        source = f'from = "{UNKNOWN}", unit = "{UNKNOWN if column is None else column.unit}"'
        if found is not None and column is None and name == TIME:
            source = f'rate = {{ value = "{UNKNOWN}", unit = "Hz" }}'
        elif found is not None and column is not None:
            if record or column.asked:
                words.append(f"{name}: {'the file is a record in time' if record else column.reason}")
            else:
                source = source.replace(f'"{UNKNOWN}"', source_of(found, column.index), 1)
        if column is None or not column.asked or name not in kind.optional:
            texts.append(f"{name} = {{ {source} }}")
    return f"columns = {{ {', '.join(texts)} }}" + (f" ({'; '.join(words)})" if words else "")
