"""The files of a result, and writing them into an existing directory."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.errors import writing
from capsule_id.inference.result import Result
from capsule_id.output import as_utf8, write_file
from capsule_id.report.columns import columns_of
from capsule_id.report.figures.style import own_style
from capsule_id.report.html import pictures, render
from capsule_id.report.messages import finding_text, messages_of, title_of
from capsule_id.report.netcdf import data_tree, netcdf_bytes
from capsule_id.report.saved import SAMPLE, SAVED, saved_bytes


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
