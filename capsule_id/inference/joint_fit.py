"""Point fit of rigs with forced runs: bench first, then everything together.

    bench experiments -> their own point fit -> starts about it, runs started from their records
    -> (Levenberg–Marquardt on the located parameters <-> scatters at their conditional maxima) until neither moves

The likelihood of a run has side maxima far from the truth, so the starts are dispersed as far as the bench leaves the
parameters open (for runs alone: about the values that the paper's protocol gives). Derivatives of the event-driven
model are exact and forward; the Hessian is Gauss–Newton's, for the residuals are small and the parameters well known.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.inference import density
from capsule_id.inference.density import HeldResiduals
from capsule_id.inference.least_squares import LeastSquaresFit, covariance, least_squares
from capsule_id.inference.log_posterior import LogPosterior
from capsule_id.inference.result import PointFit

#: Ends count as the same where they differ by less than this many posterior standard deviations.
AGREEMENT = 0.05
TOLERANCE, MAX_STEPS = 1e-7, 80
#: Rounds of least squares and scatters, and how little either may still move, in standard deviations.
ROUNDS, STILL = 8, 0.01
#: A start that comes to rest with this many times the sum of squares of the best one has found another motion: its
#: scatters are then not worth a round.
ELSEWHERE = 3.0
#: Starts leave the bench's estimates by this many of its standard deviations.
DISPERSION = 1.0
#: Relative sd of the starts about rough values.
ROUGH = 0.01
#: A scatter's conditional maximum is looked for within this factor (logarithm) of where it stands.
REACH = 6.0


def joint_fit(
    target: LogPosterior,
    known: PointFit | Mapping[str, float],
    starts: np.ndarray,
    first: Mapping[str, float] | None = None,
) -> PointFit:
    """Fit ``target``, whose experiments include forced runs.

    Parameters
    ----------
    known : the point fit of its bench experiments, or, for runs alone, rough values by name (the paper's estimates)
    starts : (s, d) in u, as ``point_fit.dispersed_starts`` makes them; the entries that are known are replaced
    first : values by name that the first start has instead, as far as it has them
    """
    starts = _about_known(target, known, starts)
    if first is not None:
        theta = target.theta(starts[0])
        own = [first.get(name, value) for name, value in zip(target.names, theta, strict=True)]
        starts[0] = target.unconstrain(np.array(own))
    located = np.flatnonzero(~target.scatter)
    ends = [_descend(target, starts[0], located)]
    # The others take the first one's scatters to begin with: they start from noise, which any of them knows as well.
    limit = ELSEWHERE * float(ends[0][1].cost[0])
    for start in starts[1:]:
        ends.append(_descend(target, np.where(target.scatter, ends[0][0], start), located, limit))
    u = np.stack([end for end, _, _ in ends])
    value = np.array([float(target.batch(np.repeat(end[None], 2, axis=0))[0]) for end in u])
    best = int(np.argmax(np.where(np.isfinite(value), value, -np.inf)))
    fit = ends[best][1]
    matrix = np.zeros((target.dimension, target.dimension))
    located_covariance = covariance(fit.jacobian[0], fit.residuals[0], residual_sd=1.0)
    matrix[np.ix_(located, located)] = located_covariance.matrix
    scatters = np.flatnonzero(target.scatter)
    matrix[scatters, scatters] = _scatter_variances(target, u[best])
    spread = np.sqrt(np.diag(matrix))
    theta = target.theta(u[best])
    errors = np.full(target.dimension, np.nan)
    errors[located] = located_covariance.standard_errors * np.where(target.positive, theta, 1.0)[located]
    return PointFit(
        names=target.names,
        u=u[best],
        values=dict(zip(target.names, (float(v) for v in theta), strict=True)),
        covariance=matrix,
        standard_errors=dict(zip(target.names, (float(e) for e in errors), strict=True)),
        starts=starts,
        ends=u,
        log_posterior=value,
        agree=bool(np.all(np.abs(u - u[best]) < AGREEMENT * spread)),
        stalled=np.array([not converged for _, _, converged in ends]),
    )


def _about_known(target: LogPosterior, known: PointFit | Mapping[str, float], starts: np.ndarray) -> np.ndarray:
    """``starts`` with the entries that are known drawn about what is known; the first start has them as they are."""
    starts = starts.copy()
    if isinstance(known, PointFit):
        own = np.array([target.names.index(name) for name in known.names])
        centre, root = known.u, np.linalg.cholesky(known.covariance)
        root = DISPERSION * np.where(target.scatter[own, None], 0.0, root)
    else:
        names = [name for name in target.names if name in known]
        own = np.array([target.names.index(name) for name in names], dtype=int)
        theta = target.theta(starts[0])
        theta[own] = [known[name] for name in names]
        centre, root = target.unconstrain(theta)[own], ROUGH * np.eye(len(own))
    for i, start in enumerate(starts):
        z = np.random.default_rng([i, len(own)]).standard_normal(len(own))
        start[own] = centre + (root @ z if i else 0.0)
    return starts


def _descend(
    target: LogPosterior, start: np.ndarray, located: np.ndarray, limit: float = np.inf
) -> tuple[np.ndarray, LeastSquaresFit, bool]:
    """From one start: (d,) end, the last least-squares fit, whether everything came to rest (above ``limit`` too)."""
    u, still, fit = start.copy(), False, None
    for _ in range(ROUNDS):
        residual = HeldResiduals(target.structure, tuple(int(i) for i in located), target.numbers, jnp.asarray(u))
        fit = least_squares(
            residual, u[located][None], tolerance=TOLERANCE, max_steps=MAX_STEPS, normal_equations=True, heavy=True
        )
        if not np.isfinite(fit.x).all():
            break
        sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(fit.jacobian[0].T @ fit.jacobian[0])), 0.0))
        moved = np.max(np.abs(fit.x[0] - u[located]) / np.where(sd > 0, sd, 1.0))
        u[located] = fit.x[0]
        if fit.cost[0] > limit:
            return u, fit, not bool(fit.stalled[0])
        scatters = scatter_modes(target, u)
        shift = max((abs(scatters[i] - u[i]) for i in scatters), default=0.0)
        for i, value in scatters.items():
            u[i] = value
        still = bool(moved < STILL and shift < STILL)
        if still:
            break
    assert fit is not None, "there is at least one round"
    return u, fit, still and not bool(fit.stalled[0])


def scatter_modes(target: LogPosterior, u: np.ndarray) -> dict[int, float]:
    """Conditional maximum, in u, of every scatter given the located entries of u (d,), by index."""
    modes = {}
    for i, terms in _scatter_terms(target, u).items():
        bounds = (u[i] - REACH, u[i] + REACH)
        found: Any = minimize_scalar(lambda t, terms=terms: -terms(t), bounds=bounds, options={"xatol": 1e-5})
        modes[i] = float(found.x)
    return modes


def _scatter_variances(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """Inverse curvature of every scatter's conditional density at u (d,), in the order of the scatters."""
    h, variances = 0.05, []
    terms = _scatter_terms(target, u)
    for i in np.flatnonzero(target.scatter).tolist():
        bend = (2.0 * terms[i](u[i]) - terms[i](u[i] + h) - terms[i](u[i] - h)) / h**2
        variances.append(1.0 / max(bend, 0.1))
    return np.array(variances)


def _scatter_terms(target: LogPosterior, u: np.ndarray) -> dict[int, Callable[[float], float]]:
    """log-density of every scatter's u given the located entries of u (d,), up to a constant, by index."""
    values = target.mapping(target.theta(u))
    parts: dict[int, list[Misfit | Moments]] = {int(i): [] for i in np.flatnonzero(target.scatter)}
    for experiment in target.experiments:
        names = {row.symbol: row.name for row in experiment.parameters}
        for part, symbol in zip(experiment.summaries(experiment.local(values), np), experiment.scatters, strict=True):
            if symbol is not None:
                parts[target.names.index(names[symbol])].append(part)

    def terms(i: int, t: float) -> float:
        prior = {name: array[i] for name, array in target.priors.items()}
        own = sum(part.log_density(np.exp(t), np) for part in parts[i])
        return float(own + density.prior_terms(prior, np.float64(t), np.exp(t), np))

    return {i: partial(terms, i) for i in parts}
