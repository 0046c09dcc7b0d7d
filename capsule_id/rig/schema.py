"""Types for the columns, settings and rules of a kind of experiment, and the choices of ``[model]``."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from math import cos
from types import MappingProxyType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Generic,
    Literal,
    Protocol,
    get_args,
    get_origin,
    get_type_hints,
    runtime_checkable,
)

import numpy as np

from capsule_id.errors import InputError, collecting, raise_all
from capsule_id.parameters import TABLE, Parameter
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.model import SHORTEST_RECORD, ModelChoices, Quantity, S, Settings, Table
from capsule_id.rig.toml import (
    ANY,
    ERRORS,
    INCLINE,
    NAME_PATTERN,
    NOT_NEGATIVE,
    POSITIVE,
    Domain,
    Node,
    is_count,
    remedy_for,
    shown,
)
from capsule_id.views import counted

# schema: Types for the columns, settings and rules of a kind of experiment. The reader uses no other type of a kind.


@dataclass(frozen=True)
class ColumnRule:
    """A column: SI unit, domain, and whether its values must increase from row to row or vary.

    ``usual``: lowest and highest usual magnitude, SI, where it is not that of all quantities of this unit.
    """

    si: str
    domain: Domain = ANY
    increasing: bool = False
    varies: bool = False
    usual: tuple[float, float] | None = None


def table_schema(keys: Mapping[str, Any], required: Iterable[str] = ()) -> dict[str, Any]:
    """The JSON schema of a table with these ``keys``, rules of settings or schemas; a rule without one allows any value."""
    forms = {key: form if isinstance(form, dict) else getattr(form, "schema", {}) for key, form in keys.items()}
    return {"type": "object", "properties": forms, "required": [*required], "additionalProperties": False}


def number_schema(domain: Domain) -> dict[str, Any]:
    """The JSON schema of a number whose ``domain`` has a lower end of 0, in any unit, or no lower end."""
    end = "minimum" if domain.closed else "exclusiveMinimum"
    return {"type": "number", **({end: domain.low} if domain.low >= 0.0 else {})}


@runtime_checkable
class SettingRule(Protocol):
    """Reads one setting. A kind may define its own rule: any object with this method.

    Its JSON schema, for the help of editors, may stand in an attribute ``schema``.
    """

    def read(self, node: Node) -> object:
        """The checked value of ``node``, as stored in the settings.

        Raises
        ------
        InputError
            At the node, where its value breaks the rule.
        """


@dataclass(frozen=True)
class QuantityRule:
    """``{ value = ..., unit = ... }`` as an SI float; with ``has_sd`` also ``sd``, as a ``Quantity``.

    ``usual``: as in ``ColumnRule``.
    """

    si: str
    domain: Domain = POSITIVE
    has_sd: bool = False
    usual: tuple[float, float] | None = None

    def read(self, node: Node) -> float | Quantity:
        """See ``SettingRule``."""
        quantity = node.quantity(self.si, self.domain, self.has_sd)
        return quantity if self.has_sd else quantity.value

    @property
    def schema(self) -> dict[str, Any]:
        """Its JSON schema."""
        keys = {
            "value": number_schema(self.domain),
            **dict.fromkeys(ERRORS if self.has_sd else (), number_schema(NOT_NEGATIVE)),
            "unit": {"type": "string", "description": f"{self.si}, or an equivalent unit"},
        }
        return table_schema(keys, ("value", "unit"))


#: Slope of the track and force that presses the capsule down.
SLOPE = QuantityRule("rad", INCLINE, has_sd=True, usual=(INCLINE.low, INCLINE.high))
PRESSING_FORCE = QuantityRule("N", ANY, has_sd=True, usual=(-1e3, 1e3))


@dataclass(frozen=True, kw_only=True)
class GroundSettings(Settings):
    """``slope`` of the track, rad, +X uphill, and ``N0``, N, besides the weight; absent: those of [rig]."""

    slope: Annotated[Quantity | None, SLOPE] = None
    N0: Annotated[Quantity | None, PRESSING_FORCE] = None

    @property
    def ground(self) -> dict[str, Quantity]:
        """The leaves of the capsule that may differ from level ground and the weight alone, SI."""
        stated = (("slope", self.slope), ("N0", self.N0))
        return {name: quantity for name, quantity in stated if quantity is not None and quantity != Quantity(0.0)}


@dataclass(frozen=True)
class ChoiceRule:
    """One of a few words."""

    choices: tuple[str, ...]

    def read(self, node: Node) -> str:
        """See ``SettingRule``."""
        return node.choice(self.choices)

    @property
    def schema(self) -> dict[str, Any]:
        """Its JSON schema."""
        return {"enum": [*self.choices]}


@dataclass(frozen=True)
class PlainRule:
    """A value of TOML as it is. ``rule`` continues "<key> must ..."; ``schema``: its JSON schema."""

    holds: Callable[[Any], bool]
    rule: str
    remedy: str
    schema: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def read(self, node: Node) -> Any:
        """See ``SettingRule``."""
        node.require(self.holds(node.value), self.rule, self.remedy)
        return node.value


@dataclass(frozen=True)
class WordsRule:
    """One of a few words, or a list of some of them."""

    choices: tuple[str, ...]

    def read(self, node: Node) -> tuple[str, ...]:
        """See ``SettingRule``."""
        if not isinstance(node.value, list):
            return (node.choice(self.choices),)
        node.require(bool(node.value), "not be empty", f"write some of {' '.join(self.choices)}")
        # Words of a list have no place of their own.
        return tuple(replace(node, value=word).choice(self.choices) for word in node.value)

    @property
    def schema(self) -> dict[str, Any]:
        """Its JSON schema."""
        word = {"enum": [*self.choices]}
        return {"anyOf": [word, {"type": "array", "items": word, "minItems": 1}]}


#: JSON schema of a whole number, 1 or more.
WHOLE = {"type": "integer", "minimum": 1}


@dataclass(frozen=True)
class NameRule:
    """A name of letters, digits, dot, underscore, hyphen."""

    schema: ClassVar = {"type": "string", "pattern": f"^{NAME_PATTERN}$"}

    def read(self, node: Node) -> str:
        """See ``SettingRule``."""
        return node.name()


#: Keys of the support springs of the rod, in front and behind, with those of their gaps.
SPRINGS_AND_GAPS = (("spring", "gap"), ("spring_back", "gap_back"))


@dataclass(frozen=True, kw_only=True)
class SupportSettings(GroundSettings):
    """Support springs in front of the rod and behind it, by name, with their gaps, m, from x_rel = 0 on."""

    spring: Annotated[str | None, NameRule()] = None
    gap: Annotated[Quantity | None, QuantityRule("m", ANY, has_sd=True)] = None
    spring_back: Annotated[str | None, NameRule()] = None
    gap_back: Annotated[Quantity | None, QuantityRule("m", ANY, has_sd=True)] = None


#: A whole number, 1 or more.
COUNT = PlainRule(is_count, "be a whole number, 1 or more", "write e.g. 10", WHOLE)


@dataclass(frozen=True)
class Entry(Generic[S]):
    """The argument of a kind's rules.

    Attributes
    ----------
    table : columns and settings, SI
    node : the entry in ``rig.toml``
    file : the table as written
    """

    table: Table[S]
    node: Node
    file: RawTable

    def error(self, key: str, rule: str, value: str, remedy: str, of_key: bool = False) -> InputError:
        """The error about a setting, at its value or key; ``key`` "" means the whole entry."""
        return (self.node.get(key, None) if key else self.node).error(rule, value, remedy, of_key)

    def refuse_ground(self, key: str, rule: str) -> None:
        """Refuse a slope or N0 that this experiment cannot have, its own or that of [rig].

        Raises
        ------
        InputError
            Where ``key``, "slope" or "N0", is stated.
        """
        settings: Any = self.table.settings
        if stated := settings.ground.get(key):
            unit = "deg" if key == "slope" else "N"
            raise node_of_ground(self.node, key).error(
                rule,
                f"{stated.value:.3g}{f' ± {stated.sd:.3g}' if stated.sd else ''} in SI units",
                f'state {key} = {{ value = 0, unit = "{unit}" }} in this experiment, if that is true of it',
            )

    def check_springs_with_gaps(self) -> None:
        """Require a gap where a spring is within reach.

        Raises
        ------
        InputError
            At the one of spring and gap that stands alone, in front of the rod or behind it.
        """
        for pair in SPRINGS_AND_GAPS:
            alone = [key for key in pair if getattr(self.table.settings, key) is not None]
            if len(alone) == 1:
                (one,), (other,) = alone, {*pair} - {*alone}
                raise self.error(
                    one,
                    f"{' and '.join(pair)} must stand together",
                    f"{one} alone",
                    f"add {other}, or remove {one} where the spring is out of reach",
                    of_key=True,
                )

    def check_length(self) -> None:
        """Refuse a record that is too short to fit.

        Raises
        ------
        InputError
            At the last sample.
        """
        samples = len(self.table.rows)
        if samples < SHORTEST_RECORD:
            raise self.file.error(
                samples - 1,
                "time",
                f"a record must have at least {SHORTEST_RECORD} samples",
                counted(samples, "sample"),
                f"record {self.table.kind} for longer or faster",
            )


@dataclass(frozen=True, kw_only=True)
class KindRule:
    """The properties of one kind of experiment that the reader uses.

    Attributes
    ----------
    name : as ``kind`` in ``rig.toml``
    columns : every column that the file may have
    sets : the file must have exactly one of these sets of columns
    channels : columns of which the file must have at least one; () means no such rule
    optional : columns that may be absent
    settings : the dataclass of the entry's settings. A field's type states its rule: ``Literal`` a choice,
        ``Annotated[type, rule]`` any other. A field with a default may be absent
    rules : each raises an ``InputError`` where columns and settings are inconsistent
    masses : the masses of [rig] that an experiment with this table needs
    masses_of_free : the masses that an experiment needs where ``[model] free`` names a parameter, by its symbol
    meant : words of ``capsule_id.rig.guess`` for the forces of the file: the one that the kind takes, then others
    parameters : rows of the parameters that only experiments of this kind have
    bench : a bench test; else a forced run
    test : the word for one test, a record or a row, in [plan]
    minutes : what one test takes where [plan] states nothing, min
    read_by : what may be stated of the instruments of its columns, besides a clock: gain and offset
    divide : the number, from 0, of the part of a record that a row belongs to, (n,), -1 for none; each part is a record.
        Its arguments are the entry, columns in SI, and the settings. None: it stays whole
    """

    name: str
    columns: Mapping[str, ColumnRule]
    sets: tuple[tuple[str, ...], ...]
    channels: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    settings: type[Settings] = Settings
    rules: tuple[Callable[[Entry[Any]], None], ...] = ()
    masses: Callable[[Table[Any]], tuple[str, ...]] = field(default=lambda table: ())
    masses_of_free: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    meant: tuple[str, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    bench: bool = True
    test: str = ""
    minutes: float = 1.0
    read_by: tuple[str, ...] = ()
    divide: Callable[[Node, Mapping[str, np.ndarray], Any], np.ndarray | None] | None = None

    @cached_property
    def setting_rules(self) -> Mapping[str, SettingRule]:
        """The rule of every setting, by key.

        Raises
        ------
        TypeError
            If the type of a field states no rule.
        """
        hints = get_type_hints(self.settings, include_extras=True)
        return MappingProxyType({f.name: _rule_of(f.name, hints[f.name]) for f in fields(self.settings)})

    @property
    def required(self) -> tuple[str, ...]:
        """Settings that the entry must have."""
        stated = fields(self.settings)
        return tuple(f.name for f in stated if f.default is MISSING and f.default_factory is MISSING)


def _rule_of(name: str, hint: object) -> SettingRule:
    """The rule in the type of a field."""
    for part in (hint, *reversed(get_args(hint))):  # a rule stands behind the type
        if isinstance(part, SettingRule):
            return part
        if get_origin(part) is Literal:
            return ChoiceRule(get_args(part))
    raise TypeError(f"the type of setting {name} must be a Literal, or Annotated with its rule")


def read_rules(node: Node, rules: Mapping[str, SettingRule]) -> dict[str, Any]:
    """The values that a table states, each read by its rule.

    Raises
    ------
    InputError
        At every value that breaks its rule, in the order of the rules.
    """
    values, faults = dict[str, Any](), list[InputError]()
    for key, rule in rules.items():
        if key in node:
            with collecting(faults):
                values[key] = rule.read(node[key])
    raise_all(faults)
    return values


def parameter_rows(kinds: Mapping[str, KindRule]) -> dict[str, Parameter]:
    """Every parameter by symbol: the package's table, then the rows of ``kinds``.

    Raises
    ------
    ValueError
        If one symbol has two different rows.
    """
    rows = dict(TABLE)
    for kind in kinds.values():
        for row in kind.parameters:
            if rows.setdefault(row.symbol, row) != row:
                raise ValueError(f"parameter {row.symbol} of kind {kind.name} is declared twice")
    return rows


#: Quantities of [rig], by key.
RIG_QUANTITIES: Mapping[str, QuantityRule] = {
    "m1": QuantityRule("kg", has_sd=True),
    "m2": QuantityRule("kg", has_sd=True),
    "g": QuantityRule("m/s^2", usual=(9.5, 10.1)),
    "slope": SLOPE,
    "N0": PRESSING_FORCE,
}
#: Its other keys but ``confirmed``.
RIG_WORDS: Mapping[str, SettingRule] = {
    "name": NameRule(),
    "synthetic": PlainRule(
        lambda value: isinstance(value, bool),
        "be true or false",
        "write true or false without quotes",
        {"type": "boolean"},
    ),
}
#: Keys of the tables of rig.toml that stand once.
TABLE_KEYS: Mapping[str, tuple[str, ...]] = {
    "[rig]": ("name", "synthetic", "confirmed", *RIG_QUANTITIES),
    "[model]": ("friction", "free", "reaction", "engine"),
    "[plan]": ("minutes", "tests"),
}
#: Keys of ``[[instrument]]``.
INSTRUMENT_KEYS = ("name", "gain", "offset", "clock")


# choices: Reads ``[model]`` of ``rig.toml``, and checks choices of [rig] and of an experiment that depend on each
# other.


#: Choices of ``[model]``.
MODEL_RULES: Mapping[str, ChoiceRule] = {
    key: ChoiceRule(get_args(get_type_hints(ModelChoices)[key])) for key in ("friction", "reaction", "engine")
}
#: Words that ``free`` may hold.
OPTIONAL = tuple(symbol for symbol, row in TABLE.items() if row.optional)


def read_words(node: Node, known: Sequence[str], rule: str, remedy: str) -> list[str]:
    """The words of a list, each of them ``known``.

    Raises
    ------
    InputError
        At the list; ``remedy`` is that of a word that is like no other.
    """
    for word in node.value:
        if word not in known:
            raise node.error(
                f"{node.key} must name {rule}",
                shown(word),
                remedy_for(word if isinstance(word, str) else "", known, remedy, "write {}"),
            )
    return node.value


def read_model(root: Node) -> ModelChoices:
    """Return the choices of ``[model]``; the defaults where it is absent.

    Raises
    ------
    InputError
        If a key or word is unknown or repeated, or a free parameter has no effect in the chosen law.
    """
    head = root.get("model", {}).table("[model]")
    head.refuse_unknown(TABLE_KEYS["[model]"], TABLE_KEYS)
    choices = read_rules(head, MODEL_RULES)
    node = head.get("free", [])
    node.require(isinstance(node.value, list), "be a list of words", f'write free = ["{OPTIONAL[0]}"]')
    free = read_words(node, OPTIONAL, "optional parameters", f"write some of {' '.join(OPTIONAL)}")
    if twice := [word for index, word in enumerate(free) if word in free[:index]]:
        raise node.error("free must name each parameter once", shown(twice[0]), "remove the second one")
    if choices.get("friction") == "constant" and "ratio" in free:
        raise node.error(
            "constant friction has no ratio",
            shown("ratio"),
            'remove "ratio" from free, or remove friction = "constant"',
        )
    in_order = tuple(symbol for symbol in OPTIONAL if symbol in free)
    return ModelChoices(free=in_order, **choices)


def words_of_tests(kinds: Mapping[str, KindRule]) -> list[str]:
    """The words for one test of each of ``kinds`` in [plan]."""
    return [kind.test or name for name, kind in kinds.items()]


def read_plan(root: Node, kinds: Mapping[str, KindRule]) -> dict[str, dict[str, float]]:
    """Return ``minutes`` of one test and number of ``tests`` by word, of [plan]; {} where they are absent.

    Raises
    ------
    InputError
        If a key or word is unknown, or a number is not positive.
    """
    head = root.get("plan", {}).table("[plan]")
    head.refuse_unknown(TABLE_KEYS["[plan]"], TABLE_KEYS)
    stated = {key: head[key].table("{ push = 10 }", words_of_tests(kinds)) for key in head.value}
    return {key: {word: node.number(word, 1.0, POSITIVE) for word in node.value} for key, node in stated.items()}


def check_engine(root: Node, model: ModelChoices, tables: Sequence[Table[Any]]) -> None:
    """Refuse a smoothed engine in a rig without an experiment that integrates eqs. (1) and (2).

    Raises
    ------
    InputError
        At ``engine``.
    """
    integrated = any(not table.bench or getattr(table.settings, "forward", "") == "capsule" for table in tables)
    if model.engine == "smooth" and not integrated:
        raise root["model"]["engine"].error(
            'engine = "smooth" needs an experiment that integrates eqs. (1) and (2): a run, or forward = "capsule"',
            "closed forms alone",
            'remove engine, or write forward = "capsule" for a decay or for pushes',
        )


def read_confirmed(root: Node, tables: Sequence[Table[Any]], stated: Iterable[str]) -> tuple[str, ...]:
    """Return the names in ``confirmed`` of [rig]; ``stated``: the quantities of [rig].

    Raises
    ------
    InputError
        If it is no list of names of [rig], of the word friction, or of columns and settings of experiments.
    """
    node = root["rig"].get("confirmed", [])
    known = ["friction", *stated, *(f"{t.label}.{name}" for t in tables for name in (*t.columns, *vars(t.settings)))]
    node.require(isinstance(node.value, list), "be a list of names", 'write confirmed = ["m1"]')
    rule = "quantities of [rig], friction, or LABEL.COLUMN or LABEL.SETTING of experiments"
    return tuple(read_words(node, known, rule, "remove it"))


def check_masses(
    root: Node, model: ModelChoices, tables: Sequence[Table], kinds: Mapping[str, KindRule], stated: Collection[str]
) -> None:
    """Refuse an experiment, or a free parameter with an experiment, that needs a mass which [rig] does not state.

    Raises
    ------
    InputError
        At the kind of the experiment, or at ``free``; it names the missing mass.
    """
    needs = [
        *(
            (root["experiment"][table.entry]["kind"], mass, f"{table.kind} needs {mass}", "")
            for table in tables
            for mass in kinds[table.kind].masses(table)
        ),
        *(
            (
                root["model"]["free"],
                mass,
                f"free {symbol} needs {mass}, because {table.label} gives friction without the weight",
                f', or remove "{symbol}"',
            )
            for symbol in model.free
            for table in tables
            for mass in kinds[table.kind].masses_of_free.get(symbol, ())
        ),
    ]
    for node, mass, rule, other in needs:
        if mass not in stated:
            raise node.error(
                rule, f"no {mass} in [rig]", f'add {mass} = {{ value = ..., sd = ..., unit = "kg" }} to [rig]{other}'
            )


def node_of_ground(entry: Node, key: str) -> Node:
    """The node where ``key``, which an entry or [rig] may have, is stated for an experiment."""
    root = Node(entry.document, (), entry.document.data)
    return entry[key] if key in entry else root["rig"][key]


def check_normal_forces(root: Node, tables: Sequence[Table[Any]], stated: Mapping[str, Quantity]) -> None:
    """Refuse a pressing force that lifts the capsule off the ground; ``stated``: g and the stated masses.

    Raises
    ------
    InputError
        At the first N0 with (m1 + m2) g cos(slope) + N0 <= 0.
    """
    mass = sum(stated[name].value for name in ("m1", "m2") if name in stated)
    for table in tables:
        settings = table.settings
        if not isinstance(settings, GroundSettings) or settings.N0 is None or "m2" not in stated:
            continue
        slope = 0.0 if settings.slope is None else settings.slope.value
        N = mass * stated["g"].value * cos(slope) + settings.N0.value
        if N <= 0.0:
            rule = f"the normal force (m1 + m2) g cos(slope) + N0 of {table.label} must be positive"
            node = node_of_ground(root["experiment"][table.entry], "N0")
            raise node.error(rule, f"{N:.3g} N", "raise N0; N0 > 0 presses the capsule down")
