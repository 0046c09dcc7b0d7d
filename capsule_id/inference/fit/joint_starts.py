"""Where the fit of bench and runs starts: where the bench stands, and the likeliest of many candidates about it.

The likelihood of a run has side maxima far from the truth, and a bench that is wrong by more than it says starts
beside one of them. So candidates that leave the bench's estimates (for runs alone: the values that the paper's
protocol gives) in some parameters, a little or by a third, are weighed by their log-posterior in batches.
"""

from collections.abc import Mapping

import numpy as np

from capsule_id.inference.fit.point_fit import dispersed_starts
from capsule_id.inference.target.log_posterior import LogPosterior

#: Starts that are always tried, of them one where the bench stands; and how many there are in all.
STARTS, MOST_STARTS = 3, 8
#: Candidates, weighed so many at a time.
CANDIDATES, LANES = 1024, 64
#: A parameter of a candidate stays where it is known to be, or leaves it by a factor whose logarithm has an sd drawn
#: between these two (log-uniform): what is wrong is one thing or another, by little or by much.
LEAVES, NEAR, FAR = 0.5, 3e-3, 0.3


def choose_starts(
    target: LogPosterior, known: Mapping[str, float], seed: int, first: Mapping[str, float]
) -> np.ndarray:
    """(at most MOST_STARTS, d) in u: the ``first`` of ``joint_fit`` and the likeliest candidates about it.

    The likeliest stand on top, but for the ``first``, which is one of the first ``STARTS``.
    """
    rng = np.random.default_rng(seed)
    candidates = dispersed_starts(target, seed, CANDIDATES)
    theta = target.theta(candidates[0])
    stands = {**dict(zip(target.names, theta, strict=True)), **known, **first}
    centre = target.unconstrain(np.array([stands[name] for name in target.names]))
    told = {row.name for e in target.experiments if e.event_driven for row in e.parameters}
    has = np.array([name in known for name in target.names])
    open_ = has & target.positive & ~target.scatter & np.array([name in told for name in target.names])
    width = np.exp(rng.uniform(np.log(NEAR), np.log(FAR), candidates.shape)) * open_
    moved = np.where(has, width * rng.standard_normal(candidates.shape), candidates - candidates[0]) + centre
    candidates = np.where((rng.random(candidates.shape) < LEAVES) & ~target.scatter, moved, centre)
    candidates[0] = centre
    value = weigh(target, candidates)
    ranked = 1 + np.argsort(-value[1:])[: MOST_STARTS - 1]
    ranked = ranked[np.isfinite(value[ranked])]
    early = np.append(ranked[: STARTS - 1], 0)
    return candidates[[*early[np.argsort(-value[early], kind="stable")], *ranked[STARTS - 1 :]]]


def weigh(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(n,) log-posterior of u (n, d), one compiled batch for any n; -inf where it is not finite."""
    rows = np.concatenate([u, np.repeat(u[-1:], -len(u) % LANES, axis=0)])
    value = np.concatenate([target.batch(part) for part in np.split(rows, len(rows) // LANES)])[: len(u)]
    return np.where(np.isfinite(value), value, -np.inf)
