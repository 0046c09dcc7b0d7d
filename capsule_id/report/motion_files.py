"""A simulated motion as a table: CSV with ``name [unit]`` headers, or NetCDF with units as attributes."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

UNITS = {"time": "s", "X1": "m", "Y1": "m/s", "X2": "m", "Y2": "m/s", "x_rel": "m"}
MEANINGS = {
    "X1": "displacement of the rod",
    "Y1": "velocity of the rod",
    "X2": "displacement of the capsule",
    "Y2": "velocity of the capsule",
    "x_rel": "X1 - X2, positive towards the support spring",
}


def write_motion(path: Path, columns: Mapping[str, np.ndarray], provenance: Mapping[str, float | str]) -> None:
    """Write the columns (n,), named as in ``UNITS``, to a ``.csv`` or ``.nc`` file; numbers keep all their digits.

    provenance : parameters and model; attributes of the NetCDF file (a CSV file holds the table alone)

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    if path.suffix == ".nc":
        _write_netcdf(path, columns, provenance)
        return
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([f"{name} [{UNITS[name]}]" for name in columns])
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def _write_netcdf(path: Path, columns: Mapping[str, np.ndarray], provenance: Mapping[str, float | str]) -> None:
    data = {
        name: ("time", column, {"units": UNITS[name], "long_name": MEANINGS[name]})
        for name, column in columns.items()
        if name != "time"
    }
    dataset = xr.Dataset(data, {"time": ("time", columns["time"], {"units": UNITS["time"]})}, dict(provenance))
    dataset.to_netcdf(path, engine="h5netcdf")
