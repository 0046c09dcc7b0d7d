"""Labels the motion of a record, P-<n>-<F|B|S>-<m> as in the paper, with evidence, or "undecided" with the reason.

drive -> period by repeat -> mean velocity -> contacts on the folded record -> label
"""

from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from capsule_id.errors import InputError
from capsule_id.records.contacts import Contacts, Cycle, find_contacts
from capsule_id.records.mean_velocity import MeanVelocity, fit_mean_velocity
from capsule_id.records.repeat import Repeat, find_period
from capsule_id.records.stated_settings import stated_gap, stated_Omega
from capsule_id.records.tone import Harmonic, fit_harmonic, recorded_drive
from capsule_id.rig.filters import sampling_step
from capsule_id.rig.model import Table

UNDECIDED = "undecided"


@dataclass(frozen=True)
class Evidence:
    """Evidence for a label; None where the channels for it were not recorded.

    drive : the tone of the current
    Omega : rad/s, of the current, else of x_rel, else as stated
    repeat, mean_velocity, contacts : results of the single steps
    reasons : why the label is undecided, () for a decided label
    """

    drive: Harmonic | None
    Omega: float
    repeat: Repeat | None
    mean_velocity: MeanVelocity | None
    contacts: Contacts | None
    reasons: tuple[str, ...]


class MeasuredMotion(NamedTuple):
    """Label, mean velocity and evidence.

    label : in the format of ``response``, or "undecided"
    mean_velocity : of the capsule, m/s; NaN if x_capsule was not recorded
    """

    label: str
    mean_velocity: float
    evidence: Evidence


def measured_motion(table: Table) -> MeasuredMotion:
    """Label, mean velocity and evidence of a recorded run.

    Parameters
    ----------
    table : a ``forced_run`` of a rig; period and contacts need x_rel, direction needs x_capsule

    The label describes the record, not a settled motion of the model: "P-1" means that it repeats within the noise.
    """
    time, columns = table["time"], table.columns
    drive = recorded_drive(table)
    Omega = drive.Omega if drive else stated_Omega(table)
    try:
        sampling_step(time)
    except InputError as error:
        reason = f"{error.rule} ({error.value})"
        return MeasuredMotion(UNDECIDED, float("nan"), Evidence(drive, Omega, None, None, None, (reason,)))
    if drive is None and "x_rel" in columns:
        Omega = fit_harmonic(time, table["x_rel"], Omega).Omega
    T = 2.0 * np.pi / Omega
    repeat = find_period(time, table["x_rel"], T, columns["x_rel"].reading_sd) if "x_rel" in columns else None
    period = repeat.period if repeat else None
    velocity = fit_mean_velocity(time, table["x_capsule"], T, period) if "x_capsule" in columns else None
    contacts = find_contacts(_cycle(table, Omega, period * T, repeat.noise_sd)) if repeat and period else None
    mean_velocity = velocity.velocity if velocity else float("nan")
    label, reasons = _label(repeat, velocity, contacts)
    return MeasuredMotion(label, mean_velocity, Evidence(drive, Omega, repeat, velocity, contacts, reasons))


def _cycle(table: Table, Omega: float, period: float, noise_sd: float) -> Cycle:
    gap = stated_gap(table)
    acceleration = table["acceleration_rod"] if "acceleration_rod" in table.columns else None
    return Cycle(table["time"], table["x_rel"], acceleration, Omega, period, gap.value, gap.sd, noise_sd)


def _label(
    repeat: Repeat | None, velocity: MeanVelocity | None, contacts: Contacts | None
) -> tuple[str, tuple[str, ...]]:
    """The label and, where it is "undecided", the reasons."""
    if repeat is None:
        return UNDECIDED, ("x_rel was not recorded",)
    if repeat.period is None:
        return UNDECIDED, (repeat.reason,)
    if repeat.period == 0:
        return "aperiodic", ()
    reasons = [part.reason for part in (velocity, contacts) if part is not None and part.reason]
    if velocity is None:
        reasons.append("x_capsule was not recorded")
    if reasons or velocity is None or contacts is None or contacts.count is None:
        return UNDECIDED, tuple(reasons)
    return f"P-{repeat.period}-{velocity.direction}-{Fraction(contacts.count, repeat.period)}", ()
