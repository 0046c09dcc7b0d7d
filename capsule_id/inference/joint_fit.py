"""Joint fit of all experiments: its starts, its second fits, and the stage of the pipeline that runs it."""

import threading
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import minimize

from capsule_id.console import stop_if_interrupted, threads
from capsule_id.errors import InputError
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.inference.curvature import covariance
from capsule_id.inference.least_squares import KINKED, LeastSquaresFit, Solver, least_squares, linearised
from capsule_id.inference.marginal import density_of, rows_of
from capsule_id.inference.point_fit import NEGLIGIBLE_INCREASE, at_another_maximum, described, dispersed_starts
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.views import counted

# joint starts: Starting points of the joint fit: the bench estimates and the best of many candidates around them.
#
# The likelihood of a run has local maxima far from the truth. Where bench estimates are wrong by more than their stated
# errors, a fit from them ends in one. Candidates differ from the bench estimates in some parameters, by 0.3 % to 30 %.
# For runs alone, the estimates of the paper's protocol replace those of the bench. Log-posteriors come in batches.


#: Filters of warnings belong to the process: one thread at a time changes them.
_FILTERS = threading.Lock()
#: Number of starting points that are always tried (the bench estimate included), and the largest number.
STARTS, MAX_STARTS = 3, 8
#: Number of candidates.
CANDIDATES = 1024
#: Where motions have kinks: number of the best candidates, and of others, that descend before the starting points are
#: chosen; and their steps.
CONTENDERS, FIRST_STEPS = 16, 6
#: Perturb a random half of the parameters, by a log-sd that is log-uniform between these two.
PROBABILITY_TO_PERTURB, SMALLEST_LOG_SD, LARGEST_LOG_SD = 0.5, 3e-3, 0.3


def choose_starts(
    target: LogPosterior, known: Mapping[str, float], seed: int, first: Mapping[str, float]
) -> np.ndarray:
    """(at most MAX_STARTS, d) in u: the bench's estimates and the candidates of largest log-posterior.

    The largest come first. The bench estimate, with the values of ``first``, is one of the first ``STARTS``. Without
    estimates, and where an amplitude has no sign, it is the centre of the priors and has no place of its own.
    """
    rng = np.random.default_rng(seed)
    candidates = dispersed_starts(target, seed, CANDIDATES)
    theta = target.theta(candidates[0])
    estimates = {**dict(zip(target.names, theta, strict=True)), **known, **first}
    centre = target.unconstrain(np.array([estimates[name] for name in target.names]))
    of_runs = {row.name for e in target.experiments if e.event_driven for row in e.parameters}
    has = np.array([name in known for name in target.names])
    open_ = has & target.positive & ~target.scatter & np.array([name in of_runs for name in target.names])
    width = np.exp(rng.uniform(np.log(SMALLEST_LOG_SD), np.log(LARGEST_LOG_SD), candidates.shape)) * open_
    moved = np.where(has, width * rng.standard_normal(candidates.shape), candidates - candidates[0]) + centre
    candidates = np.where((rng.random(candidates.shape) < PROBABILITY_TO_PERTURB) & ~target.scatter, moved, centre)
    mirrored = np.isin(target.names, [name for e in target.experiments for name in e.mirrored])
    candidates = np.where(mirrored & (rng.random((len(candidates), 1)) < 0.5), -candidates, candidates)
    # Copies of the centre would agree with it without a proof.
    candidates = np.concatenate([centre[None], candidates[np.any(candidates != centre, axis=1)]])
    value = weigh(target, candidates)
    if target.kinked:
        candidates[1:], value[1:] = _descended(target, candidates[1:], value[1:])
    ranked = 1 + np.argsort(-value[1:])[: MAX_STARTS - 1]
    ranked = ranked[np.isfinite(value[ranked])]
    if not known and mirrored.any() and len(ranked) >= STARTS:
        return candidates[ranked]
    early = np.append(ranked[: STARTS - 1], 0)
    return candidates[[*early[np.argsort(-value[early], kind="stable")], *ranked[STARTS - 1 :]]]


def _descended(target: LogPosterior, candidates: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Candidates (m, d) and their log-posterior (m,), of which the best have descended a few steps.

    A motion with kinks has narrow maxima: the best of random candidates often lie near a wrong one.
    """
    candidates, value = candidates.copy(), value.copy()
    ranked = np.argsort(-value)
    ranked = ranked[np.isfinite(value[ranked])]
    # The best ones often lie near one maximum, so that worse ones descend too.
    chosen = np.append(ranked[:CONTENDERS], ranked[CONTENDERS :: max(len(ranked) // CONTENDERS, 1)])
    if len(chosen):
        ends = candidates[chosen]
        for u in ends:
            u[target.located] = descended(target, u, FIRST_STEPS).x[0]
        reached = weigh(target, ends)
        # Squares may fall while the log-posterior does too, because the scatter of a trial depends on the motion.
        higher = reached > value[chosen]
        candidates[chosen[higher]], value[chosen[higher]] = ends[higher], reached[higher]
    return candidates, value


def descended(target: LogPosterior, u: np.ndarray, steps: int | None = None) -> LeastSquaresFit:
    """Minimise half the squared residuals over the located parameters from u (d,), in ``steps`` steps; the scatters stay."""
    solver = KINKED if target.kinked else SOLVER
    solver = replace(solver, max_steps=steps or solver.max_steps)
    return least_squares(partial(linearised, target, u), u[target.located][None], solver)


def weigh(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(n,) log-posterior of u (n, d), one compiled batch for any n; -inf where it is not finite."""
    density, rows = density_of(target), rows_of(target)
    # The first batch compiles the program that all threads then call.
    first, rest = density(u[:rows]), u[rows:]
    return np.concatenate([first, density(rest)]) if len(rest) else first


# joint fit: Joint point fit of bench tests and forced runs.
#
#     bench tests -> bench point fit -> starting points around it (``joint_starts``), initial conditions from records
#     -> alternate Levenberg–Marquardt on the located parameters and conditional maxima of the scatters until converged
#     -> repeat from any better point that a change of one parameter reaches
#
# Derivatives of motions are central differences, right to 1e-6 sd: forward mode gives the same and takes ten seconds a
# record to trace. The Hessian is that of Gauss–Newton, because the residuals are small. The likelihood has local maxima
# (one contact more or less), so the fit needs several starts.


#: Tolerance, dimensionless, and largest number of solver steps of one descent.
SOLVER = Solver(tolerance=1e-7, max_steps=80, heavy=True)
#: Largest number of rounds of least squares and scatters. Convergence tolerance of a round, in standard deviations.
ROUNDS, SMALL_MOVE_IN_SD = 8, 0.01
#: Largest number of rounds where residuals have kinks: small moves go on there without an end.
ROUNDS_WITH_KINKS = 3
#: Single-parameter steps after a descent, in standard deviations. A point whose log-posterior is higher by more than
#: ``LEAST_INCREASE`` starts another descent, at most ``MAX_RESTARTS`` times.
MOVES_IN_SD, LEAST_INCREASE, MAX_RESTARTS = 2.0 ** np.arange(8), 1.0, 4
#: Largest such step of a positive parameter, natural logarithm.
FARTHEST = 2.0
#: Stop refining a start whose cost exceeds this many times the best.
COST_RATIO_TO_ABANDON = 3.0
#: Searches that run side by side; their number does not depend on the cores, nor do the results.
TOGETHER = 2
#: Try starts until two of them fit every channel within this many times its noise, or so many end at the same maximum.
NOISE_RATIO_OF_A_GOOD_FIT, ENOUGH_THAT_AGREE = 1.2, 4
#: Ends whose excess noise is so close to the smallest have the same misfit: it is that of the model, not of a wrong maximum.
SAME_MISFIT = 1.02
#: Factors by which a scatter moves together with what it multiplies.
FACTORS = np.geomspace(0.1, 10.0, 32)


@dataclass(frozen=True)
class _End:
    """End point of a descent: u (d,), the last least-squares fit, convergence, log-posterior."""

    u: np.ndarray
    fit: LeastSquaresFit
    converged: bool
    value: float


def joint_fit(
    target: LogPosterior,
    known: Mapping[str, float],
    seed: int,
    first: Mapping[str, float] | None = None,
    starts: np.ndarray | None = None,
) -> PointFit:
    """Fit ``target``, whose experiments include forced runs.

    Parameters
    ----------
    known : previous estimates by name: a fit of the bench tests, or the paper's estimates
    seed : seed of the candidates
    first : values by name that replace those of ``known`` in the first starting point
    starts : (s, d) u of the starting points, instead of the best candidates
    """
    if starts is None:
        # Another thread compiles the derivatives meanwhile; an error occurs again where they are used.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(linearised, target, dispersed_starts(target, seed, 1)[0])
            starts = choose_starts(target, known, seed, first or {})
    ends = _ends(target, starts)
    u, value = np.stack([end.u for end in ends]), np.array([end.value for end in ends])
    best = int(np.argmax(value))
    if not np.isfinite(value[best]):
        raise _not_finite(target, ends[best].fit, len(starts))
    fit, located = ends[best].fit, target.located
    matrix = np.zeros((target.dimension, target.dimension))
    matrix[np.ix_(located, located)] = covariance(fit.jacobian[0])
    matrix[np.diag_indices_from(matrix)] += _scatter_variances(target, u[best])
    return described(
        target,
        u[best],
        fit.jacobian[0],
        target.residual_owners(u[best]),
        covariance=matrix,
        starts=starts[: len(ends)],
        ends=u,
        log_posterior=value,
        at_other_maximum=at_another_maximum(u, value, np.sqrt(np.diag(matrix))),
        stalled=np.array([not end.converged for end in ends]),
    )


def _not_finite(target: LogPosterior, fit: LeastSquaresFit, starts: int) -> InputError:
    """The error where no start leads to a finite fit: the derivatives that are not finite where the motion is."""
    columns = np.isfinite(fit.jacobian[0]).all(axis=0)
    names = [target.names[i] for i, finite in zip(target.located, columns, strict=True) if not finite]
    alone = "fit the bench alone (--experiments bench)"
    if names and np.isfinite(fit.residuals).all():
        return InputError(
            "every motion must have finite derivatives",
            f"the motion is finite, its derivative is not: {', '.join(names)}",
            f"state a prior of {' and '.join(names)} with another median, or {alone}",
        )
    return InputError(
        "bench and runs are fitted from a start at which every motion is finite",
        f"none in {counted(starts, 'start')}",
        f"check masses, gaps and settings of the runs, or {alone}",
    )


def _ends(target: LogPosterior, starts: np.ndarray) -> list[_End]:
    """Search from the ``starts`` (s, d) until some suffice: alone until a motion is finite, then ``TOGETHER``."""
    ends: list[_End] = []
    with threads(TOGETHER) as workers:
        while len(ends) < len(starts):
            best = max(ends, key=lambda end: end.value, default=None)
            if best is None or not np.isfinite(best.value):
                ends.append(_search(target, starts[len(ends)], np.inf))
                continue
            if _suffice(target, ends, best.value):
                break
            # Reuse the noise levels of the best fit.
            own = np.where(target.scatter, best.u, starts[len(ends) : len(ends) + TOGETHER])
            limit = COST_RATIO_TO_ABANDON * float(best.fit.cost[0])
            ends += workers.map(partial(_search, target, limit=limit), own)
    return ends


def _suffice(target: LogPosterior, ends: list[_End], highest: float) -> bool:
    """Whether further starts are not needed.

    Two ends fit every channel, many reach the ``highest`` log-posterior, or ``STARTS`` of them have the same misfit.
    """
    if len(ends) < STARTS:
        return False
    if sum(end.value > highest - NEGLIGIBLE_INCREASE for end in ends) >= ENOUGH_THAT_AGREE:
        return True
    excess = np.array([_excess_noise(target, end.u) for end in ends])
    misfit = max(float(np.min(excess)), NOISE_RATIO_OF_A_GOOD_FIT)
    return bool(np.sum(excess <= NOISE_RATIO_OF_A_GOOD_FIT) > 1 or np.sum(excess < SAME_MISFIT * misfit) >= STARTS)


def _excess_noise(target: LogPosterior, u: np.ndarray) -> float:
    """Largest ratio of the residuals of a record at u (d,) to its noise level; above 1 the model does not fit its motion."""
    values = target.mapping(target.theta(u))
    return max(e.excess_noise(e.local(values)) for e in target.experiments)


def _search(target: LogPosterior, start: np.ndarray, limit: float) -> _End:
    """Repeat ``_descend`` from any better point that a change of one parameter reaches."""
    end = _descend(target, start, limit)
    for _ in range(MAX_RESTARTS):
        if not np.isfinite(end.value) or end.fit.cost[0] > limit:
            break
        better = _better_point(target, end)
        if better is None:
            break
        other = _descend(target, better, limit)
        if other.value <= end.value:
            break
        end = other
    return end


def _better_point(target: LogPosterior, end: _End) -> np.ndarray | None:
    """(d,) best point that differs from ``end`` in one located parameter; None if none is clearly better."""
    located = target.located
    sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(end.fit.jacobian[0].T @ end.fit.jacobian[0])), 0.0))
    farthest = np.where(target.positive[located], FARTHEST, np.inf)
    sizes = np.minimum(MOVES_IN_SD[:, None] * sd, farthest)[:, None, :] * np.eye(len(located))
    steps = np.concatenate([sizes, -sizes]).reshape(-1, len(located))
    points = np.repeat(end.u[None], len(steps) + 1, axis=0)
    points[1:, located] += steps
    value = weigh(target, points)
    best = int(np.argmax(value))
    return points[best] if value[best] > value[0] + LEAST_INCREASE else None


def _descend(target: LogPosterior, start: np.ndarray, limit: float = np.inf) -> _End:
    """Descend from one start (d,); stop where the cost exceeds ``limit`` or a number is not finite."""
    located = target.located
    u, still, fit = start.copy(), False, None
    for _ in range(ROUNDS_WITH_KINKS if target.kinked else ROUNDS):
        stop_if_interrupted()
        fit = descended(target, u)
        if not all(np.isfinite(part).all() for part in (fit.x, fit.residuals, fit.jacobian)):
            return _End(u, fit, False, -np.inf)
        sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(fit.jacobian[0].T @ fit.jacobian[0])), 0.0))
        moved = np.max(np.abs(fit.x[0] - u[located]) / np.where(sd > 0, sd, 1.0))
        u[located] = fit.x[0]
        scatters = scatter_modes(target, u)
        shift = max((abs(scatters[i] - u[i]) for i in scatters), default=0.0)
        u[list(scatters)] = list(scatters.values())
        before, u = u, _rescaled(target, u)
        still = bool(moved < SMALL_MOVE_IN_SD and shift < SMALL_MOVE_IN_SD and np.array_equal(before, u))
        if still or fit.cost[0] > limit:
            break
    assert fit is not None, "there is at least one round"
    converged = (still or bool(fit.cost[0] > limit)) and _is_converged(fit)
    return _End(u, fit, converged, float(weigh(target, u[None])[0]))


def _rescaled(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """The best of u (d,) and of points with the same motion, at which a scatter and what it multiplies have changed.

    The readings determine only their product, so that a change of one alone is always worse.
    """
    for scale, own, _ in target.scaled:
        points = np.repeat(u[None], len(FACTORS), axis=0)
        points[:, scale] += np.log(FACTORS)
        points[:, own] /= FACTORS[:, None]
        value = weigh(target, points)
        u = points[np.argmax(value)] if np.max(value) > weigh(target, u[None])[0] else u
    return u


def _is_converged(fit: LeastSquaresFit) -> bool:
    """Whether a fit from one start converged, or stopped where no step increases the log-posterior, as at a kink."""
    step = np.linalg.lstsq(fit.jacobian[0], -fit.residuals[0])[0]
    return not fit.stalled[0] or bool(0.5 * np.sum((fit.jacobian[0] @ step) ** 2) < NEGLIGIBLE_INCREASE)


def scatter_modes(target: LogPosterior, u: np.ndarray) -> dict[int, float]:
    """Conditional maximum, in u, of every scatter given the located entries of u (d,), by index."""
    modes: dict[int, float] = {}
    for members, density in _scatter_densities(target, u):
        # The line search may try sizes that have no finite density, and rounding may end it at the maximum.
        with _FILTERS, warnings.catch_warnings(), np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            warnings.filterwarnings("ignore", "The line search algorithm did not converge", RuntimeWarning)
            found = minimize(lambda t, density=density: -density(t), u[members], method="BFGS").x
        modes |= dict(zip(members.tolist(), found.tolist(), strict=True))
    return modes


def _scatter_variances(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(d,) inverse curvature of every scatter's conditional density at u (d,); 0 for the located entries."""
    h, variances = 0.05, np.zeros(len(u))
    for members, density in _scatter_densities(target, u):
        at = u[members]
        for i, step in zip(members, h * np.eye(len(members)), strict=True):
            bend = (2.0 * density(at) - density(at + step) - density(at - step)) / h**2
            variances[i] = 1.0 / max(bend, 0.1)
    return variances


def _scatter_densities(target: LogPosterior, u: np.ndarray) -> list[tuple[np.ndarray, Callable[[np.ndarray], float]]]:
    """Indices of scatters, alone or those that only act together, and their log-density in u, up to a constant.

    It is given the located entries of u (d,).
    """
    values = target.mapping(target.theta(u))
    parts, profiles = dict[int, list[Misfit | Moments]](), list[tuple[Callable[..., float], dict[str, int]]]()
    for e in target.experiments:
        own = e.local(values)
        index = {row.symbol: target.names.index(row.name) for row in e.parameters if row.scatter}
        if e.has_joint_scatters:
            profiles.append((e.profile(own), index))
            continue
        for part, symbol in zip(e.summaries(own, np), e.scatters, strict=True):
            if symbol is not None:
                parts.setdefault(index[symbol], []).append(part)

    def prior(members: Any, t: Any) -> Any:
        return target.priors.at(members, np).terms(t, np.exp(t), np)

    def alone(i: int, t: np.ndarray) -> float:
        return float(sum(part.log_density(np.exp(t[0]), np) for part in parts[i]) + prior(i, t[0]))

    def together(t: np.ndarray) -> float:
        sizes = dict(zip(joint.tolist(), np.exp(t), strict=True))
        total = sum(profile({s: sizes[i] for s, i in index.items()}) for profile, index in profiles)
        return float(total + np.sum(prior(joint, t)))

    joint = np.array(list(dict.fromkeys(i for _, index in profiles for i in index.values())), dtype=int)
    return [*((np.array([i]), partial(alone, i)) for i in parts), *([(joint, together)] if len(joint) else [])]
