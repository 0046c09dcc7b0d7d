"""The frozen nouns that inference hands on; the report renders them and computes nothing."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from capsule_id.experiments.checks.context import RunRecord as RunRecord
from capsule_id.rig.model import Rig
from capsule_id.views import Comparison as Comparison
from capsule_id.views import Curve as Curve
from capsule_id.views import Finding as Finding
from capsule_id.views import NoteTable as NoteTable
from capsule_id.views import Points as Points


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
    elsewhere : (s,) bool: this start ended at another maximum than the best one
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
    elsewhere: np.ndarray
    stalled: np.ndarray

    @property
    def agree(self) -> bool:
        """Every start ended at the same maximum."""
        return not self.elsewhere.any()


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
    records: tuple[RunRecord, ...] = ()

    @property
    def clean(self) -> bool:
        """No finding of level ``fail``."""
        return all(finding.level != "fail" for finding in self.findings)
