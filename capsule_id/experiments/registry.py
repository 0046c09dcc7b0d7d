"""Registry of all kinds of experiments, by name: built-in kinds and those of installed packages.

A package adds kinds through the entry-point group ``capsule_id.experiments``; each entry point names a ``Kind``.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import entry_points
from typing import TypeVar

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Kind
from capsule_id.parameters import Parameter
from capsule_id.rig.schema import parameter_rows
from capsule_id.views import Message

#: Entry-point group of installed packages with further kinds.
GROUP = "capsule_id.experiments"

#: Folders of the built-in kinds, in the order of templates and synthetic rigs.
BUILT_IN = (
    "free_vibration",
    "static_friction",
    "dynamic_friction",
    "sliding_friction",
    "motor_current",
    "support_spring",
    "transducer",
    "forced_run",
    "progression",
)

Declared = TypeVar("Declared")


@dataclass(frozen=True, eq=False)
class Registry(Mapping[str, Kind]):
    """Kinds of experiments by name, in a fixed order.

    Attributes
    ----------
    packages : version of each installed package that adds a kind, by name of its distribution

    Raises
    ------
    ValueError
        If two kinds have the same name, or declare the same parameter, caption or message differently. If the symbol
        of a parameter has a bracket, which names a spring or record.
    TypeError
        If the type of a setting has no rule.
    """

    kinds: tuple[Kind, ...]
    packages: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.by_name) < len(self.kinds):
            names = [kind.name for kind in self.kinds]
            raise ValueError(f"kind {next(n for n in names if names.count(n) > 1)} is declared twice")
        for kind in self.kinds:
            _ = kind.setting_rules
            for row in kind.parameters:
                if "[" in row.symbol:
                    raise ValueError(f"symbol of parameter {row.symbol} of kind {kind.name} must have no bracket")
        _ = self.parameters, self.captions, self.messages

    @cached_property
    def by_name(self) -> dict[str, Kind]:
        """The kinds by name."""
        return {kind.name: kind for kind in self.kinds}

    @cached_property
    def parameters(self) -> Mapping[str, Parameter]:
        """Every parameter by symbol: the package's table, then the rows of the kinds."""
        return parameter_rows(self.by_name)

    @cached_property
    def captions(self) -> Mapping[str, str]:
        """Captions of all panels, by ``Comparison.kind``."""
        return _joined("caption", ((kind.name, kind.captions) for kind in self.kinds))

    @cached_property
    def messages(self) -> Mapping[str, Message]:
        """Texts of the checks and tables of all kinds, by code."""
        return _joined("message", ((kind.name, kind.messages) for kind in self.kinds))

    def __getitem__(self, name: str) -> Kind:
        return self.by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.by_name)

    def __len__(self) -> int:
        return len(self.kinds)


def _joined(what: str, declared: Iterable[tuple[str, Mapping[str, Declared]]]) -> dict[str, Declared]:
    """Everything that the kinds declare, by name; ``declared`` holds pairs of a kind's name and its declarations.

    Raises
    ------
    ValueError
        If two kinds declare the same name differently.
    """
    joined: dict[str, Declared] = {}
    for kind, own in declared:
        for name, value in own.items():
            if joined.setdefault(name, value) != value:
                raise ValueError(f"{what} {name} of kind {kind} is declared twice")
    return joined


@cache
def default_registry() -> Registry:
    """Return the built-in kinds and those of installed packages; the result is cached.

    Raises
    ------
    InputError
        If a package's kind does not load or conflicts with another one; the error names the package.
    """
    registry = Registry(tuple(import_module(f"{__package__}.{folder}.declaration").KIND for folder in BUILT_IN))
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        package = point.dist.name if point.dist is not None else point.value
        remedy = f"update the package {package}, or uninstall it"
        try:
            kind = point.load()
            if not isinstance(kind, Kind):
                raise TypeError(f"{point.value} is no Kind")
            own = {} if point.dist is None else {point.dist.name: point.dist.version}
            registry = Registry((*registry.kinds, kind), {**registry.packages, **own})
        except Exception as error:  # a package may raise anything while it loads
            rule = f"the experiment kind {point.name} of an installed package must load"
            raise InputError(rule, f"{type(error).__name__}: {error}", remedy, package) from error
    return registry
