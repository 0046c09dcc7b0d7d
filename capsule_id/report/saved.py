"""``figures/data.npz``: what the figures and tables of a result are drawn from, so that the result can be loaded again.

A tree of frozen dataclasses becomes JSON; its arrays are saved beside it. The draws stay in ``posterior.nc``.
"""

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
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


def saved_bytes(result: Result) -> bytes:
    """The content of ``SAVED``. The registry is not saved."""
    posterior = result.posterior
    if posterior is not None:
        posterior = replace(posterior, draws=np.zeros(0), lp=np.zeros(0))
    light = replace(result, pointwise=None, prior={}, posterior=posterior)
    arrays: dict[str, np.ndarray] = {}
    kept = {field.name: getattr(light, field.name) for field in fields(Result) if field.name != "registry"}
    text = json.dumps(_encode(kept, arrays)).encode("utf-8")
    arrays[_TREE] = np.frombuffer(text, np.uint8)
    with zipfile.ZipFile(content := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as file:
        for name, values in arrays.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)
    return content.getvalue()


def load(directory: Path, registry: Registry) -> dict[str, Any]:
    """The fields of the ``Result`` that ``write_result`` wrote into ``directory``.

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
        case type():
            return {"class": [value.__module__, value.__qualname__]}
        case _ if is_dataclass(value):
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
        case {"class": names}:
            return _class(names, roots)
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
