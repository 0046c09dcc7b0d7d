"""Parameter tables as strings: every number rounded to its uncertainty, once, for standard output and HTML alike."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from capsule_id.report.typography import MISSING, decimals_for, fixed, prefix_for


@dataclass(frozen=True)
class Row:
    """One parameter, every number a string; ``informed`` is "yes", "no", "weighed", or "" where nothing was sampled."""

    name: str
    unit: str
    meaning: str
    paper: str
    map: str
    mean: str
    median: str
    interval: str
    ess: str
    rhat: str
    informed: str


def plus_minus(value: float, sd: float, decimals: int | None) -> str:
    """``1421.3 ± 3.1``; the value alone where there is no sd."""
    centre = fixed(value, decimals)
    return centre if centre == MISSING or decimals_for(sd) is None else f"{centre} ± {fixed(sd, decimals)}"


def table_rows(frame: pd.DataFrame) -> list[Row]:
    """The rows of ``Result.summary`` or ``Result.nuisances``, in their order.

    All numbers of a row keep two digits of the posterior sd (without a sample: of the standard error), the point fit
    those of its own standard error. Values far from 1 carry a decimal prefix on the unit (µm instead of m).
    """
    return [_row(str(name), row) for name, row in frame.to_dict("index").items()]


def has_sample(frame: pd.DataFrame) -> bool:
    """Whether any parameter of the table was sampled."""
    return bool(frame["mean"].notna().any())


def _row(name: str, row: Mapping[Hashable, Any]) -> Row:
    scale, unit = prefix_for(str(row["unit"]), float(row["map"]))

    def number(column: str) -> float:
        return float(row[column]) * scale

    sd, standard_error = number("sd"), number("standard_error")
    point_decimals = decimals_for(standard_error)
    decimals = decimals_for(sd)
    decimals = point_decimals if decimals is None else decimals
    lower, upper = fixed(number("lower"), decimals), fixed(number("upper"), decimals)
    return Row(
        name=name,
        unit=unit,
        meaning=str(row["meaning"]),
        paper=fixed(number("paper"), decimals),
        map=plus_minus(number("map"), standard_error, decimals if point_decimals is None else point_decimals),
        mean=plus_minus(number("mean"), sd, decimals),
        median=fixed(number("median"), decimals),
        interval=MISSING if MISSING in (lower, upper) else f"{lower} to {upper}",
        ess=fixed(float(row["ess"]), 0),
        rhat=fixed(float(row["rhat"]), 3),
        informed=_informed(name, row["informed"]),
    )


def _informed(name: str, informed: object) -> str:
    """Masses read "weighed": their prior is the weighing, so data that do not narrow it further are normal."""
    if informed is None or informed != informed:  # NaN
        return ""
    if informed:
        return "yes"
    return "weighed" if name in ("m1", "m2") else "no"
