"""Frozen results of inference, which the report shows."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
import pandas as pd

from capsule_id.experiments.kind import Choice, Registry
from capsule_id.parameters import CONSTANT
from capsule_id.records.view import RunRecord
from capsule_id.rig.model import Rig
from capsule_id.views import Comparison, Finding, ResultTable, Trust

#: Begins the name of an input that is a reading with an sd in rig.toml, such as a weighing.
STATED = "stated value of "


def held_leaves(rig: Rig) -> dict[str, float | None]:
    """Leaves of capsule and drive that ``rig`` states in [rig], [model] or its runs, SI, by symbol.

    None: its runs have several lags, or square waves, whose force between the pulses is that of no other pulses. Fitted
    values come before these.
    """
    stated = ((name, getattr(rig, name)) for name in ("m1", "m2", "g", "slope", "N0"))
    values: dict[str, float | None] = {"reaction": rig.model.share_of_reaction, "slope": 0.0, "N0": 0.0}
    values |= {name: quantity.value for name, quantity in stated if quantity is not None}
    driven = [table.settings for table in rig.tables if hasattr(table.settings, "drive")]
    lags = {0.0 if one.lag is None else one.lag.value for one in driven if one.drive in ("pulses", "square")}
    values |= {"lag": lags.pop() if len(lags) == 1 else None} if lags else {}
    values |= {"P_off": None} if any(one.drive == "square" for one in driven) else {}
    return values | (CONSTANT if rig.model.friction == "constant" else {})


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
    at_other_maximum : (s,) bool: this start ended at a maximum other than the best one
    stalled : (s,) bool: the solver reported no convergence from this start
    shares : by parameter, the share of every table and every prior in its variance; see ``point_fit.variance_shares``
    """

    names: tuple[str, ...]
    u: np.ndarray
    values: Mapping[str, float]
    covariance: np.ndarray
    standard_errors: Mapping[str, float]
    starts: np.ndarray
    ends: np.ndarray
    log_posterior: np.ndarray
    at_other_maximum: np.ndarray
    stalled: np.ndarray
    shares: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def agree(self) -> bool:
        """Whether every start ended at the same maximum."""
        return not self.at_other_maximum.any()


@dataclass(frozen=True)
class Posterior:
    """The posterior sample.

    Attributes
    ----------
    names : (d,) sampled parameters
    draws : (ensemble, draw, walker, d) constrained, SI
    lp : (ensemble, draw, walker) log-posterior density in the unconstrained space
    acceptance : (ensemble, walker)
    tau : (d,) integrated autocorrelation time over the walkers of all ensembles, in stored draws
    rhat : (d,) split R-hat of the ensembles
    ess : (d,) draws over emcee's autocorrelation time; too large for short chains
    ess_bulk, ess_tail : (d,) effective sample sizes for the stopping rule, see ``moves.bulk_and_tail_size``
    ess_wanted : the bulk and tail effective sample size that every parameter had to reach
    converged : every parameter has N > 20 tau, R-hat <= 1.01, and both sizes reach ``ess_wanted``
    moves : the move that was used -> its largest tau in the pilot, steps
    steps, thin : emcee steps after burn-in, and steps per stored draw
    """

    names: tuple[str, ...]
    draws: np.ndarray
    lp: np.ndarray
    acceptance: np.ndarray
    tau: np.ndarray
    rhat: np.ndarray
    ess: np.ndarray
    ess_bulk: np.ndarray
    ess_tail: np.ndarray
    ess_wanted: float
    converged: bool
    moves: Mapping[str, float]
    steps: int
    thin: int

    def __repr__(self) -> str:
        ensembles, draws, walkers, parameters = self.draws.shape
        size = f"{ensembles} ensembles of {walkers} walkers with {draws} draws, {parameters} parameters"
        return f"<Posterior: {size}; R-hat at most {self.rhat.max():.4f}, bulk ESS at least {self.ess_bulk.min():.0f}>"


@dataclass(frozen=True)
class Pointwise:
    """Leave-one-out densities and replicates of the readings at some draws, evenly spaced over the sample.

    Attributes
    ----------
    log_likelihood : (chain, draw, terms) by label of the experiment, see ``Experiment.left_out``
    rows : (terms,) first reading of every term, by label
    replicates : (some chains, some draws, n) by label, SI: at every ``thin``-th of the chains and of the draws
    chain, draw : indices of the walkers and of the stored draws
    """

    log_likelihood: Mapping[str, np.ndarray]
    rows: Mapping[str, np.ndarray]
    replicates: Mapping[str, np.ndarray]
    chain: np.ndarray
    draw: np.ndarray
    thin: int


@dataclass(frozen=True)
class Provenance:
    """Inputs of a result: the seed, the chosen experiments, the friction law, versions of packages, SHA-256 of the files.

    ``rejected``: number of rows that the rule ``reject`` dropped, by label of the experiment.
    ``engine``: what integrates the capsule model, "exact" or "smooth".
    ``made``: date (ISO, UTC) and command of the fit; results that differ in them only are equal.
    """

    seed: int
    experiments: Choice
    friction: str
    versions: Mapping[str, str]
    files: Mapping[str, str]
    rejected: Mapping[str, int] = field(default_factory=dict)
    engine: str = "exact"
    made: tuple[str, str] = field(default=("", ""), compare=False)


@dataclass(frozen=True)
class Result:
    """Complete result of a fit, as the report needs it.

    Attributes
    ----------
    registry : kinds of the rig's experiments, which declare the texts of their panels and checks
    summary : a row per physical parameter (index ``name``), SI, missing numbers NaN; columns unit, meaning, value, sd,
        quote, basis, trust, paper, map, standard_error, mean, median, lower, upper, ess, ess_bulk, ess_tail, rhat, informed,
        widening, and sd, lower and upper without it (sd_unwidened, lower_unwidened, upper_unwidened), not_in_sd (errors of
        instruments), and largest_error, the one of them that matters most, with the change by 1 % of it.
        Quote value and sd: the median and sd of the sample (basis "sample"), or the maximum and its standard error
        (basis "point"). Where ``quote`` is "interval", quote value, lower and upper: the posterior is skewed
    nuisances : the same columns for scatters and noise
    fixed : constants by name, SI
    observed : (n,) readings that enter the likelihood, SI, by label
    prior : (draws,) prior draws by parameter name, SI
    pointwise : None without a sample
    truth : of a synthetic rig by parameter name, SI, where its file lies beside the folder
    """

    rig: Rig
    registry: Registry
    summary: pd.DataFrame
    nuisances: pd.DataFrame
    point_fit: PointFit
    posterior: Posterior | None
    findings: tuple[Finding, ...]
    comparisons: tuple[Comparison, ...]
    notes: tuple[ResultTable, ...]
    records: tuple[RunRecord, ...]
    fixed: Mapping[str, float]
    observed: Mapping[str, np.ndarray]
    prior: Mapping[str, np.ndarray]
    pointwise: Pointwise | None
    provenance: Provenance
    truth: Mapping[str, float] = field(default_factory=dict)

    @property
    def clean(self) -> bool:
        """Whether there is no finding of level ``fail``."""
        return all(finding.level != "fail" for finding in self.findings)

    @property
    def trust(self) -> Trust:
        """The worst word of the physical parameters; "not trusted" where a check failed."""
        words = {"trusted" if self.clean else "not trusted", *self.summary["trust"]}
        return max(get_args(Trust), key=lambda word: (word in words, get_args(Trust).index(word)))
