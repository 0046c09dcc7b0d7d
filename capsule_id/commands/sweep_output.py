"""Where a sweep goes: FILE.nc and FILE.png, each complete or not there; finished blocks in FILE.nc.partial."""

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from capsule_id.errors import InputError

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

MARK = "points.json"  # stands in every store, see capsule/blocks.py


def take_store(out: Path, resume: bool) -> Path:
    """The folder for finished blocks, ``FILE.nc.partial``; what an earlier run has left there is taken up or removed.

    Raises
    ------
    InputError
        A name that does not end in .nc, a folder that cannot be written, something that is not ours in its place,
        nothing to take up.
    """
    if out.suffix != ".nc":
        raise InputError("the output must end in .nc", str(out), "change its name")
    if out.is_dir() or out.with_suffix(".png").is_dir():
        raise InputError("the output must be a file", f"{out} is a folder", "choose another --out")
    parent = next(path for path in out.absolute().parents if path.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError("the folder of the output must be writable", f"{parent} is not", "choose another --out")
    store = out.with_name(out.name + ".partial")
    if resume and not (store / MARK).is_file():
        raise InputError("--resume takes up an interrupted run", "there is none", "run without --resume", store)
    if store.exists() and not resume:
        names = {path.name for path in store.iterdir()} if store.is_dir() else set()
        if not store.is_dir() or (names and MARK not in names):
            raise InputError("work in progress stands here", "it is something else", "choose another --out", store)
        shutil.rmtree(store)
    return store


def publish_pair(out: Path, data: "xr.Dataset", figure: "Figure") -> None:
    """Write both files under other names beside their places, then rename them.

    Raises
    ------
    InputError
        If they cannot be written.
    """
    from capsule_id.report.figures.style import png

    picture = out.with_suffix(".png")
    new = [path.with_name(f".{path.name}.new") for path in (out, picture)]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        data.to_netcdf(new[0], engine="h5netcdf")
        new[1].write_bytes(png(figure))
        new[0].replace(out)
        new[1].replace(picture)
    except OSError as error:
        raise InputError("the output must be writable", str(error.strerror), "choose another --out", out) from None
    finally:
        for path in new:
            path.unlink(missing_ok=True)


def remove_store(store: Path) -> None:
    """Remove the finished blocks once the files stand."""
    shutil.rmtree(store, ignore_errors=True)
