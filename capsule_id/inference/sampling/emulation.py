"""Emulation of a posterior whose motions take long: exact motions near the posterior, and emulators fitted to them.

Each round adds exact motions about draws of the emulated posterior of the round before, so that the emulators learn where
the posterior is. An emulator whose density is far too small in some region gets no draws there, so that these rounds do not
correct it. The last rounds therefore use walkers of delayed acceptance, which can enter such regions, and draws of the
proposal, which has heavier tails. (J. A. Christen, C. Fox, *Markov
chain Monte Carlo using an approximation*, Journal of Computational and Graphical Statistics 14, 2005, 795.) Where the
sampler's pilot shows that walkers stay somewhere, ``corrected`` adds exact motions about them.
"""

from typing import NamedTuple, Protocol, Self

import numpy as np

from capsule_id.inference.sampling.ensemble import Ensemble, initial_state
from capsule_id.inference.sampling.moves import Moves, block_move, delayed_moves
from capsule_id.inference.sampling.proposal import BlockProposal
from capsule_id.inference.sampling.refinement import NO_MASS, effective_size, refined
from capsule_id.inference.sampling.transport import LARGEST_MAP, Transported
from capsule_id.inference.target.scales import Scale

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


class Emulable(Protocol):
    """A density whose motions can be emulated; see ``capsule_id.inference.target.marginal.MarginalPosterior``."""

    normal_priors: np.ndarray
    scaled: list[Scale]

    def parts(self, v: np.ndarray) -> np.ndarray: ...

    def motions(self, v: np.ndarray) -> list[np.ndarray]: ...

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> Self: ...


class Places(NamedTuple):
    """Draws v (n, d) of a chain, from which walkers begin."""

    v: np.ndarray

    def draw(self, random: np.random.RandomState, size: int) -> np.ndarray:
        """(size, d)"""
        return self.v[random.choice(len(self.v), size, replace=size > len(self.v))]


class ExactMotions(NamedTuple):
    """Exact motions (w, k) of every experiment with trials at v (w, d)."""

    v: np.ndarray
    motions: list[np.ndarray]

    def more(self, target: Emulable, v: np.ndarray) -> "ExactMotions":
        """With the motions at further v (w, d)."""
        pairs = zip(self.motions, target.motions(v), strict=True)
        return ExactMotions(np.concatenate([self.v, v]), [np.concatenate(pair) for pair in pairs])


class Emulation(NamedTuple):
    """An emulated posterior, the motions that it knows, the proposal that is adapted to it, and draws of it."""

    target: Emulable
    known: ExactMotions
    proposal: BlockProposal
    start: Places

    def draw(self, number: int, random: np.random.RandomState) -> np.ndarray:
        """``number`` draws (w, d) of the emulated posterior, by chains that go on from ``start``."""
        found = [self.start.v]
        while sum(map(len, found)) < number:
            chain = _chain(self.target, found[-1], block_move(self.proposal), random)
            found.append(chain.run(STEPS, store=False).state.coords)
        return np.concatenate(found)[:number]


def emulation(
    target: Emulable,
    first: BlockProposal,
    large: list[bool],
    random: np.random.RandomState,
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
    known, proposal = known or _first_motions(target, first, random), first
    for _ in range(ROUNDS):
        emulated = target.emulated(*known)
        proposal = refined(emulated.parts, proposal, target.normal_priors, random, large, adaptations)
        drawn, adaptations = _draws(emulated, proposal, random), AGAIN
        checked = drawn[:CHECKED]
        log_weight = np.sum(target.parts(checked), axis=1) - np.sum(emulated.parts(checked), axis=1)
        known = known.more(target, np.concatenate([_around(drawn, random) for _ in range(PLACES)]))
        if np.any(np.isfinite(log_weight)) and effective_size(log_weight) >= ENOUGH * len(checked):
            break
    walkers = _inside(target, drawn)[: max(WALKERS, 2 * drawn.shape[1])] if last_rounds else drawn
    found = _adapted(target, known, proposal, drawn, large, random)
    for _ in range(last_rounds):
        moves = delayed_moves(found.target.parts, found.proposal, found.start.v, STEPS, target.scaled, OTHER)
        walkers = _chain(target, walkers, moves, random).run(EXACT_STEPS, store=False).state.coords
        found = corrected(target, found, walkers, large, random)
    return found


def corrected(
    target: Emulable, before: Emulation, walkers: np.ndarray, large: list[bool], random: np.random.RandomState
) -> Emulation:
    """Emulate ``target`` with further exact motions about ``walkers`` (w, d) of delayed acceptance by ``before``.

    Walkers stay where the emulated density is far too small, so that the motions added there correct it.
    """
    known = before.known.more(target, _last_places(before.target, before.proposal, walkers, random))
    return _adapted(target, known, before.proposal, before.start.v, large, random)


def _adapted(
    target: Emulable,
    known: ExactMotions,
    proposal: BlockProposal,
    v: np.ndarray,
    large: list[bool],
    random: np.random.RandomState,
) -> Emulation:
    """Emulator of ``known``, with the proposal and the draws of a chain from v (w, d) that follow it."""
    emulated = target.emulated(*known)
    proposal, drawn = _follow(emulated, proposal, v, large, random)
    return Emulation(emulated, known, proposal, Places(drawn))


def _first_motions(target: Emulable, first: BlockProposal, random: np.random.RandomState) -> ExactMotions:
    v = first.draw(random, FIRST_DRAWS)
    v = v[np.all(np.isfinite(v), axis=1)]
    motions = target.motions(v)
    if any(np.sum(np.all(np.isfinite(own), axis=1)) < 2 * v.shape[1] for own in motions):
        raise RuntimeError(NO_MASS)
    return ExactMotions(v, motions)


def _draws(target: Emulable, proposal: BlockProposal, random: np.random.RandomState) -> np.ndarray:
    """``DRAWS`` draws of ``target``: the last places of as many walkers that begin with draws of ``proposal``."""
    v = proposal.draw(random, 2 * DRAWS)
    v = _inside(target, v[np.all(np.isfinite(v), axis=1)])[:DRAWS]
    return _chain(target, v, block_move(proposal), random).run(STEPS, store=False).state.coords


def _inside(target: Emulable, v: np.ndarray) -> np.ndarray:
    """Those of v (w, d) where the density of ``target`` is not 0, enough for the walkers of a chain."""
    v = v[np.all(np.isfinite(target.parts(v)), axis=1)]
    if len(v) < 2 * v.shape[1]:
        raise RuntimeError(NO_MASS)
    return v


def _chain(target: Emulable, v: np.ndarray, moves: Moves, random: np.random.RandomState) -> Ensemble:
    """Walkers at v (w, d). Each chain gets random numbers of its own: chains with the same ones come together."""
    own = np.random.RandomState(random.randint(2**32, dtype=np.uint64))
    return Ensemble(target.parts, initial_state(v, own), moves)


def _around(v: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    """Draws v (w, d) with normal noise: the emulator needs motions around the posterior too, not only inside it."""
    return v + NOISE * random.multivariate_normal(np.zeros(v.shape[1]), np.atleast_2d(np.cov(v.T)), len(v))


def _last_places(
    emulated: Emulable, proposal: BlockProposal, walkers: np.ndarray, random: np.random.RandomState
) -> np.ndarray:
    """Places about ``walkers`` (w, d) of delayed acceptance, and draws of the wide proposal."""
    wide = proposal.draw(random, 2 * DRAWS)
    wide = wide[np.all(np.isfinite(wide), axis=1)]
    least = np.median(np.sum(emulated.parts(walkers), axis=1)) - FAR
    wide = wide[np.sum(emulated.parts(wide), axis=1) > least][:DRAWS]
    return np.concatenate([wide, *(_around(walkers, random) for _ in range(max(1, DRAWS // len(walkers))))])


def _follow(
    target: Emulable, proposal: BlockProposal, v: np.ndarray, large: list[bool], random: np.random.RandomState
) -> tuple[BlockProposal, np.ndarray]:
    """Proposal with maps of the large blocks that follow a chain of ``target`` from draws v (w, d), and its last places.

    Draws of a chain determine a map better than weighted draws: few of these hold most of the weight.
    """
    for _ in range(MAPS):
        ensemble = _chain(target, v, block_move(proposal), random).run(STEPS)
        v = ensemble.state.coords
        drawn = np.concatenate([v, ensemble.chain[STEPS // 2]])
        equal = np.full(len(drawn), 1.0 / len(drawn))
        pairs = zip(proposal.blocks, proposal.densities, large, strict=True)
        maps = [Transported(drawn[:, b], equal) if own and len(b) <= LARGEST_MAP else q for b, q, own in pairs]
        proposal = BlockProposal(proposal.blocks, maps)
    return proposal, v
