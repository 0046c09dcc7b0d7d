"""The files of a result: written into an existing directory, and read back.

``figures/data.npz`` holds what the figures and tables are drawn from: a tree of frozen dataclasses becomes JSON; its arrays
are saved beside it. The draws stay in ``posterior.nc``.
"""

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.console import one_line, refusing_damage
from capsule_id.errors import writing
from capsule_id.experiments.kind import Registry
from capsule_id.inference.result import Result
from capsule_id.output import as_utf8, write_file
from capsule_id.report.columns import columns_of
from capsule_id.report.figures.style import own_style
from capsule_id.report.html import pictures, render
from capsule_id.report.messages import finding_text, messages_of, title_of
from capsule_id.report.netcdf import data_tree, netcdf_bytes, read_sample

#: The file in the directory of a result, and the sample beside it.
SAVED, SAMPLE = Path("figures") / "data.npz", "posterior.nc"
_KEPT = tuple(field.name for field in fields(Result) if field.name != "registry")
_TREE, _DIGESTS = "tree.npy", "digests"


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
    files = {f"figures/{picture.name}.png": picture.png for picture in drawn}
    files |= {SAVED.as_posix(): saved_bytes(result, sample)} | ({SAMPLE: sample} if sample else {})
    return files | {name: as_utf8(text) for name, text in texts.items()}


def write_result(files: Mapping[str, bytes], directory: Path) -> None:
    """Write ``result_files`` into an existing directory.

    Raises
    ------
    OutputError
        If the operating system refuses.
    """
    needed = sum(map(len, files.values()))
    with writing(directory):
        (directory / "figures").mkdir(exist_ok=True)
    for name, content in files.items():
        write_file(directory / name, content, needed)
        needed -= len(content)


def parameters_json(result: Result) -> dict[str, object]:
    """The content of parameters.json, ready for strict JSON: what is missing or not finite is None."""
    provenance: Any = _plain(asdict(result.provenance))
    messages, columns = messages_of(result.registry), columns_of("json")
    return {
        "rig": result.rig.name,
        "synthetic": result.rig.synthetic,
        "trust": result.trust,
        "parameters": {
            str(name): {column.key: _plain(column.of(row)) for column in columns}
            for name, row in result.summary.to_dict("index").items()
        },
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


def load_fields(directory: Path, registry: Registry) -> dict[str, Any]:
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
