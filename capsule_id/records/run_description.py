"""Describes a recorded run in a few lines of text: label with evidence, drive, filter."""

from collections.abc import Iterator

from capsule_id.errors import InputError
from capsule_id.records.label import UNDECIDED, Evidence, MeasuredMotion, measured_motion
from capsule_id.records.view import FILTER_ORDER, view_record
from capsule_id.rig.model import Table


def describe_run(table: Table) -> list[str]:
    """Lines about a ``forced_run``, without its label."""
    motion = measured_motion(table)
    evidence = "; ".join(_evidence(motion))
    lines = [f"motion {label_text(motion)} ({evidence})" if evidence else f"motion {motion.label}"]
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


def label_text(motion: MeasuredMotion) -> str:
    """The label and, where it is decided, its probability."""
    return motion.label if motion.label == UNDECIDED else f"{motion.label}, probability {motion.probability:.2g}"


def _evidence(motion: MeasuredMotion) -> Iterator[str]:
    evidence: Evidence = motion.evidence
    if evidence.repeat:
        repeat = evidence.repeat
        yield f"{repeat.periods:.1f} periods of the drive, noise of x_rel {1e6 * repeat.noise_sd:.3g} um"
        if repeat.period:
            yield f"scatter from cycle to cycle {repeat.scatter / repeat.motion:.2%} of the motion"
    if evidence.mean_velocity:
        yield f"{1e3 * motion.mean_velocity:.4g} ± {1e3 * evidence.mean_velocity.velocity_sd:.2g} mm/s"
    if evidence.contacts:
        contacts = evidence.contacts
        spikes = "/".join(map(str, contacts.spikes)) or "not recorded"
        crossings = "/".join(map(str, contacts.crossings))
        yield (
            f"contacts by spikes {spikes}, by crossings {crossings}, "
            f"same count in {contacts.agreeing} of {contacts.cycles} single periods"
        )
