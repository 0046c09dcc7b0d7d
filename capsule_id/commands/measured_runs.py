"""Selects the measured forced runs of a rig for a diagram of the model: those with the settings of the diagram."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from capsule_id.experiments.forced_run.declaration import RunSettings
from capsule_id.experiments.kind import rough_values
from capsule_id.parameters import SWEPT
from capsule_id.records.motion import measured_motion
from capsule_id.records.tones import VISIBLE, recorded_drive, stated_gap, stated_Omega
from capsule_id.report.figures.sweeps import MeasuredPoint
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.views import counted

#: A setting agrees with the diagram within this relative difference, or within ``VISIBLE`` of its own sds.
RELATIVE_TOLERANCE: Mapping[str, float] = dict.fromkeys(("k2", "G", "P_d"), 0.05) | {"Omega": 0.005}


def overlay(
    rig: Rig,
    over: str,
    x: Sequence[float] | np.ndarray,
    values: Mapping[str, float],
    fitted: Mapping[str, float],
    spring: str | None = None,
) -> tuple[list[MeasuredPoint], str]:
    """Runs of ``rig`` with the settings of a diagram, as its points; and a text: how many, and why others are left out.

    Parameters
    ----------
    over, x : the swept quantity by symbol, and its values from the smallest to the largest one, SI (f in Hz)
    values : of the diagram by symbol, SI; that of the swept quantity is ignored
    fitted : fitted values by name (K, k2[<spring>]); defaults are the paper's estimate, then the median of the prior
    spring : its name, if the k2 of the diagram was chosen by name; None compares stiffnesses

    A run agrees if k2, G, P_d and Omega lie within ``RELATIVE_TOLERANCE`` or ``VISIBLE`` sds; the swept one is free.
    P_d is the stated one, else K times the amplitude of the current.
    """
    estimate = rough_values(rig)

    def known(name: str) -> Quantity:
        """The fitted value, the paper's estimate, or the stated prior: VISIBLE sds are its 95 % range."""
        value, measured = (fitted[name], True) if name in fitted else estimate(name)
        prior = rig.priors.get(name)
        if measured or prior is None or prior.kind != "lognormal":
            # A default prior (factor 1000) is too broad for a comparison.
            return Quantity(value if measured else np.nan)
        return Quantity(value, value * float(np.log(prior.spread)) / VISIBLE)

    motions, left_out = [], []
    for table in rig.tables:
        if not isinstance(table.settings, RunSettings):
            continue
        if table.settings.drive == "base" or table.settings.spring is None:
            found = "no harmonic force, or no support spring"
        else:
            found = _point_or_reason(table, _settings(table, known), over, x, values, spring)
        if isinstance(found, str):
            left_out.append(f"{table.label} ({found})")
        else:
            motions.append(found)
    said = f"{len(motions)} of {counted(len(motions) + len(left_out), 'measured run')} overlaid"
    return motions, f"{said}; omitted: {'; '.join(left_out)}" if left_out else said


def _point_or_reason(
    table: Table[RunSettings],
    settings: Mapping[str, Quantity],
    over: str,
    x: Sequence[float] | np.ndarray,
    values: Mapping[str, float],
    spring: str | None,
) -> MeasuredPoint | str:
    """The run as a point of the diagram, or the reason for its omission."""
    swept = "Omega" if over == "f" else over
    if swept not in settings:
        return f"{swept} is not a setting of a run"
    by_name = spring is not None and swept != "k2"
    if by_name and table.settings.spring != spring:
        return f"spring {table.settings.spring}, not {spring}"
    for name, quantity in settings.items():
        if name == "k2" and by_name:
            continue
        if np.isnan(quantity.value):
            return f"{name} is neither fitted nor stated"
        allowed = max(RELATIVE_TOLERANCE[name] * abs(values[name]), VISIBLE * quantity.sd)
        if name != swept and abs(quantity.value - values[name]) > allowed:
            return f"{name} = {quantity.value:.4g}, not {values[name]:.4g} {SWEPT[name].unit}"
    value = settings[swept].value / (2.0 * np.pi if over == "f" else 1.0)
    if not x[0] <= value <= x[-1]:
        return f"{over} = {value:.4g} {SWEPT[over].unit} is outside the diagram"
    motion = measured_motion(table)
    if not np.isfinite(motion.mean_velocity):
        return "x_capsule was not recorded"
    return MeasuredPoint(value, motion.label, motion.mean_velocity)


def _settings(table: Table[RunSettings], known: Callable[[str], Quantity]) -> dict[str, Quantity]:
    """k2, G, P_d and Omega of a run, SI; NaN for an unknown value."""
    P_d = table.settings.P_d
    if P_d is None:
        drive = recorded_drive(table)
        assert drive is not None, "the reader requires P_d or the current"
        K = known("K")
        P_d = Quantity(K.value * drive.amplitude, K.sd * drive.amplitude)
    k2 = known(f"k2[{table.settings.spring}]")
    return {"k2": k2, "G": stated_gap(table), "P_d": P_d, "Omega": Quantity(stated_Omega(table))}
