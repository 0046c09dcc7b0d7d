"""What a reader sees of a fit: findings, panels, small tables.

Experiments and checks make them, the report renders them.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

Level = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """The outcome of one check: which experiment, what was expected, what was seen, what to do.

    ``experiment`` is the label of the experiment it is about, or "" when it is about the whole fit.
    """

    check: str
    level: Level
    text: str
    experiment: str = ""


@dataclass(frozen=True)
class Points:
    """Measured points of a panel, display units. ``flagged`` (n,) marks rows that a check names; never dropped."""

    label: str
    x: np.ndarray
    y: np.ndarray
    y_error: np.ndarray | None = None
    flagged: np.ndarray | None = None
    role: Literal["static", "dynamic", "sliding", "data"] = "data"


@dataclass(frozen=True)
class Curve:
    """A predicted curve of a panel, display units; ``lower``/``upper`` its 95 % band, where it has one."""

    label: str
    x: np.ndarray
    y: np.ndarray
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    role: Literal["ours", "paper", "predictive", "alternative"] = "ours"


@dataclass(frozen=True)
class Comparison:
    """Measured beside predicted: one panel of the report.

    Attributes
    ----------
    kind : "friction", "motor_current", "support_spring", "free_vibration"
    residual_x, residuals : (n,) at the point fit, residuals in units of the noise sd (None: no residual panel)
    autocorrelation : (lags,) of the residuals, lag 1 first (time series only), with ``autocorrelation_bound`` the
        half-width of the 95 % band of a white record
    predictive_p : posterior predictive p-value of the chi-square discrepancy (None without a sample)
    """

    kind: str
    label: str
    title: str
    x_label: str
    y_label: str
    points: tuple[Points, ...]
    curves: tuple[Curve, ...]
    residual_x: np.ndarray | None = None
    residuals: np.ndarray | None = None
    autocorrelation: np.ndarray | None = None
    autocorrelation_bound: float | None = None
    predictive_p: float | None = None


@dataclass(frozen=True)
class NoteTable:
    """A small table with a caption: estimates with and without flagged rows, damping alternatives, priors, ..."""

    title: str
    caption: str
    frame: pd.DataFrame
