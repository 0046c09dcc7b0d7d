"""Labels the motion of a record, P-<n>-<F|B|S>-<m> as in the paper, with its probability and the evidence.

drive -> period by repeat -> mean velocity -> contacts on the folded record -> label
"""

from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from capsule_id.errors import InputError
from capsule_id.records.contacts import Contacts, Cycle, find_contacts
from capsule_id.records.mean_velocity import MeanVelocity, fit_mean_velocity
from capsule_id.records.repeat import DECIDED, Repeat, find_period, period_word
from capsule_id.records.stated_settings import relative_position, stated_gap, stated_Omega
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
    reasons : what is missing for the whole label, () for a whole one
    """

    drive: Harmonic | None
    Omega: float
    repeat: Repeat | None
    mean_velocity: MeanVelocity | None
    contacts: Contacts | None
    reasons: tuple[str, ...]


class MeasuredMotion(NamedTuple):
    """Label, mean velocity and evidence.

    label : in the format of ``response``, its period alone ("P-1"), or "undecided" where no probability reaches 0.9
    mean_velocity : of the capsule, m/s; NaN if x_capsule was not recorded
    probability : of the label; of the most probable period where it is undecided; NaN without any
    """

    label: str
    mean_velocity: float
    evidence: Evidence
    probability: float


def measured_motion(table: Table) -> MeasuredMotion:
    """Label, mean velocity and evidence of a recorded run.

    Parameters
    ----------
    table : a ``forced_run`` of a rig; period and contacts need x_rel (or x_base and x_capsule), direction needs x_capsule

    The label describes the record, not a settled motion of the model: "P-1" means that it repeats within the scatter
    from cycle to cycle. The probability of a whole label is the product of those of period, direction and contacts.
    """
    time, columns = table["time"], table.columns
    drive = recorded_drive(table)
    Omega = drive.Omega if drive else stated_Omega(table)
    try:
        sampling_step(time)
    except InputError as error:
        reason = f"{error.rule} ({error.value})"
        return MeasuredMotion(
            UNDECIDED, float("nan"), Evidence(drive, Omega, None, None, None, (reason,)), float("nan")
        )
    relative = relative_position(table)
    if drive is None and relative:
        Omega = fit_harmonic(time, relative[0], Omega).Omega
    T = 2.0 * np.pi / Omega
    repeat = find_period(time, relative[0], T, relative[1]) if relative else None
    period = repeat.period if repeat else None
    velocity = fit_mean_velocity(time, table["x_capsule"], T, period) if "x_capsule" in columns else None
    scatter = float(np.hypot(repeat.noise_sd, repeat.scatter)) if repeat else 0.0
    contacts = None
    if period and relative and table.settings.spring is not None:
        contacts = find_contacts(_cycle(table, relative[0], Omega, period * T, scatter))
    mean_velocity = velocity.velocity if velocity else float("nan")
    label, probability, reasons = _label(repeat, velocity, contacts)
    evidence = Evidence(drive, Omega, repeat, velocity, contacts, reasons)
    return MeasuredMotion(label, mean_velocity, evidence, probability)


def _cycle(table: Table, x_rel: np.ndarray, Omega: float, period: float, noise_sd: float) -> Cycle:
    gap = stated_gap(table)
    acceleration = table["acceleration_rod"] if "acceleration_rod" in table.columns else None
    return Cycle(table["time"], x_rel, acceleration, Omega, period, gap.value, gap.sd, noise_sd)


def _label(
    repeat: Repeat | None, velocity: MeanVelocity | None, contacts: Contacts | None
) -> tuple[str, float, tuple[str, ...]]:
    """The label, its probability, and what is missing for the whole label."""
    if repeat is None:
        return UNDECIDED, float("nan"), ("x_rel was not recorded",)
    if repeat.period is None:
        return UNDECIDED, repeat.probability, (repeat.reason,)
    period = period_word(repeat.period)
    if repeat.period == 0:
        return period, repeat.probability, ()
    reasons = [part.reason for part in (velocity, contacts) if part is not None and part.reason]
    if velocity is None:
        reasons.append("x_capsule was not recorded")
    if contacts is None:
        reasons.append("spring and gap are not stated")
    if reasons or velocity is None or contacts is None or contacts.count is None:
        return period, repeat.probability, tuple(reasons)
    whole = f"{period}-{velocity.direction}-{Fraction(contacts.count, repeat.period)}"
    probability = repeat.probability * velocity.probability * contacts.probability
    if probability < DECIDED:
        return period, repeat.probability, (f"{whole} has the probability {probability:.2f}",)
    return whole, probability, ()
