"""emcee: independent ensembles, run until they agree or the budget is spent, saved while they run."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import emcee
import numpy as np

from capsule_id.inference.curvature import in_batches
from capsule_id.inference.diagnostics import effective_sample_size, integrated_time, split_rhat
from capsule_id.inference.log_posterior import LogPosterior
from capsule_id.inference.moves import PILOT_STEPS, Moves, candidates, differential_evolution
from capsule_id.inference.result import PointFit, Posterior

ENSEMBLES = 4
#: Walkers of an ensemble: at least 64, and at least three for every parameter.
MIN_WALKERS, WALKERS_PER_PARAMETER = 64, 3
#: A sample is long enough when every parameter has more draws than this many autocorrelation times ...
LENGTH_IN_TAU = 50.0
#: ... and its ensembles agree when no split R-hat is above this.
MAX_RHAT = 1.01
#: Stored draws of an ensemble before the first check, and between the checks that follow.
FIRST_CHECK, CHECK_EVERY = 120, 60
#: Autocorrelation times (of the pilot) that every ensemble runs before its first stored draw.
BURN_IN_IN_TAU = 20.0
#: Walkers start this much wider than the Laplace approximation.
OVERDISPERSION = 1.2
DEFAULT_BUDGET = 20_000

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Schedule:
    """What the pilot run decides for the recorded one."""

    move: str
    moves: Moves
    measured: Mapping[str, float]
    thin: int
    burn_in: int


def sample(
    target: LogPosterior,
    fit: PointFit,
    seed: int,
    budget: int = DEFAULT_BUDGET,
    store: Path | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Sample the posterior with ``ENSEMBLES`` independent ensembles.

    Parameters
    ----------
    seed : the same seed gives the same draws, also when the run was interrupted and goes on from ``store``
    budget : emcee steps of an ensemble after burn-in
    store : HDF5 file that holds the chains while they run; chains found in it are continued
    progress : called with (draws done, draws until the next check, what is being done)
    """
    report = progress or (lambda done, total, text: None)
    report(0, 1, "pilot")
    seeds = np.random.SeedSequence(seed).generate_state(ENSEMBLES + 1)
    schedule = pilot(target, fit, int(seeds[0]))
    samplers = [_sampler(target, fit, schedule, int(s), i, store) for i, s in enumerate(seeds[1:])]
    last = max(budget // schedule.thin, 2)
    draws = np.empty(0)
    tau, rhat, converged = np.empty(0), np.empty(0), False
    for goal in _checks(last):
        if goal < last and all(sampler.iteration > goal for sampler in samplers):
            continue
        for sampler in samplers:
            for _ in _advance(sampler, goal, schedule.thin):
                report(sum(s.iteration for s in samplers), ENSEMBLES * goal, schedule.move)
        draws = np.stack([sampler.get_chain()[:goal] for sampler in samplers])
        tau, rhat = integrated_time(draws), split_rhat(draws)
        converged = bool(np.all(draws.shape[1] > LENGTH_IN_TAU * tau) and np.all(rhat <= MAX_RHAT))
        if converged:
            break
    return Posterior(
        names=target.names,
        draws=target.theta(draws),
        lp=np.stack([sampler.get_log_prob()[: draws.shape[1]] for sampler in samplers]),
        acceptance=np.stack([sampler.backend.accepted / sampler.iteration for sampler in samplers]),
        tau=np.max(tau, axis=0),
        rhat=split_rhat(target.theta(draws)),
        ess=effective_sample_size(draws, integrated_time(target.theta(draws))),
        converged=converged,
        moves={schedule.move: schedule.measured[schedule.move], **schedule.measured},
        steps=draws.shape[1] * schedule.thin,
        thin=schedule.thin,
    )


def pilot(target: LogPosterior, fit: PointFit, seed: int) -> Schedule:
    """Burn in one ensemble, then measure the autocorrelation time of every candidate move on it."""
    random = np.random.RandomState(seed)
    state = emcee.State(_initial(target, fit, random), random_state=random.get_state())
    sampler = _ensemble(target, state.coords.shape[0], differential_evolution())
    state = sampler.run_mcmc(state, 2 * PILOT_STEPS)
    sample = sampler.get_chain(discard=PILOT_STEPS, flat=True)
    measured, moves = {}, candidates(sample)
    for name, candidate in moves.items():
        sampler = _ensemble(target, state.coords.shape[0], candidate)
        state = sampler.run_mcmc(state, PILOT_STEPS)
        measured[name] = float(np.max(integrated_time(sampler.get_chain()[None])))
    best = min(measured, key=lambda name: measured[name])
    tau = measured[best]
    return Schedule(best, moves[best], measured, max(1, round(tau)), int(np.ceil(BURN_IN_IN_TAU * tau)))


def _checks(last: int) -> Iterator[int]:
    """Numbers of stored draws at which convergence is checked."""
    goal = FIRST_CHECK
    while goal < last:
        yield goal
        goal += CHECK_EVERY
    yield last


def _advance(sampler: emcee.EnsembleSampler, goal: int, thin: int) -> Iterator[emcee.State]:
    """Run until ``goal`` draws are stored; every draw is saved as it is made."""
    missing = goal - sampler.iteration
    if missing > 0:
        yield from sampler.sample(sampler._previous_state, iterations=missing, thin_by=thin, store=True)


def _sampler(
    target: LogPosterior, fit: PointFit, schedule: Schedule, seed: int, number: int, store: Path | None
) -> emcee.EnsembleSampler:
    """One ensemble: burnt in from its own overdispersed start, or taken up where ``store`` left it."""
    random = np.random.RandomState(seed)
    start = _initial(target, fit, random)
    backend = None if store is None else emcee.backends.HDFBackend(str(store), name=f"ensemble_{number}")
    if backend is not None and backend.initialized and backend.iteration > 0:
        sampler = _ensemble(target, len(start), schedule.moves, backend)
        sampler._previous_state = backend.get_last_sample()
        return sampler
    state = emcee.State(start, random_state=random.get_state())
    state = _ensemble(target, len(start), schedule.moves).run_mcmc(state, schedule.burn_in, store=False)
    if backend is not None:
        backend.reset(len(start), target.dimension)
    sampler = _ensemble(target, len(start), schedule.moves, backend)
    sampler._previous_state = state
    return sampler


def _ensemble(target: LogPosterior, walkers: int, moves: Moves, backend: Any = None) -> emcee.EnsembleSampler:
    def log_density(u: np.ndarray) -> np.ndarray:
        return in_batches(target.batch, u)

    return emcee.EnsembleSampler(walkers, target.dimension, log_density, vectorize=True, moves=moves, backend=backend)


def _initial(target: LogPosterior, fit: PointFit, random: np.random.RandomState) -> np.ndarray:
    """(walkers, d) from the widened Laplace approximation, every one where the posterior is not zero."""
    walkers = max(MIN_WALKERS, 2 * ((WALKERS_PER_PARAMETER * target.dimension + 1) // 2))
    root = OVERDISPERSION * np.linalg.cholesky(fit.covariance)
    u = fit.u + random.standard_normal((walkers, target.dimension)) @ root.T
    for _ in range(100):
        bad = ~np.isfinite(in_batches(target.batch, u))
        if not bad.any():
            return u
        u[bad] = fit.u + random.standard_normal((int(bad.sum()), target.dimension)) @ root.T
    raise RuntimeError("no finite log-posterior near the point fit: the Laplace approximation does not hold there")
