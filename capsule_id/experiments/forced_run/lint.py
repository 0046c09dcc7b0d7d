"""Findings on the readings of a forced run: its frequency, mislabelled columns, and those of any record."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.lint_records import lint_channel, lint_smooth, lint_times
from capsule_id.records.faults.channels import (
    FEWEST_PERIODS,
    SIGN_ERRORS,
    Phasor,
    acceleration_ratio,
    drive_power,
    phasor,
)
from capsule_id.records.tone import recorded_drive
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Finding, Message

#: Admissible ratio of the recorded acceleration to that of the recorded position X1 = x_rel + x_capsule; without
#: x_capsule its motion is unknown, so the limits are wide.
RATIO_OF_X1, RATIO_OF_X_REL = (0.5, 2.0), (0.1, 10.0)


def lint_run(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report faults of the record, a stated frequency that differs from that of the current, and wrong columns."""
    del rig
    used = np.ones(len(table.rows), dtype=bool)
    yield from lint_times(table, used)
    period = 2.0 * np.pi / table.settings.angular_frequency
    faults = []
    for name in table.columns:
        # A capsule may rest at an extreme position, which is no clipping.
        if name not in ("time", "x_capsule"):
            faults += lint_channel(table, name, used, period)
    if "current" in table.columns and not faults:
        faults += lint_smooth(table, "current", used, period)
    yield from faults
    try:
        drive = recorded_drive(table)
    except InputError:
        return
    if drive is not None and drive.disagrees:
        facts = {"stated": drive.stated_Omega, "Omega": drive.Omega, "sd": drive.Omega_sd}
        yield Finding("runs.frequency", "warn", facts, table.label)
    elif not faults:
        yield from _columns(table)


def _columns(table: Table[Any]) -> Iterable[Finding]:
    """Report columns that contradict kinematics or the sign of the power of the drive."""
    time, Omega = table["time"], table.settings.angular_frequency
    if "x_rel" not in table.columns or (time[-1] - time[0]) * Omega < FEWEST_PERIODS * 2.0 * np.pi:
        return
    found = {name: phasor(time, table[name], Omega) for name in table.columns if name != "time"}
    x_rel, x_capsule = found["x_rel"], found.get("x_capsule")
    position = x_rel
    if x_capsule is not None:
        position = Phasor(x_rel.value + x_capsule.value, float(np.hypot(x_rel.sd, x_capsule.sd)))
    moves = abs(position.value) > SIGN_ERRORS * position.sd
    if "acceleration_rod" in found and moves:
        ratio = acceleration_ratio(position, found["acceleration_rod"], Omega)
        low, high = RATIO_OF_X_REL if x_capsule is None else RATIO_OF_X1
        if not low <= ratio.real <= high:
            other = "x_rel" if x_capsule is None else "x_rel + x_capsule"
            facts = {"file": table.file, "position": other, "ratio": ratio.real, "low": low, "high": high}
            yield Finding("runs.kinematics", "fail", facts, table.label)
            return
    if "current" in found and moves:
        power, error = drive_power(found["current"], position, Omega)
        if power < -SIGN_ERRORS * error:
            yield Finding("runs.power", "fail", {"file": table.file}, table.label)


MESSAGES = {
    "runs.frequency": Message(
        "frequency of the drive",
        warn=(
            "the stated Omega must be that of the current; stated {stated:g} rad/s, the current has {Omega:.6g} ± {sd:.2g} "
            "rad/s. Correct Omega."
        ),
    ),
    "runs.kinematics": Message(
        "columns of a run",
        fail=(
            "{file}: acceleration_rod must be the second derivative of {position}; at the drive's frequency it is {ratio:.3g} "
            "times that (allowed: {low:g} to {high:g}). Check the names, units and signs of these columns."
        ),
    ),
    "runs.power": Message(
        "columns of a run",
        fail=(
            "{file}: the drive must supply energy; by current and x_rel it takes energy away. Check the signs of x_rel "
            "(positive towards the spring) and current (positive pushes towards it)."
        ),
    ),
}
