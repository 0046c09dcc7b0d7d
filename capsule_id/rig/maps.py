"""Clocks, instruments and column maps of ``rig.toml``: what they state, and the columns that they correct and select."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path
from types import MappingProxyType

import numpy as np

from capsule_id.errors import InputError
from capsule_id.parameters import SAME
from capsule_id.rig.formats.raw import NO_READING, Export, Layout, Place, RawTable
from capsule_id.rig.formats.text import seconds_of_stamps
from capsule_id.rig.model import NO_DRIFT, Column, Instrument, Quantity, Table
from capsule_id.rig.schema import (
    INSTRUMENT_KEYS,
    WHOLE,
    ChoiceRule,
    ColumnRule,
    KindRule,
    PlainRule,
    QuantityRule,
    SettingRule,
    read_rules,
)
from capsule_id.rig.toml import ANY, Node, is_count, is_number, remedy_for, shown
from capsule_id.rig.units import STAMP, UNKNOWN, UnitError, factor_to_si
from capsule_id.views import counted

# clock: Puts the times of a record on the clock of another logger: ``clock = { offset = {...}, drift = {...} }``.
#
# Only times change; no reading is interpolated. Channels of two loggers are two experiments, each with its own times.
# A stated sd of the drift makes the drift a parameter of the fit (``capsule_id.experiments.base``).


_CLOCK_EXAMPLE = '{ offset = { value = 0.3, unit = "ms" }, drift = { value = 20, sd = 2, unit = "ppm" } }'
CLOCK: Mapping[str, SettingRule] = {
    "offset": QuantityRule("s", ANY, has_sd=True),
    "drift": QuantityRule("1", ANY, has_sd=True),
}
#: Largest offset, s, and drift. A time in s has a resolution of 2 us at this offset; times since 1970 are smaller.
LARGEST_OFFSET, LARGEST_DRIFT = 1e10, 0.1


def on_reference(node: Node, raw: RawTable) -> tuple[RawTable, Quantity]:
    """The table with its times t' replaced by offset + (1 + drift) t', and the drift.

    Raises
    ------
    InputError
        At the key or value of the clock that is wrong, or if the table has no times.
    """
    node.table(_CLOCK_EXAMPLE)
    if "value" in node:  # of an instrument: the drift alone
        node = replace(node, value={"drift": node.value})
    node.refuse_unknown(tuple(CLOCK))
    if not node.value:
        raise node.error("a clock must have an offset or a drift", "none", f"write {_CLOCK_EXAMPLE}")
    stated = read_rules(node, CLOCK)
    for key, largest, unit, remedy in (
        ("offset", LARGEST_OFFSET, " s", "check number and unit"),
        ("drift", LARGEST_DRIFT, "", 'check number and unit; 20 ppm is { value = 20, unit = "ppm" }'),
    ):
        quantity: Quantity = stated.setdefault(key, NO_DRIFT)
        for word, number in ((key, quantity.value), (f"sd of {key}", quantity.sd)):
            if abs(number) > largest:
                raise node[key].error(
                    f"{word} must lie between -{largest:g}{unit} and {largest:g}{unit}", f"{number:g}{unit}", remedy
                )
    if "time" not in raw.names:
        raise node.error("clock needs a record with times", " ".join(raw.names), "remove clock", of_key=True)
    columns, index = list(raw.columns), raw.names.index("time")
    with suppress(UnitError):  # reported at its place, where the column is converted
        offset = stated["offset"].value / factor_to_si(raw.units[index], "s")
        columns[index] = offset + (1.0 + stated["drift"].value) * columns[index]
    return replace(raw, columns=tuple(columns)), stated["drift"]


# instruments: ``[[instrument]]``, its clock, and the columns that it read.

#: Largest gain of an instrument and its sd: a gain of 0.01 reads 1 % too much.
LARGEST_GAIN = 0.2


def _instruments(root: Node) -> dict[str, Node]:
    """The instruments of a rig, by name."""
    entries = root.get("instrument", [])
    entries.require(isinstance(entries.value, list), "be tables", "write [[instrument]] above each")
    found: dict[str, Node] = {}
    for index in range(len(entries.value)):
        node = entries[index]
        if not isinstance(node.value, dict) or "name" not in node:
            raise node.error(
                "an instrument must be a table with a name", shown(node.value), 'write [[instrument]] and name = "..."'
            )
        node.refuse_unknown(INSTRUMENT_KEYS)
        if (name := node["name"].name()) in found:
            raise node["name"].error("instruments must have different names", shown(name), "rename one of them")
        found[name] = node
    return found


def refuse_idle_errors(root: Node, tables: Sequence[Table]) -> None:
    """Refuse an error of an instrument that acts on no column: a line of an experiment may be missing."""
    columns = [
        (name, column.instrument) for table in tables for name, column in table.columns.items() if column.instrument
    ]
    read = {(one.name, symbol) for name, one in columns for symbol in (("clock",) if name == "time" else one.errors)}
    for name, node in _instruments(root).items():
        if name in [table.label for table in tables]:
            raise node["name"].error("an instrument and an experiment have different names", shown(name), "rename it")
        for key in node.value.keys() - {"name"}:
            if (name, key) not in read:
                column = "time" if key == "clock" else "<column>"
                raise node[key].error(
                    f"the {key} of an instrument must act on a column",
                    "none",
                    f'write {column}_instrument = "{name}" in an experiment, or remove {key}',
                    of_key=True,
                )
        if node.value.keys() == {"name"}:
            raise node.error("an instrument must have a gain, an offset or a clock", "none", "state one")


def _instrument_of(entry: Node, column: str) -> Node | None:
    """The instrument that read ``column`` in an experiment."""
    key = f"{column}_instrument"
    if key not in entry:
        return None
    known, name = _instruments(Node(entry.document, (), entry.document.data)), entry[key].text()
    if name not in known:
        raise entry[key].error(
            "an experiment must name an instrument of rig.toml",
            shown(name),
            remedy_for(name, known, f'add [[instrument]] with name = "{name}"'),
        )
    return known[name]


def clock_of(entry: Node) -> Node | None:
    """The clock of the times of an experiment: its own, or that of the instrument that read them."""
    instrument, own = _instrument_of(entry, "time"), "clock" in entry
    if instrument is None:
        return entry["clock"] if own else None
    if own or "clock" not in instrument:
        rule = "a clock is stated once, by the experiment or by the instrument of its times"
        value, remedy = ("both", "remove clock") if own else ("none", "give the instrument a clock")
        raise entry["clock" if own else "time_instrument"].error(rule, value, remedy, of_key=True)
    return _error_of(instrument, "clock", "1")


def _error_of(instrument: Node, key: str, si: str) -> Node:
    """An error of an instrument; without a value it is 0."""
    stated = instrument[key].table(f'{{ value = ..., sd = ..., unit = "{si}" }}')
    stated.require(len(stated.value) > 1 or "unit" not in stated, "have a value or an sd", "state one, or remove it")
    return replace(stated, value={"value": 0.0, **stated.value})


def without_stated_errors(entry: Node, column: Column, kind: KindRule) -> Column:
    """The column without the stated errors of the instrument that read it."""
    node = _instrument_of(entry, column.name)
    if node is None or column.name == "time":
        return column if node is None else replace(column, instrument=Instrument(node["name"].value))
    place, rule, gain_sd = entry[f"{column.name}_instrument"], kind.columns[column.name], f"{column.name}_gain_sd"
    if gain_sd in entry:
        raise place.error(
            "a gain is stated once", f"by {gain_sd} and by an instrument", f"remove {gain_sd}", of_key=True
        )
    known = kind.read_by if not kind.channels or gain_sd in kind.setting_rules else ()
    units = {symbol: si for symbol, si in (("gain", "1"), ("offset", rule.si)) if symbol in known and symbol in node}
    if not units:
        wanted = f"must state {' or '.join(known)}" if known else "cannot be stated, only that of time"
        raise place.error(
            f"the instrument of {column.name} of {kind.name} {wanted}",
            shown(place.value),
            f"{'state it, or ' if known else ''}remove {column.name}_instrument",
            of_key=True,
        )
    stated = {symbol: _error_of(node, symbol, si).quantity(si, ANY, has_sd=True) for symbol, si in units.items()}
    instrument = Instrument(node["name"].value, rule.si, stated)
    gain, offset = stated.get("gain", NO_DRIFT), instrument.value("offset")
    if max(abs(gain.value), gain.sd) > LARGEST_GAIN:
        raise node["gain"].error(
            f"a gain is a relative error, at most {LARGEST_GAIN:g}",
            f"{gain.value:g} ± {gain.sd:g}",
            "write 0.01 for readings 1 % too large",
        )
    values = (column.values - offset) / (1.0 + gain.value)
    if not rule.domain.holds(values).all():
        raise node.error(
            f"{column.name} without its errors must {rule.domain.text}",
            f"{np.min(values) * column.to_display:g} {column.unit}",
            "correct value or unit",
        )
    values.flags.writeable = False
    sd, step = (size and size / (1.0 + gain.value) for size in (column.sd, column.resolution))
    return replace(column, values=values, sd=sd, resolution=step, instrument=instrument)


# declared: Reads the column map of an experiment in ``rig.toml``: ``columns`` and the keys that go with it.


def text_rule(what: str, example: str) -> PlainRule:
    """A text that is not empty."""
    return PlainRule(
        lambda value: isinstance(value, str) and bool(value),
        f"be {what}",
        f'write ... = "{example}"',
        {"type": "string"},
    )


LAYOUT: Mapping[str, SettingRule] = {
    **dict.fromkeys(
        ("data_from_line", "data_to_line"),
        PlainRule(is_count, "be a line, counted from 1", "write the line of that reading, such as 2", WHOLE),
    ),
    "missing": PlainRule(
        lambda value: isinstance(value, list) and all(isinstance(text, str) for text in value),
        "be a list of texts",
        'write missing = ["--", "NaN"]',
        {"type": "array", "items": {"type": "string"}},
    ),
    "decimal": ChoiceRule((".", ",")),
    "sheet": text_rule("the name of a sheet", "Sheet1"),
    "split_by": text_rule("the header of a column, or its number in quotes", "direction"),
}
#: Keys of an experiment that go with ``columns``.
MAP_KEYS = ("columns", "files", *LAYOUT, "where", "plateaus")
#: A finite number without unit.
NUMBER = PlainRule(is_number, "be a finite number", "write a number without quotes, or leave it out")
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


#: What selects the rows of a column: numbers from the first to the second, both included, in the unit of the file; or a text.
Wanted = tuple[float, float] | str


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


def read_map(entry: Node, kind: KindRule, propose: Callable[[Layout], str]) -> ColumnMap | None:
    """The column map of an experiment, None where it states none.

    ``propose`` gives the map that reads its first file, for remedies.

    Raises
    ------
    InputError
        At the key or value of ``rig.toml`` that is wrong.
    """
    stated = read_rules(entry, LAYOUT)
    layout = Layout(**{**stated, "missing": (*NO_READING, *stated.get("missing", ()))})
    first, last = layout.data_from_line, layout.data_to_line
    if first is not None and last is not None and last < first:
        raise entry["data_to_line"].error(
            f"data_to_line must not be above data_from_line = {first}", str(last), "exchange them"
        )
    if "columns" not in entry:
        for key in MAP_KEYS[1:]:
            if key in entry:
                raise entry[key].error(f"{key} needs a column map", "no columns", f"add {propose(layout)}", of_key=True)
        return None
    node = entry["columns"]
    if not isinstance(node.value, dict) or not node.value:
        example = propose(layout)
        node.table(example)
        raise node.error("a column map must have columns", "none", f"write {example}")
    # Plateaus are readings of a time trace, whatever the columns of the kind; without them a trace is refused as such.
    rules = {"time": ColumnRule("s"), **kind.columns}
    node.refuse_unknown(tuple(rules))
    sources = {name: _source(node[name], rules[name]) for name in node.value}
    where = entry.get("where", {}).table("where = { <header> = <value> }")
    wanted = {key: _wanted(where[key]) for key in where.value}
    named = [header for source in sources.values() for header in (source.header, source.minus) if header is not None]
    # A key of ``where`` is a header, or the number of a column.
    keys = [
        (form, value)
        for key, value in (*wanted.items(), *([(layout.split_by, "")] if layout.split_by else []))
        for form in (" ".join(key.split()), *([int(key)] if key.isdecimal() else []))
    ]
    words = (
        *(form for form, value in keys if isinstance(value, str)),
        *(source.header for source in sources.values() if source.unit == STAMP),
    )
    layout = replace(layout, columns=(*named, *(form for form, _ in keys)), words=words)
    return ColumnMap(MappingProxyType(sources), layout, MappingProxyType(wanted))


def _source(node: Node, rule: ColumnRule) -> Source:
    """One entry of ``columns``."""
    node.table(_EXAMPLE)
    if "rate" in node:
        node.refuse_unknown(("rate",))
        if rule.si != "s":
            raise node["rate"].error("rate is for times", node.key, f"write {_EXAMPLE}", of_key=True)
        return Source(rate=node["rate"].quantity("Hz").value)
    node.refuse_unknown(("from", "minus", "unit", "scale", "offset"))
    header = _header(node.required("from", f"write {_EXAMPLE}"))
    node.unit(rule.si)
    scale, offset = (float(NUMBER.read(node.get(key, zero))) for key, zero in (("scale", 1.0), ("offset", 0.0)))
    if scale == offset == 0.0:
        raise node["scale"].error(
            "scale must not be 0", "0", "write 1, or -1 for the other sign; for a constant, state it as offset"
        )
    unit, further = node.value["unit"], node.value.keys() - {"from", "unit"}
    if unit == STAMP and further:
        raise node[min(further)].error(
            f"time stamps have no {min(further)}", "one", "remove it; clock shifts times", of_key=True
        )
    return Source(header, _header(node["minus"]) if "minus" in node else None, unit, scale, offset)


def _header(node: Node) -> Header:
    """A header, or a number counted from 1."""
    key, value = node.key, node.value
    if is_count(value):
        return value
    rule = "be a header or the number of a column, counted from 1"
    node.require(isinstance(value, str), rule, f'write {key} = 1 or {key} = "<header>"')
    named = f"name the column that holds {node.path[-2]}"
    node.require(value != UNKNOWN, named, "write its header, or its number counted from 1")
    return " ".join(node.text().split())


def _wanted(node: Node) -> Wanted:
    """One value of ``where``."""
    value = node.value
    if isinstance(value, str):
        return value.strip()
    if not isinstance(value, dict):
        return (number := float(NUMBER.read(node))), number
    node.refuse_unknown(("min", "max"))
    if not value:
        raise node.error("a range must have min or max", "none", "write { min = 2, max = 10 }, or one of them")
    low, high = (float(NUMBER.read(node[k])) if k in node else end for k, end in (("min", -inf), ("max", inf)))
    if low > high:
        raise node.error("min must not exceed max", shown(value), "exchange them")
    return low, high


# mapped: Applies a column map: selects, combines and scales the columns of one file or several.


#: Numbers of a file equal one of ``where`` within this many units in the last place.
ULPS = 4
_MOST_VALUES = 6  # shown of a column where no row has the value wanted


Found = tuple[np.ndarray, Callable[[int | None], Place]]  #: one column of a part: its numbers, and where a row stands


def apply_map(entry: Node, exports: Sequence[Export], column_map: ColumnMap) -> list[tuple[str, RawTable]]:
    """The tables of an experiment, one for each text of the column ``split_by``, after that text; else one, after "".

    Their columns have the names of the kind, in the stated units.

    Files with the same headers are put one below the other; else side by side, and a column that several of them hold
    must be the same within rounding.

    Raises
    ------
    InputError
        If a column is not found, cells are no numbers, columns have different lengths, or no row is left.
    """
    first = exports[0]
    alike = all((each.headers, each.width) == (first.headers, first.width) for each in exports)
    parts = [_Part([each]) for each in exports] if alike else [_Part(exports)]
    node = entry["columns"]
    sources = {name: source for name, source in column_map.sources.items() if source.rate is None}
    found = [
        {name: part.find(node[name]["from"], source.header, source.unit == STAMP) for name, source in sources.items()}
        for part in parts
    ]
    # The numbers of the files are not kept beside the table.
    places = [{name: place for name, (_, place) in here.items()} for here in found]
    names = tuple(column_map.sources)

    def place(row: int | None, column: int) -> Place:
        part = 0 if row is None else int(np.searchsorted(first_rows, row, side="right")) - 1
        here = places[part].get(names[column]) or next(iter(places[part].values()))
        return here(None if row is None else row - int(first_rows[part]))

    first_rows = np.cumsum([0, *(part.rows for part in parts)])
    values: dict[str, np.ndarray] = {}
    for name, source in sources.items():
        own = [here.pop(name)[0] for here in found]
        if source.unit == STAMP:
            texts = np.concatenate(own).tolist()
            values[name] = seconds_of_stamps(texts, column_map.layout.missing, partial(place, column=names.index(name)))
            continue
        if source.minus is not None:
            own = [one - part.find(node[name]["minus"], source.minus)[0] for part, one in zip(parts, own, strict=True)]
        with np.errstate(over="ignore"):
            values[name] = np.concatenate(own) * source.scale + source.offset
    where = [_selected_by(parts, entry["where"][key], value) for key, value in column_map.where.items()]
    keep, missing = _kept(node, values, where)
    rates = {name: source.rate for name, source in column_map.sources.items() if source.rate is not None}
    values |= {name: np.arange(first_rows[-1]) / rate for name, rate in rates.items()}

    # Arrays of a file may have other lengths than those that the map names.
    rows = np.arange(1, 1 + int(first_rows[-1])) if len(parts) > 1 else first.lines[: int(first_rows[-1])]
    units = tuple("s" if source.unit == STAMP else source.unit for source in column_map.sources.values())
    raw = RawTable(names, units, tuple(values[name] for name in names), rows, place)
    other = int(np.sum(~keep & ~missing))
    raw = raw if keep.all() else replace(raw.taken(np.flatnonzero(keep)), lost=rows[missing], other=other)
    split = column_map.layout.split_by is not None
    tables = _by_texts(entry["split_by"], parts, raw, keep) if split else [("", raw)]
    _refuse_lost(entry, parts, tables, list(rates))
    return tables


def _refuse_lost(
    entry: Node, parts: Sequence["_Part"], tables: Sequence[tuple[str, RawTable]], rates: Sequence[str]
) -> None:
    """Refuse a file of which no column is used, and ``rates`` where rows do not show which sample they are.

    Each blank line between some rows of a table may be a lost sample; between all rows they stem from the ends of the lines.
    """
    exports = [each for part in parts for each in part.exports]
    used = set[Path]().union(*(part.used for part in parts))
    if idle := [each.path.name for each in exports if each.path not in used]:
        rule = "files with different headers are put side by side, and each must hold a column that is mapped"
        raise entry["files"].error(rule, idle[0], "give all files the same headers, or make an experiment of each")
    if rates and len(parts) > 1:
        rule, remedy = "a rate gives the times of one file", "make an experiment of each"
        raise entry["columns"][rates[0]]["rate"].error(rule, counted(len(parts), "file"), remedy)
    for _, raw in tables if rates else ():
        behind = np.searchsorted(raw.rows, exports[0].blanks)
        inside = np.flatnonzero((behind > 0) & (behind < len(raw.rows)))
        if 0 < len(np.unique(behind[inside])) < len(raw.rows) - 1:
            rule = "a rate gives the times of rows that follow one another"
            remedy = "write NaN there if a reading is lost, else delete the line"
            raise InputError(rule, "a blank line", remedy, exports[0].path, int(exports[0].blanks[inside[0]]), 1)


def _by_texts(split_by: Node, parts: Sequence["_Part"], raw: RawTable, keep: np.ndarray) -> list[tuple[str, RawTable]]:
    """The rows that are kept for each text of the column that ``split_by`` names, after that text."""
    header = _header_named(split_by.value, parts)
    texts = np.concatenate([part.find(split_by, header, texts=True)[0] for part in parts])[keep]
    names, owners = np.unique(texts, return_inverse=True)
    if "" in names:
        rule = f"split_by needs a text in every row of {split_by.value}"
        raise raw.error(int(np.argmin(owners)), raw.names[0], rule, "none", "fill it")
    return [*zip(map(str, names), raw.divided(owners), strict=True)]


class _Part:
    """Files side by side: the columns of one are found in any of them."""

    def __init__(self, exports: Sequence[Export]) -> None:
        self.exports, self.rows = exports, 0  # the number of rows of the columns found
        self.used = set[Path]()

    def find(self, node: Node, header: Header, texts: bool = False) -> Found:
        """The column ``header``, stated at ``node`` of ``rig.toml``: its numbers, or its ``texts``."""
        named = [(export, column) for export in self.exports for column in self._column(node, export, header)]
        if not named:
            known = [name for export in self.exports for row in export.headers for name in row if name]
            raise node.error(
                f"{node.key} must be a header of the file",
                f"{shown(header)}; headers: {shown(' '.join(known)) if known else 'none'}",
                remedy_for(str(header), known, "write the number of the column, counted from 1"),
            )
        found = list[np.ndarray]()
        self.used |= {export.path for export, _ in named}
        for export, index in named:
            if not texts:
                found.append(export.values(index))
            elif export.cells is not None:  # as objects: one long text must not widen all
                found.append(np.array([row[index] for row in export.cells()], dtype=object))
            else:
                raise node.error(
                    f"{node.key} takes numbers for a {export.path.suffix} file",
                    "a text",
                    "write a number, or export the file as CSV",
                )
            self.rows = self.rows or found[-1].size
            if found[-1].size != self.rows:
                raise node.error(
                    f"columns must have equal lengths ({self.rows})",
                    f"{shown(header)}: {found[-1].size}",
                    "map columns of equal length, or make an experiment of each file, with a clock",
                )
            same = found[-1] == found[0]
            if not (texts or same.all()):
                rounding = SAME * float(np.nanmax(np.abs(found[0]), initial=0.0))
                same = np.isclose(found[-1], found[0], rtol=0.0, atol=rounding, equal_nan=True)
            if not same.all():
                one, other = (each[~same].tolist()[0] for each in (found[0], found[-1]))
                raise node.error(
                    f"{shown(header)} must be the same in {named[0][0].path.name} and {export.path.name}",
                    f"{shown(one)} and {shown(other)}",
                    "name files that were recorded together, or make an experiment of each",
                )
        (first, column), values = named[0], found[0]
        place = first.place  # the numbers of the file are not kept beside the table
        return values, lambda row: place(row, column)

    def _column(self, node: Node, export: Export, header: Header) -> list[int]:
        """Index of a column in one file; none if the file does not have the header."""
        if isinstance(header, int):
            if len(self.exports) > 1:
                raise node.error(
                    "columns of files with different headers are named by their headers",
                    str(header),
                    f'write {node.key} = "<header>"',
                )
            if header > export.width:
                raise node.error(
                    f"{node.key} must be one of the {export.width} columns of the file",
                    str(header),
                    f"write a number from 1 to {export.width}",
                )
            return [header - 1]
        found = ([index for index, name in enumerate(row) if name == header] for row in export.headers)
        numbers = next(filter(None, found), [])
        if len(numbers) > 1:
            value = f"{shown(header)} in columns {' '.join(str(index + 1) for index in numbers)}"
            where = node.path[-2] == "where"
            raise node.error(
                "a header must be unique",
                value,
                f"write its number, {f'{numbers[0] + 1} = ...' if where else f'{node.key} = {numbers[0] + 1}'}",
                of_key=where,
            )
        return numbers


def _selected_by(parts: Sequence[_Part], node: Node, wanted: Wanted) -> tuple[np.ndarray, np.ndarray]:
    """The rows whose column, named by the key of ``node``, has what is ``wanted``, and those without a value, (n,)."""
    header = _header_named(node.key, parts)
    column = np.concatenate([part.find(node, header, isinstance(wanted, str))[0] for part in parts])
    if isinstance(wanted, str):
        rows, unknown = column == wanted, column == ""
    else:
        # 0.1 + 0.2 is 0.3; times since 1970 in microseconds keep their digits.
        ends = np.array(wanted)
        low, high = ULPS * np.array([-1, 1]) * np.spacing(np.where(np.isfinite(ends), np.abs(ends), 0.0)) + ends
        rows, unknown = (column >= low) & (column <= high), np.isnan(column)
    if not rows.any():
        raise node.error(
            f"where must keep a row; column {shown(node.key)} holds {_held(column, wanted)}",
            shown(node.value),
            "write one of the values of the column"
            if isinstance(wanted, str) or wanted[0] == wanted[1]
            else "widen the range",
        )
    return rows, unknown


def _header_named(key: str, parts: Sequence[_Part]) -> Header:
    """The header that ``key`` is, or the number of a column where no header is that."""
    stated = any(key in row for part in parts for export in part.exports for row in export.headers)
    number = key.isascii() and key.isdigit() and int(key) > 0 and not stated
    return int(key) if number else " ".join(key.split())


def _held(column: np.ndarray, wanted: Wanted) -> str:
    """What a column, (n,) texts or numbers, holds where nothing is ``wanted``, in words."""
    seen = np.unique(column if isinstance(wanted, str) else column[~np.isnan(column)])
    if not isinstance(wanted, str) and wanted[0] < wanted[1] and seen.size:
        return f"{seen[0]:.15g} to {seen[-1]:.15g}"
    texts = [shown(str(one)) if isinstance(wanted, str) else f"{one:.15g}" for one in seen[: _MOST_VALUES + 1]]
    return " ".join(texts[:_MOST_VALUES]) + " …" * (len(texts) > _MOST_VALUES) or "no number"


def _kept(
    node: Node, values: Mapping[str, np.ndarray], where: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Which rows are used, and which are dropped for a missing cell; the others lie outside ``where``."""
    everything = np.ones(next(iter(values.values())).size, bool)
    inside = np.all([everything, *(rows for rows, _ in where)], axis=0)
    unknown = np.any([~everything, *(rows for _, rows in where)], axis=0)
    empty = np.any([~everything, *(np.isnan(column) for column in values.values())], axis=0)
    keep = inside & ~empty
    if not keep.any():
        raise node.error("a table must have rows", "none is left", "correct where, or map another column")
    return keep, (inside & empty) | (unknown & ~inside)
