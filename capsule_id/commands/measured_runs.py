"""The measured forced runs of a rig beside a diagram of the model: which have its settings, and where they stand on it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capsule_id.experiments.forced_run.declaration import RunSettings
from capsule_id.experiments.rough_values import rough_values
from capsule_id.parameters import SWEPT
from capsule_id.records.label import measured_motion
from capsule_id.records.stated_settings import stated_gap, stated_Omega
from capsule_id.records.tone import recorded_drive
from capsule_id.report.figures.sweeps import MeasuredPoint
from capsule_id.rig.model import Quantity, Rig, Table

#: A setting is the diagram's where it differs by no more than this share of it, or by this many of its own sds.
SHARES: Mapping[str, float] = {"k2": 0.05, "G": 0.05, "P_d": 0.05, "Omega": 0.005}
ERRORS = 3.0


class Span(NamedTuple):
    """The range of a diagram: the quantity's symbol, its least and its largest value, SI (f in Hz)."""

    name: str
    low: float
    high: float


@dataclass(frozen=True)
class Overlay:
    """Runs with the settings of a diagram, and why the others have not: a phrase per run."""

    motions: tuple[MeasuredPoint, ...]
    left_out: tuple[str, ...]

    def sentence(self) -> str:
        """Both in one line."""
        count = f"{len(self.motions)} of {len(self.motions) + len(self.left_out)} measured runs overlaid"
        return f"{count}; left out: {'; '.join(self.left_out)}" if self.left_out else count


def overlay(
    rig: Rig, span: Span, values: Mapping[str, float], fitted: Mapping[str, float], spring: str | None = None
) -> Overlay:
    """The forced runs of ``rig`` on a diagram over ``span``.

    Parameters
    ----------
    values : of the diagram by symbol, SI; that of the swept quantity is not looked at
    fitted : fitted values by name (K, k2[<spring>]); what is missing is the paper's estimate, else the prior's median
    spring : its name, where the diagram's k2 was taken by name; None compares stiffnesses

    A run agrees where k2, G, P_d and Omega, other than the swept one, lie within ``SHARES`` or ``ERRORS`` sds.
    P_d is the stated one, else K times the amplitude of the current.
    """
    estimate = rough_values(rig)

    def known(name: str) -> Quantity:
        """As fitted, as the paper estimates it, or as the folder's prior has it: then ERRORS sds are its 95 % range."""
        value, measured = (fitted[name], True) if name in fitted else estimate(name)
        prior = rig.priors.get(name)
        if measured or prior is None or prior.factor is None:
            # a default prior, of a factor 1000, knows nothing worth comparing
            return Quantity(value if measured else np.nan)
        return Quantity(value, value * float(np.log(prior.factor)) / ERRORS)

    motions, left_out = [], []
    for table in rig.tables:
        if isinstance(table.settings, RunSettings):
            found = _motion(table, _settings(table, known), span, values, spring)
            if isinstance(found, MeasuredPoint):
                motions.append(found)
            else:
                left_out.append(f"{table.label} ({found})")
    return Overlay(tuple(motions), tuple(left_out))


def _motion(
    table: Table[RunSettings],
    settings: Mapping[str, Quantity],
    span: Span,
    values: Mapping[str, float],
    spring: str | None,
) -> MeasuredPoint | str:
    """Where the run stands on the diagram, or why it does not."""
    swept = "Omega" if span.name == "f" else span.name
    if swept not in settings:
        return f"{swept} is no setting of a run"
    by_name = spring is not None and swept != "k2"
    if by_name and table.settings.spring != spring:
        return f"spring {table.settings.spring}, not {spring}"
    for name, quantity in settings.items():
        if name == "k2" and by_name:
            continue
        if np.isnan(quantity.value):
            return f"{name} is neither fitted nor stated"
        allowed = max(SHARES[name] * abs(values[name]), ERRORS * quantity.sd)
        if name != swept and abs(quantity.value - values[name]) > allowed:
            return f"{name} = {quantity.value:.4g}, not {values[name]:.4g} {SWEPT[name].unit}"
    value = settings[swept].value / (2.0 * np.pi if span.name == "f" else 1.0)
    if not span.low <= value <= span.high:
        return f"{span.name} = {value:.4g} {SWEPT[span.name].unit} is outside of the diagram"
    motion = measured_motion(table)
    if not np.isfinite(motion.mean_velocity):
        return "x_capsule was not recorded"
    return MeasuredPoint(value, motion.label, motion.mean_velocity)


def _settings(table: Table[RunSettings], known: Callable[[str], Quantity]) -> dict[str, Quantity]:
    """k2, G, P_d and Omega of a run, SI; NaN where nothing is known."""
    k2 = known(f"k2[{table.settings.spring}]")
    return {"k2": k2, "G": stated_gap(table), "P_d": _load(table, known), "Omega": Quantity(stated_Omega(table))}


def _load(table: Table[RunSettings], known: Callable[[str], Quantity]) -> Quantity:
    """P_d of a run, N."""
    drive = recorded_drive(table)
    if table.settings.P_d is not None:
        return table.settings.P_d
    assert drive is not None, "the reader requires P_d or the current"
    K = known("K")
    return Quantity(K.value * drive.amplitude, K.sd * drive.amplitude)
