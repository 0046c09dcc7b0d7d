"""``capsule-id init DIR``: an empty rig folder with a commented ``rig.toml`` to fill in."""

import argparse
import re
from pathlib import Path

from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.experiments.registry import Registry, default_registry
from capsule_id.rig.toml_values import NAME_PATTERN

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
#:   files = ["a.csv", "b.csv"] instead of file; data_from_line = 3
#:   decimal = ","; missing = ["--", "NaN"]; where = { tau = 30 }.
#: Every experiment has three optional keys: label = "..." is its unique name (default: the file without suffix);
#: <column>_sd states a reading error; <column>_resolution states a reading step.

[rig]
name = "@NAME@"
#: true for synthetic data: every table and the report then show it
# synthetic = false
#: mass of the rod, needed for free vibrations, forced runs and sliding forces
# m1 = { value = 0.110, sd = 0.0005, unit = "kg" }
#: mass of the capsule, needed for forced runs, sliding forces and free vibrations with capsule = "free"
# m2 = { value = 0.530, sd = 0.001, unit = "kg" }
# g = { value = 9.81, unit = "m/s^2" }

#: Choices of the model. friction: "stribeck" (eq. (1)) or "constant" (the same at every speed, no v_s).
#: free: optional parameters that the fit samples: @OPTIONAL@.
# [model]
# friction = "stribeck"
# free = ["ratio"]

#: Priors: knowledge from before the measurement. Default priors are broad.
#: Log-normal, 95 % within median/factor to median*factor: @LOGNORMAL@.
#: Half-normal, by scale: @HALFNORMAL@.
# [prior]
# k1 = { median = 1500, factor = 3, unit = "N/m" }
# tilt_sd = { scale = 1, unit = "deg" }
"""


def template(kinds: Registry, name: str) -> str:
    """The commented ``rig.toml`` of a rig called ``name``, with an entry for each of ``kinds``."""
    stated = [row for row in kinds.parameters.values() if row.prior_can_be_stated]
    lognormal = ['"k2[<spring>]"' if row.symbol == "k2" else row.symbol for row in stated if not row.scatter]
    head = HEAD.replace("@NAME@", name).replace("@LOGNORMAL@", " ".join(lognormal))
    head = head.replace("@HALFNORMAL@", " ".join(row.symbol for row in stated if row.scatter))
    head = head.replace("@OPTIONAL@", " ".join(row.symbol for row in kinds.parameters.values() if row.optional))
    return "\n".join([head, *(kind.template for kind in kinds.values())])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add DIR."""
    parser.add_argument("dir", metavar="DIR", help="new or empty folder")


def run(args: argparse.Namespace) -> int:
    """Write the folder; 0.

    Raises
    ------
    InputError
        If DIR is not empty, is no folder, or cannot be written.
    """
    folder = Path(args.dir)
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError("DIR must be new or an empty folder", str(folder), "name another one", folder)
        folder.mkdir(parents=True, exist_ok=True)
        name = folder.resolve().name
        usable = re.fullmatch(NAME_PATTERN, name) and name.strip(".")
        text = template(default_registry(), name if usable else "rig")
        (folder / "rig.toml").write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError("DIR must be writable", str(error.strerror), "name another one", folder) from None
    say(
        f"wrote {folder / 'rig.toml'}: add tables, remove the `# ` of their entries, then run capsule-id check {folder}"
    )
    return 0
