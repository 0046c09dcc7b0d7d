"""``figures/data.npz``: what the figures and tables of a result are drawn from, so that the result can be loaded again.

A tree of frozen dataclasses becomes JSON; its arrays are saved beside it. The draws stay in ``posterior.nc``.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.console import one_line
from capsule_id.errors import InputError
from capsule_id.experiments.kind import Registry
from capsule_id.inference.result import Result
from capsule_id.report.netcdf import read_sample

#: The file in the directory of a result, and the sample beside it.
SAVED, SAMPLE = Path("figures") / "data.npz", "posterior.nc"
_KEPT = tuple(field.name for field in fields(Result) if field.name != "registry")
_TREE, _DIGESTS = "tree.npy", "digests"


def saved_bytes(result: Result, sample: bytes) -> bytes:
    """The content of ``SAVED``, with digests of itself and of ``sample``, the content of ``SAMPLE``.

    The registry is not saved.
    """
    posterior = result.posterior
    if posterior is not None:
        posterior = replace(posterior, draws=np.zeros(0), lp=np.zeros(0))
    light = replace(result, pointwise=None, prior={}, posterior=posterior)
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(_encode({name: getattr(light, name) for name in _KEPT}, arrays)).encode("utf-8")
    members = {f"{name}.npy": _npy(values) for name, values in arrays.items()}
    members[_TREE] = _npy(np.frombuffer(text, np.uint8))
    digests = f"{_digest(members)}\n{hashlib.sha256(sample).hexdigest()}"
    with zipfile.ZipFile(content := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in (members | {_DIGESTS: digests.encode()}).items():
            with file.open(name, "w", force_zip64=True) as member:
                member.write(data)
    return content.getvalue()


def _npy(values: np.ndarray) -> bytes:
    np.lib.format.write_array(content := io.BytesIO(), values, allow_pickle=False)
    return content.getvalue()


def _digest(members: Mapping[str, bytes]) -> str:
    """Digest of names and contents."""
    one = {name: hashlib.sha256(data).hexdigest() for name, data in members.items()}
    return hashlib.sha256(repr(one).encode()).hexdigest()


def load(directory: Path, registry: Registry) -> dict[str, Any]:
    """The fields of the ``Result`` that ``write_result`` wrote into ``directory``.

    Raises
    ------
    InputError
        If ``directory`` holds no result, one that another version wrote, or a file that has changed since.
    """
    roots = {"capsule_id", *(kind.settings.__module__.partition(".")[0] for kind in registry.kinds)}
    with _reading(directory / SAVED), zipfile.ZipFile(directory / SAVED) as file:
        members = {name: file.read(name) for name in file.namelist()}
        own, of_sample = members.pop(_DIGESTS).decode().split("\n")
        _check(own, _digest(members))
        arrays = {Path(name).stem: np.load(io.BytesIO(data), allow_pickle=False) for name, data in members.items()}
        kept = _decode(json.loads(arrays[Path(_TREE).stem].tobytes().decode("utf-8")), arrays, roots)
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


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Any error is one of ``path``, a file of a result: it is absent, damaged, or another version wrote it."""
    try:
        yield
    except Exception as error:
        absent = isinstance(error, FileNotFoundError | NotADirectoryError)
        rule = "a result must be a directory that this version of fit-params wrote"
        value = f"it has no {path.name}" if absent else one_line(error)
        raise InputError(rule, value, "run fit-params again", path) from error


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
