"""Bifurcation diagrams, two-parameter maps, bands over draws, basins of attraction: settled motions over any quantity."""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import jax
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.stats import qmc

from capsule_id import console
from capsule_id.console import OnProgress, stop_if_interrupted
from capsule_id.errors import InputError, writing
from capsule_id.motions.response import (
    REST,
    SAME_POSITION,
    SAME_VELOCITY,
    SETTLING,
    Settled,
    Settling,
    settle,
    with_exponents,
)
from capsule_id.output import replace_file
from capsule_id.parameters import CAPSULE_LEAVES, ENDS, LEAVES, SWEPT
from capsule_id.physics.batches import CHUNK, lanes_of
from capsule_id.physics.model import CapsuleParameters, Excitation, Initial, PeriodicDrive, without_absent

if TYPE_CHECKING:
    from distributed import Client


# points: The points of a sweep, and the columns of their settled motions.
#
# A *point* is one set of leaves with one initial state. A lane of the engine is the same to the last bit in every
# batch, so the result does not depend on the blocks or on the worker that computes them.


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

    def part(self, chosen: slice) -> "SweepPoints":
        """The points of a slice."""
        return SweepPoints(*jax.tree.map(lambda leaf: leaf[chosen], (self.p, self.e, self.initial)))


def sweep_points(
    p: CapsuleParameters, e: PeriodicDrive, over: Mapping[str, np.ndarray], initial: Initial = REST
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
    kinds = ("capsule", "drive")
    of_p, of_e = ({name: x for name, x in leaves.items() if LEAVES[name].leaf == kind} for kind in kinds)
    # What is absent is absent in all blocks of a sweep, so a point does not depend on its block.
    p, e = without_absent(replace(p, **of_p), replace(cast(Any, e), **of_e))
    return SweepPoints(*lanes_of((p, e, initial), np.zeros(1))[0])


def swept_leaf(name: str, e: PeriodicDrive) -> str:
    """The leaf that a swept quantity sets: ``f`` is Omega or the period of pulses."""
    return name if name != "f" else "Omega" if isinstance(e, Excitation) else "period"


# attractors: Which motions are the same attractor: by direction and period, contacts, and the points of the Poincaré
# section.


# Two settled motions that are the same have come within this many times the tolerance of the section's repetition.
SLACK = 10.0


def attractors_of(columns: MotionColumns) -> np.ndarray:
    """(n,) int32: number of the attractor of each of n motions *at one set of parameters*; -1 where the run failed.

    columns : as ``points.settled_columns``, of n motions

    Periodic motions are one attractor if their labels agree and the points of one period of their sections agree up
    to where they begin. Aperiodic motions count as one: their points, and the sign of a slow drift, cannot be matched.
    """
    label, period = columns["label"], columns["period"]
    numbers, found = np.full(len(label), -1, np.int32), list[int]()
    for i in np.flatnonzero(label != "failed").tolist():
        alike = (k for k, j in enumerate(found) if label[i] == label[j])
        same = (k for k in alike if period[i] == 0 or _same_orbit(columns, i, found[k], int(period[i])))
        numbers[i] = next(same, len(found))
        if numbers[i] == len(found):
            found.append(i)
    return numbers


def _same_orbit(columns: MotionColumns, i: int, j: int, period: int) -> bool:
    """Whether the last ``period`` points of motions i and j are the same but for a shift along the orbit."""
    (x, x_other), (w, w_other) = ((columns[name][[i, j], -period:]) for name in ("x_rel", "rate"))
    return any(
        np.abs(np.roll(x, shift) - x_other).max() <= SLACK * SAME_POSITION
        and np.abs(np.roll(w, shift) - w_other).max() <= SLACK * SAME_VELOCITY
        for shift in range(period)
    )


# blocks: Many points block by block: in this process or on a Dask cluster, with finished blocks kept on disk.
#
# The same function computes a block wherever it runs, and a lane does not depend on its block: the result is the
# same to the last bit, whoever computed it and however often the work was interrupted.


# Points of one block: seconds of work, a multiple of the lanes of one call.
BLOCK = 256
# File of a store that states which points its blocks belong to.
FINGERPRINT = "points.json"


def compute(
    points: SweepPoints,
    settling: Settling,
    keep: Sequence[str] = tuple(MOTION_COLUMNS),
    *,
    progress: OnProgress | None = None,
    store: Path | None = None,
    client: "Client | None" = None,
    block: int = BLOCK,
) -> MotionColumns:
    """Settled motions of all points: columns (points, ...) by name.

    Parameters
    ----------
    keep : the names of ``MOTION_COLUMNS`` to return
    progress : called with the points done, their number, and the word "points"
    store : a folder, created if missing: finished blocks are saved there and read from there
    client : of a Dask cluster; the blocks of a worker that dies are computed again by others. Workers must
        have the same versions and XLA flags as each other, or the last bits of the blocks may differ.
    block : points of a block

    Seven arguments: three state the points, the others are options by name.

    Raises
    ------
    InputError
        A store that belongs to other points.
    """
    begins, parts = range(0, points.size, block), dict[int, MotionColumns]()
    if store is not None:
        _check_store(store, points, settling, keep, block)
        console.saved.set()
        saved = ((begin, _saved_block(store, begin)) for begin in begins)
        parts = {begin: part for begin, part in saved if part is not None}
    missing = [begin for begin in begins if begin not in parts]
    done = sum(len(part["status"]) for part in parts.values())
    _report(progress, done, points.size)
    tasks = ((points.part(slice(begin, begin + block)), settling, tuple(keep)) for begin in missing)
    computed = (settled_block(*task) for task in tasks)
    if client is not None:
        futures = [client.submit(settled_block, *task, pure=False) for task in tasks]
        computed = (future.result() for future in futures)
    for i, (begin, part) in enumerate(zip(missing, computed, strict=True)):
        parts[begin] = part
        if store is not None:
            _save_block(store, begin, part, len(missing) - i)
        done += len(part["status"])
        _report(progress, done, points.size)
    return {name: np.concatenate([parts[begin][name] for begin in begins]) for name in keep}


def settled_block(points: SweepPoints, settling: Settling, keep: Sequence[str]) -> MotionColumns:
    """One block: the named columns and the status."""
    seen = settle(points.p, points.e, points.initial, settling)
    return {name: getattr(seen, name) for name in (*keep, "status")}


def _report(progress: OnProgress | None, done: int, total: int, what: str = "points") -> None:
    stop_if_interrupted()
    if progress is not None:
        progress(done, total, what)


def _check_store(store: Path, points: SweepPoints, settling: Settling, keep: Sequence[str], block: int) -> None:
    """Create the folder, or check that its blocks belong to these points."""
    leaves = hashlib.sha256(str(jax.tree.structure((points.p, points.e))).encode())
    for leaf in jax.tree.leaves((points.p, points.e, points.initial)):
        leaves.update(np.ascontiguousarray(leaf).tobytes())
    mine = {
        "points": leaves.hexdigest(),
        "settling": asdict(settling),
        "keep": list(keep),
        "block": block,
        "jax": jax.__version__,
    }
    file, text = store / FINGERPRINT, json.dumps(mine, indent=1)
    with writing(store):
        store.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        if any(store.iterdir()):
            rule = "a store is a new folder or one of this program"
            raise InputError(rule, "it is neither", "name another one", store)
        replace_file(file, text)
    elif file.read_bytes() != text.encode():
        remedy = "repeat the command with the same points, or remove the folder"
        raise InputError("finished blocks are reused for the same points only", "other points", remedy, store)


def _file(store: Path, begin: int) -> Path:
    return store / f"block_{begin:09d}.npz"


def _save_block(store: Path, begin: int, part: MotionColumns, left: int) -> None:
    """Save a block; ``left`` blocks are still to be saved, with this one."""
    np.savez(content := io.BytesIO(), **part)  # pyright: ignore[reportArgumentType]  (names are ours: none is "file")
    replace_file(_file(store, begin), content.getvalue(), left * content.tell())


def _saved_block(store: Path, begin: int) -> MotionColumns | None:
    """A saved block; None if there is none or it cannot be read."""
    try:
        with _file(store, begin).open("rb") as file, np.load(file, allow_pickle=False) as saved:
            return {name: saved[name] for name in saved.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


# datasets: From the columns of a sweep's points to an ``xarray.Dataset``, and what a sweep accepts as its axes.


ATTRACTOR = {"units": "1", "long_name": "number of the attractor among those found here, -1 if the run failed"}
ATTRACTORS = {"units": "1", "long_name": "number of different attractors found here"}


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
    held = {
        name: str(x) if name == "forces" else float(np.asarray(x))
        for name, x in given.items()
        if name not in swept and x is not None
    }
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
        values = column.reshape(*shape, *column.shape[1:])
        extra = ("section",) if name in SECTION else ()
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


# sweep: Bifurcation diagrams, two-parameter maps, basins of attraction: settled motions over any quantity of the model.
#
#     diagram(p, e, "k2", values)                      each value from rest
#     diagram(..., starts=spread_starts(p, e, 16))     each value from many initial states: co-existing attractors
#     continuation(p, e, "k2", values)                 forward and backward, each value from where the last one ended
#     motion_map(p, e, {"k2": ..., "P_d": ...})        label, mean velocity, efficiency over two quantities
#     basins(p, e, x_rel, rate)                        which initial state leads where, at one set of parameters
#
# All of them return an ``xarray.Dataset`` in SI units whose variables say what they are (``units``, ``long_name``). A
# run that was given up is labelled "failed", and ``status`` says why.


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
    x, begin = values_of(over, values), _starts(starts)
    branches = len(begin[0])
    X1, Y1, X2, Y2 = (np.repeat(component, len(x)) for component in begin)
    points = sweep_points(*single(p, e), {over: np.tile(x, branches)}, (X1, Y1, X2, Y2))
    seen = compute(points, settling, progress=progress)
    names = ["rest"] if starts is None else [f"start {i}" for i in range(branches)]
    method = "rest" if starts is None else "starts"
    return branched(seen, names, {over: x}, provenance(p, e, [over], settling, method))


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
    x, begin = values_of(over, values), _starts(starts)
    if not directions or not set(directions) <= {"forward", "backward"}:
        raise InputError("a direction is forward or backward", str(tuple(directions)), "give one of them or both")
    each, places = len(begin[0]), np.arange(len(x))
    order = np.repeat(np.stack([places if way == "forward" else places[::-1] for way in directions]), each, axis=0)
    X1, Y1, X2, Y2 = (np.tile(component, len(directions)) for component in begin)
    state: Initial = (X1, Y1, X2, Y2)
    plain, parts = replace(settling, exponent_periods=0), list[Settled]()
    for i in range(len(x)):
        _report(progress, i, len(x), "values")
        points = sweep_points(*single(p, e), {over: x[order[:, i]]}, state)
        # As many lanes as there are branches: a full chunk would cost many times as much.
        parts.append(settle(points.p, points.e, points.initial, plain, width=min(len(order), CHUNK)))
        state = parts[-1].end
    # (value in the order of the branch, branch, ...) -> (branch and value, ...)
    branches, place = np.arange(len(order))[:, None], np.argsort(order, axis=1)
    stacked = {name: np.stack([getattr(part, name) for part in parts], axis=1) for name in MOTION_COLUMNS}
    flat = {name: np.concatenate(column[branches, place]) for name, column in stacked.items()}
    # The exponents of all aperiodic points at once.
    points = sweep_points(p, e, {over: np.tile(x, len(order))})
    x_rel, rate, Y2 = (flat[name][:, -1] for name in SECTION)
    ends = (x_rel, rate + Y2, np.zeros_like(x_rel), Y2)
    flat["label"], flat["lyapunov"] = with_exponents(points.p, points.e, ends, flat["label"], settling)
    names = [way if each == 1 else f"{way} {i}" for way in directions for i in range(each)]
    return branched(flat, names, {over: x}, provenance(p, e, [over], settling, "continuation"))


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
    store, client, block : finished blocks on disk, Dask cluster, points of a block: see ``compute``

    Eight arguments: three state the map, the others are options by name.

    Raises
    ------
    InputError
        As ``diagram``; a store of other points.
    """
    grid = {name: values_of(name, values) for name, values in over.items()}
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
    numbers, summary = attractors_of(seen), {name: seen[name] for name in SUMMARY}
    data = dataset_of(summary, {}, tuple(axes), mesh[0].shape, provenance(p, e, [], settling, "basins") | {"Y2_0": Y2})
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
    box[0] = 0.5
    x_rel, rate, Y2 = ((2.0 * box - 1.0) * reach * np.array([1.0, 2.0 * np.pi / period, 2.0 * np.pi / period])).T
    return x_rel, rate + Y2, np.zeros(count), Y2


def _starts(starts: Initial | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    pairs = zip(("X1", "Y1", "X2", "Y2"), starts if starts is not None else REST, strict=True)
    X1, Y1, X2, Y2 = np.broadcast_arrays(*(values_of(name, np.atleast_1d(np.asarray(x))) for name, x in pairs))
    return X1, Y1, X2, Y2


# operating: Diagrams for draws of the parameters: how probable each motion is, how fast, and where to operate best.
#
#     draws over values -> settled motions (value, draw) -> bands: probabilities, quantiles, best operating point
#
# Draws are arrays of leaves; they may come from anywhere.


QUANTILES = (ENDS[0], 0.5, ENDS[1])


def draws_diagram(
    p: CapsuleParameters,
    e: PeriodicDrive,
    over: str,
    values: ArrayLike,
    *,
    settling: Settling = SETTLING,
    progress: OnProgress | None = None,
    store: "Path | None" = None,
    client: "Client | None" = None,
) -> xr.Dataset:
    """Settled motions from rest at every value for every draw: a Dataset over (<over>, draw).

    Parameters
    ----------
    p, e : leaves () or (draws,), at least one with draws
    over, values : the quantity that is varied, (n,), SI (f in Hz)
    store, client : see ``compute``

    Eight arguments: four state the diagram, the others are options by name.

    Raises
    ------
    InputError
        A quantity that does not exist, no leaf with draws, values that are no list of finite numbers.
    """
    x = values_of(over, values)
    if not any(np.ndim(leaf) for leaf in jax.tree.leaves((p, e))):
        raise InputError("a posterior band needs draws", "every leaf is one number", "use diagram, or give arrays")
    drawn, _, _ = lanes_of((p, e), np.zeros(1))
    n, draws = len(x), len(np.asarray(drawn[0].m1))
    p, e = jax.tree.map(lambda leaf: np.tile(leaf, n), drawn)
    points = sweep_points(p, e, {over: np.repeat(x, draws)})
    seen = compute(points, settling, SUMMARY, progress=progress, store=store, client=client)
    about = {**asdict(settling), "method": "rest", "model": "exact", "semantics": "stick-slip"}
    return dataset_of(seen, {over: x}, (over, "draw"), (n, draws), about).assign_coords(draw=np.arange(draws))


def bands(seen: xr.Dataset, objective: str = "mean_velocity") -> xr.Dataset:
    """Probabilities and quantiles over the draws, at each value and at the best operating point.

    Parameters
    ----------
    seen : from ``draws_diagram``
    objective : the quantity to maximise: "mean_velocity" (forward), or "efficiency"

    Returns a Dataset with

    probability (label, <over>) : share of the draws with this label, "failed" among them: over labels it sums to 1
    <objective>_quantiles (quantile, <over>) : 2.5 %, 50 % and 97.5 % over the draws that have not failed
    best (draw), best_<objective> (draw) : for each draw the value with the largest objective, and that objective
    best_quantiles, best_<objective>_quantiles (quantile) : the same over the draws
    chosen () : the value whose *mean* over the draws is largest, that is, what to set when the parameters are not
        known better; chosen_<objective>_quantiles (quantile) : what it gives

    Raises
    ------
    InputError
        An objective that does not exist, draws of which every one failed at some value or at all of them.
    """
    if objective not in ("mean_velocity", "efficiency"):
        raise InputError("the objective is mean_velocity or efficiency", objective, "choose one of them")
    over = str(next(name for name in seen.dims if name != "draw"))
    axis, label, goal = seen[over].to_numpy(), seen["label"].to_numpy(), seen[objective].to_numpy()
    failed = label == "failed"
    if failed.all(axis=0).any() or failed.all(axis=1).any():
        raise InputError("every value and every draw needs a run that is complete", "all failed", "look at status")
    occurring, counts = np.unique(label, return_counts=True)
    names = occurring[np.argsort(-counts, kind="stable")]
    probability = np.stack([(label == name).mean(axis=1) for name in names])
    goal = np.where(failed, np.nan, goal)
    at = np.nanargmax(goal, axis=0)
    best, best_goal = axis[at], goal[at, np.arange(goal.shape[1])]
    chosen = int(np.argmax(np.nanmean(goal, axis=1)))
    value, unit = dict(seen[over].attrs), seen[objective].attrs["units"]
    about = {"units": unit, "long_name": seen[objective].attrs["long_name"]}
    per_draw = "with the largest objective, of each draw"
    return xr.Dataset(
        {
            "probability": (
                ("label", over),
                probability,
                {"units": "1", "long_name": "posterior probability of the motion"},
            ),
            f"{objective}_quantiles": (("quantile", over), np.nanquantile(goal, QUANTILES, axis=1), about),
            "best": ("draw", best, value | {"long_name": f"{value['long_name']} {per_draw}"}),
            f"best_{objective}": ("draw", best_goal, about),
            "best_quantiles": ("quantile", np.quantile(best, QUANTILES), value),
            f"best_{objective}_quantiles": ("quantile", np.quantile(best_goal, QUANTILES), about),
            "chosen": ((), axis[chosen], value | {"long_name": "value whose objective is largest in the mean"}),
            f"chosen_{objective}_quantiles": ("quantile", np.nanquantile(goal[chosen], QUANTILES), about),
        },
        {over: (over, axis, value), "label": list(map(str, names)), "quantile": list(QUANTILES)},
        {**seen.attrs, "objective": objective, "draws": goal.shape[1]},
    )
