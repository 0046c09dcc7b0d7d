"""``posterior.nc`` in the groups of ArviZ, written and read back, and simulated motions as tables."""

import csv
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from capsule_id.errors import InputError
from capsule_id.inference.result import Pointwise, Posterior, Result
from capsule_id.parameters import LEAVES, TABLE

# netcdf: ``posterior.nc``: the sample in the groups and dimensions that ArviZ knows.


# The extra dimension of bracketed names; every other family gets "<base>_of".
_DIMENSIONS = {"k2": "spring"}


def write_posterior(result: Result, path: Path) -> None:
    """Write the sample of ``result`` as netCDF (h5netcdf), to be opened by ``arviz.from_netcdf``.

    Raises
    ------
    ValueError
        If nothing was sampled, or a name is used both alone and as a family.
    """
    data_tree(result).to_netcdf(path, engine="h5netcdf")


def data_tree(result: Result) -> xr.DataTree:
    """The sample of ``result`` in the groups of ArviZ.

    ``posterior``, ``sample_stats``: dimensions ``chain`` (every walker of every ensemble, with the coordinate
    ``ensemble``) and ``draw``. ``log_likelihood`` (one variable ``readings``) and ``posterior_predictive``: at every so
    many of these chains and draws, whose labels they keep. ``observed_data``, ``prior``. Readings are numbered, and their
    attribute ``experiment`` is the label. A family of names such as ``k2[soft]``, ``k2[stiff]`` is one variable with one
    dimension more. Groups without variables are left out.

    Raises
    ------
    ValueError
        If nothing was sampled, or a name is used both alone and as a family.
    """
    if result.posterior is None:
        raise ValueError("nothing was sampled (point fit only): fit without --no-sample (budget=None)")
    # Exact masses and g need no row in the tables of the result.
    units = {symbol: row.unit for symbol, row in TABLE.items()}
    for frame in (result.summary, result.nuisances):
        units |= {str(name): str(unit) for name, unit in frame["unit"].items()}
    groups = {
        "posterior": _posterior(result.posterior, result.fixed, units),
        "sample_stats": _sample_stats(result.posterior),
        "observed_data": _readings(result.observed, ()),
        "prior": _families({name: draws[np.newaxis] for name, draws in result.prior.items()}, units),
    }
    if result.pointwise is not None:
        groups |= {
            "log_likelihood": _log_likelihood(result.pointwise),
            "posterior_predictive": _replicates(result.pointwise),
        }
    tree = xr.DataTree.from_dict({name: group for name, group in groups.items() if group.data_vars})
    tree.attrs = {"rig": result.rig.name, "synthetic": int(result.rig.synthetic)}
    return tree


def read_sample(path: Path, saved: Posterior) -> tuple[Posterior, dict[str, np.ndarray], Pointwise | None]:
    """The arrays of ``posterior.nc``: ``saved`` with its draws, the prior draws by name, the pointwise values.

    Raises
    ------
    OSError, KeyError, ValueError
        If the file is absent, damaged, or another fit wrote it.
    """
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    shape = (saved.acceptance.shape[0], -1, saved.acceptance.shape[1])
    columns = _members_of(tree["posterior"].to_dataset())
    by_chain = np.stack([columns[name] for name in saved.names], axis=-1)  # (chain, draw, d)
    _, draws, d = by_chain.shape
    by_walker = by_chain.reshape(shape[0], shape[2], draws, d)
    lp = tree["sample_stats"]["lp"].to_numpy().reshape(shape[0], shape[2], draws)
    posterior = replace(saved, draws=by_walker.transpose(0, 2, 1, 3), lp=lp.transpose(0, 2, 1))
    prior = {
        name: values[0] for name, values in (_members_of(tree["prior"].to_dataset()) if "prior" in tree else {}).items()
    }
    if "log_likelihood" not in tree:
        return posterior, prior, None
    density, replicates = tree["log_likelihood"]["readings"], tree["posterior_predictive"].to_dataset()
    of, rows = density["experiment"].to_numpy(), density["row"].to_numpy()
    by_label = {str(values.attrs["experiment"]): values.to_numpy() for values in replicates.data_vars.values()}
    return (
        posterior,
        prior,
        Pointwise(
            {label: density.to_numpy()[..., of == label] for label in by_label},
            {label: rows[of == label] for label in by_label},
            by_label,
            density["chain"].to_numpy(),
            density["draw"].to_numpy(),
            int(replicates.attrs["thin"]),
        ),
    )


def _posterior(posterior: Posterior, fixed: Mapping[str, float], units: Mapping[str, str]) -> xr.Dataset:
    ensembles, draws, walkers, d = posterior.draws.shape
    chains = ensembles * walkers
    columns = posterior.draws.transpose(3, 0, 2, 1).reshape(d, chains, draws).astype(np.float64)
    arrays = dict(zip(posterior.names, columns, strict=True))
    # Exact masses stand among the draws as constants, so that whoever computes with draws has them all in one place.
    arrays |= {name: np.full((chains, draws), value, dtype=np.float64) for name, value in fixed.items()}
    dataset = _families(arrays, units)
    for name, variable in dataset.data_vars.items():
        if _members(str(name), arrays) <= set(fixed):
            variable.attrs["fixed"] = 1
    return dataset.assign_coords(chain=np.arange(chains), draw=np.arange(draws), ensemble=_ensemble_of(posterior))


def _sample_stats(posterior: Posterior) -> xr.Dataset:
    ensembles, draws, walkers, _ = posterior.draws.shape
    chains = ensembles * walkers
    lp = posterior.lp.transpose(0, 2, 1).reshape(chains, draws).astype(np.float64)
    acceptance = posterior.acceptance.reshape(chains).astype(np.float64)
    dataset = xr.Dataset(
        {
            "lp": (("chain", "draw"), lp, {"units": "1", "meaning": "log-posterior density, unconstrained space"}),
            "acceptance": ("chain", acceptance, {"units": "1", "meaning": "share of accepted proposals of the walker"}),
        }
    )
    return dataset.assign_coords(chain=np.arange(chains), draw=np.arange(draws), ensemble=_ensemble_of(posterior))


def _log_likelihood(pointwise: Pointwise) -> xr.Dataset:
    """One variable with all terms, whose experiment and first row are coordinates: ``arviz.loo`` needs no argument."""
    values = pointwise.log_likelihood
    labels = np.repeat(list(values), [part.shape[-1] for part in values.values()])
    rows = np.concatenate([pointwise.rows[label] for label in values])
    together = np.concatenate(list(values.values()), axis=-1)
    dataset = xr.Dataset({"readings": (("chain", "draw", "reading"), together, {"units": "1"})})
    return dataset.assign_coords(
        chain=pointwise.chain, draw=pointwise.draw, experiment=("reading", labels), row=("reading", rows)
    )


def _replicates(pointwise: Pointwise) -> xr.Dataset:
    dataset = _readings(pointwise.replicates, ("chain", "draw"))
    dataset.attrs["thin"] = pointwise.thin
    return dataset.assign_coords(chain=pointwise.chain[:: pointwise.thin], draw=pointwise.draw[:: pointwise.thin])


def _readings(by_label: Mapping[str, np.ndarray], leading: tuple[str, ...]) -> xr.Dataset:
    """A variable per experiment. A label may be a name that ArviZ gives, so that its number precedes it."""
    return xr.Dataset(
        {
            f"y{i}_{re.sub(r'[^0-9A-Za-z_]', '_', label)[:40]}": (
                (*leading, f"row_{i}"),
                np.asarray(values, np.float64),
                {"units": "SI", "experiment": label},
            )
            for i, (label, values) in enumerate(by_label.items(), 1)
        }
    )


def _ensemble_of(posterior: Posterior) -> tuple[str, np.ndarray]:
    ensembles, _, walkers, _ = posterior.draws.shape
    return "chain", np.repeat(np.arange(ensembles), walkers)


def _families(arrays: Mapping[str, np.ndarray], units: Mapping[str, str]) -> xr.Dataset:
    """Variables (chain, draw) by name; names with brackets are stacked along the dimension of their family."""
    variables: dict[str, xr.Variable] = {}
    coordinates: dict[str, list[str]] = {}
    for base in dict.fromkeys(name.partition("[")[0] for name in arrays):
        members = [name for name in arrays if name in _members(base, arrays)]
        if members == [base]:
            variables[base] = xr.Variable(("chain", "draw"), arrays[base], {"units": units.get(base, "")})
            continue
        if base in members:
            raise ValueError(f"{base} is used both alone and as a family: {', '.join(members)}; rename one of them")
        dimension = _DIMENSIONS.get(base, f"{base}_of")
        stacked = np.stack([arrays[name] for name in members], axis=-1)
        # A symbol has one unit, so the first member's holds for all.
        variables[base] = xr.Variable(("chain", "draw", dimension), stacked, {"units": units.get(members[0], "")})
        coordinates[dimension] = [name[len(base) + 1 : -1] for name in members]
    return xr.Dataset(variables, coords=coordinates)


def _members_of(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Variables (chain, draw) by name of the parameter; the inverse of ``_families``."""
    found: dict[str, np.ndarray] = {}
    for base, variable in dataset.data_vars.items():
        if variable.ndim == 2:
            found[str(base)] = variable.to_numpy()
            continue
        dimension = variable.dims[-1]
        found |= {f"{base}[{of}]": variable.sel({dimension: of}).to_numpy() for of in variable[dimension].to_numpy()}
    return found


def _members(base: str, names: Mapping[str, np.ndarray]) -> set[str]:
    return {name for name in names if name == base or (name.startswith(f"{base}[") and name.endswith("]"))}


# motion files: A simulated motion as a table: CSV with ``name [unit]`` headers, or NetCDF with units as attributes.


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


# posterior file: ``posterior.nc`` read back: draws of the model's leaves.


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
