"""Types for the columns, settings and rules of a kind of experiment. The reader uses no other type of a kind."""

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from types import MappingProxyType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Protocol,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    runtime_checkable,
)

from capsule_id.parameters import TABLE, Parameter
from capsule_id.rig.domains import ANY, INCLINE, POSITIVE, Domain
from capsule_id.rig.model import Quantity, Settings, Table
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import read_choice, read_name, read_quantity, shown

if TYPE_CHECKING:
    from capsule_id.rig.entry import Entry

#: Fewest samples of a record: six unknowns of a free decay (k1, c, amplitude, phase, offset, noise) and two more.
SHORTEST_RECORD = 8


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


@runtime_checkable
class SettingRule(Protocol):
    """Reads one setting. A kind may define its own rule: any object with this method."""

    def read(self, document: TomlDocument, path: KeyPath, value: object) -> object:
        """The checked value at ``path`` of ``rig.toml``, as stored in the settings.

        Raises
        ------
        InputError
            At ``path``, where the value breaks the rule.
        """
        ...


@dataclass(frozen=True)
class QuantityRule:
    """``{ value = ..., unit = ... }`` as an SI float; with ``has_sd`` also ``sd``, as a ``Quantity``.

    ``usual``: as in ``ColumnRule``.
    """

    si: str
    domain: Domain = POSITIVE
    has_sd: bool = False
    usual: tuple[float, float] | None = None

    def read(self, document: TomlDocument, path: KeyPath, value: object) -> float | Quantity:
        """See ``SettingRule``."""
        quantity = read_quantity(document, path, value, self.si, self.domain, self.has_sd)
        return quantity if self.has_sd else quantity.value


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

    def read(self, document: TomlDocument, path: KeyPath, value: object) -> str:
        """See ``SettingRule``."""
        return read_choice(document, path, value, self.choices)


@dataclass(frozen=True)
class CountRule:
    """A whole number, 1 or more."""

    def read(self, document: TomlDocument, path: KeyPath, value: object) -> int:
        """See ``SettingRule``."""
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise document.error(path, f"{path[-1]} must be a whole number, 1 or more", shown(value), "write e.g. 10")
        return value


@dataclass(frozen=True)
class WordsRule:
    """One of a few words, or a list of some of them."""

    choices: tuple[str, ...]

    def read(self, document: TomlDocument, path: KeyPath, value: object) -> tuple[str, ...]:
        """See ``SettingRule``."""
        if not isinstance(value, list):
            return (read_choice(document, path, value, self.choices),)
        if not value:
            known = " ".join(self.choices)
            raise document.error(path, f"{path[-1]} must not be empty", "[]", f"write some of {known}")
        # Words of a list have no place of their own.
        for word in value:
            read_choice(document, path, word, self.choices)
        return tuple(value)


@dataclass(frozen=True)
class NameRule:
    """A name of letters, digits, dot, underscore, hyphen."""

    def read(self, document: TomlDocument, path: KeyPath, value: object) -> str:
        """See ``SettingRule``."""
        return read_name(document, path, value)


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
    meant : words of ``capsule_id.rig.maps.headers`` for the forces of the file: the one that the kind takes, then others
    parameters : rows of the parameters that only experiments of this kind have
    bench : a bench test; else a forced run
    """

    name: str
    columns: Mapping[str, ColumnRule]
    sets: tuple[tuple[str, ...], ...]
    channels: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    settings: type[Settings] = Settings
    rules: tuple[Callable[["Entry[Any]"], None], ...] = ()
    masses: Callable[[Table[Any]], tuple[str, ...]] = field(default=lambda table: ())
    masses_of_free: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    meant: tuple[str, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    bench: bool = True

    @property
    def setting_rules(self) -> Mapping[str, SettingRule]:
        """The rule of every setting, by key."""
        return _setting_rules(self.settings)

    @property
    def required(self) -> tuple[str, ...]:
        """Settings that the entry must have."""
        stated = fields(self.settings)
        return tuple(f.name for f in stated if f.default is MISSING and f.default_factory is MISSING)


@cache
def _setting_rules(settings: type[Settings]) -> Mapping[str, SettingRule]:
    """The rule of every field of a settings dataclass.

    Raises
    ------
    TypeError
        If the type of a field states no rule.
    """
    hints = get_type_hints(settings, include_extras=True)
    return MappingProxyType({f.name: _rule_of(f.name, hints[f.name]) for f in fields(settings)})


def _rule_of(name: str, hint: object) -> SettingRule:
    """The rule in the type of a field."""
    if get_origin(hint) is Annotated:
        for extra in get_args(hint)[1:]:
            if isinstance(extra, SettingRule):
                return extra
    one_of = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    for option in one_of:
        if get_origin(option) is Literal:
            return ChoiceRule(get_args(option))
    raise TypeError(f"the type of setting {name} must be a Literal, or Annotated with its rule")


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
#: Keys of the tables of rig.toml that stand once.
TABLE_KEYS: Mapping[str, tuple[str, ...]] = {
    "[rig]": ("name", "synthetic", "confirmed", *RIG_QUANTITIES),
    "[model]": ("friction", "free", "reaction"),
}
