"""``posterior.nc`` in the groups of ArviZ, written and read back, and simulated motions as tables."""

import io
import re
from collections import defaultdict
from collections.abc import Container, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from capsule_id.console import refusing_damage
from capsule_id.errors import InputError
from capsule_id.inference.result import Pointwise, Posterior, Result
from capsule_id.output import replace_file
from capsule_id.parameters import TABLE

# netcdf: ``posterior.nc``: the sample in the groups and dimensions that ArviZ knows.


# The extra dimension of bracketed names; every other family gets "<base>_of".
_DIMENSIONS = {"k2": "spring"}


def netcdf_bytes(data: xr.DataTree | xr.Dataset) -> bytes:
    """``data`` as a netCDF file (h5netcdf). It is made in memory: HDF5 ends the process where the disk is full."""
    file = io.BytesIO()
    data.to_netcdf(file, engine="h5netcdf")
    return file.getvalue()


def data_tree(result: Result) -> xr.DataTree:
    """The sample of ``result`` in the groups of ArviZ; ``arviz.from_netcdf`` opens its ``netcdf_bytes``.

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
    posterior, pointwise = result.posterior, result.pointwise
    if posterior is None:
        raise ValueError("nothing was sampled (point fit only): fit without --no-sample (budget=None)")
    # Exact masses and g need no row in the tables of the result.
    units = {symbol: row.unit for symbol, row in TABLE.items()}
    for frame in (result.summary, result.nuisances):
        units |= {str(name): str(unit) for name, unit in frame["unit"].items()}
    ensembles, draws, walkers, _ = posterior.draws.shape
    chains = ensembles * walkers
    chain = {"chain": np.arange(chains), "draw": np.arange(draws)}
    chain |= {"ensemble": ("chain", np.repeat(np.arange(ensembles), walkers))}
    # Exact masses stand among the draws as constants, so that whoever computes with draws has them all in one place.
    columns = dict(zip(posterior.names, np.moveaxis(_by_chain(posterior.draws), -1, 0), strict=True))
    columns |= {name: np.full((chains, draws), value, np.float64) for name, value in result.fixed.items()}
    about_lp = {"units": "1", "meaning": "log-posterior density, unconstrained space"}
    about_acceptance = {"units": "1", "meaning": "share of accepted proposals of the walker"}
    stats = {
        "lp": (("chain", "draw"), _by_chain(posterior.lp), about_lp),
        "acceptance": ("chain", posterior.acceptance.reshape(chains).astype(np.float64), about_acceptance),
    }
    groups = {
        "posterior": _families(columns, units, result.fixed).assign_coords(chain),
        "sample_stats": xr.Dataset(stats, chain),
        "observed_data": _readings(result.observed, ()),
        "prior": _families({name: values[np.newaxis] for name, values in result.prior.items()}, units),
    }
    if pointwise is not None:
        thinned = {"chain": pointwise.chain[:: pointwise.thin], "draw": pointwise.draw[:: pointwise.thin]}
        replicates = _readings(pointwise.replicates, ("chain", "draw")).assign_attrs(thin=pointwise.thin)
        groups |= {
            "log_likelihood": _log_likelihood(pointwise),
            "posterior_predictive": replicates.assign_coords(thinned),
        }
    tree = xr.DataTree.from_dict({name: group for name, group in groups.items() if group.data_vars})
    tree.attrs = {"rig": result.rig.name, "synthetic": int(result.rig.synthetic)}
    return tree


def _by_chain(values: np.ndarray) -> np.ndarray:
    """(ensemble, draw, walker, ...) as (chain, draw, ...)."""
    return np.swapaxes(values, 1, 2).reshape(-1, values.shape[1], *values.shape[3:]).astype(np.float64)


def _by_walker(values: np.ndarray, walkers: int) -> np.ndarray:
    """The inverse of ``_by_chain``."""
    return values.reshape(-1, walkers, *values.shape[1:]).swapaxes(1, 2)


def read_sample(path: Path, saved: Posterior) -> tuple[Posterior, dict[str, np.ndarray], Pointwise | None]:
    """The arrays of ``posterior.nc``: ``saved`` with its draws, the prior draws by name, the pointwise values.

    Raises
    ------
    Exception
        Of any kind, if the file is absent, damaged, or another fit wrote it.
    """
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    columns, walkers = _members_of(tree["posterior"].to_dataset()), saved.acceptance.shape[1]
    draws = _by_walker(np.stack([columns[name] for name in saved.names], axis=-1), walkers)
    posterior = replace(saved, draws=draws, lp=_by_walker(tree["sample_stats"]["lp"].to_numpy(), walkers))
    prior = _members_of(tree["prior"].to_dataset()) if "prior" in tree else {}
    prior = {name: values[0] for name, values in prior.items()}
    if "log_likelihood" not in tree:
        return posterior, prior, None
    density, replicates = tree["log_likelihood"]["readings"], tree["posterior_predictive"].to_dataset()
    of, rows = density["experiment"].to_numpy(), density["row"].to_numpy()
    by_label = {str(values.attrs["experiment"]): values.to_numpy() for values in replicates.data_vars.values()}
    pointwise = Pointwise(
        {label: density.to_numpy()[..., of == label] for label in by_label},
        {label: rows[of == label] for label in by_label},
        by_label,
        density["chain"].to_numpy(),
        density["draw"].to_numpy(),
        int(replicates.attrs["thin"]),
    )
    return posterior, prior, pointwise


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


def _families(arrays: Mapping[str, np.ndarray], units: Mapping[str, str], fixed: Container[str] = ()) -> xr.Dataset:
    """Variables (chain, draw) by name; names with brackets are stacked along the dimension of their family."""
    families: defaultdict[str, dict[str, np.ndarray]] = defaultdict(dict)
    for name, values in arrays.items():
        base, _, of = name.partition("[")
        families[base][of[:-1]] = values
    dataset = xr.Dataset()
    for base, members in families.items():
        names = [f"{base}[{of}]" if of else base for of in members]
        if base in names and len(names) > 1:
            raise ValueError(f"{base} is used both alone and as a family: {', '.join(names)}; rename one of them")
        # A symbol has one unit, so the first member's holds for all.
        about = {"units": units.get(names[0], ""), **({"fixed": 1} if all(name in fixed for name in names) else {})}
        if base in names:
            dataset[base] = (("chain", "draw"), members[""], about)
        else:
            dimension = _DIMENSIONS.get(base, f"{base}_of")
            dataset[base] = (("chain", "draw", dimension), np.stack(list(members.values()), axis=-1), about)
            dataset = dataset.assign_coords({dimension: list(members)})
    return dataset


def _members_of(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Variables (chain, draw) by name of the parameter; the inverse of ``_families``."""
    found: dict[str, np.ndarray] = {}
    for base, variable in dataset.data_vars.items():
        values = variable.to_numpy()
        if variable.ndim == 2:
            found[str(base)] = values
        else:
            members = variable[variable.dims[-1]].to_numpy()
            found |= {f"{base}[{of}]": values[..., i] for i, of in enumerate(members)}
    return found


# motion files: A simulated motion as a table: CSV with ``name [unit]`` headers, or NetCDF with units as attributes.


#: Unit and meaning by name; the time comes first.
COLUMNS = {
    "time": ("s", ""),
    "X1": ("m", "displacement of the rod"),
    "Y1": ("m/s", "velocity of the rod"),
    "X2": ("m", "displacement of the capsule"),
    "Y2": ("m/s", "velocity of the capsule"),
    "x_rel": ("m", "X1 - X2, positive towards the support spring"),
}


def write_motion(path: Path, columns: Mapping[str, np.ndarray], provenance: Mapping[str, float | str]) -> None:
    """Write the columns (n,), named as in ``COLUMNS``, to a ``.csv`` or ``.nc`` file; numbers keep all their digits.

    provenance : parameters and model; attributes of the NetCDF file (a CSV file holds the table alone)

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    if path.suffix == ".csv":
        table = pd.DataFrame({f"{name} [{COLUMNS[name][0]}]": values for name, values in columns.items()})
        replace_file(path, table.to_csv(index=False, lineterminator="\n"))
        return
    about = {name: {"units": unit, "long_name": meaning} for name, (unit, meaning) in COLUMNS.items()}
    about["time"] = {"units": "s"}
    data = {name: ("time", values, about[name]) for name, values in columns.items()}
    replace_file(path, netcdf_bytes(xr.Dataset(data, attrs=dict(provenance)).set_coords("time")))


# posterior file: ``posterior.nc`` read back: some draws.


def read_draws(path: Path, count: int, seed: int) -> dict[str, np.ndarray]:
    """``count`` draws, taken at random without repetition: name -> (count,), SI.

    Raises
    ------
    InputError
        No file of fit-params, or fewer draws than wanted.
    """
    rule, remedy = "--posterior takes the posterior.nc of a result", "give results/<rig>/posterior.nc"
    with (
        refusing_damage(rule, remedy, path, lambda error: type(error).__name__),
        xr.open_dataset(path, group="posterior", engine="h5netcdf") as data,
    ):
        size = data.sizes["chain"] * data.sizes["draw"]
        columns = _members_of(data)
    if not 1 <= count <= size:
        rule = "--draws must lie between 1 and the draws of the file"
        raise InputError(rule, str(count), f"give at most {size}", path)
    chosen = np.random.default_rng(seed).choice(size, count, replace=False)
    return {name: values.reshape(-1)[chosen] for name, values in columns.items()}
