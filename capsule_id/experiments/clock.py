"""The clock of a record: where rig.toml states the sd of its drift, the drift is a parameter of the fit.

An error of the drift stretches the record. k1 follows it twice, c once; a record of many excitation periods runs out of
step with its drive. An error of the offset changes nothing, because each record has its own initial state and phase.
"""

from typing import Any

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.rig.model import Rig, Table


def clock_parameters(table: Table[Any], rig: Rig) -> tuple[Parameter, ...]:
    """The drift of the table's clock where its sd is stated; tables with equal statements share one clock."""
    stated = table.drift
    if stated.sd == 0.0:
        return ()
    same = (other.label for other in rig.tables if other.drift == stated)
    return (parameter("clock_drift", next(same, table.label), Prior("normal", stated.value, stated.sd)),)


def stated_rate(table: Table[Any]) -> float | None:
    """1 + the stated drift, with which the times of ``table`` were read; None where the drift is exact."""
    return 1.0 + table.drift.value if table.drift.sd else None


def stretch(rate: float | None, theta: ValuesBySymbol) -> Any:
    """True time per time as read; ``rate`` from ``stated_rate``. Rough fits of one record have no drift in ``theta``."""
    return 1.0 if rate is None else (1.0 + theta.get("clock_drift", rate - 1.0)) / rate
