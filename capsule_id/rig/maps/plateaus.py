"""Makes readings of a time trace of steps: ``plateaus = { levels = [0, 10, 20], unit = "lbf", guard = "2 s" }``.

The trace is divided into as many parts as there are levels, by least squares of a piecewise constant function (dynamic
programming; Bellman, Commun. ACM 4, 284 (1961)). Each part gives one row: its mean without the guard at both ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.maps.rejection import read_duration
from capsule_id.rig.schema import KindRule
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import read_table, read_unit, refuse_unknown_keys, shown

_EXAMPLE = '{ levels = [0, 10, 20], unit = "N", guard = "2 s" }'
#: Most parts of a trace that are compared; longer traces are averaged in blocks first.
MOST_BLOCKS = 1500
#: Smallest correlation of the levels with the means of the parts.
SMALLEST_CORRELATION = 0.9
#: Reversed levels that leave less than this share of the misfit, 1 - correlation, are the true order.
CLEARLY_LESS = 0.1
#: Fewest samples of a plateau.
FEWEST_SAMPLES = 3
#: Largest step inside a plateau relative to the median step between plateaus, where both sides of it hold at least this
#: share of the samples of the plateau.
LARGEST_INNER_STEP, LEAST_SHARE = 0.3, 0.1


@dataclass(frozen=True)
class Plateaus:
    """Levels of the column ``name`` in the order of time, in ``unit``; ``guard``: left out beside each step, s."""

    name: str
    levels: np.ndarray
    unit: str
    guard: float


def read_plateaus(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any], kind: KindRule) -> Plateaus | None:
    """The plateaus of the experiment at ``path``, None where it states none.

    The levels are those of the column of the kind that ``columns`` leaves out.

    Raises
    ------
    InputError
        At the key or value that is wrong.
    """
    if "plateaus" not in entry:
        return None
    place = (*path, "plateaus")
    mapped = set(entry["columns"]) if isinstance(entry.get("columns"), dict) else set()
    left = [[name for name in columns if name not in mapped] for columns in kind.sets if "time" not in columns]
    names = next((names for names in left if len(names) == 1), None)
    if names is None or "time" not in mapped:
        rule = f"plateaus of {kind.name} need a map of time and of all its columns but one"
        remedy = f"map time and {' or '.join(sorted({name for columns in kind.sets for name in columns}))} in columns"
        raise document.error(place, rule, " ".join(sorted(mapped)) or "no columns", remedy, of_key=True)
    stated = read_table(document, place, entry["plateaus"], _EXAMPLE)
    refuse_unknown_keys(document, place, stated, ("levels", "unit", "guard"))
    levels = stated.get("levels")
    numbers = isinstance(levels, list) and all(
        isinstance(level, int | float) and not isinstance(level, bool) and np.isfinite(level) for level in levels
    )
    if not isinstance(levels, list) or not numbers or len(set(levels)) < 2:
        rule = "levels must be a list of numbers, two or more different ones"
        raise document.error((*place, "levels"), rule, shown(levels), "write a level for each plateau, in order")
    read_unit(document, place, stated, kind.columns[names[0]].si)
    guard = read_duration(document, (*place, "guard"), stated["guard"]) if "guard" in stated else 0.0
    return Plateaus(names[0], np.array(levels, float), stated["unit"], guard)


def readings_of_plateaus(
    document: TomlDocument, path: KeyPath, raw: RawTable, time: np.ndarray, plateaus: Plateaus
) -> tuple[RawTable, np.ndarray]:
    """A row for each plateau, and the index of its first sample, (k,).

    Parameters
    ----------
    raw : the trace; its columns but ``time`` are averaged
    time : (n,) s, increasing

    Raises
    ------
    InputError
        If the guard leaves too few samples, or the readings do not follow the levels.
    """
    place = (*path, "plateaus")
    channels = [index for index, name in enumerate(raw.names) if name != "time"]
    trace = raw.values[:, channels]
    count = len(plateaus.levels)
    if len(time) < FEWEST_SAMPLES * count:
        raise document.error(place, f"{count} plateaus need more samples", f"{len(time)}", "record them for longer")
    edges, block = find_steps(trace, count)
    guard = plateaus.guard + (block - 1) * float(np.median(np.diff(time)))
    parts = []
    for first, last in pairwise(edges):
        begins = time[first] + (guard if first > 0 else 0.0)
        ends = time[last - 1] - (guard if last < len(time) else 0.0)
        part = np.flatnonzero((time >= begins) & (time <= ends) & (np.arange(len(time)) >= first))
        parts.append(part[part < last])
        if len(parts[-1]) < FEWEST_SAMPLES:
            rule = f"a plateau must have {FEWEST_SAMPLES} samples beside the guard"
            value = f"{len(parts[-1])} from {time[first]:.4g} to {time[last - 1]:.4g} s"
            raise document.error(place, rule, value, "shorten guard, or state a level for each plateau of the trace")
    means = np.array([trace[part].mean(axis=0) for part in parts])
    correlation = abs(float(np.corrcoef(plateaus.levels, means[:, 0])[0, 1]))
    _check_order(document, place, plateaus.levels, means[:, 0])
    if not correlation >= SMALLEST_CORRELATION:
        rule = f"the readings must follow the levels (correlation {SMALLEST_CORRELATION} or more)"
        value = f"{correlation:.2g}; means {' '.join(f'{mean:.4g}' for mean in means[:, 0])}"
        raise document.error((*place, "levels"), rule, value, "state a level for each plateau, in the order of time")
    _check_constant(document, place, trace, parts, means)
    starts = np.array([part[0] for part in parts])
    names = (*(raw.names[index] for index in channels), plateaus.name)
    units = (*(raw.units[index] for index in channels), plateaus.unit)

    def cell(row: int | None, column: int) -> tuple[int, int]:
        return raw.place(None if row is None else int(starts[row]), channels[min(column, len(channels) - 1)])

    return RawTable(names, units, (*means.T, plateaus.levels), raw.rows[starts], cell), starts


def _check_order(document: TomlDocument, place: KeyPath, levels: np.ndarray, means: np.ndarray) -> None:
    """Refuse levels (k,) that fit the means (k,) of the parts in reverse order only: every sensitivity is positive.

    Raises
    ------
    InputError
        At the list of levels.
    """
    stated, reversed_ = (float(np.corrcoef(order, means)[0, 1]) for order in (levels, levels[::-1]))
    if reversed_ > stated and 1.0 - reversed_ < CLEARLY_LESS * (1.0 - stated):
        rule = "the levels must stand in the order of time, and the readings must increase with them"
        value = f"correlation {stated:.4g} as stated, {reversed_:.4g} in reverse order"
        remedy = "reverse the levels, or state scale = -1 for a sensor of the other sign"
        raise document.error((*place, "levels"), rule, value, remedy)


def _check_constant(
    document: TomlDocument, place: KeyPath, trace: np.ndarray, parts: list[np.ndarray], means: np.ndarray
) -> None:
    """Refuse a part with a step inside: the trace then has more plateaus than levels.

    Parameters
    ----------
    trace : (n, channels)
    parts, means : samples of each part, and their means (k, channels)

    Raises
    ------
    InputError
        At the list of levels.
    """
    step = np.median(np.abs(np.diff(means[:, 0])))
    for part in parts:
        middle = find_steps(trace[part], 2)[0][1]
        one, other = trace[part[:middle], 0], trace[part[middle:], 0]
        if min(len(one), len(other)) < LEAST_SHARE * len(part):
            continue
        if abs(one.mean() - other.mean()) > LARGEST_INNER_STEP * step:
            rule = "the trace must be constant on each plateau"
            value = f"{one.mean():.4g} and {other.mean():.4g} on one of {len(parts)} plateaus"
            raise document.error((*place, "levels"), rule, value, "state a level for each plateau of the trace")


def find_steps(trace: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """First sample of each of ``count`` constant parts, and the end, (count + 1,); and the samples of a block.

    Parameters
    ----------
    trace : (n, channels) readings; every channel counts by its own scatter
    """
    block = -(-len(trace) // MOST_BLOCKS)
    sizes = np.diff(np.append(np.arange(0, len(trace), block), len(trace)))
    spread = np.std(trace, axis=0)
    scaled = (trace - trace.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    sums = np.add.reduceat(scaled, np.arange(0, len(trace), block), axis=0)
    total = np.vstack([np.zeros(trace.shape[1]), np.cumsum(sums, axis=0)])
    number = np.concatenate([[0], np.cumsum(sizes)]).astype(float)
    # Gain of a part from block i to block j: the part of the sum of squares that its mean explains.
    length = number[None, :] - number[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.sum((total[None] - total[:, None]) ** 2, axis=2) / length
    gain[~(length > 0.0)] = -np.inf
    best, origins = gain[0], []
    for _ in range(count - 1):
        through = best[:, None] + gain
        origins.append(np.argmax(through, axis=0))
        best = np.max(through, axis=0)
    edges = [len(sizes)]
    for origin in reversed(origins):
        edges.append(int(origin[edges[-1]]))
    return number[[0, *edges[::-1]]].astype(int), block
