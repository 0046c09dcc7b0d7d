"""Starting points of the joint fit: the bench estimates and the best of many candidates around them.

The likelihood of a run has local maxima far from the truth. Where bench estimates are wrong by more than their stated
errors, a fit from them ends in one. Candidates differ from the bench estimates in some parameters, by 0.3 % to 30 %.
For runs alone, the estimates of the paper's protocol replace those of the bench. Log-posteriors come in batches.
"""

from collections.abc import Mapping

import numpy as np

from capsule_id.inference.fit import difference_descent
from capsule_id.inference.fit.curvature import BATCH, in_batches
from capsule_id.inference.fit.point_fit import dispersed_starts
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.marginal import density_of

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
    if any(e.has_joint_scatters for e in target.experiments):
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
            u[target.located] = difference_descent.descend(target, u, FIRST_STEPS).x[0]
        reached = weigh(target, ends)
        # Squares may fall while the log-posterior does too, because the scatter of a trial depends on the motion.
        higher = reached > value[chosen]
        candidates[chosen[higher]], value[chosen[higher]] = ends[higher], reached[higher]
    return candidates, value


def weigh(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(n,) log-posterior of u (n, d), one compiled batch for any n; -inf where it is not finite."""
    density = density_of(target)
    # The first batch compiles the program that all threads then call.
    first, rest = in_batches(density, u[:BATCH]), u[BATCH:]
    return np.concatenate([first, in_batches(density, rest)]) if len(rest) else first
