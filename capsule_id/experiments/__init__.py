"""Experiments: a file or a folder per kind with one declaration; here the experiments of a rig are made."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Estimate, Kind, Registry, Values, default_registry, own_panels
from capsule_id.parameters import symbol_of
from capsule_id.rig.model import Rig, Table

if TYPE_CHECKING:
    from capsule_id.experiments.base import Experiment
    from capsule_id.physics.forces import Force
    from capsule_id.physics.friction import FrictionLaw
    from capsule_id.views import Comparison

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
    from capsule_id.experiments.friction_model import EQUATION_1, friction_of

    model = friction_of(rig, friction, contact)
    model.check(kinds.parameters)
    made = tuple(e for table in tables for e in kinds[table.kind].make(table, rig, model))
    absent = {row.symbol for row in EQUATION_1.law.parameters} - {row.symbol for row in model.law.parameters}
    absent |= set() if contact is None else {"k2"}
    for e in made:
        if taken := absent.intersection(row.symbol for row in e.parameters):
            rule = f"the kind {e.kind} reads {min(taken)}, which {model.name} replaces"
            raise InputError(rule, e.label, f"remove {e.label}, or fit without this law", rig.folder / "rig.toml")
    springs = sorted({str(t.settings.spring) for t in tables if getattr(t.settings, "spring", None) is not None})
    if contact is not None and len(springs) > 1:
        rule, remedy = (
            f"the contact {contact.__name__} describes one spring",
            "fit the runs of each spring by themselves",
        )
        raise InputError(rule, ", ".join(springs), remedy, rig.folder / "rig.toml")
    measured = {row.symbol for e in made for row in e.parameters}
    for symbol in rig.model.free if experiments == "all" else ():
        if symbol not in measured:
            rule = f"an experiment must measure {symbol}, which [model] sets free"
            wanted = 'with direction = "backward"' if symbol == "mu_back" else "with a sliding capsule"
            remedy = f'remove "{symbol}" from free, or add an experiment {wanted}'
            raise InputError(rule, "none", remedy, rig.folder / "rig.toml")
    for e in made:
        for mass in e.masses:
            if getattr(rig, mass) is None:
                rule = f"the friction law {model.name} is in N, and {e.label} needs {mass}"
                raise InputError(rule, "not stated", f"add {mass} to [rig]", rig.folder / "rig.toml")
    return made


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
