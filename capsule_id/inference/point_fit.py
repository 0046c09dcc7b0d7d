"""Point fit of the parameters, and what each experiment contributes to their variances."""

import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from scipy import linalg, optimize

from capsule_id.console import stop_if_interrupted
from capsule_id.experiments.base import Experiment
from capsule_id.inference.curvature import Jacobian, Matrix, Vector, covariance, directions, hessian
from capsule_id.inference.least_squares import Solver, least_squares, linearised
from capsule_id.inference.marginal import density_of, terms_of
from capsule_id.inference.result import STATED, PointFit
from capsule_id.inference.target import LogPosterior, prior_of
from capsule_id.parameters import is_stated

# variance shares: Uncertainty budget of a point fit: how much every table and every prior contributes to the sd of a
# parameter.
#
# At the maximum an error e of the residuals moves the estimate by C Jᵀ e, with C = (Jᵀ J)⁻¹ and unit variance of
# every entry of e. The entries of one input, rows i of J, therefore contribute diag(C J_iᵀ J_i C) to the variance
# diag(C), and the contributions of all inputs add up to it (JCGM 100:2008, *Guide to the expression of
# uncertainty*, 5.1.2).


def variance_shares(
    target: LogPosterior, jacobian: Jacobian, owners: Sequence[Experiment | None]
) -> dict[str, dict[str, float]]:
    """Share of every input in the variance of every located parameter; {} where the Jacobian is rank deficient.

    Parameters
    ----------
    jacobian : (n, located) of the standardised residuals, priors last
    owners : (n,) experiment of every residual; None: a prior

    Returns
    -------
    By parameter, then by input: the label of a table, ``prior of c``, ``stated value of m1``.
    """
    found = covariance(jacobian)
    if not np.isfinite(found).all():
        return {}
    effect = (jacobian @ found) ** 2 / np.diag(found)
    inputs = [e.table.label for e in owners if e is not None]
    stated = [is_stated(row.name) or prior_of(row).kind == "positive_normal" for row in target.parameters]
    inputs += [f"{STATED if own else 'prior of '}{name}" for name, own in zip(target.names, stated, strict=True)]
    names = list(dict.fromkeys(inputs))
    number = np.array([names.index(name) for name in inputs])
    shares = np.stack([np.bincount(number, column, len(names)) for column in effect.T])
    located = [target.names[i] for i in target.located]
    return {
        name: dict(zip(names, (float(s) for s in row), strict=True)) for name, row in zip(located, shares, strict=True)
    }


# point fit: Maximum of the joint log-posterior from several starts.
#
# Least squares finds the basin, with the scatters fixed at their starting values. Quasi-Newton then maximises the joint
# log-posterior, scatters included. Its coordinates are whitened by the curvature at the best least-squares end. Its
# gradients are differences of batched log-posteriors, which the Hessian needs anyway. A gradient by reverse mode takes
# seconds to compile and only milliseconds to run.


#: Default number of starting points.
STARTS = 5
#: Ends that differ by less than this many posterior standard deviations count as the same maximum.
AGREEMENT = 0.05
#: Differences in log-posterior below this count as equal. A contact that crosses a sample gives the likelihood a kink.
#: Kinks, and rounding, produce local maxima less than a standard deviation apart, which count as one.
NEGLIGIBLE_INCREASE = 0.1
#: Smallest curvature that counts, relative to Gauss-Newton's.
FLATTEST = 1e-4
#: An end of least squares this near to a maximum, in posterior standard deviations, belongs to it.
SAME_BASIN = 0.3
#: Gradients per posterior standard deviation: quasi-Newton stops below the first, and its end counts as a maximum
#: below the second. Rounding of the log-posterior may stop it in between.
TOLERANCE, MAXIMUM = 1e-4, 1e-3
#: Step of the gradient's central differences, in standard deviations. Its error is 3e-5 where the curvature changes
#: by half over one standard deviation. A log-posterior of 500 readings of 4000 sds is rounded to 1e-6, which a step of
#: 1e-3 made an error of 1e-3.
GRADIENT_STEP = 2e-2
#: Largest number of parameters along each of which differences are taken: their time grows with its square.
MANY = 100
#: Largest number of quasi-Newton steps, and the times that the curvature is taken anew on the way to the best maximum.
MAX_STEPS, ROUNDS = 400, 4
#: Replaces a term of the log-posterior that is not finite, because line searches need a finite number.
LOG_POSTERIOR_FLOOR = -1e12
#: Solver settings to find the basin. Few steps suffice: the logarithm of an absent damping term decreases
#: until the prior stops it. Quasi-Newton reaches that point in fewer steps.
BASIN_SOLVER = Solver(tolerance=1e-6, max_steps=40)


def point_fit(target: LogPosterior, seed: int, number_of_starts: int = STARTS) -> PointFit:
    """Maximise the log-posterior from ``number_of_starts`` dispersed starting points of this ``seed``.

    Starts at fits of simpler models come on top. They are reported only where one of them leads to the highest maximum.
    """
    starts = np.concatenate([dispersed_starts(target, seed, number_of_starts), target.nested_starts()])
    maxima = starts, *_maxima(target, starts)
    kept = np.union1d(np.arange(number_of_starts), _highest(maxima[2]))
    return _from_maxima(target, *(each[kept] for each in maxima))


def point_fit_again(target: LogPosterior, before: PointFit, start: np.ndarray) -> PointFit:
    """The fit ``before`` with one more start (d,)."""
    known = before.starts, before.ends, before.log_posterior, ~before.stalled
    found = start[None], *_maxima(target, start[None])
    return _from_maxima(target, *(np.concatenate(pair) for pair in zip(known, found, strict=True)))


def _highest(value: np.ndarray) -> int:
    return int(np.argmax(np.where(np.isfinite(value), value, -np.inf)))


def at_another_maximum(u: np.ndarray, value: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """(s,) whether each end u (s, d) differs from the best maximum; log-posterior (s,), posterior sd (d,)."""
    best = _highest(value)
    away = np.max(np.abs(u - u[best]) / spread, axis=1)
    same = (away <= AGREEMENT) | ((away < 1.0) & (value > value[best] - NEGLIGIBLE_INCREASE))
    return ~same | ~np.isfinite(value)


def _from_maxima(
    target: LogPosterior, starts: np.ndarray, u: np.ndarray, value: np.ndarray, converged: np.ndarray
) -> PointFit:
    """The fit at the highest of the maxima u (s, d), which ``starts`` (s, d) led to; see ``_maxima``."""
    best = _highest(value)
    _, at_fit = linearised(target, u[best])
    root = np.matmul(*root_of_covariance(target, u[best], at_fit))
    spread = np.sqrt(np.sum(root**2, axis=1))
    return described(
        target,
        u[best],
        at_fit,
        target.residual_owners(u[best]),
        covariance=root @ root.T,
        starts=starts,
        ends=u,
        log_posterior=value,
        at_other_maximum=at_another_maximum(u, value, spread),
        stalled=~converged | ~np.isfinite(value),
    )


def _maxima(target: LogPosterior, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maxima (s, d) from ``starts`` (s, d), log-posteriors there, and whether each has converged, (s,) each."""
    located, density = target.located, density_of(target)
    # Compile the log-posterior at the same time as least squares, to save time.
    with ThreadPoolExecutor(1) as pool:
        compiled = pool.submit(density, starts[:1])
        rough = least_squares(partial(linearised, target, starts[0]), starts[:, located], BASIN_SOLVER).x
        compiled.result()
    ends = starts.copy()
    ends[:, located] = np.where(np.isfinite(rough), rough, starts[:, located])
    # Least squares knows no scatter: it may end at a lower density than it began with.
    before, after = density(starts), density(ends)
    ends = np.where((after >= before)[:, None], ends, starts)
    best = int(np.argmax(np.nan_to_num(np.fmax(before, after), nan=-np.inf)))
    at = ends[best]
    # Every batch runs in the pool of threads, so the starts need their own.
    with warnings.catch_warnings(), ThreadPoolExecutor(os.cpu_count()) as threads:
        # SciPy hides this warning itself, but its way is not safe in threads.
        warnings.filterwarnings("ignore", "The line search algorithm did not converge", RuntimeWarning)
        # The best end of least squares may lie far from the maximum, where the curvature is another one.
        for _ in range(ROUNDS):
            roots = root_of_covariance(target, at, linearised(target, at)[1])
            at, _, converged = highest = polish(target, at, roots, MAX_STEPS // ROUNDS)
            if converged:
                break
        # An end of least squares within a fraction of a standard deviation leads to the same maximum.
        spread = np.sqrt(np.sum(np.matmul(*roots) ** 2, axis=1))
        away = np.any(np.abs(ends - highest[0])[:, located] > SAME_BASIN * spread[located], axis=1)
        away[best] = False
        # Where even the best end stalls, a long search from the others is of no use.
        steps = MAX_STEPS if highest[2] else MAX_STEPS // ROUNDS
        others = list(threads.map(lambda end: polish(target, end, roots, steps), ends[away]))
    polished = [others.pop(0) if own else highest for own in away]
    u, value, converged = (np.stack(part) for part in zip(*polished, strict=True))
    return u, value, converged


def dispersed_starts(target: LogPosterior, seed: int, number: int) -> np.ndarray:
    """(number, d) in u: the proposed centre, then normal draws about it with the spread of each parameter."""
    by_name = target.starts()
    proposed = [by_name[name] for name in target.names]
    centre = target.unconstrain(np.array([start.centre for start in proposed]))
    spread = np.array([start.spread for start in proposed])
    z = np.random.default_rng(seed).standard_normal((number, target.dimension))
    # The first start is the centre. The others differ from it by at least a third of their spread.
    z = np.where(np.abs(z) < 1.0 / 3.0, np.copysign(1.0 / 3.0, z), z)
    z[0] = 0.0
    return centre + spread * z


def polish(
    target: LogPosterior, end: Vector, roots: tuple[Matrix, Matrix], steps: int = MAX_STEPS
) -> tuple[Vector, float, bool]:
    """BFGS from ``end`` (d,) in coordinates whitened by ``roots``: maximum (d,), log-posterior there, converged.

    Roots (d, k) search k directions only, k < d.

    The differences of its gradient are along the white coordinates; of more than ``MANY`` parameters along those of the first
    root alone, where all scatters share one difference.
    """
    (whitening, rotation), alone, terms = roots, np.flatnonzero(target.integrated), terms_of(target)
    d = whitening.shape[1]
    if d <= MANY or d < len(end):
        whitening, rotation, alone = whitening @ rotation, np.eye(d), alone[:0]
    rest, moves = np.setdiff1d(np.arange(d), alone), GRADIENT_STEP * directions(d, alone)

    def objective(v: Vector) -> tuple[float, Vector]:
        """Negative log-posterior at whitened v (d,), and its gradient (d,): one batch for both, up to 15 directions."""
        w = rotation @ v
        found = terms(end + np.concatenate([w[None], w + moves, w - moves]) @ whitening.T)
        found = np.where(np.isfinite(found), found, LOG_POSTERIOR_FLOOR)
        centre, *sides = np.split(found, [1, 1 + len(moves)])
        slopes, gradient = (sides[0] - sides[1]) / (2.0 * GRADIENT_STEP), np.empty(d)
        gradient[rest], gradient[alone] = np.sum(slopes[: len(rest)], axis=1), slopes[len(rest) :, 1:].reshape(-1)
        return -float(np.sum(centre)), -gradient @ rotation

    stop_if_interrupted()
    options = {"gtol": TOLERANCE, "maxiter": steps}
    # A line search may leave the domain, where slopes of the floor overflow.
    with np.errstate(over="ignore", invalid="ignore"):
        solution = optimize.minimize(objective, np.zeros(d), jac=True, method="BFGS", options=options)
    value = -float(solution.fun)
    # Beside a term at the floor the others may be positive.
    inside = value > 0.5 * LOG_POSTERIOR_FLOOR
    return end + whitening @ rotation @ solution.x, value, inside and bool(np.max(np.abs(solution.jac)) < MAXIMUM)


def root_of_covariance(target: LogPosterior, u: Vector, jacobian: Jacobian) -> tuple[Matrix, Matrix]:
    """W, T (d, d) with W T (W T)' the inverse Hessian of -log-posterior at u (d,); ``jacobian`` (n, located) of residuals.

    The Hessian is taken in coordinates that W whitens by Gauss-Newton's approximation, by an orthogonal factor. Where
    the readings determine k1/m1 to six digits and m1 to two, no digit of the Hessian in u itself would be left. W mixes no
    scatter with another parameter.
    """
    located = target.located
    count = np.zeros(target.dimension)
    for experiment in target.experiments:
        for row in experiment.parameters:
            if row.scatter:
                count[target.names.index(row.name)] += 2.0 * experiment.n
    whitening = np.diag(np.maximum(count, 1e-2) ** -0.5)
    triangle = np.linalg.qr(np.nan_to_num(jacobian, posinf=0.0, neginf=0.0), mode="r")
    whitening[np.ix_(located, located)] = linalg.solve_triangular(triangle, np.eye(len(located)))
    terms, zero, alone = terms_of(target), np.zeros(len(u)), np.flatnonzero(target.integrated)
    curvature = hessian(lambda w: terms(u + w @ whitening.T), zero, zero + 1.0, alone)
    # Reading errors may hide a scatter from any number of readings: its prior alone then gives its curvature.
    hidden = target.scatter & (-np.diag(curvature) < FLATTEST)
    if np.any(hidden):
        whitening[hidden, hidden] = target.prior_sd[hidden]
        curvature = hessian(lambda w: terms(u + w @ whitening.T), zero, zero + 1.0, alone)
    # Away from a maximum a direction may have no positive curvature; there Gauss-Newton's stands.
    values, vectors = np.linalg.eigh(np.nan_to_num(-curvature, nan=0.0, posinf=0.0, neginf=0.0))
    return whitening, vectors / np.sqrt(np.where(values > FLATTEST, values, 1.0))


def described(
    target: LogPosterior, u: np.ndarray, at_fit: Jacobian, owners: Sequence[Experiment | None], **rest: Any
) -> PointFit:
    """The fit at u (d,), from the Jacobian ``at_fit`` (n, located) of the residuals and the ``owners`` of these.

    The error of a parameter sampled through its logarithm is its relative error times its value; NaN for scatters.
    """
    theta, located, errors = target.theta(u), target.located, np.full(target.dimension, np.nan)
    errors[located] = np.sqrt(np.diag(covariance(at_fit))) * np.where(target.positive, theta, 1.0)[located]
    return PointFit(
        names=target.names,
        u=u,
        values=dict(zip(target.names, theta.tolist(), strict=True)),
        standard_errors=dict(zip(target.names, errors.tolist(), strict=True)),
        shares=variance_shares(target, at_fit, owners),
        **rest,
    )
