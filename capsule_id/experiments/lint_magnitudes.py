"""Findings on magnitudes: masses, settings and columns with unusual values, and the unit that was probably meant."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.experiments.kind import Kind
from capsule_id.records.faults.magnitudes import USUAL, unit_meant
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.rig.schema import RIG_QUANTITIES, QuantityRule
from capsule_id.views import Finding


def lint_rig_quantities(rig: Rig) -> Iterable[Finding]:
    """Warn of unusual masses and of an unusual g."""
    for name, rule in RIG_QUANTITIES.items():
        quantity: Quantity | None = getattr(rig, name)
        if quantity is not None:
            yield from _unusual(f"{name} of [rig]", quantity.value, rule.si, rule.si, 1.0, rule.usual)


def lint_magnitudes(table: Table[Any], kind: Kind) -> Iterable[Finding]:
    """Warn of columns and settings with unusual values."""
    for name, column in table.columns.items():
        rule = kind.columns[name]
        largest = float(max(np.max(column.values), -np.min(column.values)))
        # A channel that may be constant, as a capsule at rest, has no smallest amplitude.
        if rule.si in USUAL and (rule.varies or rule.domain.low == 0.0 or largest > USUAL[rule.si][1]):
            name = f"the largest {name} of {table.file}"
            yield from _unusual(name, largest, rule.si, column.unit, column.to_display, rule.usual, table.label)
    for key, rule in kind.setting_rules.items():
        stated = getattr(table.settings, key)
        if isinstance(rule, QuantityRule) and stated is not None and rule.si in USUAL and not key.endswith("_sd"):
            value = stated.value if isinstance(stated, Quantity) else float(stated)
            yield from _unusual(f"{key} of {table.label}", value, rule.si, rule.si, 1.0, rule.usual, table.label)


def _unusual(
    name: str,
    value: float,
    si: str,
    unit: str,
    to_display: float,
    usual: tuple[float, float] | None,
    label: str = "",
) -> Iterable[Finding]:
    """Warn where ``value`` lies outside the usual interval; each argument is one property of one number."""
    low, high = usual or USUAL[si]
    if value == 0.0 or low <= value <= high:
        return
    facts = {
        "name": name,
        "value": value * to_display,
        "unit": unit,
        "low": low * to_display,
        "high": high * to_display,
        "meant": unit_meant(value, to_display, si, (low, high)),
    }
    yield Finding("readings.magnitude", "warn", facts, label)
