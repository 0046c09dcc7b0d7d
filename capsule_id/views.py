"""What a reader sees of a fit: findings, panels, tables.

Experiments and checks make them with codes and numbers; the report adds the texts and renders them.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from string import Formatter
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

Level = Literal["ok", "warn", "fail"]
#: Whether a number may be quoted; "not judged" where no check could tell.
Trust = Literal["trusted", "not judged", "not trusted"]
#: What a check or a table has found, by name; quantities in the unit that the text prints.
Facts = Mapping[str, Any]
#: A format string over facts, or a function of them. ``{rows:# row}`` writes a count: ``1 row``, ``2 rows``.
Text = str | Callable[[Facts], str]

#: Smaller probabilities of a test are not printed.
SMALLEST_P = 1e-10


def counted(number: int, noun: str) -> str:
    """``1 row``, ``2 rows``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def listed(labels: Iterable[str]) -> str:
    """The labels of a text that concerns them all: of more than ten the first eight, and how many others."""
    labels = list(labels)
    return ", ".join(labels if len(labels) <= 10 else [*labels[:8], f"and {len(labels) - 8} others"])


def after_number(unit: str) -> str:
    """A unit behind a number; nothing for a number without unit."""
    return "" if unit == "1" else f" {unit}"


def with_unit(name: str, unit: str) -> str:
    """The label of an axis: ``x_rel, mm``; the name alone for a number without unit."""
    return name if unit == "1" else f"{name}, {unit}"


def stated_p(p: float) -> str:
    """``p = 0.01``, or ``p < 1e-10`` for a smaller one: so far out, no distribution is known."""
    return f"p = {p:.2g}" if p >= SMALLEST_P else f"p < {SMALLEST_P:g}"


class _Texts(Formatter):
    """Fills in facts; the format ``# noun`` writes a count, the format ``p`` a probability; a space stands before %."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """The text of one fact."""
        if format_spec.startswith("# "):
            return counted(value, format_spec[2:])
        if format_spec.endswith("%"):
            return f"{format(value, format_spec)[:-1]} %"
        return stated_p(value) if format_spec == "p" else format(value, format_spec)


def filled_in(text: str, facts: Facts) -> str:
    """``text`` with its ``{names}`` replaced by facts; formats as of ``str.format``, and ``# noun`` and ``p``."""
    return _Texts().vformat(text, (), facts)


#: Checks of what one fault of a record leaves behind: where another check names a fault, they fail with it.
#: Those that say most about the cause come first.
SYMPTOMS = (
    "decays.stiffness", "decays.position", "decays.halves", "decays.onset", "decays.hidden", "decays.drift",
    "decays.residuals", "runs.repeated", "errors.stated", "outliers", "residuals.white", "residuals.statistics",
    "starts.agree", "model.error",
)  # fmt: skip
#: Warnings that name the cause of failed checks.
CAUSES = ("decays.changing", "decays.tone")


@dataclass(frozen=True)
class Finding:
    """The outcome of one check.

    Attributes
    ----------
    code : stable name of what was checked, such as ``residuals.white``; a ``Message`` gives its words
    facts : numbers and names that the text needs
    experiment : label of the experiment that the finding is about; "" where it is about the whole fit
    parameters : names of the parameters that it is about; () for all that its experiment informs

    Raises
    ------
    ValueError
        If ``level`` is no ``Level``.
    """

    code: str
    level: Level
    facts: Facts = field(default_factory=dict)
    experiment: str = ""
    parameters: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.level not in get_args(Level):
            raise ValueError(f"level of finding {self.code} must be one of {get_args(Level)}; found {self.level!r}")

    @property
    def cause(self) -> bool:
        """Whether it names a fault that other failed checks of its experiment may come from."""
        return (self.level == "fail" and self.code not in SYMPTOMS) or (self.level == "warn" and self.code in CAUSES)


@dataclass(frozen=True)
class ResultTable:
    """A small table: estimates with and without flagged rows, damping models, priors. ``Message`` gives its words."""

    code: str
    frame: "pd.DataFrame"
    facts: Facts = field(default_factory=dict)


@dataclass(frozen=True)
class Message:
    """The words of one code: its title, the text of a finding of each level, the caption of a table.

    ``on_console``: the console shows the warning or failure of this code: it says which model is quoted, or names a number
    that is probably in another unit.
    """

    title: str
    ok: Text = ""
    warn: Text = ""
    fail: Text = ""
    caption: Text = ""
    on_console: bool = False

    def text(self, part: Literal["ok", "warn", "fail", "caption"], facts: Facts) -> str:
        """The text of ``part`` with ``facts`` filled in.

        Raises
        ------
        KeyError
            If the text needs a fact that is missing.
        TypeError
            If a function returns no string.
        """
        text: Text = getattr(self, part)
        found = filled_in(text, facts) if isinstance(text, str) else text(facts)
        if not isinstance(found, str):
            raise TypeError(f"the text must be a string, found {found!r}")
        return found


@dataclass(frozen=True)
class Points:
    """Measured points of a panel, display units. ``flagged`` (n,) marks rows that a check names; never dropped."""

    label: str
    x: np.ndarray
    y: np.ndarray
    y_error: np.ndarray | None = None
    flagged: np.ndarray | None = None
    role: Literal["static", "dynamic", "mean", "sliding", "data"] = "data"


@dataclass(frozen=True)
class Curve:
    """A predicted curve of a panel, display units; ``lower``/``upper`` its 95 % band, where it has one."""

    label: str
    x: np.ndarray
    y: np.ndarray
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    role: Literal["ours", "paper", "alternative"] = "ours"


@dataclass(frozen=True)
class Comparison:
    """Measured beside predicted: one panel of the report.

    Attributes
    ----------
    kind : "friction", "motor_current", "support_spring", "free_vibration"
    residuals : (n,) of the first of ``points`` at the point fit, in units of the noise sd (None: no residual panel)
    autocorrelation : (lags,) of the residuals, lag 1 first (time series only)
    predictive_p : posterior predictive p-value of the chi-square discrepancy (None without a sample)
    """

    kind: str
    label: str
    title: str
    x_label: str
    y_label: str
    points: tuple[Points, ...]
    curves: tuple[Curve, ...]
    residuals: np.ndarray | None = None
    autocorrelation: np.ndarray | None = None
    predictive_p: float | None = None
