"""Writes a sweep: FILE.nc and FILE.png, each complete or absent; FILE.nc.partial holds finished blocks."""

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from capsule_id.errors import InputError

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

STORE_FILE = "points.json"  # in every store, see motions/blocks.py


def prepare_store(out: Path, resume: bool) -> Path:
    """The folder for finished blocks, ``FILE.nc.partial``. Blocks of an earlier run are kept (``resume``) or removed.

    Raises
    ------
    InputError
        If the name does not end in .nc, the folder cannot be written, is a result or belongs to something else, or
        ``resume`` finds no blocks.
    """
    if out.suffix != ".nc":
        raise InputError("the output must end in .nc", str(out), "change the suffix")
    if out.is_dir() or out.with_suffix(".png").is_dir():
        raise InputError("the output must be a file", f"{out} is a folder", "choose another --out")
    parent = next(path for path in out.absolute().parents if path.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError("the folder of the output must be writable", f"{parent} is not", "choose another --out")
    if (out.parent / "parameters.json").exists():
        rule, remedy = "the output must not lie in a result of fit-params", "choose another --out"
        raise InputError(rule, f"{out.parent} is one", remedy, out)
    store = out.with_name(out.name + ".partial")
    if resume and not (store / STORE_FILE).is_file():
        raise InputError("--resume needs an interrupted run", "there is none", "run without --resume", store)
    if store.exists() and not resume:
        names = {path.name for path in store.iterdir()} if store.is_dir() else set()
        if not store.is_dir() or (names and STORE_FILE not in names):
            raise InputError(
                "FILE.nc.partial must be unfinished work", "it is something else", "choose another --out", store
            )
        shutil.rmtree(store)
    return store


def publish_pair(out: Path, data: "xr.Dataset", figure: "Figure") -> None:
    """Write both files under temporary names in the same folder, then rename them.

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
    """Remove the finished blocks."""
    shutil.rmtree(store, ignore_errors=True)
