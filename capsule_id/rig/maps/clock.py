"""Puts the times of a record on the clock of another logger: ``clock = { offset = {...}, drift = {...} }``.

Only times change; no reading is interpolated. Channels of two loggers are two experiments, each with its own times.
A stated sd of the drift makes the drift a parameter of the fit (``capsule_id.experiments.clock``).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from capsule_id.rig.domains import ANY
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.model import Quantity
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import read_quantity, read_table, refuse_unknown_keys
from capsule_id.rig.units import UnitError, factor_to_si

_EXAMPLE = '{ offset = { value = 0.3, unit = "ms" }, drift = { value = 20, sd = 2, unit = "ppm" } }'
#: Largest offset, s, and drift. A time in s has a resolution of 2 us at this offset; times since 1970 are smaller.
LARGEST_OFFSET, LARGEST_DRIFT = 1e10, 0.1


class StatedClock(NamedTuple):
    """The clock t = offset + (1 + drift) t' of times t'; s and 1."""

    offset: Quantity
    drift: Quantity


def read_clock(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> StatedClock | None:
    """The clock of the experiment at ``path``, None where it states none.

    Raises
    ------
    InputError
        At the key or value that is wrong.
    """
    if "clock" not in entry:
        return None
    place = (*path, "clock")
    stated = read_table(document, place, entry["clock"], _EXAMPLE)
    refuse_unknown_keys(document, place, stated, ("offset", "drift"))
    if not stated:
        raise document.error(place, "a clock must have an offset or a drift", "none", f"write {_EXAMPLE}")
    clock = StatedClock(
        *(
            read_quantity(document, (*place, key), stated[key], si, ANY, has_sd=True)
            if key in stated
            else Quantity(0.0)
            for key, si in (("offset", "s"), ("drift", "1"))
        )
    )
    for key, quantity, largest, unit, remedy in (
        ("offset", clock.offset, LARGEST_OFFSET, " s", "check number and unit"),
        ("drift", clock.drift, LARGEST_DRIFT, "", 'check number and unit; 20 ppm is { value = 20, unit = "ppm" }'),
    ):
        for word, number in ((key, quantity.value), (f"sd of {key}", quantity.sd)):
            if abs(number) > largest:
                rule = f"{word} must lie between -{largest:g}{unit} and {largest:g}{unit}"
                raise document.error((*place, key), rule, f"{number:g}{unit}", remedy)
    return clock


def on_reference(document: TomlDocument, path: KeyPath, raw: RawTable, clock: StatedClock) -> RawTable:
    """The table with its times t' replaced by offset + (1 + drift) t'.

    Raises
    ------
    InputError
        If the table has no times.
    """
    if "time" not in raw.names:
        value = " ".join(raw.names)
        raise document.error((*path, "clock"), "clock needs a record with times", value, "remove clock", of_key=True)
    index = raw.names.index("time")
    try:
        factor = factor_to_si(raw.units[index], "s")
    except UnitError:  # reported at its place, where the column is converted
        return raw
    columns = list(raw.columns)
    columns[index] = clock.offset.value / factor + (1.0 + clock.drift.value) * columns[index]
    return replace(raw, columns=tuple(columns))
