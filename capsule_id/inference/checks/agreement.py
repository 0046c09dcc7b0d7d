"""Check that forced runs and bench tests give consistent parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import stats

from capsule_id.inference.fit.least_squares import linearised
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.target.log_posterior import HeldResiduals, LogPosterior
from capsule_id.views import Finding

#: Family-wise false-alarm rate of the comparison between bench tests and runs, dimensionless.
LEVEL = 0.02
#: Degrees of freedom of the tails without a sample: those of three trials, the fewest that show their own scatter.
FREEDOM_WITHOUT_SAMPLE = 2


@dataclass(frozen=True)
class RunsAlone:
    """Estimate from runs and priors only: ``names`` of the located parameters, u (p,), covariance (p, p)."""

    names: tuple[str, ...]
    u: np.ndarray
    covariance: np.ndarray


def runs_alone(target: LogPosterior, fit: PointFit) -> RunsAlone:
    """Estimate from runs and priors: one Gauss–Newton step from the joint ``fit`` without bench residuals."""
    located = target.located
    misses, jacobian = linearised(HeldResiduals(target, jnp.asarray(fit.u)), fit.u[located])
    rows = np.array([owner is None or not owner.bench for owner in target.residual_owners(fit.u)])
    kept = jacobian[rows]
    covariance = np.linalg.inv(kept.T @ kept)
    u = fit.u[located] - covariance @ (kept.T @ misses[rows])
    return RunsAlone(tuple(target.names[i] for i in located), u, covariance)


@dataclass(frozen=True)
class Distance:
    """Bench estimate minus run estimate of one parameter.

    Attributes
    ----------
    sd : difference in units of its Laplace standard deviation
    z : standard normal quantile of the tail probability of the difference. The tails are those of the bench sample,
        where one exists.
    """

    sd: float
    z: float


def disagreement(
    shared: Sequence[str], runs: RunsAlone, bench: PointFit, sample: Posterior | None
) -> dict[str, Distance]:
    """Return the distance of every ``shared`` parameter, by name; bench and runs are independent."""
    found = {}
    for name in shared:
        i, j = runs.names.index(name), bench.names.index(name)
        own = runs.covariance[i, i]
        z = sd = float((bench.u[j] - runs.u[i]) / np.sqrt(bench.covariance[j, j] + own))
        if sample is not None:
            # Every shared parameter is positive: u is its logarithm.
            draws = np.log(sample.draws[..., j].ravel())
            blurred = draws + np.sqrt(own) * np.random.default_rng(j).standard_normal(draws.size)
            z = _by_sample(blurred, float(runs.u[i]), sd)
        found[name] = Distance(sd, z)
    return found


def _by_sample(draws: np.ndarray, value: float, laplace: float) -> float:
    """Standard normal quantile of the rank of ``value`` among ``draws``, with the sign of ``laplace``.

    Beyond the outermost 1 % a Student t tail, fitted to the outer quantiles, extrapolates the sample.
    """
    below = np.mean(draws < value)
    if 0.005 < below < 0.995:
        return float(-stats.norm.ppf(below))
    # The outer quantiles at two levels give the number of degrees of freedom of the tail.
    levels = np.array([0.005, 0.05]) if below < 0.5 else np.array([0.995, 0.95])
    centre = float(np.median(draws))
    outer, inner = np.abs(np.quantile(draws, levels) - centre)
    freedom = _freedom(outer / inner)
    scale = outer / stats.t.isf(0.005, freedom)
    tail = stats.t.logsf(abs(value - centre) / scale, freedom)
    return float(np.copysign(_quantile_of_log_tail(float(tail)), laplace))


def _freedom(ratio: float) -> float:
    """Degrees of freedom of a Student t whose 0.5 % and 5 % points have this ``ratio``."""
    grid = np.geomspace(1.0, 1e3, 200)
    return float(grid[np.argmin(np.abs(stats.t.isf(0.005, grid) / stats.t.isf(0.05, grid) - ratio))])


def _quantile_of_log_tail(log_tail: float) -> float:
    """z with log(1 - Phi(z)) = ``log_tail``, also where the tail itself underflows."""
    z = np.linspace(0.0, 40.0, 8001)
    return float(np.interp(-log_tail, -stats.norm.logsf(z), z))


def check_agreement(
    target: LogPosterior, joint: PointFit, bench: PointFit | None, sample: Posterior | None
) -> list[Finding]:
    """Check that bench tests and runs are consistent (two-sided, Šidák over the shared parameters).

    Masses are excluded, because both estimates contain their weighings.
    """
    known = {row.name for e in target.experiments if not e.bench for row in e.parameters}
    shared = [] if bench is None else [name for name in bench.names if name in known]
    found = disagreement(shared, runs_alone(target, joint), bench, sample) if bench is not None and shared else {}
    tests = {
        name: [e.label for e in target.experiments if e.bench and name in {row.name for row in e.parameters}]
        for name in found
    }
    return [agreement(found, sample is not None, tests)] if found else []


def agreement(
    found: Mapping[str, Distance], sampled: bool, tests: Mapping[str, Sequence[str]] | None = None
) -> Finding:
    """Convert the distances of ``disagreement`` to a finding.

    Without a bench sample a disagreement is a failure only where Student's t with ``FREEDOM_WITHOUT_SAMPLE`` excludes
    it too, because the Laplace approximation of few trials underestimates their tails.

    Among the parameters that disagree significantly, the largest disagreement, in sd, is reported.
    The distance in sd measures how much the error of one parameter explains. An error in one parameter also shifts
    the parameters correlated with it (v_s with mu). Heavy tails make z a poor measure of its origin.
    ``tests`` are the labels of the bench tests that inform each parameter; those of the largest disagreement are named.
    """
    p = {name: _sidak(stats.norm.sf(abs(one.z)), len(found)) for name, one in found.items()}
    lost = [name for name, one in found.items() if not (np.isfinite(one.sd) and np.isfinite(one.z))]
    far = [name for name in found if p[name] < LEVEL and name not in lost]
    far.sort(key=lambda name: -abs(found[name].sd))
    if lost and not far:
        return Finding("bench_and_runs.estimates", "warn", {"shared": len(found), "missing": lost})
    heavy = [_sidak(stats.t.sf(abs(found[name].sd), FREEDOM_WITHOUT_SAMPLE), len(found)) < LEVEL for name in far]
    level = "ok" if not far else "fail" if sampled or any(heavy) else "warn"
    named = far or [min(p, key=lambda name: p[name])]
    facts = {
        "distances": [(name, found[name].sd, p[name]) for name in named],
        "shared": len(found),
        "sampled": sampled,
        "tests": ", ".join((tests or {}).get(named[0], ())),
    }
    return Finding("bench_and_runs.agree", level, facts)


def _sidak(tail: Any, number: int) -> float:
    """p-value of the largest of ``number`` scores with this one-sided ``tail``."""
    with np.errstate(divide="ignore"):  # tail 0.5: log(0), and p = 1
        return float(-np.expm1(number * np.log1p(-2.0 * tail)))
