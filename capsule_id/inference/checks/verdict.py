"""All checks of a fit, and which of its numbers may be quoted."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy import stats

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.checks import LAGS, LEVEL, correlated_records, refit
from capsule_id.inference.checks.posterior import (
    PRIOR_PULL,
    check_maximum,
    check_priors,
    check_starts,
    check_statistics,
    default_scatter,
    in_doubt,
)
from capsule_id.inference.checks.settings import MOST_FLAGGED, SampledFit, check_trials, outliers
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling import LENGTH_IN_TAU, MAX_RHAT
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import is_stated
from capsule_id.views import Finding, Trust

# trust: Which numbers of a fit may be quoted, from its findings.
#
# A failed check makes the parameters that its experiment informs not trusted. Without a sample, where the data do not
# inform a parameter, where a warning names it, and where every table that informs it has too few rows to show its
# scatter, its number is not judged: no check can tell.


def concerned(finding: Finding, experiments: Sequence[Experiment]) -> frozenset[str] | None:
    """Names of the parameters that ``finding`` is about; None for all."""
    if finding.parameters:
        return frozenset(finding.parameters)
    named = [e for e in experiments if finding.experiment in (e.label, e.table.label)]
    return frozenset(row.name for e in named for row in e.parameters) if named else None


def with_scaled(finding: Finding, experiments: Sequence[Experiment]) -> Finding:
    """``finding`` with the parameters that its scales multiply: those of the tables and masses that it names."""
    scales = finding.facts.get("scales", ())
    masses, labels = {"m1", "m2"}.intersection(scales), {name.rpartition(".")[0] for name in scales} - {""}
    others = {"g", "slope", "N0"}.intersection(scales)  # all friction depends on them
    read = [e for e in experiments if others or masses & {*e.masses} or labels & {e.label, e.table.label}]
    names = dict.fromkeys([*sorted(masses), *(row.name for e in read for row in e.parameters)])
    return replace(finding, parameters=tuple(names)) if scales else finding


def trust_words(sampled: SampledFit, informed: np.ndarray) -> dict[str, Trust]:
    """Word of every sampled parameter, by name.

    Parameters
    ----------
    informed : (d,) whether the data narrow the prior of each parameter
    """
    failed = [concerned(f, sampled.experiments) for f in sampled.findings if f.level == "fail"]
    doubtful = {name for f in sampled.findings if f.level == "warn" for name in f.parameters}
    few = {f.experiment for f in sampled.findings if f.code == "readings.few"}
    sizes: dict[str, list[bool]] = {}
    for e in sampled.experiments:
        for row in e.parameters:
            sizes.setdefault(row.name, []).append(e.table.label in few)
    doubtful |= {name for name, are_few in sizes.items() if all(are_few) and not is_stated(name)}
    words: dict[str, Trust] = {}
    for row, known in zip(sampled.target.parameters, informed, strict=True):
        judged = sampled.posterior is not None and (known or is_stated(row.name)) and row.name not in doubtful
        words[row.name] = "trusted" if judged else "not judged"
        if any(names is None or row.name in names for names in failed):
            words[row.name] = "not trusted"
    return words


# experiment checks: Residual checks of every experiment at the point fit.
#
# Every check of level ``fail`` has a family-wise false-alarm rate of ``LEVEL`` over its experiments (Bonferroni).


def check_whiteness(s: SampledFit) -> list[Finding]:
    """Check that the residuals of every record are white (Ljung–Box)."""
    correlated, records = correlated_records(s.experiments, s.values)
    findings = [
        Finding("residuals.white", "fail", {**one._asdict(), **one.experiment.noise_facts()}, one.experiment.label)
        for one in correlated
    ]
    return findings or [Finding("residuals.white", "ok", {"records": records, "lags": LAGS})] * bool(records)


def check_outliers(s: SampledFit) -> tuple[list[Finding], dict[str, list[int]]]:
    """Check every table for outliers; also return the flagged row indices, by label."""
    tables = [e for e in s.experiments if not e.time_series]
    findings, flagged = [], {}
    for e in tables:
        theta = e.local(s.values)
        found = outliers(e, theta, LEVEL / len(tables))
        if not found:
            continue
        rows = [o.row for o in found]
        flagged[e.label] = rows
        without = refit(e, theta, rows)
        facts = {
            "file": e.table.file,
            "lines": sorted(int(e.table.rows[row]) for row in rows),
            "score": abs(found[0].score),
            "p": found[0].p,
            "most": MOST_FLAGGED,
            "estimates": [
                (row.name, row.unit, s.values[row.name], without[row.symbol][0])
                for row in e.parameters
                if row.symbol in without
            ],
        }
        findings.append(Finding("outliers", "fail", facts, e.label))
    return findings or [Finding("outliers", "ok")] * bool(tables), flagged


def check_stated_errors(s: SampledFit) -> list[Finding]:
    """Check that stated reading errors explain the scatter (chi-square)."""
    known = [e for e in s.experiments if e.scale_known and e.label not in s.flagged]
    findings = []
    for e in known:
        square = float(np.sum(np.asarray(e.residuals(e.local(s.values), np))[: e.n] ** 2))
        freedom = e.n - 2
        p = float(stats.chi2.sf(square, freedom)) if freedom > 0 else 1.0
        if p * len(known) < LEVEL:
            facts = {"freedom": freedom, "chi_square": square, "p": p}
            findings.append(Finding("errors.stated", "fail", facts, e.label))
    return findings or [Finding("errors.stated", "ok")] * bool(known)


# verdict: All checks of a fit: each finding states the experiment, the expected value, the observed value and a remedy.
#
# A rig without faults passes all checks together in more than 95 of 100 cases (measured in the calibration study).


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
