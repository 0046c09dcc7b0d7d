"""Many points block by block: in this process or on a Dask cluster, with finished blocks kept on disk.

The same function computes a block wherever it runs, and a lane does not depend on its block: the result is the same to
the last bit, whoever computed it and however often the work was interrupted.
"""

import hashlib
import json
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.interruption import stop_if_interrupted
from capsule_id.motions.points import MOTION_COLUMNS, MotionColumns, SweepPoints, settled_columns
from capsule_id.motions.response import Settling

if TYPE_CHECKING:
    from distributed import Client

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
    begins = range(0, points.size, block)
    if store is not None:
        _check_store(store, points, settling, keep, block)
    parts: dict[int, MotionColumns] = {}
    for begin in begins:
        finished = _saved_block(store, begin)
        if finished is not None:
            parts[begin] = finished
    missing = [begin for begin in begins if begin not in parts]
    make = _in_process if client is None else _on_cluster(client)
    done = sum(len(part["status"]) for part in parts.values())
    _report(progress, done, points.size)
    for begin, part in make(points, settling, tuple(keep), missing, block):
        parts[begin] = part
        _save_block(store, begin, part)
        done += len(part["status"])
        _report(progress, done, points.size)
    return {name: np.concatenate([parts[begin][name] for begin in begins]) for name in keep}


def settled_block(points: SweepPoints, settling: Settling, keep: Sequence[str]) -> MotionColumns:
    """One block: the named columns and the status."""
    seen = settled_columns(points, settling)
    return {name: seen[name] for name in dict.fromkeys((*keep, "status"))}


def _in_process(
    points: SweepPoints, settling: Settling, keep: Sequence[str], missing: list[int], block: int
) -> Iterator[tuple[int, MotionColumns]]:
    for begin in missing:
        yield begin, settled_block(points.part(begin, begin + block), settling, keep)


def _on_cluster(client: "Client") -> Callable[..., Iterator[tuple[int, MotionColumns]]]:
    from distributed import as_completed

    def run(
        points: SweepPoints, settling: Settling, keep: Sequence[str], missing: list[int], block: int
    ) -> Iterator[tuple[int, MotionColumns]]:
        futures: dict[Any, int] = {}
        for begin in missing:
            task = client.submit(settled_block, points.part(begin, begin + block), settling, keep, pure=False)
            futures[task] = begin
        for future, part in as_completed(list(futures), with_results=True):
            yield futures[future], part

    return run


def _report(progress: OnProgress | None, done: int, total: int) -> None:
    stop_if_interrupted()
    if progress is not None:
        progress(done, total, "points")


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
    store.mkdir(parents=True, exist_ok=True)
    file = store / FINGERPRINT
    if file.exists():
        try:
            theirs = json.loads(file.read_text(encoding="utf-8"))
        except ValueError:
            theirs = None
        if theirs != json.loads(json.dumps(mine)):
            remedy = "repeat the command with the same points, or remove the folder"
            raise InputError("finished blocks are reused for the same points only", "other points", remedy, store)
        return
    if any(store.iterdir()):
        raise InputError("a store is a new folder or one of this program", "it is neither", "name another one", store)
    file.write_text(json.dumps(mine, indent=1), encoding="utf-8", newline="\n")


def _file(store: Path, begin: int) -> Path:
    return store / f"block_{begin:09d}.npz"


def _save_block(store: Path | None, begin: int, part: MotionColumns) -> None:
    if store is None:
        return
    new = store / "block.new"
    with new.open("wb") as file:
        np.savez(file, **part)  # pyright: ignore[reportArgumentType]  (names are ours: none is "file")
    new.replace(_file(store, begin))


def _saved_block(store: Path | None, begin: int) -> MotionColumns | None:
    """A saved block; None if there is none or it cannot be read."""
    if store is None or not _file(store, begin).exists():
        return None
    try:
        with _file(store, begin).open("rb") as file, np.load(file, allow_pickle=False) as saved:
            return {name: saved[name] for name in saved.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
