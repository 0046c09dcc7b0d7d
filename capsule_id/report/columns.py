"""The columns of a parameter table, declared once for parameters.json, parameters.csv, the page and standard output.

All numbers of a row keep two digits of the posterior sd (without a sample: of the standard error), the point fit those
of its own standard error. Values far from 1 carry a decimal prefix on the unit (µm instead of m); all rows of a symbol
(G[run_1], G[run_2]) have the same unit.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pandas as pd

from capsule_id.parameters import is_stated, symbol_of
from capsule_id.report.typography import MISSING, decimals_for, fixed, prefix_for

Output = Literal["json", "csv", "html", "console"]
FILES: frozenset[Output] = frozenset({"json", "csv"})
EVERYWHERE: frozenset[Output] = FILES.union({"html", "console"})


@dataclass(frozen=True)
class Row:
    """A row of ``Result.summary`` or ``Result.nuisances`` and how its numbers are printed.

    Attributes
    ----------
    values : SI, by column of the table
    scale, unit : factor and unit of the printed numbers
    decimals, point_decimals : of the sample's numbers, and of those of the point fit; None: six digits
    """

    name: str
    values: Mapping[Hashable, Any]
    scale: float
    unit: str
    decimals: int | None
    point_decimals: int | None

    def number(self, column: str, decimals: int | None = None) -> str:
        """One number in the printed unit, by default with the row's decimals."""
        return fixed(float(self.values[column]) * self.scale, self.decimals if decimals is None else decimals)

    def plus_minus(self, column: str, error: str, decimals: int | None) -> str:
        """``1421.3 ± 3.1``; the value alone where there is no error."""
        centre = self.number(column, decimals)
        known = centre != MISSING and decimals_for(float(self.values[error])) is not None
        return f"{centre} ± {self.number(error, decimals)}" if known else centre

    @property
    def skewed(self) -> bool:
        """Whether the interval describes the value, and its sd does not."""
        return self.values["quote"] == "interval"

    @property
    def ends(self) -> tuple[str, str]:
        """The ends of the 95 % interval."""
        return self._printed("lower"), self._printed("upper")

    @property
    def quoted(self) -> str:
        """What to quote: ``1421.3 ± 3.1``, or ``5.8 (2.1 to 20.5)`` where the posterior is skewed."""
        if not self.skewed:
            return self.plus_minus("value", "sd", self.decimals)
        return f"{self._printed('value')} ({' to '.join(self.ends)})"

    def _printed(self, column: str) -> str:
        """A number with the row's decimals; of a skewed posterior with two digits of the short arm and of itself."""
        if not self.skewed:
            return self.number(column)
        value, lower, upper = (float(self.values[name]) * self.scale for name in ("value", "lower", "upper"))
        least = decimals_for(min(value - lower, upper - value))
        own = decimals_for(abs(float(self.values[column]) * self.scale))
        return self.number(column, None if least is None or own is None else max(least, min(own, least + 2)))

    @property
    def concise(self) -> str:
        """Value and sd as ``1422.4(27) N/m``: the digits in parentheses count in the last place of the value."""
        if self.skewed:
            return self.quoted if self.unit == "1" else f"{self.quoted} {self.unit}"
        places = self.decimals
        centre, sd = self.number("value"), float(self.values["sd"]) * self.scale
        if places is None or decimals_for(sd) is None:
            return f"{centre} {self.unit}" if self.unit != "1" else centre
        digits = f"{sd:.0f}" if places <= 0 else f"{sd * 10.0**places:.0f}"
        return f"{centre}({fixed(float(digits), min(places, 0))})" + ("" if self.unit == "1" else f" {self.unit}")


def table_rows(frame: pd.DataFrame) -> list[Row]:
    """The rows of ``frame`` in their order."""
    rows = {str(name): values for name, values in frame.to_dict("index").items()}
    largest: dict[str, float] = {}
    for name, values in rows.items():
        symbol = symbol_of(name)
        largest[symbol] = max(largest.get(symbol, 0.0), magnitude(values))
    return [_row(name, values, largest[symbol_of(name)]) for name, values in rows.items()]


def magnitude(values: Mapping[Hashable, Any]) -> float:
    """Largest of the quoted numbers, SI: value and sd, or ends. The maximum, often far from them, counts without a value."""
    columns = ("value", "lower", "upper") if values["quote"] == "interval" else ("value", "sd")
    quoted = np.abs([float(values[column]) for column in columns])
    largest = max(quoted[np.isfinite(quoted)], default=abs(float(values["map"])))
    return float(largest) if np.isfinite(largest) else 0.0


def skewed_names(frame: pd.DataFrame) -> list[str]:
    """Names of the parameters whose interval is to be quoted."""
    return [row.name for row in table_rows(frame) if row.skewed]


def _row(name: str, values: Mapping[Hashable, Any], largest: float) -> Row:
    scale, unit = prefix_for(str(values["unit"]), largest)
    sample, point = (decimals_for(float(values[column]) * scale) for column in ("sd", "standard_error"))
    decimals = point if sample is None else sample
    return Row(name, values, scale, unit, decimals, decimals if point is None else point)


def _ends(values: Mapping[Hashable, Any], suffix: str = "") -> list[float] | None:
    ends = [float(values[f"lower{suffix}"]), float(values[f"upper{suffix}"])]
    return ends if np.all(np.isfinite(ends)) else None


def _informed(row: Row) -> str:
    """Masses read "weighed", a stated slope "stated": their prior is a reading, which data rarely narrow further."""
    informed = row.values["informed"]
    if pd.isna(informed):
        return ""
    if informed or not is_stated(row.name):
        return "yes" if informed else "no"
    return "weighed" if row.name in ("m1", "m2") else "stated"


@dataclass(frozen=True)
class OutputColumn:
    """One column.

    Attributes
    ----------
    key : its name in files
    header : its name where it is printed
    text : the printed cell
    value : what files hold, SI; None: the table's column ``key``
    outputs : where it appears
    sampled : rests on the sample: it is not printed without one
    numeric : set flush right
    """

    key: str
    header: str = ""
    text: Callable[[Row], str] = field(default=lambda row: "")
    value: Callable[[Mapping[Hashable, Any]], object] | None = None
    outputs: frozenset[Output] = EVERYWHERE
    sampled: bool = False
    numeric: bool = True

    def of(self, values: Mapping[Hashable, Any]) -> object:
        """What files hold for a row of the table."""
        return values[self.key] if self.value is None else self.value(values)


COLUMNS = (
    OutputColumn("meaning", "meaning", lambda row: row.values["meaning"], outputs=frozenset({"csv", "html"}), numeric=False),
    OutputColumn("unit", "unit", lambda row: row.unit, numeric=False),
    OutputColumn("value", "value ± sd", lambda row: row.quoted),
    OutputColumn("sd", outputs=FILES),
    OutputColumn(
        "sd_unwidened", "sd without model error", lambda row: row.number("sd_unwidened"), outputs=EVERYWHERE - {"console"}
    ),
    OutputColumn("widening", outputs=FILES),
    OutputColumn("quote", outputs=FILES),
    OutputColumn("basis", outputs=FILES),
    OutputColumn("trust", "trust", lambda row: str(row.values["trust"]), numeric=False),
    OutputColumn(
        "ci95",
        "95 % interval",
        lambda row: MISSING if MISSING in row.ends else " to ".join(row.ends),
        _ends,
        EVERYWHERE - {"csv"},
        sampled=True,
    ),
    OutputColumn("paper", "paper", lambda row: row.number("paper")),
    OutputColumn("map", "MAP ± s.e.", lambda row: row.plus_minus("map", "standard_error", row.point_decimals), sampled=True),
    OutputColumn("standard_error", outputs=frozenset({"csv"})),
    OutputColumn("mean", "mean", lambda row: row.number("mean"), outputs=EVERYWHERE - {"console"}, sampled=True),
    OutputColumn("median", outputs=FILES),
    OutputColumn("lower", outputs=frozenset({"csv"})),
    OutputColumn("upper", outputs=frozenset({"csv"})),
    OutputColumn("ci95_unwidened", value=lambda values: _ends(values, "_unwidened"), outputs=frozenset({"json"})),
    OutputColumn("ess", "ESS", lambda row: fixed(float(row.values["ess"]), 0), outputs=EVERYWHERE - {"console"}, sampled=True),
    OutputColumn("ess_bulk", outputs=FILES),
    OutputColumn("ess_tail", outputs=FILES),
    OutputColumn("rhat", "R-hat", lambda row: fixed(float(row.values["rhat"]), 3), sampled=True),
    OutputColumn("informed", "informed", _informed, sampled=True, numeric=False),
    OutputColumn("quoted", "to copy", lambda row: row.concise, outputs=frozenset({"html"})),
)  # fmt: skip


def columns_of(output: Output, frame: pd.DataFrame | None = None) -> list[OutputColumn]:
    """The columns of ``output``; of a printed ``frame`` without those that have nothing to show."""
    columns = [column for column in COLUMNS if output in column.outputs]
    if frame is None:
        return columns
    sampled, rows = bool(frame["ess"].notna().any()), table_rows(frame)
    return [c for c in columns if (sampled or not c.sampled) and any(c.text(row) not in ("", MISSING) for row in rows)]
