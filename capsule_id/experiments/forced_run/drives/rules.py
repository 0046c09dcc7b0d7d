"""Rules on the drive of a forced run: what each kind of drive needs, and what it does not have."""

from typing import TYPE_CHECKING

from capsule_id.errors import InputError
from capsule_id.rig.entry import Entry
from capsule_id.rig.filters import sampling_step

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.declaration import RunSettings

#: Settings of pulses alone.
OF_PULSES = ("duty", "P_on", "lag")


def check_base(entry: "Entry[RunSettings]") -> None:
    """Require x_base with drive = "base" and only there, and nothing that belongs to a force on the rod."""
    settings, columns = entry.table.settings, entry.table.columns
    if settings.drive != "base":
        if "x_base" in columns:
            rule, remedy = "x_base prescribes the motion of the rod", 'add drive = "base", or remove the column'
            raise entry.error("", rule, "a force", remedy)
        return
    if "x_base" not in columns:
        raise entry.error("drive", 'drive = "base" needs a column x_base', f"columns {' '.join(columns)}", "add it")
    present = [name for name in ("acceleration_rod", "current") if name in columns]
    if present:
        rule = "a run with a prescribed rod has x_capsule, x_rel or both, and no other channel"
        raise entry.error("drive", rule, f"columns {' '.join(columns)}", f"remove {' and '.join(present)}")
    if settings.P_d is not None:
        raise entry.error("P_d", 'drive = "base" has no force P_d', "P_d", "remove P_d", of_key=True)
    if settings.start == "settled":
        rule, remedy = 'start = "settled" needs a harmonic force', 'write start = "auto"'
        raise entry.error("start", rule, 'drive = "base"', remedy)
    if settings.Omega is None and settings.f is None:
        try:
            sampling_step(entry.table["time"])
        except InputError as error:
            rule = "the frequency of a base sampled unevenly must be stated"
            raise entry.error("", rule, error.value, 'add f = { value = ..., unit = "Hz" }') from None


def check_drive(entry: "Entry[RunSettings]") -> None:
    """Require one frequency, and an amplitude from P_d or from the recorded current."""
    settings, columns = entry.table.settings, entry.table.columns
    stated = [key for key in ("Omega", "f") if getattr(settings, key) is not None]
    if settings.drive == "base" and not stated:
        return
    if len(stated) != 1:
        rule = "forced_run must have Omega (rad/s) or f (Hz), not both"
        raise entry.error("f" if stated else "", rule, " and ".join(stated) or "none", "state one of them")
    if settings.drive == "base":
        return
    _check_other_drives(entry)
    if settings.drive != "harmonic":
        return
    if settings.P_d is None and "current" not in columns:
        rule = "forced_run must have P_d where current is not recorded"
        remedy = 'add P_d = { value = ..., sd = ..., unit = "N" }'
        raise entry.error("", rule, f"columns {' '.join(columns)}", remedy)
    if "current" in columns and settings.P_d is not None and settings.P_d.sd == 0.0:
        rule = "P_d beside a recorded current is a second reading of the same amplitude and must have an sd"
        raise entry.error("P_d", rule, "none", "add sd = ... to it, or leave P_d out")


def _check_other_drives(entry: "Entry[RunSettings]") -> None:
    """Require a current with drive = "recorded", duty and P_on with pulses, and none of them elsewhere."""
    settings, columns, drive = entry.table.settings, entry.table.columns, entry.table.settings.drive
    if drive != "pulses":
        for key in OF_PULSES:
            if getattr(settings, key) is not None:
                raise entry.error(key, f'only drive = "pulses" has {key}', key, f"remove {key}", of_key=True)
    if drive == "harmonic":
        return
    if settings.P_d is not None:
        raise entry.error("P_d", f'drive = "{drive}" has no amplitude P_d', "P_d", "remove P_d", of_key=True)
    if settings.start == "settled":
        rule, remedy = 'start = "settled" needs a harmonic force', 'write start = "auto"'
        raise entry.error("start", rule, f'drive = "{drive}"', remedy)
    if drive == "recorded":
        if "current" not in columns or len(columns) < 3:
            rule = 'drive = "recorded" needs the column current and another channel'
            raise entry.error("drive", rule, f"columns {' '.join(columns)}", "add it")
        return
    if "current" in columns:
        rule, remedy = "pulses have no column current", 'write drive = "recorded", or remove the column'
        raise entry.error("drive", rule, f"columns {' '.join(columns)}", remedy)
    for key in ("duty", "P_on"):
        if getattr(settings, key) is None:
            raise entry.error(
                "drive", f'drive = "pulses" needs {key}', "none", f"add {key} = {{ value = ..., unit = ... }}"
            )
