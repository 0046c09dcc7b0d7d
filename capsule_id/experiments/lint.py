"""Findings on the readings of a rig before a fit: tables, scales, and channels of a record."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capsule_id.experiments.kind import Estimate, Kind
from capsule_id.parameters import TABLE_1
from capsule_id.records.duplicates import Readings, repeated_blocks
from capsule_id.records.faults import (
    clipped_samples,
    dropouts,
    find_gaps,
    frozen_samples,
    jump_or_noise,
    noisy_stretch,
    time_rounding,
)
from capsule_id.records.release import find_free_decay
from capsule_id.records.tones import frequency_of
from capsule_id.rig.filters import TIMING_TOLERANCE, hampel_outliers, largest_offset, median_step, rounded
from capsule_id.rig.formats.raw import WINDOWS
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.rig.schema import RIG_QUANTITIES, SHORTEST_RECORD, ColumnRule, GroundSettings, QuantityRule
from capsule_id.rig.units import factor_to_si
from capsule_id.views import Finding, Level

# lint magnitudes: Findings on scales: numbers of a rig, and relations between them, that a wrong unit would make
# unusual.


#: Usual magnitudes by SI unit: lowest and highest largest value of a column, or value of a setting. A rig with m1 of 10 g
#: to 10 kg stays inside. What a wrong prefix leaves inside for some rigs, the relations below find.
USUAL: Mapping[str, tuple[float, float]] = {
    "kg": (2e-3, 60.0),
    "m": (2e-5, 0.9),
    "N": (0.1, 900.0),
    "A": (0.01, 200.0),
    "m/s": (2e-3, 100.0),
    "m/s^2": (0.1, 3000.0),
    "rad": (0.03, 1.57),
    "rad/s": (0.3, 3000.0),
    "Hz": (0.05, 500.0),
    "1": (0.01, 10.0),
}
#: Usual ratios: m2 over m1, a force over the weight of the stated masses, k2 over k1, gap over amplitude. Of 60 random
#: benches (m1 log-uniform from 10 g to 10 kg, their other ratios scattered by 30 %) none leaves these intervals; of 1,800
#: masses and columns of theirs that are wrong by 1000 one stays inside. k2 over k1 may not vary by more than a prefix does.
MASSES, FORCES, STIFFNESSES, GAPS = (0.03, 150.0), (0.02, 100.0), (0.3, 300.0), (3e-3, 20.0)
#: Usual m1 of a rig without m2, and force per current and force per deflection of a rig without masses: no relation
#: judges them, so that an interval is narrower than the prefix of a unit.
MASS_ALONE, MOTOR_ALONE, SPRING_ALONE = (0.02, 5.0), (0.3, 40.0), (100.0, 1e5)
#: Usual period of a decay or a drive, s, and amplitude of the acceleration of a decay, m/s^2, which holds the square of
#: the unit of time.
USUAL_PERIODS, ACCELERATIONS = (2e-3, 20.0), (3e-3, 1e4)
#: Factor of a wrong prefix, such as m for mm, and largest distance of a ratio from it, in decades, that it explains.
PREFIX, NEAR_PREFIX = 1.0 / factor_to_si("mm", "m"), 0.3


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.ptp(x) / (np.ptp(y) or 1e-30))


#: Relations between two columns: their names, the words, the SI unit, the value, its usual interval, and that without masses.
RELATIONS = (
    (("force", "current"), "force per current", "N/A", _slope, (0.03, 300.0), MOTOR_ALONE),
    (("force", "deflection"), "force per deflection", "N/m", _slope, (0.0, np.inf), SPRING_ALONE),
    # A load in kg that is taken for N makes the friction 9.81 times too large, and fits as well.
    (
        ("force", "normal_force"),
        "force over normal force",
        "1",
        lambda x, y: float(np.median(x / y)),
        *2 * [(0.02, 2.0)],
    ),
    (
        ("speed", "distance"),
        "speed^2/(2 g distance)",
        "1",
        lambda x, y: float(np.median(x**2 / (2.0 * TABLE_1["g"] * y))),
        (0.01, 20.0),
        (0.01, 20.0),
    ),
)
#: Units that are mistaken for each other, the likeliest first.
_ALTERNATIVES: Mapping[str, tuple[str, ...]] = {
    "kg": ("g", "kg", "mg"),
    "m": ("mm", "m", "um", "cm"),
    "s": ("ms", "s", "us", "min"),
    "N": ("N", "mN", "kN", "gf", "kgf"),
    "A": ("A", "mA", "uA"),
    "m/s": ("m/s", "mm/s", "cm/s"),
    "m/s^2": ("m/s^2", "mm/s^2", "g_n"),
    "rad": ("rad", "deg", "mrad"),
    "rad/s": ("rad/s", "rpm", "rev/s"),
    "Hz": ("Hz", "kHz"),
}


@dataclass(frozen=True)
class Number:
    """A number, SI, with the words and the interval that judge it.

    Attributes
    ----------
    scales : what it is a product of, as ``confirmed`` of [rig] names it: ``m1``, ``decay_1.time``
    shared : further ones, those of all relations of its kind
    label : of its experiment
    unit, to_display : as written; "" for ``si``
    code : of the finding
    """

    name: str
    value: float
    si: str
    usual: tuple[float, float]
    scales: tuple[str, ...]
    label: str = ""
    unit: str = ""
    to_display: float = 1.0
    code: str = "readings.magnitude"
    shared: tuple[str, ...] = ()

    def unusual(self, rig: Rig) -> Iterable[Finding]:
        """Warn where the value lies outside the interval and ``rig`` does not confirm every scale."""
        (low, high), written = self.usual, abs(self.value) * self.to_display
        if self.value == 0.0 or low <= abs(self.value) <= high or set(self.scales) <= set(rig.confirmed):
            return
        units = _ALTERNATIVES.get(self.si, ()) if len(self.scales) == 1 else ()
        facts = {
            "name": self.name,
            "value": self.value * self.to_display,
            "low": low * self.to_display,
            "high": high * self.to_display,
            "unit": self.unit or self.si,
            "scales": self.scales,
            # The likeliest unit in which the written number would be usual.
            "meant": next((unit for unit in units if low <= written * factor_to_si(unit, self.si) <= high), ""),
        }
        yield Finding(self.code, "warn", facts, self.label)


def lint_rig_quantities(rig: Rig) -> Iterable[Finding]:
    """Warn of unusual masses, their ratio, and an unusual g."""
    for name, rule in RIG_QUANTITIES.items():
        quantity: Quantity | None = getattr(rig, name)
        if quantity is not None:
            usual = rule.usual or (USUAL[rule.si] if rig.m2 is not None else MASS_ALONE)
            yield from Number(f"{name} of [rig]", quantity.value, rule.si, usual, (name,)).unusual(rig)
    if rig.m1 is not None and rig.m2 is not None:
        yield from Number("m2 / m1", rig.m2.value / rig.m1.value, "1", MASSES, ("m1", "m2")).unusual(rig)


def lint_magnitudes(tables: Sequence[Table[Any]], kinds: Mapping[str, Kind], rig: Rig) -> Iterable[Finding]:
    """Warn of columns, settings and relations with unusual values."""
    numbers = [number for table in tables for number in _numbers(table, kinds[table.kind], rig)]
    # A wrong prefix in shared scales would make these relations unusual, so that they are right in the others too.
    right = {n.shared for n in numbers if n.usual[1] / PREFIX <= n.value <= n.usual[0] * PREFIX}
    for number in numbers:
        shared = () if number.shared in right else number.shared
        yield from replace(number, scales=(*number.scales, *shared)).unusual(rig)


def lint_stated_sd(table: Table[Any], kind: Kind) -> Iterable[Finding]:
    """Warn of amplitudes, lags and gaps that lie less than 2 sd from 0; a slope and N0 may be 0."""
    for key in kind.setting_rules.keys() - GroundSettings.__dataclass_fields__.keys():
        stated = getattr(table.settings, key)
        if isinstance(stated, Quantity) and 0.0 < abs(stated.value) < 2.0 * stated.sd:
            yield Finding("settings.sd", "warn", {"name": key, **vars(stated)}, table.label)


def _numbers(table: Table[Any], kind: Kind, rig: Rig) -> Iterable[Number]:
    """The columns, settings and relations of a table that have a usual interval."""
    label = table.label
    for name, column in table.columns.items():
        rule = kind.columns[name]
        usual, masses = _usual(rule, rig)
        largest = float(max(np.max(column.values), -np.min(column.values)))
        if usual is not None:
            words, written = f"the largest {name} of {table.file}", (label, column.unit, column.to_display)
            yield Number(words, largest, rule.si, usual, (f"{label}.{name}",), *written, shared=masses)
    for key, rule in kind.setting_rules.items():
        stated = getattr(table.settings, key)
        if not isinstance(rule, QuantityRule) or stated is None or key.endswith("_sd"):
            continue
        value, (usual, others) = stated.value if isinstance(stated, Quantity) else float(stated), _usual(rule, rig)
        if key in ("gap", "gap_back") and "x_rel" in table.columns:
            size = float(np.ptp(table["x_rel"])) / 2.0
            usual, others = (GAPS[0] * size, GAPS[1] * size), (f"{label}.x_rel",)
        if usual is not None:
            yield Number(f"{key} of {label}", value, rule.si, usual, (f"{label}.{key}",), label, shared=others)
    for pair, words, si, relation, usual, alone in RELATIONS:
        if set(pair) <= set(table.columns):
            value, scales = relation(*(table[name] for name in pair)), tuple(f"{label}.{name}" for name in pair)
            usual = alone if rig.m1 is None and rig.m2 is None else usual
            yield Number(f"{words} of {table.file}", value, si, usual, scales, label)
    yield from _against_k1(table, rig)


def _usual(rule: ColumnRule | QuantityRule, rig: Rig) -> tuple[tuple[float, float] | None, tuple[str, ...]]:
    """The usual interval of a quantity, and the masses in it: forces of a rig grow with its weight."""
    masses = {name: getattr(rig, name).value for name in ("m1", "m2") if getattr(rig, name) is not None}
    if rule.si == "N" and rule.usual is None and masses:
        weight = sum(masses.values()) * rig.g.value
        return (FORCES[0] * weight, FORCES[1] * weight), tuple(masses)
    return rule.usual or USUAL.get(rule.si), ()


def _against_k1(table: Table[Any], rig: Rig) -> Iterable[Number]:
    """The stiffness of a spring over that of the rod: m1 times the square of the frequency of the first decay."""
    decay = next((t for t in rig.tables if t.bench and "time" in t.columns and "x_rel" in t.columns), None)
    if decay is None or rig.m1 is None or not {"deflection", "force"} <= set(table.columns):
        return
    time, values = decay["time"], decay["x_rel"]
    free = find_free_decay(time, values, displacement=True)  # a long hold has a frequency of its own
    frequency = frequency_of(time, values) if free is None else 1.0 / free.period
    k1 = rig.m1.value * (2.0 * np.pi * frequency) ** 2
    ratio = float(np.ptp(table["force"]) / (np.ptp(table["deflection"]) or 1e-30)) / k1
    scales, shared = (f"{table.label}.force", f"{table.label}.deflection"), ("m1", f"{decay.label}.time")
    yield Number(f"k2 of {table.file} over k1", ratio, "1", STIFFNESSES, scales, table.label, shared=shared)


def with_line(findings: Sequence[Finding], rig: Rig) -> Iterable[Finding]:
    """The findings, those on scales once, with the line of rig.toml that confirms them all.

    A relation is left out where one of its scales is unusual by itself.
    """
    first = {f.facts["scales"]: f for f in reversed(findings) if "scales" in f.facts}
    alone = {scales[0] for scales in first if len(scales) == 1}
    names = dict.fromkeys([*rig.confirmed, *(name for scales in reversed(first) for name in scales)])
    for finding in findings:
        scales = finding.facts.get("scales")
        if scales is None:
            yield finding
        elif finding is first[scales] and (len(scales) == 1 or not alone.intersection(scales)):
            yield replace(finding, facts={**finding.facts, "line": f"confirmed = {json.dumps([*names])}"})


# lint: Findings on the readings of a rig before a fit.


def lint(rig: Rig, kinds: Mapping[str, Kind], tables: Sequence[Table[Any]]) -> tuple[Finding, ...]:
    """Return findings on the readings, settings and masses; they count in the verdict of a fit.

    Parameters
    ----------
    rig : rig as ``read_rig`` returns it
    kinds : kinds of experiments of the rig
    tables : tables of ``rig`` that are fitted together
    """
    exact = (name for name, mass in (("m1", rig.m1), ("m2", rig.m2)) if mass is not None and mass.sd == 0.0)
    findings = [
        *(Finding("masses.exact", "warn", {"name": name}) for name in exact),
        *lint_rig_quantities(rig),
        *lint_magnitudes(tables, kinds, rig),
    ]
    for table in tables:
        findings += [
            *lint_stated_sd(table, kinds[table.kind]),
            *(
                Finding("readings.encoding", "ok", {"file": file, "encoding": encoding}, table.label)
                for file, encoding in table.encodings.items()
                if encoding == WINDOWS
            ),
            *_missing(table),
            *(replace(found, experiment=table.label) for found in table.findings),
        ]
        facts = {"file": table.file, "rows": table.rejected, "used": len(table.rows)}
        findings += [Finding("readings.rejected", "warn", facts, table.label)] * bool(table.rejected)
        for lint_table in kinds[table.kind].lint:
            findings += lint_table(table, rig)
    return (*with_line(findings, rig), *_repeated(rig, tables))


#: Largest share of missing readings that does not count; those in so many periods from a release on always do.
MOST_MISSING, AFTER_RELEASE = 0.05, 2.0


def _missing(table: Table[Any]) -> Iterable[Finding]:
    """Report rows with a missing reading; a warning where they can change a result."""
    if not table.missing:
        return
    rows, behind, near, times = len(table.rows), np.searchsorted(table.rows, table.lost), 0, table.columns.get("time")
    # What is missing behind the last reading of a record is no gap in it.
    within = int(np.sum(behind < rows)) if times is not None else table.missing
    if times is not None and table.bench and rows >= SHORTEST_RECORD:
        stated = (getattr(table.settings, key, None) for key in ("start", "stop"))
        low, high = (end if value is None else value for value, end in zip(stated, (-np.inf, np.inf), strict=True))
        used = (times.values >= low) & (times.values <= high)
        time, values = times.values[used], table[next(name for name in table.columns if name != "time")][used]
        decay = find_free_decay(time, values)
        start = time[0] if decay is None or decay.start <= time[0] else decay.start
        period = 1.0 / frequency_of(time, values) if decay is None else decay.period
        # Of a missing row the next one in use is known; the last rows before the release may be the release.
        next_one = times.values[np.minimum(behind, rows - 1)]
        near = int(np.sum((next_one >= start) & (next_one <= start + AFTER_RELEASE * period) & (behind < rows)))
    share = within / (rows + within)
    many = share > MOST_MISSING or near > 0
    facts = {"file": table.file, "rows": table.missing, "used": rows, "share": share, "near": near, "unjudged": many}
    yield Finding("readings.missing", "warn" if many else "ok", facts, table.label)


def lint_settings(rig: Rig, kinds: Mapping[str, Kind], estimate: Estimate) -> tuple[Finding, ...]:
    """Return findings on settings at rough values, before anything is fitted."""
    return tuple(found for table in rig.tables for found in kinds[table.kind].lint_rig(table, rig, estimate))


def _content(rig: Rig, table: Table[Any]) -> tuple[object, ...]:
    """Equal for two tables with the same readings of the same file; column maps may read different ones."""
    columns = ((name, np.ascontiguousarray(column.values).data) for name, column in table.columns.items())
    readings = [(name, hashlib.sha256(data).digest()) for name, data in columns]
    return rig.files.get(table.file, table.label), *readings


def _read_part(table: Table[Any]) -> Table[Any]:
    """The table from ``start`` to ``stop`` of its settings: several tests may stand in one record."""
    ends = (getattr(table.settings, name, None) for name in ("start", "stop"))
    start, stop = (end if isinstance(end, float) else None for end in ends)  # a run has words, too
    if "time" not in table.columns or start is stop is None:
        return table
    time = table["time"]
    used = (time >= (time[0] if start is None else start)) & (time <= (time[-1] if stop is None else stop))
    columns = {name: replace(column, values=column.values[used]) for name, column in table.columns.items()}
    return replace(table, columns=columns, rows=table.rows[used]) if used.any() else table


def _repeated(rig: Rig, tables: Sequence[Table[Any]]) -> Iterable[Finding]:
    """Report tables with the same readings of files with the same bytes, then other rows that occur twice.

    These may stand within a table or in tables with the same columns.
    """
    whole, tables = {table.label: table for table in tables}, [_read_part(table) for table in tables]
    by_content: dict[tuple[object, ...], list[Table[Any]]] = {}
    groups: dict[tuple[str, ...], list[Table[Any]]] = {}
    for table in tables:
        by_content.setdefault(_content(rig, table), []).append(table)
    for first, *others in by_content.values():
        groups.setdefault(tuple(sorted(set(first.columns) - {"time"})), []).append(first)
        for other in others:
            facts = {"file": other.file, "first": first.label, "rows": list(range(len(other.rows)))}
            yield Finding("readings.repeated_file", "fail", facts, other.label)
    for names, members in groups.items():
        by_label = {table.label: table for table in members}
        readings = [
            Readings(
                table.label,
                np.stack([table[name] for name in names], axis=1),
                "time" in table.columns,
                tuple(table.columns[name].to_display for name in names),
            )
            for table in members
        ]
        for block in repeated_blocks(readings):
            later, first = by_label[block.label], by_label[block.first]
            facts = {
                "file": later.file,
                "line": int(later.rows[block.row]),
                "last": int(later.rows[block.row + block.count - 1]),
                "first": first.file,
                "first_line": int(first.rows[block.first_row]),
                "first_last": int(first.rows[block.first_row + block.count - 1]),
                "rows": np.flatnonzero(
                    np.isin(whole[later.label].rows, later.rows[block.row : block.row + block.count])
                ).tolist(),
            }
            yield Finding("readings.repeated", "fail", facts, block.label)


def wrong_prefix(ratio: float) -> bool:
    """Whether a wrong prefix explains the ratio of two positive numbers."""
    return bool(abs(abs(np.log10(ratio)) - np.log10(PREFIX)) < NEAR_PREFIX)


#: Columns that are often measured once for all rows.
MEASURED_ONCE = ("length", "normal_force")


def lint_rows(table: Table[Any], rig: Rig, unknowns: int) -> Iterable[Finding]:
    """Warn of few rows, fewer than three for one unknown, five for two, and of an sd of what was measured once for all rows."""
    fewest = 1 + 2 * unknowns
    if len(table.rows) < fewest:
        yield Finding("readings.few", "warn", {"rows": len(table.rows), "wanted": fewest}, table.label)
    for column in (table.columns[name] for name in MEASURED_ONCE if name in table.columns and len(table.rows) > 1):
        if column.sd and column.instrument is None and np.ptp(column.values) == 0.0:
            facts = {"name": column.name, "sd": column.sd * column.to_display, "unit": column.unit}
            yield Finding("readings.one_value", "warn", facts, table.label, ("mu",))


def lint_reading_errors(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Warn where columns have no reading error."""
    unstated = [name for name, column in table.columns.items() if column.reading_sd == 0.0]
    if unstated:
        facts = {"names": " and ".join(unstated), "first": unstated[0]}
        yield Finding("readings.errors", "warn", facts, table.label)


# lint records: Findings on the channels of a record, shared by all kinds with a column ``time``.


#: Periods before a burst of noise or a jump that a decay is cut to; with fewer it begins behind it.
KEPT_PERIODS = 3
#: Most samples that are named as spikes, window of the rule that drops them, steps, and its limits, robust sds.
MOST_SPIKES, WINDOW, LIMITS = 20, 10, (20.0, 12.0, 8.0, 5.0)


def _cut(table: Table[Any], used: slice, key: str, time: float) -> str:
    """The line that leaves out one side of a time of a decay; a run has no such key, and a record has a shortest length."""
    line = f'{key} = {{ value = {rounded(time, table["time"][used], 1):.15g}, unit = "s" }}'
    kept = np.sign(table["time"][used] - time) != (-1.0 if key == "start" else 1.0)
    possible = hasattr(table.settings, "stop") and np.count_nonzero(kept) >= SHORTEST_RECORD
    return f"Add this line to the experiment in rig.toml: {line}" if possible else "Record again."


def _fault(table: Table[Any], code: str, rows: np.ndarray, level: Level, /, **facts: object) -> Finding:
    """A finding on ``rows`` of a record: file, line and time of the first one, and further facts."""
    first = int(rows[0])
    place = {"file": table.file, "line": int(table.rows[first]), "time": float(table["time"][first])}
    return Finding(code, level, {**place, "rows": rows.tolist(), **facts}, table.label)


def lint_times(table: Table[Any], used: slice) -> Iterable[Finding]:
    """Report gaps and rounded times.

    Parameters
    ----------
    used : the rows that a fit reads
    """
    time = table["time"][used]
    gaps = find_gaps(time)
    if gaps is not None:  # rows that are counted as missing are no gap
        missing = np.bincount(np.searchsorted(table.rows, table.lost), minlength=used.stop + 1)
        kept = missing[used.start + gaps.rows + 1] < gaps.lost
        rows, lost = used.start + gaps.rows[kept], int(gaps.lost[kept].sum())
        if len(rows):
            yield _fault(table, "readings.gaps", rows, "warn", gaps=len(rows), lost=lost, step=gaps.step)
        return
    rounding = time_rounding(time)
    if rounding is not None:
        yield Finding("readings.rounded_times", "warn", {"step": rounding, "file": table.file}, table.label)


def lint_channel(table: Table[Any], name: str, used: slice, period: float, switched: bool = False) -> Iterable[Finding]:
    """Report clipped samples, drop-outs and a frozen sensor.

    Parameters
    ----------
    name : of the column
    used : the rows that a fit reads
    period : of the oscillation, s; infinite where it is unknown
    switched : whether it may rest at its limits and elsewhere: only drop-outs are faults
    """
    column, time = table.columns[name], table["time"]
    values, unit = column.values[used], column.to_display
    if len(time[used]) < 2 or np.ptp(values) == 0.0:
        return
    values = values * unit if unit != 1.0 else values
    step = median_step(time[used])
    channel = {"column": name, "unit": column.unit}
    for clipped in () if switched else clipped_samples(values, period / step):
        found = used.start + clipped.rows
        facts = channel | {
            "side": clipped.side,
            "level": clipped.level,
            "samples": len(found),
            "share": len(found) / len(values),
            "time": float(time[found[-1]]),
            "cut": _cut(table, used, "start", float(time[min(found[-1] + 1, len(time) - 1)])),
        }
        yield _fault(table, "readings.clipped", found, "fail", **facts)
    for code, wrong in (("readings.dropouts", dropouts(values)), ("readings.frozen", frozen_samples(values))):
        if len(wrong) and not (switched and code == "readings.frozen"):
            found = used.start + wrong
            lines = " ".join(map(str, table.rows[found]))
            facts = channel | {"value": float(values[wrong[0]]), "samples": len(found), "lines": lines}
            yield _fault(table, code, found, "fail", **facts)
            return


def lint_smooth(table: Table[Any], name: str, used: slice, period: float, alone: bool = False) -> Iterable[Finding]:
    """Report samples of a smooth oscillation that were lost without a gap in the times, or a burst of noise.

    Parameters
    ----------
    name : of the column
    used : the rows of the oscillation
    period : of the oscillation, s
    alone : leave out jumps that recur every half period
    """
    time = table["time"][used]
    step = median_step(time)
    if largest_offset(time, step) > TIMING_TOLERANCE * step:
        return
    values = table[name][used]
    jump = jump_or_noise(values, period / step, alone)
    if jump is None:
        return
    burst = noisy_stretch(values, period / step, jump.row)
    if burst is not None:
        first, last = used.start + burst.start, used.start + burst.stop
        begin, end = float(table["time"][first]), float(table["time"][min(last, used.stop - 1)])
        # An early burst is left out with what is before it.
        key, cut = ("start", end) if burst.start < KEPT_PERIODS * period / step else ("stop", begin)
        facts = {
            "column": name,
            "begin": begin,
            "end": end,
            "key": key,
            "value": rounded(cut, table["time"][used], 1),
            "cut": _cut(table, used, key, cut),
        }
        yield _fault(table, "readings.burst", np.array([first, last - 1]), "fail", **facts)
        return
    if jump.noisy:
        return
    # Samples are spikes where the record is smooth once a rule has dropped them.
    index = np.arange(len(values))
    for n_sd in LIMITS:
        spikes = np.flatnonzero(hampel_outliers(values, WINDOW + 1, n_sd))
        good = np.delete(index, spikes)
        left = jump_or_noise(np.interp(index, good, values[good]), period / step, alone)
        if 0 < len(spikes) <= MOST_SPIKES and (left is None or left.noisy):
            break
    else:
        spikes = index[:0]
    rows = spikes if len(spikes) else np.array([jump.row])
    early = jump.row < KEPT_PERIODS * period / step
    facts = {
        "column": name,
        "lines": " ".join(map(str, table.rows[used.start + spikes])),
        "size": jump.size,
        "cut": _cut(table, used, "start" if early else "stop", float(time[rows[0] - (not early)])),
        "rule": f'{{ rule = "hampel", window = "{1e3 * float(f"{WINDOW * step:.6g}"):g} ms", n_sd = {n_sd:g} }}',
    }
    yield _fault(table, "readings.spike" if len(spikes) else "readings.jump", used.start + rows, "fail", **facts)
