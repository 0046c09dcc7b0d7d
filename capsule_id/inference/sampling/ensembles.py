"""Sampling by independent emcee ensembles until convergence or a step limit, with regular saving."""

from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from emcee import State

from capsule_id.console import OnProgress
from capsule_id.inference.result import Posterior
from capsule_id.inference.sampling.chain_store import ChainStore
from capsule_id.inference.sampling.diagnostics import (
    bulk_and_tail_size,
    effective_sample_size,
    ensemble_time,
    integrated_time,
    split_rhat,
)
from capsule_id.inference.sampling.ensemble import Ensemble, OpenBackend, initial_state
from capsule_id.inference.sampling.moves import LARGE, Moves, block_move, candidates

#: Number of independent ensembles, enough for a split R-hat.
ENSEMBLES = 4
#: Smallest number of walkers of an ensemble: one batch of the log-posterior. There are at least two per parameter.
MIN_WALKERS, WALKERS_PER_PARAMETER = 32, 2
#: Convergence requires more draws than this many autocorrelation times for every parameter. The time is an average
#: over the walkers of an ensemble, 32 or more. Its standard error at this length is 20 % or less (Sokal 1997, eq. 3.19).
LENGTH_IN_TAU = 20.0
#: Convergence requires this bulk and tail effective sample size for every parameter, unless stated.
DEFAULT_ESS = 4000.0
#: Convergence requires a split R-hat of at most this for every parameter.
MAX_RHAT = 1.01
#: Stored draws of an ensemble before the first convergence check, and between later checks.
FIRST_CHECK, CHECK_EVERY = 120, 30
#: Burn-in of every ensemble before its first stored draw, in autocorrelation times of the pilot.
BURN_IN_IN_TAU = 8.0
#: Spread of the initial walkers relative to the Laplace approximation, dimensionless.
OVERDISPERSION = 1.2
#: Largest number of emcee steps of an ensemble after burn-in, unless stated.
DEFAULT_BUDGET = 20_000
#: Stored draws per autocorrelation time of the pilot, and the largest number of steps per stored draw. The limit is
#: needed because a short pilot estimates the autocorrelation time only roughly.
DRAWS_PER_TAU, MAX_THIN = 5.0, 15
#: Steps of the pilot's burn-in, half of which determines the block proposal, and steps of each measured move (short, long).
PILOT_BURN_IN, PILOT_STEPS, LONG_PILOT_STEPS = 100, 100, 300
#: Name of the move that the pilot adapts to its own sample, largest number of adaptations, and steps of each.
ADAPTED, ADAPTATIONS, ADAPTING_STEPS = "adapted block independence + differential evolution", 4, 200
#: The pilot stops once a move has an autocorrelation time below this, in steps.
GOOD_TAU = 10.0
#: Other kinds of moves are tried only where every block proposal stays above this, in steps.
FAIR_TAU = 40.0


@dataclass(frozen=True)
class Schedule:
    """Move, thinning and burn-in of the recorded run, chosen by the pilot run."""

    move: str
    moves: Moves
    measured: Mapping[str, float]
    thin: int
    burn_in: int


class Target(Protocol):
    """A density to sample; see ``capsule_id.inference.target.marginal.MarginalPosterior``."""

    names: tuple[str, ...]
    dimension: int
    blocks: list[np.ndarray]
    centre: np.ndarray
    covariance: np.ndarray

    @property
    def fingerprint(self) -> str:
        """Equal for equal densities: saved draws of another density are not resumed."""
        ...

    def parts(self, v: np.ndarray) -> np.ndarray: ...

    def restore(self, draws: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]: ...

    def theta(self, u: np.ndarray) -> np.ndarray: ...


def sample(
    target: Target,
    seed: int,
    budget: int = DEFAULT_BUDGET,
    store: Path | None = None,
    progress: OnProgress | None = None,
    ess: float = DEFAULT_ESS,
) -> Posterior:
    """Sample the posterior with ``ENSEMBLES`` independent ensembles.

    Parameters
    ----------
    seed : the same seed gives the same draws, also when an interrupted run resumes from ``store``
    budget : emcee steps of an ensemble after burn-in
    store : HDF5 file for the chains during the run; sampling resumes from the draws in its saved copy
    progress : called with (draws done, draws until the next check, name of the stage)
    ess : bulk and tail effective sample size of every parameter at which the sampling stops
    """
    report = progress or (lambda done, total, text: None)
    report(0, 1, "pilot")
    pilot_seed, restore_seed, *seeds = (int(s) for s in np.random.SeedSequence(seed).generate_state(ENSEMBLES + 2))
    schedule = pilot(target, pilot_seed)
    with nullcontext() if store is None else ChainStore(store, f"{target.fingerprint} {seed}") as chains:
        backends = [None if chains is None else chains.backend(f"ensemble_{i}") for i in range(ENSEMBLES)]
        samplers = [_sampler(target, schedule, *one) for one in zip(seeds, backends, strict=True)]
        done = [sampler.stored for sampler in samplers]
        draws = lp = np.empty((ENSEMBLES, 0, 0, 0))
        last = max(budget // schedule.thin, 2)
        for goal in _checks(min(done), last):
            for i, sampler in enumerate(samplers):
                for _ in sampler.advance(goal - done[i], schedule.thin):
                    done[i] += 1
                    if chains is not None:
                        chains.between_draws()
                    report(sum(done), ENSEMBLES * goal, schedule.move)
            located = np.stack([sampler.chain[:goal] for sampler in samplers])
            if goal == last or _converged(located, ess):
                draws, lp = target.restore(located, restore_seed)
                if _converged(draws, ess):
                    break
        if chains is not None:
            chains.save()
        acceptance = np.stack([sampler.acceptance for sampler in samplers])
    theta, (bulk, tail) = target.theta(draws), bulk_and_tail_size(draws)
    return Posterior(
        names=target.names,
        draws=theta,
        lp=lp,
        acceptance=acceptance,
        tau=np.max(ensemble_time(draws), axis=0),
        rhat=split_rhat(theta),
        ess=effective_sample_size(draws, integrated_time(theta)),
        ess_bulk=bulk,
        ess_tail=tail,
        ess_wanted=ess,
        converged=_converged(draws, ess),
        moves={schedule.move: schedule.measured[schedule.move], **schedule.measured},
        steps=draws.shape[1] * schedule.thin,
        thin=schedule.thin,
    )


def _converged(draws: np.ndarray, ess: float) -> bool:
    """Whether draws (ensemble, draw, walker, d) are long enough and their ensembles agree."""
    tau, rhat = ensemble_time(draws), split_rhat(draws)
    long_enough = np.all(draws.shape[1] > LENGTH_IN_TAU * tau) and np.all(rhat <= MAX_RHAT)
    return bool(long_enough and np.all(bulk_and_tail_size(draws) >= ess))


def pilot(target: Target, seed: int) -> Schedule:
    """Burn in one ensemble, then measure autocorrelation times of candidate moves until one is short enough."""
    start = _initial(target, np.random.RandomState(seed))
    # In 30 dimensions a proposal that is 20 % too wide is almost never accepted: large blocks are not widened.
    wider = np.ones(target.dimension)
    wider[[i for block in target.blocks if len(block) < LARGE for i in block]] = OVERDISPERSION
    rough = block_move(target.blocks, target.centre, target.covariance * np.outer(wider, wider))
    ensemble = Ensemble(target.parts, start, rough).run(PILOT_BURN_IN)
    sample = ensemble.chain[PILOT_BURN_IN // 2 :].reshape(-1, target.dimension)
    measured, moves = {}, dict(candidates(sample, target.blocks, target.centre, target.covariance))
    first, *others = moves
    # The most promising move runs first, briefly, then longer. Moves adapted to the sample follow, because a posterior
    # with kinks differs from the Laplace approximation. All other moves come last, because they are slow.
    plan = [(first, PILOT_STEPS), (first, LONG_PILOT_STEPS), *[(ADAPTED, ADAPTING_STEPS)] * ADAPTATIONS]
    for name, steps in [*plan, *((name, LONG_PILOT_STEPS) for name in others)]:
        if name in others and min(measured.values()) < FAIR_TAU:
            break
        if name == ADAPTED:
            found = ensemble.chain.reshape(-1, target.dimension)
            moves[name] = block_move(target.blocks, np.mean(found, axis=0), np.atleast_2d(np.cov(found.T)))
        ensemble = Ensemble(target.parts, ensemble.state, moves[name]).run(steps)
        measured[name] = float(np.max(ensemble_time(ensemble.chain[None])))
        if measured[name] < GOOD_TAU:
            break
    best = min(measured, key=lambda name: measured[name])
    tau = measured[best]
    thin = int(np.clip(tau / DRAWS_PER_TAU, 1, MAX_THIN))
    return Schedule(best, moves[best], measured, thin, int(np.ceil(BURN_IN_IN_TAU * tau)))


def _checks(done: int, last: int) -> Iterator[int]:
    """Numbers of stored draws at which convergence is checked, from ``done`` on."""
    yield from (goal for goal in range(FIRST_CHECK, last, CHECK_EVERY) if goal >= done)
    yield last


def _sampler(target: Target, schedule: Schedule, seed: int, backend: OpenBackend | None) -> Ensemble:
    """Return one ensemble: burnt in from its own overdispersed start, or resumed from ``backend``."""
    last = None if backend is None else backend.last_state()
    if last is not None:
        return Ensemble(target.parts, last, schedule.moves, backend)
    start = _initial(target, np.random.RandomState(seed))
    burnt_in = Ensemble(target.parts, start, schedule.moves).run(schedule.burn_in, store=False).state
    if backend is not None:
        backend.reset(*start.coords.shape)
    return Ensemble(target.parts, burnt_in, schedule.moves, backend)


def _initial(target: Target, random: np.random.RandomState) -> State:
    """Walkers from the widened Laplace approximation, each at a finite log-posterior."""
    walkers = max(MIN_WALKERS, 2 * ((WALKERS_PER_PARAMETER * target.dimension + 1) // 2))
    root = OVERDISPERSION * np.linalg.cholesky(target.covariance)
    u = target.centre + random.standard_normal((walkers, target.dimension)) @ root.T
    for _ in range(100):
        bad = ~np.all(np.isfinite(target.parts(u)), axis=1)
        if not bad.any():
            return initial_state(u, random)
        u[bad] = target.centre + random.standard_normal((int(bad.sum()), target.dimension)) @ root.T
    raise RuntimeError("no finite log-posterior near the point fit: the Laplace approximation does not hold there")
