"""The files of a result: written into an existing directory, and read back.

``figures/data.npz`` holds what the figures and tables are drawn from: a tree of frozen dataclasses becomes JSON; its arrays
are saved beside it. The draws stay in ``posterior.nc``.
"""

import hashlib
import io
import json
import math
import re
import sys
from collections import defaultdict
from collections.abc import Container, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
import pandas as pd
import xarray as xr

from capsule_id.console import one_line, refusing_damage
from capsule_id.errors import InputError, writing
from capsule_id.experiments.kind import Registry
from capsule_id.inference.result import Pointwise, Posterior, Result, held_leaves
from capsule_id.output import as_utf8, publish, work_in_progress, write_file
from capsule_id.parameters import TABLE, Name, refuse_another_law
from capsule_id.report.columns import columns_of, errors_left_out
from capsule_id.report.figures.style import own_style
from capsule_id.report.html import pictures, render
from capsule_id.report.messages import finding_text, messages_of, title_of

#: The file in the directory of a result, and the sample beside it.
SAVED, SAMPLE = Path("figures") / "data.npz", "posterior.nc"
_KEPT = tuple(field.name for field in fields(Result) if field.name != "registry")
_TREE, _DIGESTS = "tree", "digests"


def result_files(result: Result) -> dict[str, bytes]:
    """The files of a result by their paths: parameters.json, parameters.csv, posterior.nc (where there is a sample),
    report.html, figures/*.png and figures/data.npz.
    """
    with own_style():
        drawn = pictures(result)
    text = json.dumps(parameters_json(result), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    texts = {
        "report.html": render(result, drawn),
        "parameters.csv": table_frame(result).to_csv(lineterminator="\n"),
        "parameters.json": text,
    }
    sample = b"" if result.posterior is None else netcdf_bytes(data_tree(result))
    return {
        **{f"figures/{picture.name}.png": picture.png for picture in drawn},
        SAVED.as_posix(): saved_bytes(result, sample),
        **({SAMPLE: sample} if sample else {}),
        **{name: as_utf8(text) for name, text in texts.items()},
    }


def write_result(files: Mapping[str, bytes], directory: Path) -> None:
    """Write ``result_files`` into an existing directory.

    Raises
    ------
    OutputError
        If the operating system refuses.
    """
    needed = sum(map(len, files.values()))
    with writing(figures := directory / "figures"):
        figures.mkdir(exist_ok=True)
    for name, content in files.items():
        write_file(directory / name, content, needed)
        needed -= len(content)


def replace_result(files: Mapping[str, bytes], directory: Path, fingerprint: Mapping[str, object]) -> None:
    """Write ``result_files`` into a new directory, which then takes the place of ``directory``; see ``work_in_progress``."""
    with work_in_progress(directory, fingerprint, resume=False) as unfinished:
        write_result(files, unfinished)
        publish(unfinished, directory)


def parameters_json(result: Result) -> dict[str, object]:
    """The content of parameters.json, ready for strict JSON: what is missing or not finite is None."""
    provenance: Any = _plain(asdict(result.provenance))
    messages, columns = messages_of(result.registry), columns_of("json")
    return {
        "rig": result.rig.name,
        "synthetic": result.rig.synthetic,
        "trust": result.trust,
        "not_in_sd": errors_left_out(result.summary),
        "parameters": {
            str(name): {column.key: _plain(column.of(row)) for column in columns}
            for name, row in result.summary.to_dict("index").items()
        },
        "fixed": _constants(result, result.summary.index),
        "verdict": {
            "clean": result.clean,
            "findings": [
                {
                    "check": title_of(finding.code, messages),
                    "level": finding.level,
                    "text": finding_text(finding, messages),
                    "code": finding.code,
                    "experiment": finding.experiment,
                    "parameters": list(finding.parameters),
                }
                for finding in result.findings
            ],
        },
        "records": {
            record.name: {"label": record.view.label, "probability": _plain(record.view.probability)}
            for record in result.records
        },
        # Without date and command: the same seed gives the same file.
        "provenance": {key: value for key, value in provenance.items() if key != "made"},
    }


def model_json(result: Result, draws: Mapping[str, np.ndarray]) -> dict[str, object]:
    """The calibrated model, ready for strict JSON, SI: sampled physical parameters, their covariance, ``draws`` of them.

    ``templates/model.schema.json`` describes it. The covariance has the correlations of the sample and the quoted sds.
    """
    posterior: Any = result.posterior
    names = [str(name) for name in result.summary.index if name in posterior.names]
    own = result.summary.loc[names]
    columns = np.stack([posterior.draws[..., posterior.names.index(name)].ravel() for name in names])
    sd = own["sd"].to_numpy(float)
    content = {
        "format": "capsule-id model 1",
        "rig": result.rig.name,
        "synthetic": result.rig.synthetic,
        "trust": result.trust,
        "model": asdict(result.rig.model) | {"friction_law": result.provenance.friction},
        "parameters": [
            {"name": name, **{key: own.at[name, key] for key in ("unit", "value", "sd", "trust", "widening")}}
            for name in names
        ],
        "fixed": {name: x for name, x in _constants(result, names).items() if x is not None},
        "covariance": np.atleast_2d(np.corrcoef(columns)) * np.outer(sd, sd),
        "draws": np.column_stack([draws[name] for name in names]),
    }
    return {key: _plain(value) for key, value in content.items()}


def _constants(result: Result, sampled: Container[str]) -> dict[str, float | None]:
    """Constants of the folder by name, SI, without those that were ``sampled``; None where its runs have several."""
    return {name: x for name, x in {**held_leaves(result.rig), **result.fixed}.items() if name not in sampled}


def table_frame(result: Result) -> pd.DataFrame:
    """Physical parameters and nuisances in one table, SI; ``role`` separates them, every row says ``synthetic``."""
    table = pd.concat([part for part in (result.summary, result.nuisances) if len(part)]).rename_axis("name")
    rows = table.to_dict("index")
    columns = {column.key: [column.of(row) for row in rows.values()] for column in columns_of("csv")}
    roles = ["physical"] * len(result.summary) + ["nuisance"] * len(result.nuisances)
    return table.assign(**columns, role=roles, synthetic=result.rig.synthetic)


def _plain(value: object) -> object:
    """``value`` in the types of JSON: arrays and tuples as lists, NumPy scalars as Python's, not finite as None."""
    match value:
        case Mapping():
            return {str(key): _plain(item) for key, item in value.items()}
        case np.ndarray() | np.generic():
            return _plain(value.tolist())
        case Sequence() if not isinstance(value, str | bytes):
            return [_plain(item) for item in value]
        case float():
            return value if math.isfinite(value) else None
        case None | bool() | int():
            return value
    return None if value is pd.NA else str(value)


# saved: ``figures/data.npz``, written and read back.


def saved_bytes(result: Result, sample: bytes) -> bytes:
    """The content of ``SAVED``, with digests of itself and of ``sample``, the content of ``SAMPLE``.

    The registry is not saved.
    """
    posterior = result.posterior
    if posterior is not None:
        posterior = replace(posterior, draws=np.zeros(0), lp=np.zeros(0))
    light = replace(result, pointwise=None, prior={}, posterior=posterior)
    arrays: dict[str, Any] = {}
    text = json.dumps(_encode({name: getattr(light, name) for name in _KEPT}, arrays)).encode("utf-8")
    arrays[_TREE] = np.frombuffer(text, np.uint8)
    arrays[_DIGESTS] = np.array([_digest(arrays), hashlib.sha256(sample).hexdigest()])
    np.savez_compressed(content := io.BytesIO(), **arrays)
    return content.getvalue()


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Digest of names and values."""
    one = {name: (str(x.dtype), x.shape, hashlib.sha256(x.tobytes()).hexdigest()) for name, x in arrays.items()}
    return hashlib.sha256(repr(one).encode()).hexdigest()


def load_fields(directory: Path, registry: Registry) -> dict[str, Any]:
    """The fields of the ``Result`` that ``write_result`` wrote into ``directory``.

    Raises
    ------
    InputError
        If ``directory`` holds no result, one that another version wrote, or a file that has changed since.
    """
    roots = {"capsule_id", *(kind.settings.__module__.partition(".")[0] for kind in registry.kinds)}
    with _reading(directory / SAVED):
        # From bytes: NumPy leaves a damaged file open.
        arrays = dict(np.load(io.BytesIO((directory / SAVED).read_bytes()), allow_pickle=False))
        own, of_sample = arrays.pop(_DIGESTS).tolist()
        _check(own, _digest(arrays))
        kept = _decode(json.loads(arrays[_TREE].tobytes().decode("utf-8")), arrays, roots)
        posterior = {name: kept[name] for name in _KEPT}["posterior"]
    if posterior is not None:
        with _reading(directory / SAMPLE):
            _check(of_sample, hashlib.sha256((directory / SAMPLE).read_bytes()).hexdigest())
            posterior, prior, pointwise = read_sample(directory / SAMPLE, posterior)
            kept |= {"posterior": posterior, "prior": prior, "pointwise": pointwise}
    return {**kept, "registry": registry}


def _check(stated: str, found: str) -> None:
    if stated != found:
        raise ValueError("it has changed since it was written")


def _reading(path: Path) -> AbstractContextManager[None]:
    """Any error is one of ``path``, a file of a result: it is absent, damaged, or another version wrote it."""

    def shown(error: Exception) -> str:
        absent = isinstance(error, FileNotFoundError | NotADirectoryError)
        return f"it has no {path.name}" if absent else one_line(error)

    rule = "a result must be a directory that this version of fit-params wrote"
    return refusing_damage(rule, "run fit-params again", path, shown)


def _encode(value: object, arrays: dict[str, np.ndarray]) -> Any:
    """``value`` for JSON. Dicts of one entry tag what JSON does not know; arrays go to ``arrays``."""

    def inner(item: object) -> Any:
        return _encode(item, arrays)

    match value:
        case np.generic():
            return inner(value.item())
        case None | bool() | int() | float() | str():
            return value
        case np.ndarray() if value.dtype != object:
            name = f"a{len(arrays)}"
            arrays[name] = value
            return {"array": name}
        case Path():
            return {"path": value.as_posix()}
        case pd.DataFrame():
            index = None if isinstance(value.index, pd.RangeIndex) else inner(value.index.tolist())
            columns = [[inner(name), str(column.dtype), inner(column.tolist())] for name, column in value.items()]
            rest = {"name": inner(value.index.name), "rows": len(value), "columns": columns}
            return {"frame": {"index": index, **rest}}
        case _ if is_dataclass(value) and not isinstance(value, type):
            kind = type(value)
            return {
                "object": [
                    kind.__module__,
                    kind.__qualname__,
                    {field.name: inner(getattr(value, field.name)) for field in fields(value)},
                ]
            }
        case Mapping():
            return {"map": [[inner(key), inner(item)] for key, item in value.items()]}
        case list():
            return [inner(item) for item in value]
        case Sequence() | np.ndarray():
            return {"tuple": [inner(item) for item in value]}
    return str(value)  # a fact of another type: its text is all that a message needs


def _decode(node: Any, arrays: Mapping[str, np.ndarray], roots: set[str]) -> Any:
    """The inverse of ``_encode``. Classes come from the packages ``roots`` only."""

    def inner(item: Any) -> Any:
        return _decode(item, arrays, roots)

    match node:
        case list():
            return [inner(item) for item in node]
        case {"array": name}:
            values = arrays[name]
            values.setflags(write=False)
            return values
        case {"path": path}:
            return Path(path)
        case {"frame": {"index": index, "name": name, "rows": rows, "columns": columns}}:
            labels = pd.RangeIndex(rows) if index is None else pd.Index(inner(index))
            read = {inner(key): pd.Series(inner(values), labels, dtype) for key, dtype, values in columns}
            return pd.DataFrame(read, labels).rename_axis(inner(name))
        case {"object": [*names, own]}:
            return _class(names, roots)(**{key: inner(part) for key, part in own.items()})
        case {"map": pairs}:
            return {inner(key): inner(part) for key, part in pairs}
        case {"tuple": parts}:
            return tuple(inner(part) for part in parts)
        case dict():
            raise ValueError(f"unknown tag {', '.join(node)}")
    return node


def _class(names: Sequence[str], roots: set[str]) -> Any:
    """A dataclass by its module and its name."""
    module, name = names
    if module.partition(".")[0] not in roots:
        raise ValueError(f"class {module}.{name} belongs to no package of this result")
    kind = getattr(import_module(module), name)
    if not is_dataclass(kind):
        raise ValueError(f"{module}.{name} is no dataclass")
    return kind


# netcdf: ``posterior.nc``: the sample in the groups and dimensions that ArviZ knows.


# Of an array in a file; a higher level takes three times as long for a hundredth of the size.
_PACKED = {"zlib": True, "complevel": 2, "shuffle": True}
# The extra dimension of bracketed names; every other family gets "<base>_of".
_DIMENSIONS = {"k2": "spring"}


def netcdf_bytes(data: xr.DataTree | xr.Dataset) -> bytes:
    """``data`` as a netCDF file (h5netcdf). It is made in memory: HDF5 ends the process where the disk is full.

    The arrays of a tree are compressed without loss: a walker that stays repeats its draw.
    """
    packed, file, dask = None, io.BytesIO(), cast(Any, sys.modules.get("dask"))
    if isinstance(data, xr.DataTree):
        arrays = {node.path: [name for name, own in node.data_vars.items() if own.size > 1] for node in data.subtree}
        packed = {path: {name: dict(_PACKED) for name in names} for path, names in arrays.items()}
    # Beside a cluster xarray would ask Dask for a lock, which only a file with a name can have.
    with nullcontext() if dask is None else dask.config.set(scheduler="synchronous"):
        cast(Any, data).to_netcdf(file, engine="h5netcdf", encoding=packed)
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
        If nothing was sampled.
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
    chain = {
        "chain": np.arange(chains),
        "draw": np.arange(draws),
        "ensemble": ("chain", np.repeat(np.arange(ensembles), walkers)),
    }
    # Exact masses stand among the draws as constants, so that whoever computes with draws has them all in one place.
    columns = dict(zip(posterior.names, np.moveaxis(_by_chain(posterior.draws), -1, 0), strict=True))
    stated = _constants(result, columns)
    held = {name: x for name in ("reaction", "slope", "N0", "lag", "ratio", "v_s") if (x := stated.get(name))}
    held |= result.fixed
    columns |= {name: np.full((chains, draws), value, np.float64) for name, value in held.items()}
    about_lp = {"units": "1", "meaning": "log-posterior density, unconstrained space"}
    about_acceptance = {"units": "1", "meaning": "share of accepted proposals of the walker"}
    stats = {
        "lp": (("chain", "draw"), _by_chain(posterior.lp), about_lp),
        "acceptance": ("chain", posterior.acceptance.reshape(chains).astype(np.float64), about_acceptance),
    }
    groups = {
        "posterior": _families(columns, units, held).assign_coords(chain),
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
    tree.attrs = {
        "rig": result.rig.name,
        "synthetic": int(result.rig.synthetic),
        "friction": result.provenance.friction,
    }
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
    # xarray takes four times as long.
    with h5py.File(path) as file:
        tree: Any = file
        columns, walkers = _members_of(tree["posterior"]), saved.acceptance.shape[1]
        draws = _by_walker(np.stack([columns[name] for name in saved.names], axis=-1), walkers)
        posterior = replace(saved, draws=draws, lp=_by_walker(tree["sample_stats/lp"][()], walkers))
        prior = _members_of(tree["prior"]) if "prior" in tree else {}
        prior = {name: values[0] for name, values in prior.items()}
        if "log_likelihood" not in tree:
            return posterior, prior, None
        group, replicates = tree["log_likelihood"], tree["posterior_predictive"]
        made = [values for values in replicates.values() if "experiment" in values.attrs]
        made.sort(key=lambda values: int(re.findall(r"/y(\d+)_", values.name)[0]))
        by_label = {str(values.attrs["experiment"]): values[()] for values in made}
        of, rows, density = group["experiment"].asstr()[()], group["row"][()], group["readings"][()]
        pointwise = Pointwise(
            {label: density[..., of == label] for label in by_label},
            {label: rows[of == label] for label in by_label},
            by_label,
            group["chain"][()],
            group["draw"][()],
            replicates.attrs["thin"].item(),
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
    """Variables (chain, draw) by name; names with brackets are stacked along the dimension of their family.

    There "" is the one without a bracket: the slope of the rig beside that of one table.
    """
    families: defaultdict[str, dict[str, np.ndarray]] = defaultdict(dict)
    for name, values in arrays.items():
        base, of = Name.parse(name)
        families[base][of] = values
    dataset = xr.Dataset()
    for base, members in families.items():
        names = [str(Name(base, of)) for of in members]
        # A symbol has one unit, so the first member's holds for all.
        about = {"units": units.get(names[0], ""), **({"fixed": 1} if all(name in fixed for name in names) else {})}
        if names == [base]:
            dataset[base] = (("chain", "draw"), members[""], about)
        else:
            dimension = _DIMENSIONS.get(base, f"{base}_of")
            dataset[base] = (("chain", "draw", dimension), np.stack(list(members.values()), axis=-1), about)
            dataset = dataset.assign_coords({dimension: list(members)})
    return dataset


def _members_of(group: Any) -> dict[str, np.ndarray]:
    """Variables (chain, draw) of an HDF5 group by name of the parameter; the inverse of ``_families``."""
    found: dict[str, np.ndarray] = {}
    for base, variable in group.items():
        if variable.ndim == 2:
            found[base] = variable[()]
        elif variable.ndim > 2:
            members = group[_DIMENSIONS.get(base, f"{base}_of")].asstr()[()]
            found |= {
                str(Name(base, of)): values
                for of, values in zip(members, np.moveaxis(variable[()], -1, 0), strict=True)
            }
    return found


def read_draws(path: Path, count: int, seed: int) -> dict[str, np.ndarray]:
    """``count`` draws, taken at random without repetition: name -> (count,), SI.

    Raises
    ------
    InputError
        No file of fit-params, one of another friction law, or fewer draws than wanted.
    """
    rule, remedy = "--posterior takes the posterior.nc of a result", "give results/<rig>/posterior.nc"
    with (
        refusing_damage(rule, remedy, path, lambda error: type(error).__name__),
        h5py.File(path) as file,
    ):
        columns = _members_of(file["posterior"])
        size = next(iter(columns.values())).size
        law = str(file.attrs.get("friction", "eq. (1)"))
    refuse_another_law(law, path)
    if not 1 <= count <= size:
        raise InputError(
            "--draws must lie between 1 and the draws of the file", str(count), f"give at most {size}", path
        )
    chosen = np.random.default_rng(seed).choice(size, count, replace=False)
    return {name: values.reshape(-1)[chosen] for name, values in columns.items()}
