"""From the columns of a sweep's points to an ``xarray.Dataset``, and what a sweep accepts as its axes."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import jax
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.motions.attractors import attractors_of
from capsule_id.motions.points import MOTION_COLUMNS, SECTION, SUMMARY, MotionColumns, swept_leaf
from capsule_id.motions.response import Settling
from capsule_id.parameters import SWEPT
from capsule_id.physics.drive import PeriodicDrive
from capsule_id.physics.model import CapsuleParameters

ATTRACTOR = {"units": "1", "long_name": "number of the attractor among those found here, -1 if the run failed"}
ATTRACTORS = {"units": "1", "long_name": "number of different attractors found here"}


def grid_of(over: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """The quantities that are varied, symbol -> values (n,), checked.

    Raises
    ------
    InputError
        A quantity that does not exist, values that are no list of finite numbers.
    """
    for name in over:
        if name not in SWEPT:
            raise InputError("only a quantity of the model can be swept", name, f"choose from {', '.join(SWEPT)}")
    return {name: values_of(name, values) for name, values in over.items()}


def single(p: CapsuleParameters, e: PeriodicDrive) -> tuple[CapsuleParameters, PeriodicDrive]:
    """p and e themselves.

    Raises
    ------
    InputError
        Leaves with a batch axis.
    """
    if any(np.ndim(leaf) for leaf in jax.tree.leaves((p, e))):
        raise InputError("a sweep starts from one set of parameters", "a batch", "give each leaf as one number")
    return p, e


def values_of(name: str, values: ArrayLike) -> np.ndarray:
    """``values`` as an array (n,).

    Raises
    ------
    InputError
        If they are no list of finite numbers.
    """
    x = np.asarray(values, float)
    if x.ndim != 1 or not x.size or not np.isfinite(x).all():
        raise InputError(f"{name} takes a list of finite numbers", f"shape {x.shape}", "give at least one value")
    return x


def provenance(
    p: CapsuleParameters, e: PeriodicDrive, over: Sequence[str], settling: Settling, method: str
) -> dict[str, Any]:
    """Attributes: every parameter that is not swept, and how the motions were settled."""
    swept = {swept_leaf(name, e) for name in over}
    given = {**vars(p), **vars(e)}
    held = {name: float(np.asarray(x)) for name, x in given.items() if name not in swept and x is not None}
    return {**held, **asdict(settling), "method": method, "model": "exact", "semantics": "stick-slip"}


def dataset_of(
    seen: MotionColumns,
    grid: Mapping[str, np.ndarray],
    dims: tuple[str, ...],
    shape: tuple[int, ...],
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Columns (points, ...) as variables over ``dims`` (and the section where a column has one value a period)."""
    variables = {}
    for name, column in seen.items():
        unit, meaning = MOTION_COLUMNS[name]
        extra = ("section",) if name in SECTION and "branch" in dims else ()
        if name in SUMMARY or extra:
            values = column.reshape(*shape, *column.shape[1:])
            variables[name] = ((*dims, *extra), values, {"units": unit, "long_name": meaning})
    coordinates = {
        name: (name, x, {"units": SWEPT[name].unit, "long_name": SWEPT[name].meaning}) for name, x in grid.items()
    }
    return xr.Dataset(variables, coordinates, dict(attributes))


def branched(
    seen: MotionColumns, names: Sequence[str], grid: Mapping[str, np.ndarray], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """Columns (branches x values, ...) as a Dataset over (branch, value), with the attractors at each value."""
    ((over, x),) = grid.items()
    shape = (len(names), len(x))
    numbers = np.empty(shape, np.int32)
    for i in range(len(x)):
        numbers[:, i] = attractors_of({name: column[i :: len(x)] for name, column in seen.items()})
    data = dataset_of(seen, grid, ("branch", over), shape, attributes).assign_coords(branch=("branch", list(names)))
    return data.assign(
        attractor=(("branch", over), numbers, ATTRACTOR), attractors=(over, numbers.max(axis=0) + 1, ATTRACTORS)
    )
