"""Bifurcation diagrams, two-parameter maps, basins of attraction: settled motions over any quantity of the model.

    diagram(p, e, "k2", values)                      each value from rest
    diagram(..., starts=spread_starts(p, e, 16))     each value from many initial states: co-existing attractors
    continuation(p, e, "k2", values)                 forward and backward, each value from where the last one ended
    motion_map(p, e, {"k2": ..., "P_d": ...})        label, mean velocity, efficiency over two quantities
    basins(p, e, x_rel, rate)                        which initial state leads where, at one set of parameters

All of them return an ``xarray.Dataset`` in SI units whose variables say what they are (``units``, ``long_name``). A
run that was given up is labelled "failed", and ``status`` says why.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.stats import qmc

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.interruption import stop_if_interrupted
from capsule_id.motions.attractors import attractors_of
from capsule_id.motions.blocks import BLOCK, compute
from capsule_id.motions.datasets import (
    ATTRACTOR,
    ATTRACTORS,
    branched,
    dataset_of,
    grid_of,
    provenance,
    single,
    values_of,
)
from capsule_id.motions.points import (
    MOTION_COLUMNS,
    SECTION,
    SUMMARY,
    MotionColumns,
    SweepPoints,
    motion_columns,
    sweep_points,
)
from capsule_id.motions.response import SETTLING, Settling, exponents, settle, settled_label
from capsule_id.physics.batches import CHUNK
from capsule_id.physics.drive import PeriodicDrive
from capsule_id.physics.model import CapsuleParameters, Initial

if TYPE_CHECKING:
    from pathlib import Path

    from distributed import Client


def diagram(
    p: CapsuleParameters,
    e: PeriodicDrive,
    over: str,
    values: ArrayLike,
    *,
    starts: Initial | None = None,
    settling: Settling = SETTLING,
    progress: OnProgress | None = None,
) -> xr.Dataset:
    """Settled motions at all values at once, from rest or from each of several initial states.

    Parameters
    ----------
    p, e : the other parameters; leaves ()
    over, values : the quantity that is varied (a leaf of p or e, or f) and its values (n,), SI (f in Hz)
    starts : (X1, Y1, X2, Y2), each (branches,): the initial states; default the one at rest

    Seven arguments: four state the sweep, the others are options by name.

    Returns a Dataset over (branch, <over>[, section]) with the variables of ``points.MOTION_COLUMNS`` and, at each value, which
    branches have ended on the same attractor (``attractor``) and how many there are (``attractors``).

    Raises
    ------
    InputError
        A quantity that does not exist, values or starts that are no list of finite numbers, leaves with a batch axis.
    """
    grid = grid_of({over: values})
    begin = _starts(starts)
    branches, n = len(begin[0]), len(grid[over])
    lanes = {over: np.tile(grid[over], branches)}
    X1, Y1, X2, Y2 = (np.repeat(x, n) for x in begin)
    points = sweep_points(*single(p, e), lanes, (X1, Y1, X2, Y2))
    seen = compute(points, settling, progress=progress)
    names = ["rest"] if starts is None else [f"start {i}" for i in range(branches)]
    return branched(seen, names, grid, provenance(p, e, [over], settling, "rest" if starts is None else "starts"))


def continuation(
    p: CapsuleParameters,
    e: PeriodicDrive,
    over: str,
    values: ArrayLike,
    *,
    directions: Sequence[Literal["forward", "backward"]] = ("forward", "backward"),
    starts: Initial | None = None,
    settling: Settling = SETTLING,
    progress: OnProgress | None = None,
) -> xr.Dataset:
    """Settled motions value by value, each from where the motion at the last value has ended.

    A branch per direction (forward: in the order of ``values``) and initial state of its first value; all branches
    run side by side. A branch that fails at a value goes on from rest. The other arguments and the Dataset are as for
    ``diagram``. Eight arguments: four state the sweep, the others are options by name.

    Raises
    ------
    InputError
        As ``diagram``; no direction, or one that does not exist.
    """
    grid = grid_of({over: values})
    begin = _starts(starts)
    if not directions or not set(directions) <= {"forward", "backward"}:
        raise InputError("a direction is forward or backward", str(tuple(directions)), "give one of them or both")
    each, x = len(begin[0]), grid[over]
    order = np.stack([np.arange(len(x)) if way == "forward" else np.arange(len(x))[::-1] for way in directions])
    order = np.repeat(order, each, axis=0)
    X1, Y1, X2, Y2 = (np.tile(component, len(directions)) for component in begin)
    state: Initial = (X1, Y1, X2, Y2)
    plain = Settling(**{**vars(settling), "exponent_periods": 0})
    parts: list[MotionColumns] = []
    for i in range(len(x)):
        stop_if_interrupted()
        if progress is not None:
            progress(i, len(x), "values")
        points = sweep_points(*single(p, e), {over: x[order[:, i]]}, state)
        # As many lanes as there are branches: a full chunk would cost many times as much.
        seen = settle(points.p, points.e, points.initial, plain, width=min(len(order), CHUNK))
        parts.append(motion_columns(seen, points))
        state = seen.end
    place = np.argsort(order, axis=1)
    # (value in the order of the branch, branch, ...) -> (branch, value, ...)
    stacked = {name: np.stack([part[name] for part in parts], axis=1) for name in MOTION_COLUMNS}
    sorted_ = {name: np.stack([a[k] for a, k in zip(column, place, strict=True)]) for name, column in stacked.items()}
    flat = {name: column.reshape(-1, *column.shape[2:]) for name, column in sorted_.items()}
    _add_exponents(flat, sweep_points(*single(p, e), {over: np.tile(x, len(order))}), settling)
    names = [way if each == 1 else f"{way} {i}" for way in directions for i in range(each)]
    return branched(flat, names, grid, provenance(p, e, [over], settling, "continuation"))


def motion_map(
    p: CapsuleParameters,
    e: PeriodicDrive,
    over: Mapping[str, ArrayLike],
    *,
    settling: Settling = SETTLING,
    progress: OnProgress | None = None,
    store: "Path | None" = None,
    client: "Client | None" = None,
    block: int = BLOCK,
) -> xr.Dataset:
    """Settled motions from rest over two quantities: a Dataset over both with the variables of ``points.SUMMARY``.

    Parameters
    ----------
    over : symbol -> values (n,), SI, of the two quantities (one will do)
    store, client, block : finished blocks on disk, Dask cluster, points of a block: see ``blocks.compute``

    Eight arguments: three state the map, the others are options by name.

    Raises
    ------
    InputError
        As ``diagram``; a store of other points.
    """
    grid = grid_of(over)
    mesh = np.meshgrid(*grid.values(), indexing="ij")
    points = sweep_points(*single(p, e), {name: axis.ravel() for name, axis in zip(grid, mesh, strict=True)})
    seen = compute(points, settling, SUMMARY, progress=progress, store=store, client=client, block=block)
    return dataset_of(seen, grid, tuple(grid), mesh[0].shape, provenance(p, e, list(grid), settling, "rest"))


def basins(
    p: CapsuleParameters,
    e: PeriodicDrive,
    x_rel: ArrayLike,
    rate: ArrayLike,
    Y2: float = 0.0,
    *,
    settling: Settling = SETTLING,
    progress: OnProgress | None = None,
) -> xr.Dataset:
    """Which attractor every initial state (x_rel, rate, Y2), m and m/s, leads to, at one set of parameters.

    A Dataset over (x_rel_0, rate_0) with the variables of ``points.SUMMARY``, ``attractor`` and ``attractors``.
    Seven arguments: five state the initial states, the others are options by name.

    Raises
    ------
    InputError
        Values that are no list of finite numbers, leaves with a batch axis.
    """
    axes = {"x_rel_0": values_of("x_rel", x_rel), "rate_0": values_of("rate", rate)}
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    X1, Y1 = mesh[0].ravel(), mesh[1].ravel() + Y2
    points = sweep_points(*single(p, e), {}, (X1, Y1, np.zeros_like(X1), np.full_like(X1, Y2)))
    seen = compute(points, settling, progress=progress)
    numbers = attractors_of(seen)
    data = dataset_of(seen, {}, tuple(axes), mesh[0].shape, provenance(p, e, [], settling, "basins") | {"Y2_0": Y2})
    data = data.assign_coords(
        x_rel_0=("x_rel_0", axes["x_rel_0"], {"units": "m", "long_name": "X1 - X2 at the start"}),
        rate_0=("rate_0", axes["rate_0"], {"units": "m/s", "long_name": "Y1 - Y2 at the start"}),
    )
    found = np.int32(numbers.max(initial=-1) + 1)
    return data.assign(
        attractor=(tuple(axes), numbers.reshape(mesh[0].shape), ATTRACTOR), attractors=((), found, ATTRACTORS)
    )


def spread_starts(p: CapsuleParameters, e: PeriodicDrive, count: int, seed: int = 0) -> Initial:
    """``count`` initial states (X1, Y1, X2, Y2), each (count,): rest, then a Latin hypercube around it.

    The box: x_rel within twice the larger of the gap and the static deflection of the drive's amplitude, velocities
    within what the drive's frequency makes of that. An infinite gap does not count. Leaves ().

    Raises
    ------
    InputError
        Fewer than one state.
    """
    if count < 1:
        raise InputError("the number of initial states must be at least 1", str(count), "give 1 or more")
    G, amplitude, k1, period = (float(np.asarray(x)) for x in (p.G, e.amplitude, p.k1, e.period))
    reach = 2.0 * max(G if np.isfinite(G) else 0.0, amplitude / k1 if k1 > 0.0 else 0.0)
    box = qmc.LatinHypercube(3, rng=np.random.default_rng(seed)).random(count)
    Omega = 2.0 * np.pi / period
    x_rel, rate, Y2 = ((2.0 * box - 1.0) * reach * np.array([1.0, Omega, Omega])).T
    X1, Y1, X2, Y2 = x_rel, rate + Y2, np.zeros(count), Y2
    for component in (X1, Y1, Y2):
        component[0] = 0.0
    return X1, Y1, X2, Y2


def _starts(starts: Initial | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    given = starts if starts is not None else (np.zeros(1),) * 4
    columns = [
        values_of(name, np.atleast_1d(np.asarray(x))) for name, x in zip(("X1", "Y1", "X2", "Y2"), given, strict=True)
    ]
    X1, Y1, X2, Y2 = np.broadcast_arrays(*columns)
    return X1, Y1, X2, Y2


def _add_exponents(seen: MotionColumns, points: SweepPoints, settling: Settling) -> None:
    """Lyapunov exponents of the aperiodic points of a continuation, all at once."""
    x_rel, rate, Y2 = (seen[name][:, -1] for name in SECTION)
    ends = (x_rel, rate + Y2, np.zeros_like(x_rel), Y2)
    seen["lyapunov"] = exponents(points.p, points.e, ends, seen["label"] == "aperiodic", settling)
    seen["label"] = settled_label(seen["label"], seen["lyapunov"])
