"""Prepares a record for figures (the paper's Figs. 4, 9, 12), and describes it in a few lines of text."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from capsule_id.errors import InputError
from capsule_id.records.motion import UNDECIDED, Evidence, MeasuredMotion, measured_motion
from capsule_id.records.tones import stated_gap
from capsule_id.rig.filters import filter_gain, longest_window, sampling_step, savitzky_golay
from capsule_id.rig.model import Table

# view: Prepares a record for figures: filtered, differentiated, sampled at the drive's phase (the paper's Figs. 4, 9,
# 12).
#
# For figures and starting points only. Likelihoods use the raw channels.


FILTER_ORDER = 3  # of the filter's polynomial
#: The window is the longest whose gain for a rate is at least this at the contact frequency,
SMALLEST_RATE_GAIN = 0.9
#: or, in a record without contacts, at this multiple of the excitation frequency.
PASS_BAND_MULTIPLE = 5.0


@dataclass(frozen=True)
class Gains:
    """Gains of the filter at frequency f, Hz, for x_rel and for its rate, 1."""

    f: float
    smoothing: float
    rate: float


@dataclass(frozen=True)
class MotionView:
    """A simulated motion, SI, as a ``RecordView`` shows a measured one.

    time : (n,)
    channels : raw, (n,) by column name
    x_rel, rate : (n,) and its derivative; those of a record are filtered
    section_x_rel, section_rate : (m,) where the drive's phase is a multiple of 2 pi, without half windows at the ends
    gap : as stated; infinite without a support spring
    gap_seen : x_rel where contacts begin, None if the record does not determine it
    samples : window of the filter
    label : of a record's motion, see ``measured_motion``; "" of a simulation
    """

    time: np.ndarray
    channels: Mapping[str, np.ndarray]
    x_rel: np.ndarray
    rate: np.ndarray
    section_x_rel: np.ndarray
    section_rate: np.ndarray
    gap: float
    gap_seen: float | None = None
    samples: int = 1
    label: str = ""


@dataclass(frozen=True, kw_only=True)
class RecordView(MotionView):
    """A prepared record, SI.

    probability : of its label
    force : (n,) K times the current without its offset, N, None without current or K
    at_drive, at_contact : the filter's gains; ``at_contact`` is None without contacts
    """

    probability: float
    force: np.ndarray | None
    at_drive: Gains
    at_contact: Gains | None


@dataclass(frozen=True)
class RunRecord:
    """A recorded run as in the figures of the paper; ``force`` (n,) is the fitted drive at its samples, N."""

    name: str
    view: RecordView
    force: np.ndarray


def view_record(table: Table, motion: MeasuredMotion | None = None, K: float | None = None) -> RecordView:
    """Filter, differentiate and cut a recorded run.

    Parameters
    ----------
    table : a ``forced_run`` with x_rel, evenly sampled
    motion : what ``measured_motion`` found, if it is already known
    K : force per current, N/A

    Raises
    ------
    InputError
        Without x_rel, with uneven sampling, or in a record shorter than the filter.
    """
    if "x_rel" not in table.columns:
        rule = "a phase plane needs x_rel"
        raise InputError(rule, f"columns {' '.join(table.columns)}", "record x_rel", table.file)
    motion = motion or measured_motion(table)
    time, evidence = table["time"], motion.evidence
    step = sampling_step(time)
    f = evidence.Omega / (2.0 * np.pi)
    contacts = evidence.contacts
    f_contact = 0.5 / contacts.duration if contacts and contacts.duration else None
    highest = f_contact or PASS_BAND_MULTIPLE * f
    samples = longest_window(highest * step, len(time), FILTER_ORDER, SMALLEST_RATE_GAIN, derivative=1)
    x_rel, rate = (savitzky_golay(time, table["x_rel"], samples * step, FILTER_ORDER, d) for d in (0, 1))
    phase = evidence.drive.phase if evidence.drive else 0.0
    half = samples // 2
    # Times between the half windows at which Omega t + phase is a multiple of 2 pi.
    first, last = (evidence.Omega * time[[half, len(time) - half - 1]] + phase) / (2.0 * np.pi)
    section = (2.0 * np.pi * np.arange(np.ceil(first), np.floor(last) + 1.0) - phase) / evidence.Omega
    return RecordView(
        label=motion.label,
        probability=motion.probability,
        time=time,
        channels={name: column.values for name, column in table.columns.items() if name != "time"},
        x_rel=x_rel,
        rate=rate,
        section_x_rel=CubicSpline(time, x_rel)(section),
        section_rate=CubicSpline(time, rate)(section),
        gap=stated_gap(table).value,
        gap_seen=contacts.impact_line.value if contacts and contacts.impact_line else None,
        force=K * (table["current"] - evidence.drive.offset) if K is not None and evidence.drive else None,
        samples=samples,
        at_drive=_gains(f, step, samples),
        at_contact=_gains(f_contact, step, samples) if f_contact else None,
    )


def _gains(f: float, step: float, samples: int) -> Gains:
    return Gains(f, *(float(filter_gain(f * step, samples, FILTER_ORDER, d)) for d in (0, 1)))


# run description: Describes a recorded run in a few lines of text: label with evidence, drive, filter.


def describe_run(table: Table) -> list[str]:
    """Lines about a ``forced_run``, without its label."""
    motion = measured_motion(table)
    evidence = "; ".join(_evidence(motion))
    probability = "" if motion.label == UNDECIDED or not evidence else f", probability {motion.probability:.2g}"
    lines = [f"motion {motion.label}{probability}{f' ({evidence})' * bool(evidence)}"]
    if motion.evidence.reasons:
        part = "undecided" if motion.label == UNDECIDED else "the rest of the label is undecided"
        lines.append(f"{part}: {'; '.join(motion.evidence.reasons)}")
    if drive := motion.evidence.drive:
        lines.append(
            f"drive Omega {drive.Omega:.6g} ± {drive.Omega_sd:.2g} rad/s (stated {drive.stated_Omega:g}), current "
            f"{drive.amplitude:.5g} ± {drive.amplitude_sd:.2g} A, phase {drive.phase:.4f} ± {drive.phase_sd:.2g} rad"
        )
    try:
        view = view_record(table, motion)
    except InputError:
        return lines
    gains = [("drive", view.at_drive), *([("contacts", view.at_contact)] if view.at_contact else [])]
    passed = ", ".join(f"{g.smoothing:.3f} (rate {g.rate:.3f}) at {g.f:.3g} Hz, {name}" for name, g in gains)
    return [*lines, f"Savitzky-Golay over {view.samples} samples, order {FILTER_ORDER}: gain {passed}"]


def _evidence(motion: MeasuredMotion) -> Iterator[str]:
    evidence: Evidence = motion.evidence
    if repeat := evidence.repeat:
        yield f"{repeat.periods:.1f} periods of the drive, noise of x_rel {1e6 * repeat.noise_sd:.3g} um"
        if repeat.period:
            yield f"scatter from cycle to cycle {repeat.scatter / repeat.motion:.2%} of the motion"
    if evidence.mean_velocity:
        yield f"{1e3 * motion.mean_velocity:.4g} ± {1e3 * evidence.mean_velocity.velocity_sd:.2g} mm/s"
    if contacts := evidence.contacts:
        spikes, crossings = ("/".join(map(str, one)) or "not recorded" for one in (contacts.spikes, contacts.crossings))
        yield (
            f"contacts by spikes {spikes}, by crossings {crossings}, "
            f"same count in {contacts.agreeing} of {contacts.cycles} single periods"
        )
