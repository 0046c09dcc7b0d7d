"""``figures/data.npz``: what the figures and tables of a result are drawn from, so that the result can be loaded again.

A tree of frozen dataclasses becomes JSON; its arrays are saved beside it. The draws stay in ``posterior.nc``.
"""

import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Registry
from capsule_id.inference.result import Result
from capsule_id.report.netcdf import read_sample

#: The file in the directory of a result, and the sample beside it.
SAVED, SAMPLE = Path("figures") / "data.npz", "posterior.nc"
#: Errors of a file that is no result, or of another version.
READ_ERRORS = (OSError, KeyError, ValueError, TypeError, AttributeError, ImportError, zipfile.BadZipFile)
_TREE = "tree"


def save(result: Result, directory: Path) -> None:
    """Write ``SAVED`` into ``directory``, which has a folder ``figures``. The registry is not saved."""
    light = replace(result, pointwise=None, prior={}, posterior=_without_draws(result))
    arrays: dict[str, np.ndarray] = {}
    kept = {field.name: getattr(light, field.name) for field in fields(Result) if field.name != "registry"}
    text = json.dumps(_encode(kept, arrays)).encode("utf-8")
    arrays[_TREE] = np.frombuffer(text, np.uint8)
    with zipfile.ZipFile(directory / SAVED, "w", zipfile.ZIP_DEFLATED) as file:
        for name, values in arrays.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def load(directory: Path, registry: Registry) -> dict[str, Any]:
    """The fields of the ``Result`` that ``save`` and ``write_posterior`` wrote into ``directory``.

    Raises
    ------
    InputError
        If ``directory`` holds no result, or one that another version wrote.
    """
    roots = {"capsule_id", *(kind.settings.__module__.partition(".")[0] for kind in registry.kinds)}
    try:
        with np.load(directory / SAVED, allow_pickle=False) as arrays:
            kept = _decode(json.loads(arrays[_TREE].tobytes().decode("utf-8")), arrays, roots)
        if kept["posterior"] is not None:
            posterior, prior, pointwise = read_sample(directory / SAMPLE, kept["posterior"])
            kept |= {"posterior": posterior, "prior": prior, "pointwise": pointwise}
    except READ_ERRORS as error:
        rule = "a result must be a directory that this version of fit-params wrote"
        absent = isinstance(error, FileNotFoundError | NotADirectoryError)
        value = f"it has no {Path(str(error.filename)).name}" if absent else f"{type(error).__name__}: {error}"
        raise InputError(rule, value, "run fit-params again", directory) from error
    return {**kept, "registry": registry}


def _without_draws(result: Result) -> Any:
    nothing = np.zeros(0)
    return None if result.posterior is None else replace(result.posterior, draws=nothing, lp=nothing)


def _encode(value: object, arrays: dict[str, np.ndarray]) -> Any:
    """``value`` for JSON. Dicts of one entry tag what JSON does not know; arrays go to ``arrays``."""

    def inner(item: object) -> Any:
        return _encode(item, arrays)

    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        arrays[f"a{len(arrays)}"] = value
        return {"array": f"a{len(arrays) - 1}"}
    if isinstance(value, Path):
        return {"path": value.as_posix()}
    if isinstance(value, pd.DataFrame):
        return {"frame": _parts_of_frame(value, inner)}
    if isinstance(value, type):
        return {"class": [value.__module__, value.__qualname__]}
    if is_dataclass(value):
        kind = type(value)
        own = {field.name: inner(getattr(value, field.name)) for field in fields(value)}
        return {"object": [kind.__module__, kind.__qualname__, own]}
    if isinstance(value, Mapping):
        return {"map": [[inner(key), inner(item)] for key, item in value.items()]}
    if isinstance(value, list):
        return [inner(item) for item in value]
    if isinstance(value, Sequence | np.ndarray):
        return {"tuple": [inner(item) for item in value]}
    return str(value)  # a fact of another type: its text is all that a message needs


def _decode(node: Any, arrays: Mapping[str, np.ndarray], roots: set[str]) -> Any:
    """The inverse of ``_encode``. Classes come from the packages ``roots`` only."""

    def inner(item: Any) -> Any:
        return _decode(item, arrays, roots)

    if isinstance(node, list):
        return [inner(item) for item in node]
    if not isinstance(node, dict):
        return node
    ((tag, item),) = node.items()
    readers: dict[str, Callable[[Any], Any]] = {
        "class": lambda names: _class(names, roots),
        "object": lambda names: _class(names[:2], roots)(**{key: inner(part) for key, part in names[2].items()}),
        "array": lambda name: _read_only(arrays[name]),
        "path": Path,
        "frame": lambda parts: _frame(parts, inner),
        "map": lambda pairs: {inner(key): inner(part) for key, part in pairs},
        "tuple": lambda parts: tuple(inner(part) for part in parts),
    }
    return readers[tag](item)


def _class(names: Sequence[str], roots: set[str]) -> Any:
    """A dataclass by its module and its name."""
    module, name = names
    if module.partition(".")[0] not in roots:
        raise ValueError(f"class {module}.{name} belongs to no package of this result")
    kind = getattr(import_module(module), name)
    if not is_dataclass(kind):
        raise ValueError(f"{module}.{name} is no dataclass")
    return kind


def _read_only(values: np.ndarray) -> np.ndarray:
    values.setflags(write=False)
    return values


def _parts_of_frame(frame: pd.DataFrame, inner: Callable[[object], Any]) -> dict[str, Any]:
    index = None if isinstance(frame.index, pd.RangeIndex) else inner(frame.index.tolist())
    columns = [[inner(name), str(column.dtype), inner(column.tolist())] for name, column in frame.items()]
    return {"index": index, "name": inner(frame.index.name), "rows": len(frame), "columns": columns}


def _frame(parts: Mapping[str, Any], inner: Callable[[Any], Any]) -> pd.DataFrame:
    index = pd.RangeIndex(parts["rows"]) if parts["index"] is None else pd.Index(inner(parts["index"]))
    columns = {
        inner(name): pd.Series(inner(values), index=index, dtype=dtype) for name, dtype, values in parts["columns"]
    }
    return pd.DataFrame(columns, index=index).rename_axis(inner(parts["name"]))
