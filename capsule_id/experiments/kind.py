"""Declaration of one kind of experiment, by which the rest of the package knows it, and the registry of all kinds."""

import os
import site
import sys
import sysconfig
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import distributions
from itertools import chain
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import numpy as np

from capsule_id.errors import InputError
from capsule_id.parameters import Parameter, symbol_of
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import KindRule, parameter_rows
from capsule_id.rig.toml import shown
from capsule_id.views import Comparison, Finding, Message

if TYPE_CHECKING:
    from capsule_id.experiments.base import Experiment
    from capsule_id.experiments.friction_model import FrictionModel
    from capsule_id.physics.forces import Force, FrictionLaw


# kind: Declaration of one kind of experiment: its complete interface to the rest of the package.
#
# A kind is a file that holds a ``Kind`` named ``KIND``, or a folder whose ``declaration.py`` holds it.


#: Parameter values, SI, by name (``k1``, ``k2[soft]``).
Values = Mapping[str, float]
#: Parameter name -> rough value, SI, and whether it comes from a bench test of the rig (else: prior median).
Estimate = Callable[[str], tuple[float, bool]]

#: (table, rig, friction law of the fit) -> experiments of the table.
Maker = Callable[[Table[Any], Rig, "FrictionModel"], tuple["Experiment", ...]]


@dataclass(frozen=True)
class TwinTable:
    """One synthetic table.

    Attributes
    ----------
    file : file name
    columns : (n,) by header cell, e.g. ``x_rel [mm]``, in the header's unit
    settings : lines of its entry in ``rig.toml``
    """

    file: str
    columns: Mapping[str, np.ndarray]
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Twin:
    """Synthetic data of one kind for ``synthesize``.

    Attributes
    ----------
    tables : tables in the order of ``rig.toml``
    priors : lines of its ``[prior]``
    truth : true values of each table in addition to the parameters, by label
    """

    tables: tuple[TwinTable, ...]
    priors: tuple[str, ...] = ()
    truth: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def own_panels(experiments: Sequence["Experiment"], values: Values, draws: Sequence[Values]) -> Iterable[Comparison]:
    """Return the panels of experiments without shared panels, one after the other."""
    for e in experiments:
        yield from e.comparisons(e.local(values), [e.local(draw) for draw in draws])


def made_by(reference: str, capsule: str = "") -> Maker:
    """Return ``make`` of the experiment class at ``reference`` (``module:class``); the call imports the class.

    ``capsule`` is the class where the setting ``forward`` is "capsule".
    """

    def make(table: Table[Any], rig: Rig, friction: "FrictionModel") -> tuple["Experiment", ...]:
        by_capsule = capsule and table.settings.forward == "capsule"
        return resolve_name(capsule if by_capsule else reference).make(table, rig, friction)

    return make


@dataclass(frozen=True, kw_only=True)
class Kind(KindRule):
    """One kind of experiment; it adds these attributes to those of ``KindRule``.

    Attributes
    ----------
    make : makes the experiments of one table, several for a divided record; see ``made_by``. The third argument is the
        friction law of the fit
    template : commented lines of ``rig.toml`` that ``capsule-id init`` writes
    informs : parameters that it measures, for tables
    captions : captions of its panels in the report, by ``Comparison.kind``
    messages : texts of its own findings and tables, by code
    lint : findings on the readings of a table, from the table and its rig; they enter the verdict of a fit too
    lint_rig : findings at rough values, for ``capsule-id check`` alone: a fit repeats such checks at fitted values
    describe : description of a table for ``capsule-id check``, one line each
    check : raises an ``InputError`` where all tables of the kind together cannot be fitted
    paper : estimates by the paper's protocol, by parameter name. Kinds with the same function are evaluated together
    rough : less biased rough values than the paper's, before a fit, by parameter name
    panels : predictions and readings, with a band from draws. Kinds with the same function share their panels
    set_by : column whose values a further test may choose beyond the measured ones
    twin : simulates tables from true values, SI by name, with errors from a generator (shared by all bench kinds) or
        from a seed. None: ``synthesize`` omits the kind
    truth : true values, SI by name, that only this kind adds to a synthetic rig
    """

    make: Maker
    template: str
    informs: str
    captions: Mapping[str, str]
    messages: Mapping[str, Message] = field(default_factory=dict)
    lint: tuple[Callable[[Table[Any], Rig], Iterable[Finding]], ...] = ()
    lint_rig: Callable[[Table[Any], Rig, Estimate], Iterable[Finding]] = field(default=lambda table, rig, estimate: ())
    describe: Callable[[Table[Any]], Iterable[str]] = field(default=lambda table: ())
    check: Callable[[Sequence[Table[Any]]], None] = field(default=lambda tables: None)
    paper: Callable[[Sequence[Any]], Values] = field(default=lambda experiments: {})
    rough: Callable[[Sequence[Any], Rig], Values] = field(default=lambda experiments, rig: {})
    panels: Callable[[Sequence[Any], Values, Sequence[Values]], Iterable[Comparison]] = own_panels
    set_by: str = ""
    twin: Callable[[Values, np.random.Generator, int], Twin] | None = None
    truth: Values = field(default_factory=dict)


# registry: Registry of all kinds of experiments, by name: built-in kinds and those of installed packages.
#
# A package adds kinds through the entry-point group ``capsule_id.experiments``; each entry point names a ``Kind``.


#: Entry-point group of installed packages with further kinds.
GROUP = "capsule_id.experiments"

#: Built-in kinds, in the order of templates and synthetic rigs: a file here, or a folder with a ``declaration.py``.
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


class Registry(dict[str, Kind]):
    """Kinds of experiments by name, in a fixed order.

    Attributes
    ----------
    packages : version of each installed package that adds a kind, by name of its distribution
    parameters : every parameter by symbol: the package's table, then the rows of the kinds
    captions : captions of all panels, by ``Comparison.kind``
    messages : texts of the checks and tables of all kinds, by code

    Raises
    ------
    ValueError
        If two kinds have the same name, or declare the same parameter, caption or message differently. If the symbol
        of a parameter has a bracket, which names a spring or record.
    TypeError
        If the type of a setting has no rule.
    """

    def __init__(self, kinds: tuple[Kind, ...], packages: Mapping[str, str] | None = None) -> None:
        super().__init__({kind.name: kind for kind in kinds})
        self.kinds, self.packages = kinds, packages or {}
        if len(self) < len(kinds):
            names = [kind.name for kind in kinds]
            raise ValueError(f"kind {next(n for n in names if names.count(n) > 1)} is declared twice")
        for kind in kinds:
            _ = kind.setting_rules
            for row in kind.parameters:
                if "[" in row.symbol:
                    raise ValueError(f"symbol of parameter {row.symbol} of kind {kind.name} must have no bracket")
        self.parameters: Mapping[str, Parameter] = parameter_rows(self)
        self.captions: Mapping[str, str] = _joined("caption", ((kind.name, kind.captions) for kind in kinds))
        self.messages: Mapping[str, Message] = _joined("message", ((kind.name, kind.messages) for kind in kinds))


def _joined(what: str, declared: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Everything that the kinds declare, by name; ``declared`` holds pairs of a kind's name and its declarations.

    Raises
    ------
    ValueError
        If two kinds declare the same name differently.
    """
    joined: dict[str, Any] = {}
    for kind, own in declared:
        for name, value in own.items():
            if joined.setdefault(name, value) != value:
                raise ValueError(f"{what} {name} of kind {kind} is declared twice")
    return joined


def _built_in(name: str) -> Kind:
    """The declaration of a built-in kind."""
    place = import_module(f"{__package__}.{name}")
    return place.KIND if hasattr(place, "KIND") else import_module(f"{place.__name__}.declaration").KIND


def package_folders() -> list[str]:
    """The folders of installed packages: those of the interpreter and of the user, and what their ``.pth`` files name.

    Of ``sys.path`` the absolute folders behind the standard library count: there ``site.addsitedir`` puts its own. What stands
    before it may be the working folder, which may be a rig folder that somebody else made. The working folder and rig
    folders never count; an editable install of a package in them has its metadata beside the ``.pth`` file.
    """
    user = [site.getusersitepackages()] if site.ENABLE_USER_SITE else []
    own = [*site.getsitepackages(), sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), *user]
    named = list[str]()
    for file in chain.from_iterable(sorted(Path(folder).glob("*.pth")) for folder in dict.fromkeys(own)):
        with suppress(OSError):
            lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
            named += [str(file.parent / line.strip()) for line in lines if line.strip()]
    # What Python itself would leave out may stand there, and relative folders, which it does not add.
    path = [
        os.path.realpath(one)
        for one in sys.path
        if isinstance(one, str) and Path(one).is_absolute() and "\0" not in one
    ]
    library = os.path.realpath(sysconfig.get_path("stdlib"))
    added = path[path.index(library) :] if library in path else []
    found = {os.path.realpath(folder): None for folder in (*own, *named, *added) if os.path.isdir(folder)}  # noqa: PTH112
    working = os.path.realpath(os.curdir)
    return [folder for folder in found if folder != working and not os.path.exists(f"{folder}/rig.toml")]  # noqa: PTH110


@cache
def default_registry() -> Registry:
    """Return the built-in kinds and those of packages in ``package_folders``; the result is cached.

    Raises
    ------
    InputError
        If a package's kind does not load or conflicts with another one; the error names the package.
    """
    registry = Registry(tuple(_built_in(name) for name in BUILT_IN))
    packages = {package.name: package for package in reversed([*distributions(path=package_folders())])}
    points = chain.from_iterable(package.entry_points.select(group=GROUP) for package in packages.values())
    for point in sorted(points, key=lambda point: point.name):
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


# selection: The experiments of a rig, and what their kinds do together.

#: Allowed choices of experiments for a fit: bench tests, forced runs, or both.
Choice = Literal["bench", "runs", "all"]
CHOICES: tuple[Choice, ...] = get_args(Choice)

Shared = TypeVar("Shared")


def select_tables(rig: Rig, experiments: Choice) -> list[Table]:
    """Return the rig's tables that ``experiments`` selects; may be empty.

    Raises
    ------
    InputError
        If ``experiments`` is not one of ``CHOICES``.
    """
    if experiments not in CHOICES:
        known = ", ".join(f'"{choice}"' for choice in CHOICES)
        raise InputError(f"experiments must be one of {known}", repr(experiments), "correct the word")
    return [table for table in rig.tables if experiments == "all" or table.bench == (experiments == "bench")]


def make_experiments(
    rig: Rig,
    experiments: Choice = "all",
    registry: Registry | None = None,
    friction: "type[FrictionLaw] | None" = None,
    contact: "type[Force] | None" = None,
) -> tuple["Experiment", ...]:
    """Make the selected experiments of the rig, in the order of ``rig.toml``.

    Parameters
    ----------
    experiments : one of ``CHOICES``
    registry : kinds of experiments of the rig, by default all
    friction : class of the friction law, by default eq. (1)
    contact : class of the force of the support, by default the linear spring k2

    Raises
    ------
    InputError
        If there is nothing to fit, the tables of a kind cannot be fitted together, ``experiments`` is unknown, or
        ``friction`` or ``contact`` cannot be fitted.
    """
    kinds = registry or default_registry()
    tables = select_tables(rig, experiments)
    if not tables:
        rule = "the rig folder must hold an experiment to fit"
        raise InputError(rule, f"none with --experiments {experiments}", "add one to rig.toml", rig.folder / "rig.toml")
    for name, kind in kinds.items():
        kind.check([table for table in tables if table.kind == name])
    # The law loads JAX, which takes seconds. A faulty folder must be reported before.
    from capsule_id.experiments.friction_model import friction_of

    model = friction_of(rig, friction, contact)
    model.check(kinds.parameters)
    made = tuple(e for table in tables for e in kinds[table.kind].make(table, rig, model))
    labels = [e.label for e in made]
    if same := next((label for label in labels if labels.count(label) > 1), None):
        rule, remedy = (
            "the channels of all experiments must have different names",
            'give one entry a label of its own: label = "..."',
        )
        raise InputError(rule, f"two are {shown(same)}", remedy, rig.folder / "rig.toml")
    measured = {row.symbol for e in made for row in e.parameters}
    for symbol in rig.model.free if experiments == "all" else ():
        if symbol not in measured:
            rule = f"an experiment must measure {symbol}, which [model] sets free"
            wanted = 'with direction = "backward"' if symbol == "mu_back" else "with a sliding capsule"
            remedy = f'remove "{symbol}" from free, or add an experiment {wanted}'
            raise InputError(rule, "none", remedy, rig.folder / "rig.toml")
    _check_laws(made, model, rig)
    return made


def _check_laws(made: Sequence["Experiment"], model: "FrictionModel", rig: Rig) -> None:
    """Refuse experiments that read what the laws of the fit replace, or whose masses the friction law needs."""
    for e in made:
        if taken := model.replaced.intersection(row.symbol for row in e.parameters):
            rule = f"the kind {e.kind} reads {min(taken)}, which {model.name} replaces"
            raise InputError(rule, e.label, f"remove {e.label}, or fit without this law", rig.folder / "rig.toml")
    springs = sorted({str(spring) for e in made if (spring := getattr(e.table.settings, "spring", None)) is not None})
    if model.contact is not None and len(springs) > 1:
        rule, remedy = f"the contact of {model.name} describes one spring", "fit the runs of each spring by themselves"
        raise InputError(rule, ", ".join(springs), remedy, rig.folder / "rig.toml")
    for e in made:
        if model.contact is not None and getattr(e.table.settings, "spring_back", None) is not None:
            rule, remedy = f"the contact of {model.name} stands in front of the rod", "remove spring_back and gap_back"
            raise InputError(rule, f"spring_back of {e.label}", remedy, rig.folder / "rig.toml")
        for mass in e.masses:
            if getattr(rig, mass) is None:
                rule = f"the friction law {model.name} is in N, and {e.label} needs {mass}"
                raise InputError(rule, "not stated", f"add {mass} to [rig]", rig.folder / "rig.toml")


def paper_estimates(experiments: Sequence["Experiment"], registry: Registry | None = None) -> dict[str, float]:
    """Estimates by the paper's protocol (section 2.2), by parameter name, SI; absent where it gives none."""
    estimates: dict[str, float] = {}
    for paper, together in _by_shared(lambda kind: kind.paper, experiments, registry):
        estimates |= paper(together)
    return estimates


def rough_values(rig: Rig, registry: Registry | None = None) -> Estimate:
    """Return a function from parameter name to (rough value, SI; whether it comes from a bench test of ``rig``).

    The sources in order of preference are: the kind's rough value, the paper's estimate, the median of the stated
    prior, that of the default prior. The first call evaluates the bench tests.
    """
    kinds = registry or default_registry()

    @cache
    def known() -> dict[str, float]:
        experiments = make_experiments(rig, "bench", kinds) if select_tables(rig, "bench") else ()
        values = paper_estimates(experiments, kinds)
        for name, kind in kinds.items():
            values |= kind.rough([e for e in experiments if e.kind == name], rig)
        return values

    def estimate(name: str) -> tuple[float, bool]:
        value = known().get(name, 0.0)
        if value > 0.0:
            return value, True
        stated = rig.priors.get(name)
        if stated is not None and stated.kind == "lognormal":
            return stated.location, False
        default = kinds.parameters[symbol_of(name)].prior
        assert default is not None, f"{name} has a default prior"
        return default.location, False

    return estimate


def compare(
    experiments: Sequence["Experiment"],
    values: Values,
    draws: Sequence[Values],
    registry: Registry | None = None,
) -> tuple["Comparison", ...]:
    """Return the panels of all experiments at ``values`` by name, with bands from ``draws``; shared panels first."""
    groups = sorted(
        _by_shared(lambda kind: kind.panels, experiments, registry), key=lambda group: group[0] is own_panels
    )
    return tuple(panel for panels, together in groups for panel in panels(together, values, draws))


def _by_shared(
    function: Callable[[Kind], Shared], experiments: Sequence["Experiment"], registry: Registry | None
) -> Iterable[tuple[Shared, list["Experiment"]]]:
    """Group the experiments by the function that their kinds share."""
    kinds: Mapping[str, Kind] = registry or default_registry()
    groups: dict[Shared, list[Experiment]] = {}
    for e in experiments:
        groups.setdefault(function(kinds[e.kind]), []).append(e)
    return groups.items()
