"""``capsule-id init DIR``: an empty rig folder with a commented ``rig.toml`` to fill in."""

import argparse
import re
from pathlib import Path

from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.rig.schema import NAME_PATTERN

# Lines that begin with `#:` explain; every other `#` line is TOML to be used by removing its `# `.
TEMPLATE = """\
#: A rig folder: this file, and the tables that it names.
#: Lines that begin with `#:` explain. Other lines that begin with `#` are there to be used: remove the `# `.
#: A stated quantity is { value = ..., sd = ..., unit = "..." }; without sd the value counts as exact.
#: A table is a CSV file with a header `name [unit]` per column, dimensionless [1], then a row of numbers per reading;
#: comma, semicolon or tab between the cells; a decimal comma only with semicolon or tab.
#: On every experiment, label = "..." names it (default: its file without suffix, which must then be unique),
#: <column>_sd states a reading error and <column>_resolution a reading step; all optional.

[rig]
name = "@NAME@"
#: true for made-up data: then every table and the report say so
# synthetic = false
#: mass of the rod, needed for free vibrations, forced runs and sliding forces
# m1 = { value = 0.110, sd = 0.0005, unit = "kg" }
#: mass of the capsule, needed for forced runs, sliding forces and free vibrations with capsule = "free"
# m2 = { value = 0.530, sd = 0.001, unit = "kg" }
# g = { value = 9.81, unit = "m/s^2" }

#: What was known before the measurement. Default priors are broad. Log-normal, 95 % within median/factor to
#: median*factor: k1 c mu v_s K F_dry c_q "k2[<spring>]". Half-normal by scale: tilt_sd push_scatter sliding_scatter.
# [prior]
# k1 = { median = 1500, factor = 3, unit = "N/m" }
# tilt_sd = { scale = 1, unit = "deg" }

#: Free vibration of the rod on its spring: k1 and c. Columns: time [s], x_rel [mm] (positive towards the
#: support spring).
# [[experiment]]
# kind = "free_vibration"
# file = "free_vibration_1.csv"
#: the part of the record that is free decay; default: all of it
# start = { value = 0.0, unit = "s" }
# stop = { value = 0.5, unit = "s" }
#: "held" (default) or "free"
# capsule = "held"
#: "viscous" (default), or "dry" or "quadratic" damping beside the viscous one
# damping = "viscous"
#: "closed" form (default), or the "capsule" model, where a capsule that is free slips or the rod hits the spring
# forward = "closed"
#: window of the filter that the paper's estimator looks through; default: chosen by a rule
# smoothing_window = { value = 10, unit = "ms" }
# x_rel_sd = { value = 0.02, unit = "mm" }
#: a support spring within reach: both of spring = "L60" and gap = { value = 1.0, sd = 0.02, unit = "mm" }

#: Tilts of the board until the capsule slips: mu. Column: angle [deg]; or height [mm] and length [mm] with
#: length_is = "board" (the sloping side) or "base" (the side on the floor).
# [[experiment]]
# kind = "static_friction"
# file = "static_friction.csv"
# angle_resolution = { value = 0.1, unit = "deg" }

#: Pushes, a row each, the rod locked to the capsule: mu and v_s. Columns: speed [m/s], distance [mm].
# [[experiment]]
# kind = "dynamic_friction"
# file = "dynamic_friction.csv"
# speed_sd = { value = 5, unit = "mm/s" }
# distance_sd = { value = 0.3, unit = "mm" }
# forward = "closed"                                  # "capsule" where the rod was not locked and rings

#: Steady sliding, a row per point: mu and v_s. Columns: speed [m/s], and force [N] or coefficient [1].
# [[experiment]]
# kind = "sliding_friction"
# file = "sliding_friction.csv"

#: Force of the motor against its current: K. Columns: force [N], current [A].
#: sd_ratio = { value = ..., unit = "N/A" }, of the force's reading error to the current's, where only that is known.
# [[experiment]]
# kind = "motor_current"
# file = "motor_current.csv"
# force_sd = { value = 0.03, unit = "N" }
# current_sd = { value = 0.01, unit = "A" }

#: Force of a support spring against its deflection: its k2. Columns: deflection [mm], force [N]; a file per spring.
#: sd_ratio as above, in N/m.
# [[experiment]]
# kind = "support_spring"
# file = "support_spring_L60.csv"
# spring = "L60"
# length = { value = 60, sd = 0.5, unit = "mm" }

#: Forced run. Columns: time [s], and any of x_rel [mm], x_capsule [mm], acceleration_rod [m/s^2], current [A].
#: Omega in rad/s or f in Hz; P_d is needed where current is not recorded.
# [[experiment]]
# kind = "forced_run"
# file = "run_01.csv"
# spring = "L60"
# gap = { value = 1.0, sd = 0.02, unit = "mm" }
# Omega = { value = 34.56, unit = "rad/s" }
# P_d = { value = 4.0, sd = 0.1, unit = "N" }         # needed where the current is not recorded
# start = "auto"                                      # or "stuck", "moving", "settled": the first sample
# noise = "white"                                     # or "ar1": coloured noise, its correlation is estimated
# x_rel_gain_sd = { value = 0.01, unit = "1" } # optional; also x_capsule_gain_sd acceleration_rod_gain_sd current_gain_sd
#: of less than a sample; also x_capsule_delay_sd acceleration_rod_delay_sd current_delay_sd
# x_rel_delay_sd = { value = 0.1, unit = "ms" }
# segment = { value = 0.3, unit = "s" }               # cut into parts, each with its own start, where the motion is chaotic
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """DIR."""
    parser.add_argument("dir", metavar="DIR", help="folder to make; it may exist if it is empty")


def run(args: argparse.Namespace) -> int:
    """Write the folder; 0.

    Raises
    ------
    InputError
        If DIR holds something already, is no folder, or cannot be written.
    """
    folder = Path(args.dir)
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError("DIR must be new or an empty folder", str(folder), "name another one", folder)
        folder.mkdir(parents=True, exist_ok=True)
        name = folder.resolve().name
        usable = re.fullmatch(NAME_PATTERN, name) and name.strip(".")
        (folder / "rig.toml").write_text(TEMPLATE.replace("@NAME@", name if usable else "rig"), encoding="utf-8")
    except OSError as error:
        raise InputError("DIR must be writable", str(error.strerror), "name another one", folder) from None
    say(f"wrote {folder / 'rig.toml'}: add tables, remove the `# ` of what they need, then capsule-id check {folder}")
    return 0
