"""Findings on scales: numbers of a rig, and relations between them, that a wrong unit would make unusual."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capsule_id.experiments.kind import Kind
from capsule_id.rig.filters import dominant_frequency, loudest_part
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.rig.schema import RIG_QUANTITIES, ColumnRule, GroundSettings, QuantityRule
from capsule_id.rig.units import factor_to_si
from capsule_id.views import Finding

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
#: masses and columns of theirs that are wrong by 1000 one stays inside.
MASSES, FORCES, STIFFNESSES, GAPS = (0.03, 150.0), (0.02, 100.0), (0.01, 1000.0), (3e-3, 20.0)
#: Usual m1 of a rig without m2: no relation judges it.
MASS_ALONE = (8e-3, 12.0)
#: Usual period of a decay, s, and amplitude of its acceleration, m/s^2, which holds the square of the unit of time.
PERIODS, ACCELERATIONS = (2e-3, 20.0), (3e-3, 1e4)
#: Largest distance of a ratio from 1000, in decades, that a wrong prefix explains.
WRONG_PREFIX = 0.3
#: Relations between two columns: their names, the words, the SI unit, the value, its usual interval.
RELATIONS = (
    (("force", "current"), "force per current", "N/A", lambda x, y: np.ptp(x) / (np.ptp(y) or 1e-30), (0.03, 300.0)),
    (("speed", "distance"), "speed^2/(2 g distance)", "1", lambda x, y: np.median(x**2 / (19.62 * y)), (0.01, 20.0)),
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
        low, high = self.usual
        if self.value == 0.0 or low <= abs(self.value) <= high or set(self.scales) <= set(rig.confirmed):
            return
        facts = {
            "name": self.name,
            "value": self.value * self.to_display,
            "low": low * self.to_display,
            "high": high * self.to_display,
            "unit": self.unit or self.si,
            "scales": self.scales,
            "meant": self._meant(),
        }
        yield Finding(self.code, "warn", facts, self.label)

    def _meant(self) -> str:
        """The likeliest unit in which the written number would be usual; "" where there is none."""
        written, (low, high) = abs(self.value) * self.to_display, self.usual
        units = _ALTERNATIVES.get(self.si, ()) if len(self.scales) == 1 else ()
        return next((unit for unit in units if low <= written * factor_to_si(unit, self.si) <= high), "")


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
    # A factor of 1000 in shared scales would make these relations unusual, so that they are right in the others too.
    right = {n.shared for n in numbers if n.usual[1] / 1e3 <= n.value <= n.usual[0] * 1e3}
    for number in numbers:
        shared = () if number.shared in right else number.shared
        yield from replace(number, scales=(*number.scales, *shared)).unusual(rig)


def lint_stated_sd(table: Table[Any], kind: Kind) -> Iterable[Finding]:
    """Warn of amplitudes, lags and gaps whose normal prior reaches below 0; a slope and N0 may be 0."""
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
        if key == "gap" and "x_rel" in table.columns:
            size = float(np.ptp(table["x_rel"])) / 2.0
            usual, others = (GAPS[0] * size, GAPS[1] * size), (f"{label}.x_rel",)
        if usual is not None:
            yield Number(f"{key} of {label}", value, rule.si, usual, (f"{label}.{key}",), label, shared=others)
    for pair, words, si, relation, usual in RELATIONS:
        if set(pair) <= set(table.columns):
            value, scales = float(relation(*(table[name] for name in pair))), tuple(f"{label}.{name}" for name in pair)
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
    k1 = rig.m1.value * (2.0 * np.pi * frequency_of(decay["time"], decay["x_rel"])) ** 2
    ratio = float(np.ptp(table["force"]) / (np.ptp(table["deflection"]) or 1e-30)) / k1
    scales, shared = (f"{table.label}.force", f"{table.label}.deflection"), ("m1", f"{decay.label}.time")
    yield Number(f"k2 of {table.file} over k1", ratio, "1", STIFFNESSES, scales, table.label, shared=shared)


def frequency_of(time: np.ndarray, values: np.ndarray) -> float:
    """Dominant frequency of a record that may be sampled unevenly, Hz."""
    part = loudest_part(values)
    even = np.linspace(time[part][0], time[part][-1], len(time[part]))
    return dominant_frequency(even, np.interp(even, time[part], values[part]))


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
