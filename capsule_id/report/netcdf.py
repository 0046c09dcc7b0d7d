"""``posterior.nc``: the sample in the groups and dimensions that ArviZ knows."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from capsule_id.inference.result import PointwiseLogLikelihood, Posterior, Result
from capsule_id.parameters import TABLE

# The extra dimension of bracketed names; every other family gets "<base>_of".
_DIMENSIONS = {"k2": "spring"}


def write_posterior(result: Result, path: Path) -> None:
    """Write the sample of ``result`` as netCDF (h5netcdf), to be opened by ``arviz.from_netcdf``.

    Groups: ``posterior`` and ``sample_stats`` (dimensions ``chain``: every walker of every ensemble, with the
    coordinate ``ensemble``; and ``draw``), ``observed_data``, ``log_likelihood`` and ``prior`` where the result has
    them. A family of names such as ``k2[soft]``, ``k2[stiff]`` is one variable with one dimension more.

    Raises
    ------
    ValueError
        If nothing was sampled, or a name is used both alone and as a family.
    """
    if result.posterior is None:
        raise ValueError("nothing was sampled (point fit only): there is no posterior to write")
    # Exact masses and g need no row in the tables of the result.
    units = {symbol: row.unit for symbol, row in TABLE.items()}
    for frame in (result.summary, result.nuisances):
        units |= {str(name): str(unit) for name, unit in frame["unit"].items()}
    groups = {
        "posterior": _posterior(result.posterior, result.fixed, units),
        "sample_stats": _sample_stats(result.posterior),
        "observed_data": _observed(result.observed),
        "log_likelihood": _log_likelihood(result.log_likelihood),
        "prior": _families({name: draws[np.newaxis] for name, draws in result.prior.items()}, units),
    }
    tree = xr.DataTree.from_dict({name: group for name, group in groups.items() if group.data_vars})
    tree.attrs = {"rig": result.rig.name, "synthetic": int(result.rig.synthetic)}
    tree.to_netcdf(path, engine="h5netcdf")


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


def _observed(observed: Mapping[str, np.ndarray]) -> xr.Dataset:
    return xr.Dataset(
        {label: (f"{label}_row", np.asarray(y, np.float64), {"units": "SI"}) for label, y in observed.items()}
    )


def _log_likelihood(pointwise: PointwiseLogLikelihood | None) -> xr.Dataset:
    if pointwise is None:
        return xr.Dataset()
    dataset = xr.Dataset(
        {
            label: (("chain", "draw", f"{label}_row"), np.asarray(values, np.float64), {"units": "1"})
            for label, values in pointwise.values.items()
        }
    )
    return dataset.assign_coords(chain=pointwise.chain, draw=pointwise.draw)


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


def _members(base: str, names: Mapping[str, np.ndarray]) -> set[str]:
    return {name for name in names if name == base or (name.startswith(f"{base}[") and name.endswith("]"))}
