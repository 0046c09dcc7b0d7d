"""``capsule-id init DIR``: a rig folder with a commented ``rig.toml`` to fill in, or one that reads the given exports."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from capsule_id.console import say
from capsule_id.errors import InputError, refusing
from capsule_id.experiments.kind import Registry, default_registry
from capsule_id.importing import entry_of, read_file
from capsule_id.output import replace_files
from capsule_id.rig.toml import NAME_PATTERN

# Lines that begin with `#:` are comments; without its `# `, every other `#` line is TOML.
HEAD = """\
#: A rig folder holds this file and the tables that it names.
#: Lines that begin with `#:` explain. To use another line that begins with `#`, remove its `# `.
#: A quantity is { value = ..., sd = ..., unit = "..." }; without sd the value is exact.
#: A table is a CSV file: a header `name [unit]` per column (dimensionless: [1]), then a row of numbers per reading.
#: Comma, semicolon or tab separates the cells; a decimal comma needs semicolon or tab.
#: Files of another layout (also .lvm .tdms .mat .xlsx .npz .h5 .parquet) are read by a column map.
#: Columns of the file that the map leaves out are ignored:
#:   columns = { time = { from = "Time (s)", unit = "s" }, x_rel = { from = 3, unit = "mm", scale = -1, offset = 0.2 } }
#:   from is a header, or a number counted from 1; the result is (from - minus) * scale + offset, in unit.
#:   Without a time column: time = { rate = { value = 1000, unit = "Hz" } }. Further keys, where needed:
#:   files = ["a.csv", "b.csv"] instead of file; data_from_line = 3; data_to_line = 90
#:   decimal = ","; missing = ["--", "NaN"]; where = { tau = 30 }.
#: Every experiment has four optional keys: label = "..." is its unique name (default: the file without suffix);
#: <column>_sd states a reading error; <column>_resolution a reading step; <column>_instrument names an instrument.

[rig]
name = "@NAME@"
#: true for synthetic data: every table and the report then show it
# synthetic = false
#: mass of the rod, needed for free vibrations, forced runs and sliding forces
# m1 = { value = 0.110, sd = 0.0005, unit = "kg" }
#: mass of the capsule, needed for forced runs, sliding forces and free vibrations with capsule = "free"
# m2 = { value = 0.530, sd = 0.001, unit = "kg" }
# g = { value = 9.81, unit = "m/s^2" }
#: what has an unusual size and the right unit, as `capsule-id check` prints it: "m1", "LABEL.COLUMN", "LABEL.SETTING"
# confirmed = ["m1"]
#: slope of the track, +x_capsule uphill, and force that presses the capsule down besides its weight; exact without sd.
#: An experiment may state its own; a tilt takes its own angle
# slope = { value = 0, sd = 0.1, unit = "deg" }
# N0 = { value = 0, unit = "N" }

#: Choices of the model. friction: "stribeck" (eq. (1)) or "constant" (the same at every speed, no v_s).
#: free: optional parameters that the fit samples: @OPTIONAL@.
#: reaction: "ground", or "capsule" where the drive pushes the capsule back, as a coil inside it does.
#: engine: "exact", or "smooth" (eqs. (1) and (2) smoothed; the report states the bias). For runs, and forward = "capsule".
# [model]
# friction = "stribeck"
# free = ["ratio"]
# reaction = "ground"
# engine = "exact"

#: Instruments: errors that all readings of one share, as its certificate states them. No sd holds what is not stated.
#: The columns that it read name it: force_instrument = "cell", time_instrument = "logger" in their experiments.
#:   [[instrument]]
#:   name = "cell"
#:   gain = { expanded = 1, k = 2, unit = "%" }          (or { half_width = 0.5, unit = "%" }, or { sd = 0.5, unit = "%" })
#:   offset = { sd = 0.02, unit = "N" }                  (in the unit of its columns)
#:   [[instrument]]
#:   name = "logger"
#:   clock = { value = 0, sd = 50, unit = "ppm" }

#: Priors: knowledge from before the measurement. Default priors are broad.
#: Log-normal, 95 % within median/factor to median*factor: @LOGNORMAL@.
#: Half-normal, by scale: @HALFNORMAL@.
#: Normal, by mean and sd: @NORMAL@.
# [prior]
# k1 = { median = 1500, factor = 3, unit = "N/m" }
# tilt_sd = { scale = 1, unit = "deg" }
"""


def template(kinds: Registry, name: str, entries: Sequence[str] | None = None) -> str:
    """The commented ``rig.toml`` of a rig called ``name``, with ``entries``, or a commented one for each of ``kinds``."""
    stated = [row for row in kinds.parameters.values() if row.prior_can_be_stated]
    head = HEAD.replace("@NAME@", name)
    for kind in ("lognormal", "halfnormal", "normal"):
        rows = [row for row in stated if row.prior is not None and row.prior.kind == kind]
        words = ['"k2[<spring>]"' if row.symbol == "k2" else row.symbol for row in rows]
        head = head.replace(f"@{kind.upper()}@", " ".join(words))
    head = head.replace("@OPTIONAL@", " ".join(row.symbol for row in kinds.parameters.values() if row.optional))
    return "\n".join([head, *(entries or [kind.template for kind in kinds.values()])])


OPTIONS = {
    "": (
        ("dir", "DIR", "new or empty folder; with --from it may hold the files"),
        (
            "--from",
            "FILE",
            "exports of loggers and programs: copy them into DIR and guess the entries that read them",
            {"dest": "files", "nargs": "+", "type": Path, "default": []},
        ),
    )
}


def run(args: argparse.Namespace) -> int:
    """Write the folder; 0.

    Raises
    ------
    InputError
        If DIR holds other files, is no folder, or cannot be written; if an export cannot be read.
    """
    folder, files = Path(args.dir), list(args.files)
    kinds = default_registry()
    contents = {path.name: read_file(path) for path in files}
    if len(contents) < len(files):
        raise InputError("files must have different names", "two of one name", "rename one of them", folder)
    guesses = {path.name: entry_of(contents[path.name], path, path.name, kinds) for path in files}
    with refusing("DIR must be writable", "name another one", folder):
        own = {path.resolve() for path in files}
        if folder.exists() and (not folder.is_dir() or any(each.resolve() not in own for each in folder.iterdir())):
            raise InputError("DIR must be new or an empty folder", str(folder), "name another one", folder)
        folder.mkdir(parents=True, exist_ok=True)
        name = folder.resolve().name
        usable = re.fullmatch(NAME_PATTERN, name) and name.strip(".")
        text = template(kinds, name if usable else "rig", [entry for entry, _ in guesses.values()])
        contents = {"rig.toml": text.encode(), **contents}
        # A part of a table would be read as a table.
        replace_files({folder / file: text for file, text in contents.items() if (folder / file).resolve() not in own})
    if not files:
        say(
            f"wrote {folder / 'rig.toml'}: add tables, remove the `# ` of their entries, then run capsule-id check {folder}"
        )
        return 0
    lines = [f"wrote {folder / 'rig.toml'}:"]
    lines += [
        f"{file}: {'kind unsure' if guessed is None else guessed.kind}{', unsure' if guessed and guessed.unsure else ''}"
        for file, (_, guessed) in guesses.items()
    ]
    say("\n".join([*lines, f"check its guesses, state the masses, then run capsule-id check {folder}"]))
    return 0
