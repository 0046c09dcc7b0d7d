"""Reads the column map of an experiment in ``rig.toml``: ``columns`` and the keys that go with it."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf
from types import MappingProxyType
from typing import Any

from capsule_id.rig.formats.export import Layout
from capsule_id.rig.schema import ColumnRule, KindRule
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import (
    read_choice,
    read_quantity,
    read_string,
    read_table,
    read_unit,
    refuse_unknown_keys,
    shown,
)
from capsule_id.rig.units import UNKNOWN

#: Keys of an experiment that go with ``columns``.
MAP_KEYS = ("columns", "files", "data_from_line", "data_to_line", "missing", "decimal", "where", "plateaus")
#: Largest finite number; whole numbers of TOML may be larger.
LARGEST = sys.float_info.max
_EXAMPLE = '{ from = "...", unit = "..." }'
Header = str | int  #: a header, or a column's number counted from 1


@dataclass(frozen=True)
class Source:
    """Where a column comes from: (``header`` - ``minus``) * ``scale`` + ``offset``, in ``unit``.

    Attributes
    ----------
    header, minus : columns of the file (``minus`` None: nothing is subtracted)
    unit : of the result, as written
    scale, offset : factor, and a constant in ``unit`` that is added after it
    rate : sampling rate, Hz, of a time that no column holds; else None
    """

    header: Header = 1
    minus: Header | None = None
    unit: str = "s"
    scale: float = 1.0
    offset: float = 0.0
    rate: float | None = None


@dataclass(frozen=True)
class Range:
    """Numbers from ``min`` to ``max``, both included, in the unit of the file."""

    min: float
    max: float

    def __str__(self) -> str:
        if self.max == inf:
            return f"{self.min:.15g} or more"
        return f"{self.max:.15g} or less" if self.min == -inf else f"{self.min:.15g} to {self.max:.15g}"


#: What selects the rows of a column: a number in the unit of the file, a range of them, or a text.
Wanted = float | str | Range


@dataclass(frozen=True)
class ColumnMap:
    """The column map of an experiment.

    Attributes
    ----------
    sources : by column of the experiment
    layout : what is stated about the layout of the files
    where : what a row has in a column, by its header or number: other rows are not read
    """

    sources: Mapping[str, Source]
    layout: Layout
    where: Mapping[str, Wanted]


def read_map(
    document: TomlDocument, path: KeyPath, entry: Mapping[str, Any], kind: KindRule, propose: Callable[[Layout], str]
) -> ColumnMap | None:
    """The column map of the experiment at ``path``, None where it states none.

    ``propose`` gives the map that reads its first file, for remedies.

    Raises
    ------
    InputError
        At the key or value of ``rig.toml`` that is wrong.
    """
    layout = Layout(*_lines(document, path, entry), _markers(document, path, entry), _decimal(document, path, entry))
    if "columns" not in entry:
        for key in MAP_KEYS[1:]:
            if key in entry:
                remedy = f"add {propose(layout)}"
                raise document.error((*path, key), f"{key} needs a column map", "no columns", remedy, of_key=True)
        return None
    place = (*path, "columns")
    if not isinstance(entry["columns"], dict):
        read_table(document, place, entry["columns"], propose(layout))
    stated = entry["columns"]
    if not stated:
        raise document.error(place, "a column map must have columns", "none", f"write {propose(layout)}")
    # Plateaus are readings of a time trace, whatever the columns of the kind.
    rules = {**({"time": ColumnRule("s")} if "plateaus" in entry else {}), **kind.columns}
    refuse_unknown_keys(document, place, stated, tuple(rules))
    sources = {name: _source(document, (*place, name), stated[name], rules[name]) for name in stated}
    where = _where(document, path, entry)
    named = [header for source in sources.values() for header in (source.header, source.minus) if header is not None]
    # A key of ``where`` is a header, or the number of a column.
    keys = [
        (form, value)
        for key, value in where.items()
        for form in (" ".join(key.split()), *([int(key)] if key.isdecimal() else []))
    ]
    words = tuple(form for form, value in keys if isinstance(value, str))
    layout = replace(layout, columns=(*named, *(form for form, _ in keys)), words=words)
    return ColumnMap(MappingProxyType(sources), layout, MappingProxyType(where))


def _source(document: TomlDocument, path: KeyPath, value: object, rule: ColumnRule) -> Source:
    """One entry of ``columns``."""
    entry = read_table(document, path, value, _EXAMPLE)
    if "rate" in entry:
        refuse_unknown_keys(document, path, entry, ("rate",))
        if rule.si != "s":
            remedy = f"write {_EXAMPLE}"
            raise document.error((*path, "rate"), "rate is for times", str(path[-1]), remedy, of_key=True)
        return Source(rate=read_quantity(document, (*path, "rate"), entry["rate"], "Hz").value)
    refuse_unknown_keys(document, path, entry, ("from", "minus", "unit", "scale", "offset"))
    if "from" not in entry:
        raise document.error(path, f"{path[-1]} must have a from", shown(entry), f"write {_EXAMPLE}")
    header = _header(document, (*path, "from"), entry["from"])
    read_unit(document, path, entry, rule.si)
    scale, offset = (
        _number(document, (*path, key), entry.get(key, zero)) for key, zero in (("scale", 1.0), ("offset", 0.0))
    )
    if scale == offset == 0.0:
        remedy = "write 1, or -1 for the other sign; for a constant, state it as offset"
        raise document.error((*path, "scale"), "scale must not be 0", "0", remedy)
    return Source(
        header,
        _header(document, (*path, "minus"), entry["minus"]) if "minus" in entry else None,
        entry["unit"],
        scale,
        offset,
    )


def _header(document: TomlDocument, path: KeyPath, value: object) -> Header:
    """A header, or a number counted from 1."""
    if isinstance(value, int) and not isinstance(value, bool):
        if value < 1:
            raise document.error(path, "columns are counted from 1", str(value), "write 1 for the first column")
        return value
    if not isinstance(value, str):
        rule = f"{path[-1]} must be a header or the number of a column"
        raise document.error(path, rule, shown(value), f'write {path[-1]} = 1 or {path[-1]} = "<header>"')
    if value == UNKNOWN:
        remedy = "write its header, or its number counted from 1"
        raise document.error(path, f"{path[-1]} must name the column that holds {path[-2]}", shown(value), remedy)
    return " ".join(read_string(document, path, value).split())


def _number(document: TomlDocument, path: KeyPath, value: object) -> float:
    """A finite number without unit."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise document.error(path, f"{path[-1]} must be a finite number", shown(value), "write a number without quotes")
    return float(value)


def _lines(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> tuple[int | None, int | None]:
    """``data_from_line`` and ``data_to_line``, None where they are not stated."""
    found = []
    for key, which in (("data_from_line", "first"), ("data_to_line", "last")):
        value = entry.get(key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            rule = f"{key} must be a line, counted from 1"
            raise document.error((*path, key), rule, shown(value), f"write the line of the {which} reading, such as 2")
        found.append(value)
    first, last = found
    if first is not None and last is not None and last < first:
        rule = f"data_to_line must not be above data_from_line = {first}"
        raise document.error((*path, "data_to_line"), rule, str(last), "exchange them")
    return first, last


def _markers(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> tuple[str, ...]:
    """The texts of ``missing``; "" stands for an empty cell."""
    place, value = (*path, "missing"), entry.get("missing", [])
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        remedy = 'write missing = ["--", "NaN"]'
        raise document.error(place, "missing must be a list of texts", shown(value), remedy)
    return tuple(value)


def _decimal(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> str | None:
    """``decimal``, None where it is not stated."""
    place = (*path, "decimal")
    return read_choice(document, place, entry["decimal"], (".", ",")) if "decimal" in entry else None


def _where(document: TomlDocument, path: KeyPath, entry: Mapping[str, Any]) -> dict[str, Wanted]:
    """The numbers, ranges and texts of ``where``, by header or number."""
    place = (*path, "where")
    stated = read_table(document, place, entry.get("where", {}), "where = { <header> = <value> }")
    return {key: _wanted(document, (*place, key), value) for key, value in stated.items()}


def _wanted(document: TomlDocument, path: KeyPath, value: object) -> Wanted:
    """One value of ``where``."""
    if isinstance(value, str):
        return value.strip()
    if not isinstance(value, dict):
        return _number(document, path, value)
    refuse_unknown_keys(document, path, value, ("min", "max"))
    if not value:
        raise document.error(
            path, "a range must have min or max", "none", "write { min = 2, max = 10 }, or one of them"
        )
    for key in value:
        if isinstance(value[key], float) and not abs(value[key]) <= LARGEST:
            raise document.error((*path, key), f"{key} must be a finite number", shown(value[key]), f"leave {key} out")
    ends = [_number(document, (*path, key), value[key]) if key in value else None for key in ("min", "max")]
    found = Range(*(side if end is None else end for side, end in zip((-inf, inf), ends, strict=True)))
    if found.min > found.max:
        raise document.error(path, "min must not exceed max", str(found), "exchange them")
    return found
