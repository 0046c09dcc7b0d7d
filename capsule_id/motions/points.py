"""The points of a sweep, and the columns of their settled motions.

A *point* is one set of leaves with one initial state. A lane of the engine is the same to the last bit in every
batch, so the result does not depend on the blocks or on the worker that computes them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from capsule_id.errors import InputError
from capsule_id.motions.response import Settled, Settling, settle
from capsule_id.parameters import CAPSULE_LEAVES, LEAVES, SWEPT
from capsule_id.physics.batches import lanes_of
from capsule_id.physics.drive import PeriodicDrive
from capsule_id.physics.model import CapsuleParameters, Excitation, Initial, without_absent

MotionColumns = dict[str, np.ndarray]  # name -> (points, ...)

# Columns of a settled motion: unit and meaning.
MOTION_COLUMNS = {
    "x_rel": ("m", "X1 - X2 at the drive's phase at the start of a period"),
    "rate": ("m/s", "Y1 - Y2 at the drive's phase at the start of a period"),
    "Y2": ("m/s", "velocity of the capsule at the drive's phase at the start of a period"),
    "label": (
        "1",
        "P-<period>-<direction>-<contacts per excitation period>, aperiodic, not settled, or failed (see status)",
    ),
    "period": ("1", "period of the motion in excitation periods, 0 if there is none"),
    "direction": ("1", "F forward, B backward, S standing, empty if failed"),
    "contacts_per_period": ("1", "closings of the gap per excitation period"),
    "mean_velocity": ("m/s", "mean velocity of the capsule"),
    "work_per_period": ("J", "work of the drive per excitation period"),
    "efficiency": ("m/J", "advance of the capsule per work of the drive"),
    "lyapunov": ("1/s", "largest Lyapunov exponent of a motion without a period, undefined for all others"),
    "status": ("1", "how the run ended: 0 complete, 1 complete with grazing, 2 and more given up"),
}
SECTION = ("x_rel", "rate", "Y2")  # one value a period, all others one value a point
SUMMARY = tuple(name for name in MOTION_COLUMNS if name not in SECTION)


@dataclass(frozen=True)
class SweepPoints:
    """Lanes of points: every leaf and every component of the initial state is (points,)."""

    p: CapsuleParameters
    e: PeriodicDrive
    initial: Initial

    @property
    def size(self) -> int:
        """Number of points."""
        return len(np.asarray(self.p.m1))

    def part(self, begin: int, end: int) -> "SweepPoints":
        """The points begin .. end - 1."""
        return SweepPoints(*jax.tree.map(lambda leaf: leaf[begin:end], (self.p, self.e, self.initial)))


def sweep_points(
    p: CapsuleParameters, e: PeriodicDrive, over: Mapping[str, np.ndarray], initial: Initial | None = None
) -> SweepPoints:
    """The lanes in which the quantities of ``over`` (symbol -> (points,), SI; ``f`` in Hz) replace those of p and e.

    Raises
    ------
    InputError
        A quantity that the model or the drive does not have, one given twice (f and Omega), shapes that do not agree.
    """
    leaves = {name: np.asarray(values, float) for name, values in over.items()}
    of_model = {"f", *CAPSULE_LEAVES, *(row.symbol for row in e.parameters)}
    own = [symbol for symbol in SWEPT if symbol in of_model]
    for name in leaves:
        if name not in own:
            raise InputError("only a quantity of the model can be swept", name, f"choose from {', '.join(own)}")
    if {"f", "Omega"} <= set(leaves):
        raise InputError("f and Omega are the same quantity", "both are swept", "leave one out")
    if "f" in leaves:
        f, frequency = leaves.pop("f"), swept_leaf("f", e)
        leaves[frequency] = 2.0 * np.pi * f if frequency == "Omega" else 1.0 / f
    p = replace(p, **{name: x for name, x in leaves.items() if LEAVES[name].leaf == "capsule"})
    drive: Any = e
    e = replace(drive, **{name: x for name, x in leaves.items() if LEAVES[name].leaf == "drive"})
    # What is absent is absent in all blocks of a sweep, so a point does not depend on its block.
    p, e = without_absent(p, e)
    lanes, _, _ = lanes_of((p, e, initial if initial is not None else (0.0, 0.0, 0.0, 0.0)), np.zeros(1))
    return SweepPoints(*lanes)


def swept_leaf(name: str, e: PeriodicDrive) -> str:
    """The leaf that a swept quantity sets: ``f`` is Omega or the period of pulses."""
    return name if name != "f" else "Omega" if isinstance(e, Excitation) else "period"


def settled_columns(points: SweepPoints, settling: Settling) -> MotionColumns:
    """All columns of the settled motions, by the names of ``MOTION_COLUMNS``."""
    return motion_columns(settle(points.p, points.e, points.initial, settling), points)


def motion_columns(seen: Settled, points: SweepPoints) -> MotionColumns:
    """The fields of ``seen`` and the efficiency of each motion, 0 for one that stands."""
    found: MotionColumns = {name: np.asarray(getattr(seen, name)) for name in MOTION_COLUMNS if name != "efficiency"}
    advance = found["mean_velocity"] * np.asarray(points.e.period)
    # Without a drive there is neither work nor advance.
    work = np.where(found["work_per_period"] == 0.0, np.inf, found["work_per_period"])
    return found | {"efficiency": np.where(found["direction"] == "S", 0.0, advance / work)}
