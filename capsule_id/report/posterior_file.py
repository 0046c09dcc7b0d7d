"""``posterior.nc`` read back: draws of the model's leaves."""

from pathlib import Path

import numpy as np
import xarray as xr

from capsule_id.errors import InputError
from capsule_id.parameters import LEAVES


def read_draws(path: Path, count: int, seed: int, spring: str | None = None) -> dict[str, np.ndarray]:
    """``count`` draws, taken at random without repetition: symbol -> (count,), SI, for every leaf in the file.

    spring : whose k2; None where the file has one spring, or k2 is of no interest (it is left out then)

    Raises
    ------
    InputError
        No file of fit-params, fewer draws than wanted, a spring that is not in it.
    """
    try:
        with xr.open_dataset(path, group="posterior", engine="h5netcdf") as data:
            data.load()
        size = data.sizes["chain"] * data.sizes["draw"]
    except (OSError, KeyError, ValueError) as error:
        rule, remedy = "--posterior takes the posterior.nc of a result", "give results/<rig>/posterior.nc"
        raise InputError(rule, type(error).__name__, remedy, path) from None
    if not 1 <= count <= size:
        raise InputError(
            "--draws must lie between 1 and the draws of the file", str(count), f"give at most {size}", path
        )
    chosen = np.random.default_rng(seed).choice(size, count, replace=False)
    flat = data.stack(sample=("chain", "draw"))
    found = {str(name): flat[name] for name in flat.data_vars if name in LEAVES}
    if "k2" in found and "spring" in found["k2"].dims:
        springs = [str(name) for name in found["k2"]["spring"].to_numpy()]
        named = spring if spring is not None else springs[0] if len(springs) == 1 else None
        if named is None:
            del found["k2"]
        elif named in springs:
            found["k2"] = found["k2"].isel(spring=springs.index(named))
        else:
            raise InputError("--spring must be a fitted one", named, f"choose from {', '.join(springs)}", path)
    return {name: column.to_numpy()[chosen] for name, column in found.items()}
