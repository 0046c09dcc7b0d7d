"""Sample of the posterior: independent ensembles until convergence or the budget, and emulation of slow motions."""

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from emcee import State

from capsule_id.console import OnProgress
from capsule_id.inference.curvature import Random
from capsule_id.inference.marginal import MarginalPosterior
from capsule_id.inference.moves import (
    ChainStore,
    Ensemble,
    Moves,
    OpenBackend,
    block_move,
    bulk_and_tail_size,
    delayed_moves,
    effective_sample_size,
    ensemble_time,
    initial_state,
    integrated_time,
    pooled_time,
    split_rhat,
)
from capsule_id.inference.proposal import (
    LARGEST_MAP,
    NO_MASS,
    BlockProposal,
    Transported,
    affordable_rounds,
    block_proposal,
    effective_size,
    refined,
)
from capsule_id.inference.result import Posterior
from capsule_id.inference.target import half_ensemble

# emulation: Emulation of a posterior whose motions take long: exact motions near the posterior, and emulators fitted
# to them.
#
# Each round adds exact motions about draws of the emulated posterior of the round before, so that the emulators
# learn where the posterior is. An emulator whose density is far too small in some region gets no draws there, so
# that these rounds do not correct it. The last rounds therefore use walkers of delayed acceptance, which can enter
# such regions, and draws of the proposal, which has heavier tails. (J. A. Christen, C. Fox, *Markov chain Monte
# Carlo using an approximation*, Journal of Computational and Graphical Statistics 14, 2005, 795.) Where the
# sampler's pilot shows that walkers stay somewhere, ``corrected`` adds exact motions about them.


#: Draws of the first round and of each later one, largest number of rounds.
FIRST_DRAWS, DRAWS, ROUNDS = 2048, 1024, 6
#: Steps of the chains that draw from an emulated posterior.
STEPS = 40
#: Rounds end where the effective share of so many draws, weighted by exact over emulated posterior, is this large.
CHECKED, ENOUGH = 256, 0.6
#: New places of exact motions near each draw of a round, and their distance from it in standard deviations of the draws.
PLACES, NOISE = 2, 0.4
#: Rounds of delayed acceptance, their walkers, their steps, and the share of steps by differential evolution.
DELAYED_ROUNDS, WALKERS, EXACT_STEPS, OTHER = 2, 128, 20, 0.5
#: Draws of the proposal are kept if their emulated log-posterior is at most this far below the median of the walkers.
FAR = 15.0
#: Rounds that adapt the proposal to the emulated posterior of a later round, and maps that follow each of the last ones.
AGAIN, MAPS = 3, 2


class Places(NamedTuple):
    """Draws v (n, d) of a chain, from which walkers begin."""

    v: np.ndarray

    def draw(self, random: Random, size: int) -> np.ndarray:
        """(size, d)"""
        return self.v[random.choice(len(self.v), size, replace=size > len(self.v))]


class ExactMotions(NamedTuple):
    """Exact motions (w, k) of every experiment with trials at v (w, d)."""

    v: np.ndarray
    motions: list[np.ndarray]

    def more(self, target: MarginalPosterior, v: np.ndarray) -> "ExactMotions":
        """With the motions at further v (w, d)."""
        pairs = zip(self.motions, target.motions(v), strict=True)
        return ExactMotions(np.concatenate([self.v, v]), [np.concatenate(pair) for pair in pairs])


class Emulation(NamedTuple):
    """An emulated posterior, the motions that it knows, the proposal that is adapted to it, and draws of it."""

    target: MarginalPosterior
    known: ExactMotions
    proposal: BlockProposal
    start: Places

    def draw(self, number: int, random: Random) -> np.ndarray:
        """``number`` draws (w, d) of the emulated posterior, by chains that go on from ``start``."""
        found = [self.start.v]
        while sum(map(len, found)) < number:
            found.append(_walked(self.target, found[-1], block_move(self.proposal), random))
        return np.concatenate(found)[:number]


def emulation(
    target: MarginalPosterior,
    first: BlockProposal,
    large: list[bool],
    random: Random,
    known: ExactMotions | None = None,
) -> Emulation:
    """Emulate ``target``.

    Parameters
    ----------
    first : proposal of the first round; without ``known`` the Laplace approximation, at draws of which the rounds begin
    large : see ``refined``
    known : motions near the posterior; ``first`` is then adapted to a similar posterior, and there are no last rounds

    Raises
    ------
    RuntimeError
        If hardly any draw has finite motions, or a finite log-density.
    """
    adaptations, last_rounds = (None, DELAYED_ROUNDS) if known is None else (AGAIN, 0)
    if known is None:
        v = _finite(first, random, FIRST_DRAWS)
        known = ExactMotions(v, target.motions(v))
        if any(np.sum(np.all(np.isfinite(own), axis=1)) < 2 * v.shape[1] for own in known.motions):
            raise RuntimeError(NO_MASS)
    proposal = first
    for _ in range(ROUNDS):
        emulated = target.emulated(*known)
        proposal = refined(emulated.parts, proposal, target.normal_priors, random, large, adaptations)
        v = _inside(emulated, _finite(proposal, random, 2 * DRAWS))[:DRAWS]
        drawn, adaptations = _walked(emulated, v, block_move(proposal), random), AGAIN
        checked = drawn[:CHECKED]
        log_weight = np.sum(target.parts(checked), axis=1) - np.sum(emulated.parts(checked), axis=1)
        known = known.more(target, np.concatenate([_around(drawn, random) for _ in range(PLACES)]))
        if np.any(np.isfinite(log_weight)) and effective_size(log_weight) >= ENOUGH * len(checked):
            break
    walkers = _inside(target, drawn)[: max(WALKERS, 2 * drawn.shape[1])] if last_rounds else drawn
    found = _adapted(target, known, proposal, drawn, large, random)
    for _ in range(last_rounds):
        moves = delayed_moves(found.target.parts, found.proposal, found.start.v, STEPS, target.scaled, OTHER)
        walkers = _walked(target, walkers, moves, random, EXACT_STEPS)
        found = corrected(target, found, walkers, large, random)
    return found


def corrected(
    target: MarginalPosterior, before: Emulation, walkers: np.ndarray, large: list[bool], random: Random
) -> Emulation:
    """Emulate ``target`` with further exact motions about ``walkers`` (w, d) of delayed acceptance by ``before``.

    Walkers stay where the emulated density is far too small, so that the motions added there correct it. Draws of the
    wide proposal give further motions.
    """
    emulated, wide = before.target, _finite(before.proposal, random, 2 * DRAWS)
    least = np.median(np.sum(emulated.parts(walkers), axis=1)) - FAR
    wide = wide[np.sum(emulated.parts(wide), axis=1) > least][:DRAWS]
    places = [wide, *(_around(walkers, random) for _ in range(max(1, DRAWS // len(walkers))))]
    known = before.known.more(target, np.concatenate(places))
    return _adapted(target, known, before.proposal, before.start.v, large, random)


def _adapted(
    target: MarginalPosterior,
    known: ExactMotions,
    proposal: BlockProposal,
    v: np.ndarray,
    large: list[bool],
    random: Random,
) -> Emulation:
    """Emulator of ``known``, its proposal with maps of the large blocks, and the last places of a chain from v (w, d).

    The maps follow the chain, whose draws determine a map better than weighted draws: few of these hold most of the weight.
    """
    emulated = target.emulated(*known)
    for _ in range(MAPS):
        ensemble = _chain(emulated, v, block_move(proposal), random).run(STEPS)
        v = ensemble.state.coords
        drawn = np.concatenate([v, ensemble.chain[STEPS // 2]])
        equal = np.full(len(drawn), 1.0 / len(drawn))
        pairs = zip(proposal.blocks, proposal.densities, large, strict=True)
        maps = [Transported(drawn[:, b], equal) if own and len(b) <= LARGEST_MAP else q for b, q, own in pairs]
        proposal = BlockProposal(proposal.blocks, maps)
    return Emulation(emulated, known, proposal, Places(v))


def _finite(density: BlockProposal | Places, random: Random, size: int) -> np.ndarray:
    """Those of ``size`` draws (size, d) that are finite."""
    v = density.draw(random, size)
    return v[np.all(np.isfinite(v), axis=1)]


def _inside(target: MarginalPosterior, v: np.ndarray) -> np.ndarray:
    """Those of v (w, d) where the density of ``target`` is not 0, enough for the walkers of a chain."""
    v = v[np.all(np.isfinite(target.parts(v)), axis=1)]
    if len(v) < 2 * v.shape[1]:
        raise RuntimeError(NO_MASS)
    return v


def _chain(target: MarginalPosterior, v: np.ndarray, moves: Moves, random: Random) -> Ensemble:
    """Walkers at v (w, d). Each chain gets random numbers of its own: chains with the same ones come together."""
    own = np.random.RandomState(random.randint(2**32, dtype=np.uint64))
    return Ensemble(target.parts, initial_state(v, own), moves)


def _walked(target: MarginalPosterior, v: np.ndarray, moves: Moves, random: Random, steps: int = STEPS) -> np.ndarray:
    """Last places (w, d) of walkers from v (w, d)."""
    return _chain(target, v, moves, random).run(steps, store=False).state.coords


def _around(v: np.ndarray, random: Random) -> np.ndarray:
    """Draws v (w, d) with normal noise: the emulator needs motions around the posterior too, not only inside it."""
    return v + NOISE * random.multivariate_normal(np.zeros(v.shape[1]), np.atleast_2d(np.cov(v.T)), len(v))


# ensembles: Sampling by independent emcee ensembles until convergence or a step limit, with regular saving.


#: Number of independent ensembles, enough for a split R-hat.
ENSEMBLES = 4
#: Convergence requires more draws than this many autocorrelation times for every parameter. The time is an average
#: over the walkers of all ensembles, 128 or more. Its standard error at this length is 10 % or less (Sokal 1997,
#: eq. 3.19).
LENGTH_IN_TAU = 20.0
#: Convergence requires this bulk and tail effective sample size for every parameter, unless stated: the standard error
#: of an sd is then 2.2 % of it.
DEFAULT_ESS = 1000.0
#: Convergence requires a split R-hat of at most this for every parameter.
MAX_RHAT = 1.01
#: Stored draws of an ensemble before the first convergence check, and between later checks: so many, or this part of all.
FIRST_CHECK, CHECK_EVERY, CHECK_SHARE = 40, 10, 5
#: Work of all evaluations of the default budget, and of the rounds of an adaptation, at most, in readings: some 20 s
#: and 5 s on two cores; and what an evaluation costs besides its readings: few readings take 0.1 ms too.
MOST_WORK, PILOT_WORK, FIXED_WORK = 1e9, 2.5e8, 2500
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
DEFAULT_BUDGET = 2500
#: Stored draws per autocorrelation time of the pilot, and the largest number of steps per stored draw. The limit is
#: needed because a short pilot estimates the autocorrelation time only roughly.
DRAWS_PER_TAU, MAX_THIN = 5.0, 15
#: Steps of the pilot.
PILOT_STEPS = 60
#: Name of the first move, and of that of an emulated posterior with its number of steps.
FIRST = "block independence + differential evolution"
DELAYED, DELAYED_STEPS = "delayed acceptance + differential evolution", 20
#: Largest number of corrections of an emulator, and states of the pilot that each of them learns from.
CORRECTIONS, STATES = 3, 3
#: An emulator is not corrected at autocorrelation times below this, in steps.
GOOD_TAU = 10.0


@dataclass(frozen=True)
class Schedule:
    """Density of the first walkers, name of a move and the move, and walkers that it has moved for ``PILOT_STEPS``."""

    start: BlockProposal | Places
    move: str
    moves: Moves
    ensemble: Ensemble

    @cached_property
    def tau(self) -> float:
        """Largest autocorrelation time of a parameter, in steps."""
        return float(np.max(ensemble_time(self.ensemble.chain[None])))

    @property
    def thin(self) -> int:
        """Steps per stored draw of the recorded run."""
        return int(np.clip(self.tau / DRAWS_PER_TAU, 1, MAX_THIN))


def sample(
    target: MarginalPosterior,
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
    store : file for a copy of the chains every few seconds; sampling resumes from the draws in it
    progress : called with (draws done, draws until the next check, name of the stage)
    ess : bulk and tail effective sample size of every parameter at which the sampling stops
    """
    report = progress or (lambda done, total, text: None)
    report(0, 1, "burn-in")
    pilot_seed, *seeds = (int(s) for s in np.random.SeedSequence(seed).generate_state(ENSEMBLES + 1))
    schedule = pilot(target, pilot_seed)
    with nullcontext() if store is None else ChainStore(store, f"{target.fingerprint} {seed}") as chains:
        backends = [None if chains is None else chains.backend(f"ensemble_{i}") for i in range(ENSEMBLES)]
        with ThreadPoolExecutor(CORES) as threads:
            samplers = list(threads.map(lambda *one: _sampler(target, schedule, *one), seeds, backends))
        draws = lp = np.empty((ENSEMBLES, 0, 0, 0))
        walkers = ENSEMBLES * len(samplers[0].state.coords)
        share = min(1.0, MOST_WORK / (DEFAULT_BUDGET * walkers * (target.work + FIXED_WORK)))
        last = max(int(budget * share) // schedule.thin, 2)
        for goal in _checks(min(sampler.stored for sampler in samplers), last):
            for done in _advance(samplers, goal, schedule.thin):
                if chains is not None:
                    chains.between_draws()
                report(done, ENSEMBLES * goal, "sampling")
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
        moves={schedule.move: schedule.tau},
        steps=draws.shape[1] * schedule.thin,
        thin=schedule.thin,
    )


def _completed(target: MarginalPosterior, samplers: Sequence[Ensemble], goal: int) -> tuple[np.ndarray, np.ndarray]:
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


def pilot(target: MarginalPosterior, seed: int) -> Schedule:
    """Find a proposal, and measure the autocorrelation time of its moves.

    A short chain of the Laplace approximation does not show what it has missed; rounds of weighted draws find it.
    """
    random = np.random.RandomState(seed)
    if target.can_be_emulated:
        return _emulated(target, random)
    proposal = adapted_proposal(target, random)
    moves = block_move(proposal)
    walkers = Ensemble(target.parts, _initial(target, proposal, random), moves)
    return Schedule(proposal, FIRST, moves, walkers.run(PILOT_STEPS))


def _emulated(target: MarginalPosterior, random: Random) -> Schedule:
    """Moves of delayed acceptance by an emulated posterior.

    A long autocorrelation time may mean that walkers stay where the emulator is wrong: it learns the motions there. The
    same walkers then go on, because new ones would seldom begin there.
    """
    laplace, large = laplace_proposal(target)
    found = emulation(target, laplace, large, random)
    first = _delayed(target, found, _initial(target, found.start, random))
    for _ in range(CORRECTIONS):
        if first.tau < GOOD_TAU:
            break
        walkers = np.concatenate(first.ensemble.chain[:: -(PILOT_STEPS // STATES)])
        found = corrected(target, found, walkers, large, random)
        first = _delayed(target, found, first.ensemble.state)
    return first


def _delayed(target: MarginalPosterior, found: Emulation, state: State) -> Schedule:
    """Moves of delayed acceptance by the emulated posterior ``found``, and walkers that they move from ``state`` on."""
    moves = delayed_moves(found.target.parts, found.proposal, found.start.v, DELAYED_STEPS, target.scaled)
    return Schedule(found.start, DELAYED, moves, Ensemble(target.parts, state, moves).run(PILOT_STEPS))


def adapted_proposal(target: MarginalPosterior, random: Random, first: BlockProposal | None = None) -> BlockProposal:
    """Proposal adapted to the density of ``target``, from the Laplace approximation.

    A proposal ``first`` that is adapted to a similar density takes its place, and needs ``NEAR`` rounds only.
    """
    laplace, large = laplace_proposal(target)
    rounds = affordable_rounds(PILOT_WORK / target.work) if first is None else NEAR
    return refined(target.parts, first or laplace, target.normal_priors, random, large, rounds)


def laplace_proposal(target: MarginalPosterior) -> tuple[BlockProposal, list[bool]]:
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


def _sampler(target: MarginalPosterior, schedule: Schedule, seed: int, backend: OpenBackend | None) -> Ensemble:
    """Return one ensemble: burnt in from its own start, or resumed from ``backend``.

    The starts are draws of the adapted proposal, or of the emulated posterior.
    """
    if backend is not None and backend.initialized and backend.iteration:
        return Ensemble(target.factors, backend.get_last_sample(), schedule.moves, backend)
    start = _initial(target, schedule.start, np.random.RandomState(seed))
    steps = int(np.ceil(BURN_IN_IN_TAU * schedule.tau))
    burnt_in = Ensemble(target.factors, start, schedule.moves).run(steps, store=False).state
    if backend is not None:
        backend.reset(*start.coords.shape)
    return Ensemble(target.factors, burnt_in, schedule.moves, backend)


def _initial(target: MarginalPosterior, density: BlockProposal | Places, random: Random) -> State:
    """Walkers drawn from ``density``, each at a finite log-posterior."""
    walkers = 2 * half_ensemble(target.dimension)
    u = np.empty((0, target.dimension))
    for _ in range(100):
        drawn = _finite(density, random, walkers)
        u = np.concatenate([u, drawn[np.all(np.isfinite(target.parts(drawn)), axis=1)]])
        if len(u) >= walkers:
            return initial_state(u[:walkers], random)
    raise RuntimeError(NO_MASS)
