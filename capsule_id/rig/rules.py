"""The rules that tie settings, columns and experiments together; what the schema alone cannot say."""

from collections.abc import Sequence

import numpy as np

from capsule_id.rig.model import Quantity, Table
from capsule_id.rig.schema import SHORTEST_RECORD
from capsule_id.rig.tables import TableFile
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.windows import decay_window

# Of an experiment's line with force and displacement: which two columns share an sd_ratio
_LINES = {"motor_current": ("force", "current"), "support_spring": ("force", "deflection")}


def check_experiment(document: TomlDocument, path: KeyPath, table: Table, file: TableFile) -> None:
    """Rules within one experiment.

    Raises
    ------
    InputError
        At the setting in ``rig.toml`` or the row of the table that breaks a rule.
    """
    if table.kind == "free_vibration":
        _check_spring_with_gap(document, path, table)
        _check_window(document, path, table, file)
        _check_forward(document, path, table)
    elif table.kind == "static_friction":
        _check_tilt(document, path, table, file)
    elif table.kind in _LINES:
        _check_sd_ratio(document, path, table)
    elif table.kind == "forced_run":
        _check_drive(document, path, table, file)
        _check_length(table, file, len(table["time"]))


def check_masses(document: TomlDocument, tables: Sequence[Table], stated: set[str]) -> None:
    """Masses that an experiment needs must be stated in [rig]."""
    for index, table in enumerate(tables):
        slides = table.kind == "sliding_friction" and "force" in table.columns
        free = table.settings.get("capsule") == "free" or table.settings.get("forward") == "capsule"
        moves = table.kind == "forced_run" or free or slides
        needed = {"m1": moves or table.kind == "free_vibration", "m2": moves}
        for mass, is_needed in needed.items():
            if is_needed and mass not in stated:
                rule = f"{table.kind} needs {mass}"
                remedy = f'add {mass} = {{ value = ..., sd = ..., unit = "kg" }} to [rig]'
                raise document.error(("experiment", index, "kind"), rule, f"no {mass} in [rig]", remedy)


def check_prior_springs(document: TomlDocument, path: KeyPath, spring: str, tables: Sequence[Table]) -> None:
    """A prior of k2[spring] needs an experiment with that spring."""
    springs = sorted({str(table.settings["spring"]) for table in tables if "spring" in table.settings})
    if spring not in springs:
        known = f"known springs: {' '.join(springs)}" if springs else "no experiment names a spring"
        raise document.error(path, "a prior of k2 must name a spring of an experiment", spring, known, of_key=True)


def _check_spring_with_gap(document: TomlDocument, path: KeyPath, table: Table) -> None:
    """A spring within reach has a gap."""
    for one, other in (("spring", "gap"), ("gap", "spring")):
        if one in table.settings and other not in table.settings:
            remedy = f"add {other}, or remove {one} where the support spring is out of reach"
            raise document.error(
                (*path, one), "spring and gap must stand together", f"{one} alone", remedy, of_key=True
            )


def _check_forward(document: TomlDocument, path: KeyPath, table: Table) -> None:
    """The capsule model needs a capsule that is free to move, and has viscous damping only."""
    if table.settings.get("forward") != "capsule":
        return
    place = (*path, "forward")
    if table.settings.get("capsule", "held") == "held":
        remedy = 'add capsule = "free", or write forward = "closed" where the capsule was held'
        raise document.error(place, "forward capsule needs a capsule that is free to move", "held", remedy)
    if table.settings.get("damping", "viscous") != "viscous":
        value = str(table.settings["damping"])
        raise document.error(
            place, "forward capsule has viscous damping only", value, 'remove damping, or write forward = "closed"'
        )


def _check_window(document: TomlDocument, path: KeyPath, table: Table, file: TableFile) -> None:
    """start < stop, both inside the record to one sampling step, and enough samples between them."""
    time = table["time"]
    _check_length(table, file, len(time))
    step = float(
        np.median(np.diff(time))
    )  # a record of n steps is often said to last n steps: one sample more than it has
    edges = {"start": float(time[0]), "stop": float(time[-1])}
    for key in edges:
        value = table.settings.get(key)
        if not isinstance(value, float):
            continue
        if not time[0] - step <= value <= time[-1] + step:
            span = f"a time from {time[0]:g} to {time[-1]:g} s"
            raise document.error((*path, key), f"{key} must lie inside the record", f"{value:g} s", f"write {span}")
        edges[key] = value
    place = (*path, "stop" if "stop" in table.settings else "start")
    if edges["start"] >= edges["stop"]:
        value = f"{edges['start']:g} s and {edges['stop']:g} s"
        raise document.error(place, "start must be before stop", value, "correct one of them")
    inside = len(decay_window(table)[0])
    if inside < SHORTEST_RECORD:
        rule = f"at least {SHORTEST_RECORD} samples must lie between start and stop"
        raise document.error(place, rule, f"{inside} samples", "widen the window")


def _check_length(table: Table, file: TableFile, samples: int) -> None:
    """A record needs enough samples."""
    if samples < SHORTEST_RECORD:
        rule = f"a record must have at least {SHORTEST_RECORD} samples"
        raise file.error(samples - 1, "time", rule, f"{samples} samples", f"record {table.kind} for longer or faster")


def _check_tilt(document: TomlDocument, path: KeyPath, table: Table, file: TableFile) -> None:
    """Height and length make an angle only once it is said which side of the triangle the length is."""
    meaning = table.settings.get("length_is")
    if "angle" in table.columns:
        if meaning is not None:
            remedy = "remove it, or give height and length"
            raise document.error((*path, "length_is"), "length_is needs the columns height and length", "angle", remedy)
        return
    if meaning is None:
        rule = "length_is must say which side of the triangle length is"
        remedy = 'is it the board (sloping)? length_is = "board"; or its base on the floor? length_is = "base"'
        raise document.error(path, rule, "none", remedy)
    too_high = table["height"] >= table["length"]
    if meaning == "board" and too_high.any():
        row = int(np.argmax(too_high))
        value = " of ".join(
            f"{table[name][row] * table.columns[name].to_display:g} {table.columns[name].unit}"
            for name in ("height", "length")
        )
        remedy = 'correct it, or write length_is = "base"'
        raise file.error(row, "height", "height must be less than the length of the board", value, remedy)


def _check_sd_ratio(document: TomlDocument, path: KeyPath, table: Table) -> None:
    """Two stated sds already have a ratio."""
    names = _LINES[table.kind]
    if "sd_ratio" in table.settings and all(table.columns[name].sd is not None for name in names):
        rule = f"state sd_ratio or both of {names[0]}_sd and {names[1]}_sd"
        raise document.error((*path, "sd_ratio"), rule, "all three", "remove sd_ratio", of_key=True)


def _check_drive(document: TomlDocument, path: KeyPath, table: Table, file: TableFile) -> None:
    """One frequency; and an amplitude, from P_d or from the recorded current."""
    stated = [key for key in ("Omega", "f") if key in table.settings]
    if len(stated) != 1:
        rule = "forced_run must have Omega (rad/s) or f (Hz), not both"
        place: KeyPath = (*path, "f") if stated else path
        raise document.error(place, rule, " and ".join(stated) or "none", "state one of them")
    if "P_d" not in table.settings and "current" not in table.columns:
        rule = "forced_run must have P_d where current is not recorded"
        remedy = 'add P_d = { value = ..., sd = ..., unit = "N" }'
        raise document.error(path, rule, f"columns {' '.join(file.columns)}", remedy)
    drive = table.settings.get("P_d")
    if "current" in table.columns and isinstance(drive, Quantity) and drive.sd == 0.0:
        rule = "P_d beside a recorded current is a second reading of the same amplitude and must have an sd"
        raise document.error((*path, "P_d"), rule, "none", "add sd = ... to it, or leave P_d out")
