"""The frozen nouns that inference hands on; the report renders them and computes nothing."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from capsule_id.rig.model import Rig

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
class PointFit:
    """Maximum of the joint log-posterior, found from several starts.

    Arrays over parameters follow ``names``; ``u`` is the unconstrained space.

    Attributes
    ----------
    names : (d,)
    u : (d,) the best maximum
    values : the same, constrained, SI, by name
    covariance : (d, d) Laplace covariance of u: inverse Hessian of the negative log-posterior (prior included)
    standard_errors : by name, SI: from the Jacobian of the standardised residuals
    starts, ends : (s, d) in u
    log_posterior : (s,) at the ends
    agree : every start ended at the same maximum
    stalled : (s,) bool: the solver reported no convergence from this start
    """

    names: tuple[str, ...]
    u: np.ndarray
    values: Mapping[str, float]
    covariance: np.ndarray
    standard_errors: Mapping[str, float]
    starts: np.ndarray
    ends: np.ndarray
    log_posterior: np.ndarray
    agree: bool
    stalled: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """The sample.

    Attributes
    ----------
    names : (d,) sampled parameters
    draws : (ensemble, draw, walker, d) constrained, SI
    lp : (ensemble, draw, walker) log-posterior density in the unconstrained space
    acceptance : (ensemble, walker)
    tau : (d,) largest integrated autocorrelation time over the ensembles, in stored draws
    rhat, ess : (d,)
    converged : every parameter has N > 50 tau and R-hat <= 1.01
    moves : what the pilot run measured: move -> largest tau (steps); the first is the one used
    steps, thin : emcee steps after burn-in, and steps per stored draw
    """

    names: tuple[str, ...]
    draws: np.ndarray
    lp: np.ndarray
    acceptance: np.ndarray
    tau: np.ndarray
    rhat: np.ndarray
    ess: np.ndarray
    converged: bool
    moves: Mapping[str, float]
    steps: int
    thin: int


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


@dataclass(frozen=True)
class Result:
    """What ``fit`` returns and ``fit-params`` writes.

    ``summary`` has one row per physical parameter (index ``name``) and the columns unit, meaning, paper, map,
    standard_error, mean, sd, median, lower, upper, ess, rhat, informed; missing numbers are NaN, SI throughout.
    ``nuisances`` is the same table for scatters and noise.
    """

    rig: Rig
    summary: pd.DataFrame
    nuisances: pd.DataFrame
    point_fit: PointFit
    posterior: Posterior | None
    findings: tuple[Finding, ...]
    comparisons: tuple[Comparison, ...]
    notes: tuple[NoteTable, ...]
    provenance: Mapping[str, object]
    groups: Mapping[str, object] = field(default_factory=dict)

    @property
    def clean(self) -> bool:
        """No finding of level ``fail``."""
        return all(finding.level != "fail" for finding in self.findings)
