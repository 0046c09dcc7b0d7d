"""The columns of a parameter table, how numbers and names are set, and the table of the console."""

import math
import re
import shutil
import string
import textwrap
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy import stats

from capsule_id.inference.result import Posterior, Result
from capsule_id.parameters import INSTRUMENT_WORDS, Name, is_stated, symbol_of
from capsule_id.views import Level, Trust, after_number, counted

# typography: How numbers, units and parameter names are set: one rule each, for every table and figure.


MISSING = "–"

# Outside these magnitudes a number in bare SI units is hard to read, and the unit takes a decimal prefix instead.
_PREFIX_ABOVE, _PREFIX_BELOW = 1e7, 1e-2
_PREFIXES = dict(zip(range(-12, 10, 3), ("p", "n", "µ", "m", "", "k", "M", "G"), strict=True))
# "1" has no prefix, "kg" has one already, and "m^2" with a prefix would mean the square of the prefixed unit.
_PREFIXABLE = re.compile(r"(N|m|s|A|rad|Hz|J|W|V)(?![A-Za-z^0-9²³])")

_SYMBOL = re.compile(r"([A-Za-z]+?)(?:_?(\d+|(?<=_)[A-Za-z0-9]+))?")
# A longer name of a spring or an experiment would push the axis off the picture.
_LONGEST_LABEL = 24


def decimals_for(sd: float) -> int | None:
    """Decimal places (negative: places before the point) that leave two significant digits of ``sd``.

    None where ``sd`` gives no guidance (zero, NaN or infinite).
    """
    if not math.isfinite(sd) or sd <= 0:
        return None
    # Formatting first: 0.0996 is 0.10 with two digits, one place fewer than its logarithm says.
    return 1 - int(f"{sd:.1e}".partition("e")[2])


def fixed(value: float, decimals: int | None) -> str:
    """``value`` with so many decimals; six significant digits where ``decimals`` is None; a dash for NaN."""
    if math.isnan(value):
        return MISSING
    if math.isinf(value) or decimals is None:
        return f"{value:.6g}"
    if decimals <= 0:
        return f"{round(value, decimals):.0f}"
    return f"{value:.{decimals}f}"


def prefix_for(unit: str, *magnitudes: float) -> tuple[float, str]:
    """Factor and unit that bring ``magnitudes`` into a readable range: (1e6, "µm") for 2e-5 m, else (1.0, unit).

    The prefix is that of the largest one, or a smaller one that the smallest needs.
    """
    sizes = [abs(size) for size in magnitudes if size != 0 and math.isfinite(size)]
    low, high = min(sizes, default=1.0), max(sizes, default=1.0)
    if (low >= _PREFIX_BELOW and high < _PREFIX_ABOVE) or not _PREFIXABLE.match(unit):
        return 1.0, unit
    power = min(max(3 * math.floor(math.log10(high) / 3), min(_PREFIXES)), max(_PREFIXES))
    while low * 10.0**-power < _PREFIX_BELOW and power > min(_PREFIXES):
        power -= 3
    return 10.0**-power, _PREFIXES[power] + unit


def symbol_parts(name: str) -> tuple[str, str, str]:
    """Split a parameter name as the paper sets it: symbol, index, label.

    ``k2[soft]`` -> ("k", "2", "soft"); ``mu`` -> ("μ", "", ""); ``v_s`` -> ("v", "s", "").
    Names that are words (``tilt_sd``) stay whole: ("tilt_sd", "", "").
    """
    symbol, label = Name.parse(name)
    match = _SYMBOL.fullmatch(symbol)
    base, index = match.groups("") if match else (symbol, "")
    try:
        base = unicodedata.lookup(f"GREEK {'CAPITAL' if base[:1].isupper() else 'SMALL'} LETTER {base}")
    except KeyError:
        if len(base) > 1:
            return symbol, "", label
    return base, index, label


def plain_symbol(name: str) -> str:
    """The name for a figure, in Unicode and without markup: ``k₂ soft``, ``μ``, ``vₛ``, ``tilt_sd``."""
    base, index, label = symbol_parts(name)
    small = index.translate(str.maketrans("0123456789s", "₀₁₂₃₄₅₆₇₈₉ₛ"))
    if any(mark.isascii() for mark in small):  # x_start
        small = f"_{index}"
    short = label if len(label) <= _LONGEST_LABEL else label[: _LONGEST_LABEL - 1] + "…"
    return f"{base}{small} {short}".rstrip()


# columns: The columns of a parameter table, declared once for parameters.json, parameters.csv, the page and standard
# output.
#
# All numbers of a row keep two digits of the posterior sd (without a sample: of the standard error), the point fit
# those of its own standard error. Values far from 1 carry a decimal prefix on the unit (µm instead of m); all rows
# of a symbol (G[run_1], G[run_2]) have the same unit.


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
    def interval(self) -> str:
        """Both ends of the 95 % interval; a single dash if one is missing."""
        ends = self._printed("lower"), self._printed("upper")
        return MISSING if MISSING in ends else " to ".join(ends)

    @property
    def quoted(self) -> str:
        """What to quote: ``1421.3 ± 3.1``, or ``5.8 (2.1 to 20.5)`` where the posterior is skewed."""
        if not self.skewed:
            return self.plus_minus("value", "sd", self.decimals)
        return f"{self._printed('value')} ({self.interval})"

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
        sd, places = float(self.values["sd"]) * self.scale, self.decimals
        if self.skewed or places is None or decimals_for(sd) is None:
            return (self.quoted if self.skewed else self.number("value")) + after_number(self.unit)
        digits = fixed(round(sd * 10.0 ** max(places, 0)), min(places, 0))
        return f"{self.number('value')}({digits}){after_number(self.unit)}"


def table_rows(frame: pd.DataFrame, beside: Sequence[pd.DataFrame] = ()) -> list[Row]:
    """The rows of ``frame`` in their order. Those of a symbol, also in the tables ``beside``, share the unit of the largest."""
    values_of = {str(name): values for name, values in frame.to_dict("index").items()}
    largest: defaultdict[str, float] = defaultdict(float)
    for part in (frame, *beside):
        for name, values in part.to_dict("index").items():
            largest[symbol_of(str(name))] = max(largest[symbol_of(str(name))], magnitude(values))
    rows = []
    for name, values in values_of.items():
        scale, unit = prefix_for(str(values["unit"]), largest[symbol_of(name)])
        sample, point = (decimals_for(float(values[column]) * scale) for column in ("sd", "standard_error"))
        decimals = point if sample is None else sample
        rows.append(Row(name, values, scale, unit, decimals, decimals if point is None else point))
    return rows


def magnitude(values: Mapping[Hashable, Any]) -> float:
    """Largest of the quoted numbers, SI: value and sd, or ends. The maximum, often far from them, counts without a value."""
    columns = ("value", "lower", "upper") if values["quote"] == "interval" else ("value", "sd")
    quoted = np.abs([float(values[column]) for column in columns])
    largest = max(quoted[np.isfinite(quoted)], default=abs(float(values["map"])))
    return float(largest) if np.isfinite(largest) else 0.0


def skewed_names(frame: pd.DataFrame) -> list[str]:
    """Names of the parameters whose interval is to be quoted."""
    return [row.name for row in table_rows(frame) if row.skewed]


def errors_left_out(frame: pd.DataFrame) -> list[str]:
    """A sentence about the errors of instruments that no sd of ``frame`` contains; [] where all are stated."""
    missing = {str(name): str(words).split() for name, words in frame["not_in_sd"].items()}
    names = {word: [name for name, own in missing.items() if word in own] for word in INSTRUMENT_WORDS}
    found = [word for word in INSTRUMENT_WORDS if names[word]]
    if not found:
        return []
    parts = "; ".join(f"{word}: {', '.join(names[word])}" for word in found)
    words = " or ".join(filter(None, [", ".join(found[:-1]), found[-1]]))
    largest: dict[str, list[str]] = {}
    for name, text in frame["largest_error"].items():
        largest.setdefault(str(text), []).extend([str(name)] * bool(text))
    moved = "; ".join(f"{', '.join(own)} by {text.replace(': ', ' (', 1)})" for text, own in largest.items() if own)
    effects = f". An error of 1 % changes {moved}" if moved else ""
    return [
        f"the sd contains no error of {words} ({parts}){effects}. How to state them: guide, parameters, Instruments"
    ]


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
        lambda row: row.interval,
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
    OutputColumn(
        "ess",
        "ESS",
        lambda row: fixed(float(min(row.values["ess_bulk"], row.values["ess_tail"])), 0),
        outputs=EVERYWHERE - {"console"},
        sampled=True,
    ),
    OutputColumn("ess_bulk", outputs=FILES),
    OutputColumn("ess_tail", outputs=FILES),
    OutputColumn("rhat", "R-hat", lambda row: fixed(float(row.values["rhat"]), 3), sampled=True),
    OutputColumn("informed", "informed", _informed, sampled=True, numeric=False),
    OutputColumn("not_in_sd", value=lambda values: str(values["not_in_sd"]).split(), outputs=frozenset({"json"})),
    OutputColumn("quoted", "to copy", lambda row: row.concise, outputs=frozenset({"html"})),
)  # fmt: skip


def columns_of(output: Output) -> list[OutputColumn]:
    """The columns of ``output``."""
    return [column for column in COLUMNS if output in column.outputs]


def printed_table(
    frame: pd.DataFrame, output: Literal["html", "console"]
) -> tuple[list[OutputColumn], list[tuple[str, Sequence[str]]]]:
    """Columns of ``frame`` in print, without those that have nothing to show, and name and cells of every row."""
    sampled, rows = bool(frame["ess"].notna().any()), table_rows(frame)
    printed = {
        column: [column.text(row) for row in rows] for column in columns_of(output) if sampled or not column.sampled
    }
    shown = {column: cells for column, cells in printed.items() if not {"", MISSING}.issuperset(cells)}
    return list(shown), [(row.name, [cells[i] for cells in shown.values()]) for i, row in enumerate(rows)]


# console table: The parameter table for standard output.


#: Width of the table where standard output is no terminal.
WIDTH = 110
#: Columns that are printed at any width: unit, value ± sd and trust.
KEPT = 3
_GAP = "  "

SYNTHETIC = "*** SYNTHETIC RIG: computer-made data, nothing here was measured ***"


def table_text(summary: pd.DataFrame, *, synthetic: bool, width: int | None = None) -> str:
    """The parameter table as aligned text. Columns at the right give way where the terminal is narrow; names are whole.

    Parameters
    ----------
    summary : as ``Result.summary``; without a sample the sampled columns are left out
    synthetic : the rig is a synthetic one: said in a line of its own
    width : columns of the terminal; None: those of standard output
    """
    width = shutil.get_terminal_size((WIDTH, 24)).columns if width is None else width
    columns, rows = printed_table(summary, "console")
    table = [
        ["", *(column.header for column in columns)],
        *([name, *("NO" if cell == "no" else cell for cell in cells)] for name, cells in rows),
    ]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    shown = len(widths)
    while shown > 1 + KEPT and sum(widths[:shown]) + len(_GAP) * (shown - 1) > width:
        shown -= 1
    lines = _aligned([cells[:shown] for cells in table])
    skewed, left_out = skewed_names(summary), table[0][shown:]
    notes = [
        *([f"{', '.join(skewed)}: skewed; quote the value with its 95 % interval"] if skewed else []),
        *([f"in a wider terminal and in report.html: {', '.join(left_out)}"] if left_out else []),
    ]
    return "\n".join([*([SYNTHETIC] if synthetic else []), *lines, *wrapped(notes, width)])


def _aligned(table: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, a rule under the first one. Names and units are flush left."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    form = [f"{'>' if i > 1 else '<'}{longest}" for i, longest in enumerate(widths)]
    head, *lines = (_GAP.join(map(format, cells, form)).rstrip() for cells in table)
    return [head, "-" * max(map(len, [head, *lines])), *lines]


#: Probability that ``differences`` calls any parameter of two equal rigs different.
FALSE_ALARMS = 0.05


def differences(one: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Differences of the parameters that two summaries have in common; the table of ``capsule_id.compare``."""
    names = [name for name in one.index if name in other.index]
    frame = pd.DataFrame({"unit": one.loc[names, "unit"]}, index=pd.Index(names, name="name"))
    for word, part in (("a", one.loc[names]), ("b", other.loc[names])):
        frame[f"value_{word}"], frame[f"sd_{word}"] = part["value"].astype(float), part["sd"].astype(float)
    frame["difference"] = frame["value_b"] - frame["value_a"]
    frame["sd"] = np.hypot(frame["sd_a"], frame["sd_b"])
    # Two exact constants have no sd: equal ones are 0 sd apart, others infinitely many.
    with np.errstate(divide="ignore", invalid="ignore"):
        frame["sds"] = np.where(frame["difference"] == 0.0, 0.0, frame["difference"] / frame["sd"])
    frame["differs"] = frame["sds"].abs() > stats.norm.isf(FALSE_ALARMS / 2.0 / max(len(names), 1))
    return frame


def table_side_by_side(summaries: Sequence[pd.DataFrame]) -> str:
    """One table of several results A, B, C: value ± sd of each, and the differences from A in sd of the difference.

    A word of trust stands behind the numbers of a parameter that is not trusted.
    """
    letters = string.ascii_uppercase[: len(summaries)]
    results = [{row.name: row for row in table_rows(one, summaries)} for one in summaries]
    compared = [differences(summaries[0], other) for other in summaries[1:]]
    table = [["", "unit", *letters, *(f"{letter} − A, sd" for letter in letters[1:])]]
    for name in dict.fromkeys(name for rows in results for name in rows):
        own = [rows.get(name) for rows in results]
        words = ["" if row is None or row.values["trust"] == "trusted" else f" ({row.values['trust']})" for row in own]
        values = [row.quoted + word if row else MISSING for row, word in zip(own, words, strict=True)]
        sds = [float(frame["sds"].to_dict().get(name, math.nan)) for frame in compared]
        unit = next(row.unit for row in own if row)
        table.append([name, unit, *values, *(MISSING if math.isnan(x) else f"{x:+.1f}" for x in sds)])
    differing = [
        ", ".join(str(name) for name, differs in frame["differs"].to_dict().items() if differs) for frame in compared
    ]
    texts = [
        f"{letter} differs from A in {names or 'no parameter with a number in both'}"
        for letter, names in zip(letters[1:], differing, strict=True)
    ]
    chance = f"two fits of equal rigs differ so in any parameter with a probability of {100 * FALSE_ALARMS:.0f} %"
    return "\n".join([*_aligned(table), *wrapped([*texts, chance])])


def wrapped(texts: Sequence[str], width: int | None = None) -> list[str]:
    """Lines of the ``texts``, no wider than the terminal."""
    width = shutil.get_terminal_size((WIDTH, 24)).columns if width is None else width
    return [line for text in texts for line in textwrap.wrap(text, max(width, 20), break_on_hyphens=False)]


def verdict_text(trust: Trust, findings: Sequence[tuple[Level, str]]) -> str:
    """The verdict in one line, from level and title of the findings: the failed checks, causes first, the number of warnings.

    Console and report have these words.
    """
    failed = ", ".join(dict.fromkeys(title for level, title in findings if level == "fail"))
    found = f"failed: {failed}" if failed else "no check failed"
    if trust == "not judged" and not failed:
        found += ", but not every number could be checked"
    warned = [level for level, _ in findings].count("warn")
    return f"verdict: {trust}; {found}" + (f"; {counted(warned, 'warning')}" if warned else "")


# sampled parameters: The sampled physical parameters as columns, in display units: what corner plot and traces have
# in common.


@dataclass(frozen=True)
class SampledParameters:
    """Sampled physical parameters, nuisances left out.

    Attributes
    ----------
    names : (n,) as in the summary
    symbols, units : (n,) for display
    draws : (ensemble, draw, walker, n) in display units
    map, paper : (n,) point fit and the paper's estimate (NaN where it has none), display units
    """

    names: tuple[str, ...]
    symbols: tuple[str, ...]
    units: tuple[str, ...]
    draws: np.ndarray
    map: np.ndarray
    paper: np.ndarray
    posterior: Posterior


def sampled_parameters(result: Result) -> SampledParameters:
    """The columns of ``result``. Parameters that share a unit share its prefix.

    Raises
    ------
    ValueError
        If nothing was sampled.
    """
    if result.posterior is None:
        raise ValueError("nothing was sampled (point fit only): fit without --no-sample (budget=None)")
    place = {name: i for i, name in enumerate(result.posterior.names)}
    summary = result.summary.loc[[name in place for name in result.summary.index]]
    names = tuple(str(name) for name in summary.index)
    sizes: defaultdict[str, list[float]] = defaultdict(list)
    for row in summary.to_dict("records"):
        sizes[str(row["unit"])].append(magnitude(row))
    display = [prefix_for(str(unit), *sizes[str(unit)]) for unit in summary["unit"]]
    scale = np.array([factor for factor, _ in display])
    return SampledParameters(
        names=names,
        symbols=tuple(plain_symbol(name) for name in names),
        units=tuple(unit for _, unit in display),
        draws=result.posterior.draws[..., [place[name] for name in names]] * scale,
        map=summary["map"].to_numpy(float) * scale,
        paper=summary["paper"].to_numpy(float) * scale,
        posterior=result.posterior,
    )
