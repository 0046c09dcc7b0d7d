"""Readings from plateaus of a time trace, and outliers that a stated rule drops."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import ClassVar

import numpy as np

from capsule_id.parameters import SAME
from capsule_id.rig.filters import hampel_outliers, median_step
from capsule_id.rig.formats.raw import Place, RawTable
from capsule_id.rig.schema import ChoiceRule, KindRule, PlainRule, SettingRule, read_rules
from capsule_id.rig.toml import Node, is_number, shown
from capsule_id.rig.units import UnitError, factor_to_si, scale
from capsule_id.views import counted

# rejection: Drops outliers of a record by the rule that ``rig.toml`` states: ``reject = { rule = "hampel", ... }``.


_REJECT_EXAMPLE = '{ rule = "hampel", window = "50 ms", n_sd = 5 }'
_DURATION = re.compile(r"\s*([+-]?[0-9]+\.?[0-9]*(?:[eE][+-]?[0-9]+)?)\s*([^\s0-9]+)\s*")


class DurationRule:
    """A duration such as "50 ms"."""

    schema: ClassVar = {"type": "string", "description": "such as 50 ms"}

    def read(self, node: Node) -> float:
        """See ``SettingRule``; s."""
        text, remedy = node.text(), f'write {node.key} = "50 ms"'
        found = _DURATION.fullmatch(text)
        node.require(found is not None, "be a number with a unit of time", remedy)
        assert found is not None, "a duration"
        try:
            duration = scale(float(found[1]), factor_to_si(found[2], "s"))
        except UnitError as error:
            raise node.error(error.rule, shown(text), remedy) from None
        node.require(0.0 < duration < np.inf, "be greater than 0", remedy)
        return duration


REJECT: Mapping[str, SettingRule] = {
    "rule": ChoiceRule(("hampel",)),
    "window": DurationRule(),
    "n_sd": PlainRule(
        lambda value: is_number(value) and value >= 1,
        "be a number, 1 or more",
        "write n_sd = 5",
        {"type": "number", "minimum": 1},
    ),
}


def without_outliers(node: Node, raw: RawTable, times: Callable[[RawTable], np.ndarray]) -> RawTable:
    """The table without its outliers by Hampel's rule.

    A sample further than ``n_sd`` robust sds from the median of the ``window`` around it is dropped.

    Parameters
    ----------
    node : the rule
    raw : the table; its column ``time`` is not judged
    times : gives its times, (n,) s, increasing

    Raises
    ------
    InputError
        At a key or value of the rule; if the table has no times, or the window holds less than two sampling steps or does
        not fit into the record.
    """
    node.table(_REJECT_EXAMPLE, tuple(REJECT))
    for key in REJECT:
        node.required(key, f"write {_REJECT_EXAMPLE}")
    stated = read_rules(node, REJECT)
    if "time" not in raw.names:
        raise node.error(
            "reject needs a record with times",
            " ".join(raw.names),
            "remove reject, and correct or delete the rows",
            of_key=True,
        )
    time = times(raw)
    step = median_step(time) if len(time) > 1 else np.inf
    half = stated["window"] / step / 2.0
    if not 1.0 - SAME <= half <= len(time) / 2.0:
        raise node["window"].error(
            "the window must hold two sampling steps or more, and fit into the record",
            f"{stated['window']:g} s; the record has {counted(len(time), 'sample')}, a step is {step:.4g} s",
            "write a window of about 10 steps",
        )
    judged = [column for name, column in zip(raw.names, raw.columns, strict=True) if name != "time"]
    outlying = [hampel_outliers(values, 2 * round(half) + 1, float(stated["n_sd"])) for values in judged]
    kept = np.flatnonzero(~np.any([np.zeros(len(time), bool), *outlying], axis=0))
    return replace(raw.taken(kept), rejected=len(time) - len(kept))


# plateaus: Makes readings of a time trace of steps: ``plateaus = { levels = [0, 10, 20], unit = "lbf", guard = "2 s"
# }``.
#
# The trace is divided into as many parts as there are levels, by least squares of a piecewise constant function
# (dynamic programming; Bellman, Commun. ACM 4, 284 (1961)). Each part gives one row: its mean without the guard at
# both ends.


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


#: Name of a column, its stated levels in the order of time, their unit, and the guard, s, left out before and after each
#: step.
Plateaus = tuple[str, np.ndarray, str, float]


def read_plateaus(entry: Node, kind: KindRule) -> Plateaus | None:
    """The plateaus of an experiment, None where it states none.

    The levels are those of the column of the kind that ``columns`` leaves out.

    Raises
    ------
    InputError
        At the key or value that is wrong.
    """
    if "plateaus" not in entry:
        return None
    node, columns = entry["plateaus"], entry.value.get("columns")
    mapped = set(columns) if isinstance(columns, dict) else set()
    left = [[name for name in columns if name not in mapped] for columns in kind.sets if "time" not in columns]
    names = next((names for names in left if len(names) == 1), None)
    if names is None or "time" not in mapped:
        raise node.error(
            f"plateaus of {kind.name} need a map of time and of all its columns but one",
            " ".join(sorted(mapped)) or "no columns",
            f"map time and {' or '.join(sorted({name for columns in kind.sets for name in columns}))} in columns",
            of_key=True,
        )
    levels = node.table(_EXAMPLE, ("levels", "unit", "guard")).get("levels", None)
    stated = levels.value if isinstance(levels.value, list) and all(map(is_number, levels.value)) else []
    levels.require(
        len(set(stated)) > 1,
        "be a list of numbers, two or more different ones",
        "write a level for each plateau, in order",
    )
    node.unit(kind.columns[names[0]].si)
    guard = DurationRule().read(node["guard"]) if "guard" in node else 0.0
    return names[0], np.array(stated, float), node.value["unit"], guard


def readings_of_plateaus(node: Node, raw: RawTable, time: np.ndarray, plateaus: Plateaus) -> RawTable:
    """A row for each plateau, which stands where its first sample does.

    Parameters
    ----------
    node : of the plateaus, for error lines
    raw : the trace; its columns but ``time`` are averaged
    time : (n,) s, increasing

    Raises
    ------
    InputError
        If the guard leaves too few samples, or the readings do not follow the levels.
    """
    channels = [index for index, name in enumerate(raw.names) if name != "time"]
    trace = np.column_stack([raw.columns[index] for index in channels])
    name, levels, unit, guard = plateaus
    count = len(levels)
    if len(time) < FEWEST_SAMPLES * count:
        raise node.error(f"{count} plateaus need more samples", f"{len(time)}", "record them for longer")
    edges, block = find_steps(trace, count)
    guard += (block - 1) * median_step(time)
    parts = []
    for first, last in pairwise(edges):
        begins = time[first] + (guard if first > 0 else 0.0)
        ends = time[last - 1] - (guard if last < len(time) else 0.0)
        part = np.flatnonzero((time >= begins) & (time <= ends) & (np.arange(len(time)) >= first))
        parts.append(part[part < last])
        if len(parts[-1]) < FEWEST_SAMPLES:
            raise node.error(
                f"a plateau must have {FEWEST_SAMPLES} samples beside the guard",
                f"{len(parts[-1])} from {time[first]:.4g} to {time[last - 1]:.4g} s",
                "shorten guard, or state a level for each plateau of the trace",
            )
    means = np.array([trace[part].mean(axis=0) for part in parts])
    stated, reversed_ = (float(np.corrcoef(order, means[:, 0])[0, 1]) for order in (levels, levels[::-1]))
    if reversed_ > stated and 1.0 - reversed_ < CLEARLY_LESS * (1.0 - stated):  # every sensitivity is positive
        raise node["levels"].error(
            "the levels must stand in the order of time, and the readings must increase with them",
            f"correlation {stated:.4g} as stated, {reversed_:.4g} in reverse order",
            "reverse the levels, or state scale = -1 for a sensor of the other sign",
        )
    correlation = abs(stated)
    if not correlation >= SMALLEST_CORRELATION:
        raise node["levels"].error(
            f"the readings must follow the levels (correlation {SMALLEST_CORRELATION} or more)",
            f"{correlation:.2g}; means {' '.join(f'{mean:.4g}' for mean in means[:, 0])}",
            "state a level for each plateau, in the order of time",
        )
    _check_constant(node["levels"], trace, parts, means)
    starts = np.array([part[0] for part in parts])
    names = (*(raw.names[index] for index in channels), name)
    units = (*(raw.units[index] for index in channels), unit)

    def place(row: int | None, column: int) -> Place:
        return raw.place(None if row is None else int(starts[row]), channels[min(column, len(channels) - 1)])

    columns = (*means.T, levels)
    return replace(raw, names=names, units=units, columns=columns, rows=raw.rows[starts], place=place)


def _check_constant(node: Node, trace: np.ndarray, parts: list[np.ndarray], means: np.ndarray) -> None:
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
            raise node.error(
                "the trace must be constant on each plateau",
                f"{one.mean():.4g} and {other.mean():.4g} on one of {len(parts)} plateaus",
                "state a level for each plateau of the trace",
            )


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
