"""Write a result as files into an existing directory."""

import json
import math
import numbers
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.inference.result import Result
from capsule_id.report.gallery import pictures
from capsule_id.report.html import render
from capsule_id.report.netcdf import write_posterior
from capsule_id.views import Finding


def write_result(result: Result, directory: Path) -> None:
    """Write parameters.json, parameters.csv, posterior.nc (where there is a sample), report.html and figures/*.png.

    Raises
    ------
    FileNotFoundError
        If ``directory`` does not exist: the caller makes and names it.
    """
    figures = directory / "figures"
    figures.mkdir(exist_ok=True)
    drawn = pictures(result)
    for picture in drawn:
        (figures / f"{picture.name}.png").write_bytes(picture.png)
    (directory / "report.html").write_text(render(result, drawn), encoding="utf-8")
    if result.posterior is not None:
        write_posterior(result, directory / "posterior.nc")
    table_frame(result).to_csv(directory / "parameters.csv", lineterminator="\n")
    text = json.dumps(parameters_json(result), indent=1, ensure_ascii=False, allow_nan=False)
    (directory / "parameters.json").write_text(text + "\n", encoding="utf-8")


def parameters_json(result: Result) -> dict[str, object]:
    """The content of parameters.json, ready for strict JSON: what is missing or not finite is None."""
    return {
        "rig": result.rig.name,
        "synthetic": result.rig.synthetic,
        "parameters": {str(name): _parameter(row) for name, row in result.summary.to_dict("index").items()},
        "verdict": {
            "clean": result.clean,
            "findings": [{"check": f.check, "level": f.level, "text": finding_text(f)} for f in result.findings],
        },
        "provenance": _plain(result.provenance),
    }


def finding_text(finding: Finding) -> str:
    """The text of a finding, with its experiment in front where the text does not name it itself."""
    if not finding.experiment or finding.experiment in finding.text:
        return finding.text
    return f"{finding.experiment}: {finding.text}"


def table_frame(result: Result) -> pd.DataFrame:
    """Physical parameters and nuisances in one table, SI; ``role`` tells them apart, every row says ``synthetic``."""
    parts = [result.summary.assign(role="physical"), result.nuisances.assign(role="nuisance")]
    frame = pd.concat([part for part in parts if len(part)])
    frame.index.name = "name"
    return frame.assign(synthetic=result.rig.synthetic)


def _parameter(row: Mapping[Hashable, Any]) -> dict[str, object]:
    ends = [_plain(row["lower"]), _plain(row["upper"])]
    return {
        "unit": row["unit"],
        **{key: _plain(row[key]) for key in ("paper", "map", "mean", "sd", "median")},
        "ci95": None if None in ends else ends,
        "ess": _plain(row["ess"]),
        "rhat": _plain(row["rhat"]),
        "informed": None if pd.isna(row["informed"]) else bool(row["informed"]),
    }


def _plain(value: object) -> object:
    """``value`` in the types of JSON: arrays and tuples as lists, NumPy scalars as Python's, not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | np.bool_):
        return None if value is None else bool(value)
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real):
        return float(value) if math.isfinite(value) else None
    return str(value)
