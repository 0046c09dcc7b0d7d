"""Findings on the readings of a forced run: its frequency, mislabelled columns, and those of any record."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.lint_records import lint_channel, lint_smooth, lint_times
from capsule_id.records.faults.channels import (
    FEWEST_PERIODS,
    SIGN_ERRORS,
    derivative_ratio,
    drive_power,
    phasor,
)
from capsule_id.records.stated_settings import stated_Omega
from capsule_id.records.tone import recorded_drive
from capsule_id.rig.filters import median_step
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Facts, Finding, Message

#: Harmonics of the drive that are compared, and the smallest share of the acceleration's standard deviation there.
HARMONICS, STRONG = (1, 2, 3, 4, 5), 0.15
#: Fewest samples in a period of the drive.
FEWEST_SAMPLES = 4.0
#: Admissible ratio of the recorded acceleration to that of the recorded position X1 = x_rel + x_capsule; without
#: x_capsule its motion is unknown, so the limits are wide.
RATIO_OF_X1, RATIO_OF_X_REL = (0.5, 2.0), (0.1, 10.0)


def lint_run(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report faults of the record, a stated frequency that differs from that of the current, and wrong columns."""
    del rig
    used = slice(0, len(table.rows))
    yield from lint_times(table, used)
    period = 2.0 * np.pi / stated_Omega(table)
    faults = list(_time_scale(table, period))
    for name in table.columns:
        # A capsule may rest at an extreme position, which is no clipping.
        if name not in ("time", "x_capsule"):
            faults += lint_channel(table, name, used, period)
    faults = faults or [*_columns(table)]
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


def _time_scale(table: Table[Any], period: float) -> Iterable[Finding]:
    """Report a stated frequency of which the record holds no period, or which its sampling cannot follow."""
    time = table["time"]
    samples, periods = period / median_step(time), float(time[-1] - time[0]) / period
    if samples < FEWEST_SAMPLES or periods < 1.0:
        facts = {"file": table.file, "periods": periods, "samples": samples}
        yield Finding("runs.time_scale", "fail", facts, table.label)


def _columns(table: Table[Any]) -> Iterable[Finding]:
    """Report columns that contradict kinematics or the sign of the power of the drive."""
    time, Omega = table["time"], stated_Omega(table)
    if "x_rel" not in table.columns or (time[-1] - time[0]) * Omega < FEWEST_PERIODS * 2.0 * np.pi:
        return
    whole = {name: table[name] for name in table.columns if name != "time"}
    position = whole["x_rel"] + whole.get("x_capsule", 0.0)
    first = phasor(time, position, Omega)
    if abs(first.value) < SIGN_ERRORS * first.sd:
        return
    if "acceleration_rod" in whole:
        low, high = RATIO_OF_X1 if "x_capsule" in whole else RATIO_OF_X_REL
        for harmonic in HARMONICS if "x_capsule" in whole else HARMONICS[:1]:
            frequency = harmonic * Omega
            moves, accelerates = phasor(time, position, frequency), phasor(time, whole["acceleration_rod"], frequency)
            expected = frequency**2 * abs(moves.value)
            strong = max(expected, abs(accelerates.value)) > STRONG * float(np.std(whole["acceleration_rod"]))
            ratio = derivative_ratio(moves, accelerates, frequency, 2)
            if strong and abs(moves.value) > SIGN_ERRORS * moves.sd and not low <= ratio.real <= high:
                other = "x_rel + x_capsule" if "x_capsule" in whole else "x_rel"
                facts = {"file": table.file, "position": other, "ratio": ratio.real, "low": low, "high": high}
                yield Finding("runs.kinematics", "fail", {**facts, "harmonic": harmonic}, table.label)
                return
    if "current" in whole:
        power, error = drive_power(phasor(time, whole["current"], Omega), first, Omega)
        if power < -SIGN_ERRORS * error:
            yield Finding("runs.power", "fail", {"file": table.file}, table.label)


def _contradiction(facts: Facts) -> str:
    """The ratio of the two columns, and what to check."""
    check = "Check the names and units of these columns."
    if -facts["high"] <= facts["ratio"] <= -facts["low"]:
        check = "One of them has the wrong sign: x_rel is positive towards the spring, and so is the acceleration."
    return (
        f"{facts['file']}: acceleration_rod must be the second derivative of {facts['position']}; at {facts['harmonic']} times "
        f"the drive's frequency it is {facts['ratio']:.3g} times that ({facts['low']:g} to {facts['high']:g} allowed). {check}"
    )


MESSAGES = {
    "runs.frequency": Message(
        "frequency of the drive",
        warn=(
            "the stated Omega must be that of the current; stated {stated:g} rad/s, the current has {Omega:.6g} ± {sd:.2g} "
            "rad/s. Correct Omega."
        ),
    ),
    "runs.time_scale": Message(
        "time scale of a run",
        fail=(
            "{file}: the record holds {periods:.3g} periods of the stated drive with {samples:.3g} samples each. Check the "
            "unit of time (s or ms) and that of the frequency (rad/s or Hz)."
        ),
    ),
    "runs.kinematics": Message("columns of a run", fail=_contradiction),
    "runs.power": Message(
        "columns of a run",
        fail=(
            "{file}: the drive must supply energy; by current and x_rel it takes energy away. Check the signs of x_rel "
            "(positive towards the spring) and current (positive pushes towards it)."
        ),
    ),
}
