"""All checks of a fit: each finding states the experiment, the expected value, the observed value and a remedy.

A rig without faults passes all checks together in more than 95 of 100 cases (measured in the calibration study).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from capsule_id.experiments.base import Experiment
from capsule_id.inference.checks.experiment_checks import check_outliers, check_stated_errors, check_whiteness
from capsule_id.inference.checks.modes import check_maximum, check_starts
from capsule_id.inference.checks.order import check_trials
from capsule_id.inference.checks.predictive import check_statistics
from capsule_id.inference.checks.priors import PRIOR_PULL, check_priors, default_scatter, in_doubt
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling.ensembles import LENGTH_IN_TAU, MAX_RHAT
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.parameters import is_stated
from capsule_id.views import Finding

#: The data inform a parameter where posterior sd / prior sd (in u) is at most this, dimensionless.
INFORMED_RATIO = 0.9


def run_checks(sampled: SampledFit) -> SampledFit:
    """Run all checks: return ``sampled`` with all findings and flagged outliers."""
    whiteness = check_whiteness(sampled)
    outliers, flagged = check_outliers(sampled)
    sampled = replace(sampled, flagged=flagged)
    trials = check_trials(sampled)
    findings = [
        *check_starts(sampled.fit, sampled.target, sampled.posterior),
        *check_maximum(sampled),
        *_chains(sampled),
        *whiteness,
        *outliers,
        *check_stated_errors(sampled),
        *trials,
        *check_statistics(sampled, {finding.experiment for finding in trials if finding.level == "fail"}),
        *_declared_findings(sampled, bench=True),
        *_informed(sampled),
        *check_priors(sampled),
        *_boundary(sampled),
        *_declared_findings(sampled, bench=False),
    ]
    return replace(sampled, findings=tuple(findings))


def _declared_findings(sampled: SampledFit, bench: bool) -> Iterator[Finding]:
    """Findings of the checks that experiments declare; one without an experiment is about those that declare it."""
    for check in declared(sampled.experiments, "checks", bench):
        names = dict.fromkeys(row.name for e in check.args[0] for row in e.parameters)
        for finding in check(sampled):
            general = finding.level == "fail" and not (finding.experiment or finding.parameters)
            yield replace(finding, parameters=tuple(names)) if general else finding


def declared(
    experiments: Sequence[Experiment], what: Literal["checks", "tables"], bench: bool
) -> list[partial[list[Any]]]:
    """Return every check (or table) that bench tests or runs declare, with the experiments that declare it."""
    members: dict[Callable[..., list[Any]], list[Experiment]] = {}
    for experiment in experiments:
        for function in getattr(experiment, what) if experiment.bench == bench else ():
            members.setdefault(function, []).append(experiment)
    return [partial(function, own) for function, own in members.items()]


def _chains(s: SampledFit) -> list[Finding]:
    p = s.posterior
    if p is None:
        return [Finding("chains.converged", "warn")]
    worst_tau, worst_rhat = int(np.argmax(p.tau)), int(np.argmax(p.rhat))
    sizes = np.minimum(p.ess_bulk, p.ess_tail)
    facts = {
        "draws": p.draws.shape[1],
        "length": p.draws.shape[1] / p.tau[worst_tau],
        "slowest": p.names[worst_tau],
        "rhat": p.rhat[worst_rhat],
        "worst": p.names[worst_rhat],
        "size": np.min(sizes),
        "smallest": p.names[int(np.argmin(sizes))],
        "size_wanted": p.ess_wanted,
        "length_wanted": LENGTH_IN_TAU,
        "rhat_wanted": MAX_RHAT,
    }
    if p.converged:
        return [Finding("chains.converged", "ok", facts)]
    # What no check can judge is not judged: the draws may be right.
    short = (p.rhat > MAX_RHAT) | (sizes < p.ess_wanted) | (p.draws.shape[1] < LENGTH_IN_TAU * p.tau)
    names = tuple(name for name, own in zip(p.names, short, strict=True) if own)
    return [Finding("chains.converged", "warn", {**facts, "names": ", ".join(names)}, parameters=names)]


def informed(target: LogPosterior, posterior: Posterior | None, fit: PointFit) -> np.ndarray:
    """(d,) whether posterior sd / prior sd of u is at most ``INFORMED_RATIO`` (Laplace without a sample)."""
    if posterior is None:
        sd = np.sqrt(np.diag(fit.covariance))
    else:
        flat = posterior.draws.reshape(-1, len(posterior.names))
        sd = np.std(target.unconstrain(flat), axis=0)
    return sd <= INFORMED_RATIO * target.prior_sd


def _informed(s: SampledFit) -> list[Finding]:
    known = informed(s.target, s.posterior, s.fit)
    # No other reading narrows a stated mass or slope. A scatter with a stated reading error may be zero.
    names = [
        row.name
        for row, ok in zip(s.target.parameters, known, strict=True)
        if row.physical and not is_stated(row.name) and not ok
    ]
    return [Finding("parameters.informed", "warn" if names else "ok", {"names": ", ".join(names)})]


def _boundary(s: SampledFit) -> list[Finding]:
    """Find parameters whose posterior lies in the tail of the prior; ``check_priors`` finds scatters by default priors."""
    z = np.abs(s.target.prior_residuals(s.fit.u))
    judged = [(row.name, pull) for row, pull in zip(s.target.parameters, z, strict=True) if not default_scatter(s, row)]
    names = [name for name, pull in judged if pull > PRIOR_PULL]
    out = {name for name in names if not is_stated(name)} - in_doubt(s)
    keys = [row.prior_key for row in s.target.parameters if row.name in out]
    facts = {"names": ", ".join(names), "keys": ", ".join(filter(None, keys))}
    return [Finding("priors.tails", "warn" if names else "ok", facts, parameters=tuple(names))]
