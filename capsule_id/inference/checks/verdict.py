"""Checks and verdict: each finding names the experiment, what was expected, what was seen, and what to do.

A clean rig passes all of them together in more than 95 of 100 cases (measured in the calibration study).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from capsule_id.experiments.base import Experiment
from capsule_id.inference.checks.experiment_checks import check_outliers, check_stated_errors, check_whiteness
from capsule_id.inference.checks.setting import Setting
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling.ensembles import LENGTH_IN_TAU, MAX_RHAT
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.views import Finding

#: A parameter is informed where its posterior sd (in u) is at most this part of its prior's.
INFORMED_RATIO = 0.9
#: A maximum lower than the best by this much in log-posterior holds no mass worth the name.
NEGLIGIBLE_MODE = 20.0
#: A physical parameter that ends this many prior sds from the prior's centre is pulled by it.
PRIOR_PULL = 2.5


def run_checks(setting: Setting) -> Setting:
    """``setting`` with all findings, and with the outliers flagged."""
    whiteness = check_whiteness(setting)
    outliers, flagged = check_outliers(setting)
    setting = replace(setting, flagged=flagged)
    findings = [
        *check_starts(setting.fit),
        *_chains(setting),
        *whiteness,
        *outliers,
        *check_stated_errors(setting),
        *(finding for check in declared(setting.experiments, "checks", bench=True) for finding in check(setting)),
        *_informed(setting),
        *_boundary(setting),
        *(finding for check in declared(setting.experiments, "checks", bench=False) for finding in check(setting)),
    ]
    return replace(setting, findings=tuple(findings))


def declared(
    experiments: Sequence[Experiment], what: Literal["checks", "tables"], bench: bool
) -> list[Callable[[Setting], list[Any]]]:
    """Every check (or table) that bench tests, or runs, declare, each with the experiments that declare it."""
    members: dict[Callable[..., list[Any]], list[Experiment]] = {}
    for experiment in experiments:
        for function in getattr(experiment, what) if experiment.bench == bench else ():
            members.setdefault(function, []).append(experiment)
    return [partial(function, own) for function, own in members.items()]


def check_starts(fit: PointFit) -> list[Finding]:
    """Expected: every start of the point fit ends at one maximum, or at one that holds no mass."""
    facts: dict[str, Any] = {"starts": len(fit.starts)}
    if fit.agree and not fit.stalled.any():
        return [Finding("starts.agree", "ok", facts)]
    elsewhere = fit.elsewhere
    facts |= {"stalled": int(fit.stalled.sum()), "elsewhere": int(elsewhere.sum())}
    if not elsewhere.any():
        return [Finding("starts.agree", "fail", facts)]
    distance = np.abs(fit.ends - fit.u) / np.sqrt(np.diag(fit.covariance))
    away = np.where(np.isfinite(distance), distance, np.inf).max(axis=1)
    worst = int(np.argmax(np.where(elsewhere, away, -np.inf)))
    facts |= {"distance": away[worst], "name": fit.names[int(np.argmax(distance[worst]))]}
    # How much less probable the other ends are: a mode that far down holds no posterior mass.
    below = np.max(fit.log_posterior) - np.where(np.isfinite(fit.log_posterior), fit.log_posterior, -np.inf)
    negligible = np.all(below[elsewhere] > NEGLIGIBLE_MODE)
    if negligible and np.sum(~elsewhere) >= 2 and not fit.stalled[~elsewhere].any():
        return [Finding("starts.agree", "warn", {**facts, "below": np.min(below[elsewhere])})]
    return [Finding("starts.agree", "fail", facts)]


def _chains(s: Setting) -> list[Finding]:
    p = s.posterior
    if p is None:
        return [Finding("chains.converged", "warn")]
    worst_tau, worst_rhat = int(np.argmax(p.tau)), int(np.argmax(p.rhat))
    facts = {
        "draws": p.draws.shape[1],
        "length": p.draws.shape[1] / p.tau[worst_tau],
        "slowest": p.names[worst_tau],
        "rhat": p.rhat[worst_rhat],
        "worst": p.names[worst_rhat],
        "length_wanted": LENGTH_IN_TAU,
        "rhat_wanted": MAX_RHAT,
    }
    return [Finding("chains.converged", "ok" if p.converged else "fail", facts)]


def informed(target: LogPosterior, posterior: Posterior | None, fit: PointFit) -> np.ndarray:
    """(d,) posterior sd of u at most ``INFORMED_RATIO`` of its prior's (Laplace where there is no sample)."""
    if posterior is None:
        sd = np.sqrt(np.diag(fit.covariance))
    else:
        flat = posterior.draws.reshape(-1, len(posterior.names))
        sd = np.std(target.unconstrain(flat), axis=0)
    return sd <= INFORMED_RATIO * target.prior_sd


def _informed(s: Setting) -> list[Finding]:
    known = informed(s.target, s.posterior, s.fit)
    # A weighing is not narrowed by anything else, nor need it be; a scatter whose reading error is stated may vanish.
    names = [
        row.name
        for row, ok in zip(s.target.parameters, known, strict=True)
        if row.physical and row.symbol not in ("m1", "m2") and not ok
    ]
    return [Finding("parameters.informed", "warn" if names else "ok", {"names": ", ".join(names)})]


def _boundary(s: Setting) -> list[Finding]:
    """Posteriors in the tail of a prior."""
    z = np.abs(s.target.prior_residuals(s.fit.u))
    names = [row.name for row, pull in zip(s.target.parameters, z, strict=True) if pull > PRIOR_PULL]
    return [Finding("priors.tails", "warn" if names else "ok", {"names": ", ".join(names)})]
