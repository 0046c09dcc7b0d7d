"""Declaration of one kind of experiment: its complete interface to the rest of the package.

A kind is a folder with a ``declaration.py`` whose ``KIND`` is a ``Kind``. Declarations do not load JAX. Functions that
need JAX import it when they run.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import numpy as np

from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import KindRule
from capsule_id.views import Finding, Message

if TYPE_CHECKING:
    from capsule_id.experiments.base import Experiment
    from capsule_id.experiments.families.friction_model import FrictionModel
    from capsule_id.views import Comparison

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


def own_panels(experiments: Sequence["Experiment"], values: Values, draws: Sequence[Values]) -> Iterable["Comparison"]:
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
    panels: Callable[[Sequence[Any], Values, Sequence[Values]], Iterable["Comparison"]] = own_panels
    twin: Callable[[Values, np.random.Generator, int], Twin] | None = None
    truth: Values = field(default_factory=dict)
