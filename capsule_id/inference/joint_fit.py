"""Point fit of rigs with forced runs: bench first, then everything together.

    bench experiments -> their own point fit -> starts about it (``joint_starts``), runs started from their records
    -> (Levenberg–Marquardt on the located parameters <-> scatters at their conditional maxima) until neither moves
    -> again from wherever moving one parameter alone does better

Derivatives of the event-driven model are exact and forward; the Hessian is Gauss–Newton's, for the residuals are small
and the parameters well known. The likelihood has side maxima (a contact more or less), hence several starts and moves.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from capsule_id.experiments.forced_run import NOISES, ForcedRun
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.inference import density
from capsule_id.inference.density import HeldResiduals
from capsule_id.inference.joint_starts import STARTS, choose_starts, weigh
from capsule_id.inference.least_squares import LeastSquaresFit, covariance, least_squares
from capsule_id.inference.log_posterior import LogPosterior
from capsule_id.inference.result import PointFit

#: Ends count as the same where they differ by less than this many posterior standard deviations.
AGREEMENT = 0.05
TOLERANCE, MAX_STEPS = 1e-7, 80
#: Rounds of least squares and scatters, and how little either may still move, in standard deviations.
ROUNDS, STILL = 8, 0.01
#: Where a descent ends, every parameter alone is moved by so many standard deviations; what gains more than ``GAIN`` in
#: log-posterior is a point to descend from again, and again at most.
MOVES, GAIN, ESCAPES = 2.0 ** np.arange(8), 1.0, 4
#: Difference in log-posterior without a meaning. A contact that moves over a sample gives the likelihood a kink, and so
#: maxima side by side, less than a standard deviation apart: to the posterior they are one. At a maximum on a kink no
#: gradient vanishes: the descent has come to rest where its Gauss–Newton step promises no more than this.
DENT = 0.1
#: A start that comes to rest with this many times the sum of squares of the best one has found another motion: its
#: scatters are then not worth a round.
ELSEWHERE = 3.0
#: Starts go on until two ends leave no run with more than so many times the noise that its record shows.
NOISY = 1.2
#: A scatter's conditional maximum is looked for within this factor (logarithm) of where it stands.
REACH = 6.0


def joint_fit(
    target: LogPosterior, known: Mapping[str, float], seed: int, first: Mapping[str, float] | None = None
) -> PointFit:
    """Fit ``target``, whose experiments include forced runs.

    Parameters
    ----------
    known : values by name of what is known before: a fit of the bench, or the paper's estimates
    seed : of the candidates
    first : values by name that stand where the bench's would, as far as it has them
    """
    starts = choose_starts(target, known, seed, first or {})
    located = np.flatnonzero(~target.scatter)
    ends = [_search(target, starts[0], located)]
    # The others take the first one's scatters to begin with: they start from noise, which any of them knows as well.
    limit = ELSEWHERE * float(ends[0][1].cost[0])
    for start in starts[1:]:
        if len(ends) >= STARTS and sum(not _is_noisy(target, end) for end, _, _ in ends) > 1:
            break
        ends.append(_search(target, np.where(target.scatter, ends[0][0], start), located, limit))
    starts = starts[: len(ends)]
    u = np.stack([end for end, _, _ in ends])
    value = weigh(target, u)
    best = int(np.argmax(value))
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
        elsewhere=_elsewhere(u, value, spread),
        stalled=np.array([not converged for _, _, converged in ends]),
    )


def _elsewhere(u: np.ndarray, value: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """(s,) which of the ends u (s, d) are another maximum than the best; log-posterior (s,), posterior sd (d,)."""
    best = int(np.argmax(value))
    away = np.max(np.abs(u - u[best]) / spread, axis=1)
    dent = (away < 1.0) & (value > value[best] - DENT)
    return (away > AGREEMENT) & ~dent


def _is_noisy(target: LogPosterior, u: np.ndarray) -> bool:
    """At u (d,) a channel of a run has clearly more noise than its record shows: its motion is not described."""
    values = target.mapping(target.theta(u))
    runs = [(e, e.local(values)) for e in target.experiments if isinstance(e, ForcedRun)]
    return any(theta[NOISES[name]] > NOISY * e.rough.noise[name] for e, theta in runs for name in e.channels)


def _search(
    target: LogPosterior, start: np.ndarray, located: np.ndarray, limit: float = np.inf
) -> tuple[np.ndarray, LeastSquaresFit, bool]:
    """``_descend``, and again from wherever moving one parameter alone does better."""
    end = _descend(target, start, located, limit)
    for _ in range(ESCAPES):
        better = _better_point(target, end[0], end[1], located) if end[1].cost[0] <= limit else None
        if better is None:
            break
        end = _descend(target, better, located, limit)
    return end


def _better_point(target: LogPosterior, u: np.ndarray, fit: LeastSquaresFit, located: np.ndarray) -> np.ndarray | None:
    """(d,) the likeliest of the points that differ from u (d,) in one located parameter; None where none gains."""
    sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(fit.jacobian[0].T @ fit.jacobian[0])), 0.0))
    steps = np.concatenate([MOVES, -MOVES])[:, None, None] * np.diag(sd)
    points = np.repeat(u[None], steps[..., 0].size + 1, axis=0)
    points[1:, located] += steps.reshape(-1, len(located))
    value = weigh(target, points)
    best = int(np.argmax(value))
    return points[best] if value[best] > value[0] + GAIN else None


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
            return u, fit, _at_rest(fit)
        scatters = scatter_modes(target, u)
        shift = max((abs(scatters[i] - u[i]) for i in scatters), default=0.0)
        for i, value in scatters.items():
            u[i] = value
        still = bool(moved < STILL and shift < STILL)
        if still:
            break
    assert fit is not None, "there is at least one round"
    return u, fit, still and _at_rest(fit)


def _at_rest(fit: LeastSquaresFit) -> bool:
    """One fit, from one start, converged, or stopped where nothing is left to gain."""
    misses, jacobian = fit.residuals[0], fit.jacobian[0]
    if not fit.stalled[0] or not (np.isfinite(misses).all() and np.isfinite(jacobian).all()):
        return not fit.stalled[0]
    step = np.linalg.lstsq(jacobian, -misses)[0]
    return bool(0.5 * np.sum((jacobian @ step) ** 2) < DENT)


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
