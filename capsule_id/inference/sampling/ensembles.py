"""Sampling by independent emcee ensembles until convergence or a step limit, with regular saving."""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import NamedTuple, Protocol, Self

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
    pooled_time,
    split_rhat,
)
from capsule_id.inference.sampling.emulation import Emulation, Places, corrected, emulation
from capsule_id.inference.sampling.ensemble import Ensemble, OpenBackend, initial_state
from capsule_id.inference.sampling.moves import Moves, block_move, delayed_moves, other_moves
from capsule_id.inference.sampling.proposal import BlockProposal, block_proposal
from capsule_id.inference.sampling.refinement import NO_MASS, refined
from capsule_id.inference.target.scales import Scale

#: Number of independent ensembles, enough for a split R-hat.
ENSEMBLES = 4
#: Smallest number of walkers of an ensemble: one batch of the log-posterior. There are at least two per parameter.
MIN_WALKERS, WALKERS_PER_PARAMETER = 32, 2
#: Convergence requires more draws than this many autocorrelation times for every parameter. The time is an average
#: over the walkers of all ensembles, 128 or more. Its standard error at this length is 10 % or less (Sokal 1997,
#: eq. 3.19).
LENGTH_IN_TAU = 20.0
#: Convergence requires this bulk and tail effective sample size for every parameter, unless stated.
DEFAULT_ESS = 4000.0
#: Convergence requires a split R-hat of at most this for every parameter.
MAX_RHAT = 1.01
#: Stored draws of an ensemble before the first convergence check, and between later checks: so many, or this part of all.
FIRST_CHECK, CHECK_EVERY, CHECK_SHARE = 60, 20, 5
#: Work of all evaluations of the default budget, at most, in readings: some 20 s on two cores.
MOST_WORK = 1e9
#: Parameters of the smallest large block among those with a motion of the capsule: a forced run correlates all its
#: parameters and determines them well, so that the Laplace approximation is tried as it is.
LARGE = 9
#: Rounds of adaptation that begin with a proposal adapted to a similar density.
NEAR = 2
#: Burn-in of every ensemble before its first stored draw, in autocorrelation times of the pilot. The first walkers come
#: from a proposal that is close to the posterior already.
BURN_IN_IN_TAU = 4.0
#: Spread of the first draws of other blocks relative to the Laplace approximation, dimensionless.
OVERDISPERSION = 1.2
#: Ensembles that advance side by side.
CORES = min(ENSEMBLES, os.cpu_count() or 1)
#: Time after which ensembles wait for each other, s.
ROUND = 1.0
#: Largest number of emcee steps of an ensemble after burn-in, unless stated.
DEFAULT_BUDGET = 20_000
#: Stored draws per autocorrelation time of the pilot, and the largest number of steps per stored draw. The limit is
#: needed because a short pilot estimates the autocorrelation time only roughly.
DRAWS_PER_TAU, MAX_THIN = 5.0, 15
#: Steps of each measured move (short, long).
PILOT_STEPS, LONG_PILOT_STEPS = 60, 300
#: Name of the first move, and of that of an emulated posterior with its number of steps.
FIRST = "block independence + differential evolution"
DELAYED, DELAYED_STEPS = "delayed acceptance + differential evolution", 20
#: Largest number of corrections of an emulator, and states of the pilot that each of them learns from.
CORRECTIONS, STATES = 3, 3
#: The pilot of an adapted proposal stops, and an emulator is not corrected, at autocorrelation times below this, in steps.
GOOD_TAU = 10.0
#: Delayed acceptance is not measured again, and other kinds of moves are not tried, below this, in steps.
FAIR_TAU = 100.0


@dataclass(frozen=True)
class Schedule:
    """Density of the first walkers, move, thinning and burn-in of the recorded run, chosen by the pilot run."""

    start: BlockProposal | Places
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
    normal_priors: np.ndarray
    scaled: list[Scale]
    event_driven: list[bool]

    @property
    def work(self) -> int:
        """Time of an evaluation, see ``MarginalPosterior``."""
        ...

    @property
    def can_be_emulated(self) -> bool: ...

    @property
    def fingerprint(self) -> str:
        """Equal for equal densities: saved draws of another density are not resumed."""
        ...

    def parts(self, v: np.ndarray) -> np.ndarray: ...

    def motions(self, v: np.ndarray) -> list[np.ndarray]: ...

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> Self: ...

    def factors(self, v: np.ndarray) -> np.ndarray: ...

    def whole(self, located: np.ndarray, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...

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
    budget : emcee steps of an ensemble after burn-in; fewer in proportion where an evaluation is slow
    store : HDF5 file for the chains during the run; sampling resumes from the draws in its saved copy
    progress : called with (draws done, draws until the next check, name of the stage)
    ess : bulk and tail effective sample size of every parameter at which the sampling stops
    """
    report = progress or (lambda done, total, text: None)
    report(0, 1, "pilot")
    pilot_seed, *seeds = (int(s) for s in np.random.SeedSequence(seed).generate_state(ENSEMBLES + 1))
    schedule = pilot(target, pilot_seed)
    with nullcontext() if store is None else ChainStore(store, f"{target.fingerprint} {seed}") as chains:
        backends = [None if chains is None else chains.backend(f"ensemble_{i}") for i in range(ENSEMBLES)]
        with ThreadPoolExecutor(CORES) as threads:
            samplers = list(threads.map(lambda *one: _sampler(target, schedule, *one), seeds, backends))
        draws = lp = np.empty((ENSEMBLES, 0, 0, 0))
        walkers = ENSEMBLES * len(samplers[0].state.coords)
        share = min(1.0, MOST_WORK / (DEFAULT_BUDGET * walkers * target.work))
        last = max(int(budget * share) // schedule.thin, 2)
        for goal in _checks(min(sampler.stored for sampler in samplers), last):
            for done in _advance(samplers, goal, schedule.thin):
                if chains is not None:
                    chains.between_draws()
                report(done, ENSEMBLES * goal, schedule.move)
            draws, lp = _completed(target, samplers, goal)
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
        tau=pooled_time(draws),
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


def _completed(target: Target, samplers: Sequence[Ensemble], goal: int) -> tuple[np.ndarray, np.ndarray]:
    """The first ``goal`` draws (ensemble, draw, walker, d) with scatters, and their log-posterior.

    Each proposal brings a draw of its scatters, which is accepted without regard to it.
    """
    located = np.stack([sampler.chain[:goal] for sampler in samplers])
    factors = np.stack([sampler.parts[:goal] for sampler in samplers])
    return target.whole(located, factors.reshape(*factors.shape[:3], len(target.blocks), -1))


def _converged(draws: np.ndarray, ess: float) -> bool:
    """Whether draws (ensemble, draw, walker, d) are long enough and their ensembles agree."""
    if not np.all(split_rhat(draws) <= MAX_RHAT) or not np.all(bulk_and_tail_size(draws) >= ess):
        return False
    return bool(np.all(draws.shape[1] > LENGTH_IN_TAU * pooled_time(draws)))


def pilot(target: Target, seed: int) -> Schedule:
    """Find a proposal, then measure autocorrelation times of moves until one is short enough."""
    random = np.random.RandomState(seed)
    begin, name, first, ensemble = (_emulated if target.can_be_emulated else _proposed)(target, random)
    moves, measured = {name: first, **other_moves()}, {name: _longest_time(ensemble)}
    # The first move runs longer where that was not enough. The other moves come last, because they are slow.
    for other in moves:
        # A longer measurement of delayed acceptance, or of a slow move, takes longer than what it could save.
        if min(measured.values()) < (GOOD_TAU if other == FIRST else FAIR_TAU):
            break
        ensemble = Ensemble(target.parts, ensemble.state, moves[other]).run(LONG_PILOT_STEPS)
        measured[other] = _longest_time(ensemble)
    best = min(measured, key=lambda name: measured[name])
    tau = measured[best]
    thin = int(np.clip(tau / DRAWS_PER_TAU, 1, MAX_THIN))
    return Schedule(begin, best, moves[best], measured, thin, int(np.ceil(BURN_IN_IN_TAU * tau)))


class _Pilot(NamedTuple):
    """Density of the first walkers, name of a move and the move, and walkers that it has moved for ``PILOT_STEPS``."""

    start: BlockProposal | Places
    name: str
    moves: Moves
    ensemble: Ensemble


def _proposed(target: Target, random: np.random.RandomState) -> _Pilot:
    """Moves by an adapted proposal."""
    proposal = adapted_proposal(target, random)
    moves = block_move(proposal)
    walkers = Ensemble(target.parts, _initial(target, proposal, random), moves)
    return _Pilot(proposal, FIRST, moves, walkers.run(PILOT_STEPS))


def _emulated(target: Target, random: np.random.RandomState) -> _Pilot:
    """Moves of delayed acceptance by an emulated posterior.

    A long autocorrelation time may mean that walkers stay where the emulator is wrong: it learns the motions there. The
    same walkers then go on, because new ones would seldom begin there.
    """
    laplace, large = laplace_proposal(target)
    found = emulation(target, laplace, large, random)
    first = _delayed(target, found, _initial(target, found.start, random))
    for _ in range(CORRECTIONS):
        if _longest_time(first.ensemble) < GOOD_TAU:
            break
        walkers = np.concatenate(first.ensemble.chain[:: -(PILOT_STEPS // STATES)])
        found = corrected(target, found, walkers, large, random)
        first = _delayed(target, found, first.ensemble.state)
    return first


def _delayed(target: Target, found: Emulation, state: State) -> _Pilot:
    """Moves of delayed acceptance by the emulated posterior ``found``, and walkers that they move from ``state`` on."""
    moves = delayed_moves(found.target.parts, found.proposal, found.start.v, DELAYED_STEPS, target.scaled)
    return _Pilot(found.start, DELAYED, moves, Ensemble(target.parts, state, moves).run(PILOT_STEPS))


def _longest_time(ensemble: Ensemble) -> float:
    """Largest autocorrelation time of a parameter, in steps."""
    return float(np.max(ensemble_time(ensemble.chain[None])))


def adapted_proposal(
    target: Target, random: np.random.RandomState, first: BlockProposal | None = None
) -> BlockProposal:
    """Proposal adapted to the density of ``target``, from the Laplace approximation.

    A proposal ``first`` that is adapted to a similar density takes its place, and needs ``NEAR`` rounds only.
    """
    laplace, large = laplace_proposal(target)
    if first is not None:
        return refined(target.parts, first, target.normal_priors, random, large, NEAR)
    return refined(target.parts, laplace, target.normal_priors, random, large)


def laplace_proposal(target: Target) -> tuple[BlockProposal, list[bool]]:
    """The Laplace approximation as a proposal, and for each block whether it is large.

    A bench test is not: terms of a decay that may be absent need components that draw them from their priors.
    """
    pairs = zip(target.blocks, target.event_driven, strict=True)
    large = [len(block) >= LARGE and event_driven for block, event_driven in pairs]
    narrow = np.isin(np.arange(target.dimension), np.concatenate([[], *compress(target.blocks, large)]))
    laplace = np.where(np.outer(narrow, narrow), target.covariance, OVERDISPERSION**2 * target.covariance)
    return block_proposal(target.blocks, target.centre, laplace, large), large


def _checks(done: int, last: int) -> Iterator[int]:
    """Numbers of stored draws at which convergence is checked, from ``done`` on: a check reads all draws."""
    goal = FIRST_CHECK
    while goal < last:
        if goal >= done:
            yield goal
        goal += max(CHECK_EVERY, goal // CHECK_SHARE)
    yield last


def _advance(samplers: Sequence[Ensemble], goal: int, thin: int) -> Iterator[int]:
    """Advance all ensembles to ``goal`` stored draws, side by side; yield their total about every ``ROUND`` seconds.

    No ensemble is moving while the generator waits, so that their file can be copied.
    """
    number = 1
    with ThreadPoolExecutor(CORES) as threads:
        while any(sampler.stored < goal for sampler in samplers):
            started = time.monotonic()
            runs = [threads.submit(one.run, min(number, goal - one.stored), thin) for one in samplers]
            for run in runs:
                run.result()
            number = max(int(number * ROUND / max(time.monotonic() - started, 1e-9)), 1)
            yield sum(sampler.stored for sampler in samplers)


def _sampler(target: Target, schedule: Schedule, seed: int, backend: OpenBackend | None) -> Ensemble:
    """Return one ensemble: burnt in from its own start, or resumed from ``backend``.

    The starts are draws of the adapted proposal, or of the emulated posterior.
    """
    last = None if backend is None else backend.last_state()
    if last is not None:
        return Ensemble(target.factors, last, schedule.moves, backend)
    start = _initial(target, schedule.start, np.random.RandomState(seed))
    burnt_in = Ensemble(target.factors, start, schedule.moves).run(schedule.burn_in, store=False).state
    if backend is not None:
        backend.reset(*start.coords.shape)
    return Ensemble(target.factors, burnt_in, schedule.moves, backend)


def _initial(target: Target, density: BlockProposal | Places, random: np.random.RandomState) -> State:
    """Walkers drawn from ``density``, each at a finite log-posterior."""
    walkers = max(MIN_WALKERS, 2 * ((WALKERS_PER_PARAMETER * target.dimension + 1) // 2))
    u = np.empty((0, target.dimension))
    for _ in range(100):
        drawn = density.draw(random, walkers)
        drawn = drawn[np.all(np.isfinite(drawn), axis=1)]
        u = np.concatenate([u, drawn[np.all(np.isfinite(target.parts(drawn)), axis=1)]])
        if len(u) >= walkers:
            return initial_state(u[:walkers], random)
    raise RuntimeError(NO_MASS)
