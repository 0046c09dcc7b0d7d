"""One file per rig test: its readings, the paper's estimator, its likelihood, what the report shows of it.

The next experiment is one file with a subclass of ``Experiment``, one entry in ``KINDS`` here and its columns in
``capsule_id.rig.schema``.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment, ValuesBySymbol
from capsule_id.experiments.capsule_bench import CapsuleDecay, CapsulePushes
from capsule_id.experiments.dynamic_friction.experiment import DynamicFriction
from capsule_id.experiments.forced_run.experiment import ForcedRun
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.friction_curve import FrictionExperiment, friction_comparison, paper_friction_fit
from capsule_id.experiments.line import Line
from capsule_id.experiments.motor_current.experiment import MotorCurrent
from capsule_id.experiments.sliding_friction.experiment import SlidingFriction
from capsule_id.experiments.static_friction.experiment import StaticFriction
from capsule_id.experiments.support_spring.experiment import SupportSpring
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison

KINDS: Mapping[str, type[Experiment]] = {
    "free_vibration": FreeVibration,
    "static_friction": StaticFriction,
    "dynamic_friction": DynamicFriction,
    "sliding_friction": SlidingFriction,
    "motor_current": MotorCurrent,
    "support_spring": SupportSpring,
    "forced_run": ForcedRun,
}
#: What ``forward = "capsule"`` makes of them.
CAPSULE_KINDS: Mapping[str, type[Experiment]] = {"free_vibration": CapsuleDecay, "dynamic_friction": CapsulePushes}
#: Experiments on the bench, as against forced runs.
BENCH = tuple(kind for kind in KINDS if kind != "forced_run")


def make_experiments(rig: Rig, which: str = "all") -> tuple[Experiment, ...]:
    """The rig's experiments, in the order of ``rig.toml``.

    Parameters
    ----------
    which : "bench", "runs" or "all"

    Raises
    ------
    InputError
        If nothing is left to fit.
    """
    tables = [t for t in rig.tables if which == "all" or (t.kind in BENCH) == (which == "bench")]
    if not tables:
        rule = "the rig folder must hold an experiment to fit"
        raise InputError(rule, f"none with --experiments {which}", "add one to rig.toml", rig.folder / "rig.toml")
    for kind in ("static_friction", "dynamic_friction", "sliding_friction"):
        _check_scatter([table for table in tables if table.kind == kind])
    return tuple(e for table in tables for e in _experiments_of(table, rig))


def _experiments_of(table: Table, rig: Rig) -> tuple[Experiment, ...]:
    """One experiment; of a record that is to be cut, one a part."""
    kinds = CAPSULE_KINDS if table.settings.forward == "capsule" else KINDS
    return kinds[table.kind].make(table, rig)


def _check_scatter(tables: Sequence[Table]) -> None:
    """Readings all the same, without a reading error, let their scatter run to zero: the posterior has no integral.

    Raises
    ------
    InputError
        If they are.
    """
    if len({tuple(table.columns) for table in tables}) != 1:
        return
    rows = np.concatenate([np.stack([c.values for c in t.columns.values()], axis=1) for t in tables])
    if len(rows) < 2 or np.any(rows != rows[0]):
        return
    if not any(column.reading_sd > 0.0 for table in tables for column in table.columns.values()):
        name = next(iter(tables[0].columns))
        rule = f"{tables[0].kind} readings that are all the same need their reading step"
        raise InputError(rule, f"{len(rows)} rows", f"state {name}_resolution", tables[0].file)


def paper_estimates(experiments: Sequence[Experiment]) -> dict[str, float]:
    """What the paper's own protocol gives (section 2.2), by parameter name, SI; absent where it gives nothing.

    k1 and c: the mean over the records of m1 Omega_o^2 and of the logarithmic decrement after Savitzky–Golay. mu and
    v_s: eq. (1) fitted to the static and dynamic points. K and k2: ordinary straight lines, the mean over tables.
    """
    collected: dict[str, list[float]] = {}
    for experiment in experiments:
        if isinstance(experiment, FreeVibration):
            decrement = experiment.paper_decrement()
            if decrement is not None:
                collected.setdefault("k1", []).append(decrement.k1)
                collected.setdefault("c", []).append(decrement.c)
        elif isinstance(experiment, Line):
            collected.setdefault(experiment.slope.name, []).append(experiment.ordinary_line()[0])
    estimates = {name: float(np.mean(values)) for name, values in collected.items()}
    friction = [e.paper_points() for e in experiments if isinstance(e, FrictionExperiment)]
    if friction:
        speed, coefficient = (np.concatenate(parts) for parts in zip(*friction, strict=True))
        estimates |= paper_friction_fit(speed, coefficient)
    return estimates


def compare(
    experiments: Sequence[Experiment], values: Mapping[str, float], draws: Sequence[Mapping[str, float]]
) -> tuple[Comparison, ...]:
    """One panel per experiment, at ``values`` by name with a band from ``draws``; friction experiments share one."""
    friction = [e for e in experiments if isinstance(e, FrictionExperiment)]
    panels = []
    if friction:
        # Their local values differ in scatters only; together they know both mu and v_s where one of them does.
        everything: list[ValuesBySymbol] = [
            {k: v for e in friction for k, v in e.local(point).items()} for point in (values, *draws)
        ]
        panels.append(friction_comparison(friction, everything[0], everything[1:]))
    for e in experiments:
        if not isinstance(e, FrictionExperiment):
            panels += e.comparisons(e.local(values), [e.local(draw) for draw in draws])
    return tuple(panels)
