"""Emulation of a posterior whose motions take long: exact motions near the posterior, and emulators fitted to them.

Each round adds exact motions about draws of the emulated posterior of the round before, so that the emulators learn where
the posterior is. They do not see a part of it where an emulated density is far too small. The last rounds therefore draw
by delayed acceptance, which leaves the emulated posterior, and from the wide proposal too. (J. A. Christen, C. Fox, *Markov
chain Monte Carlo using an approximation*, Journal of Computational and Graphical Statistics 14, 2005, 795.)
"""

from typing import NamedTuple, Protocol, Self

import numpy as np

from capsule_id.inference.sampling.ensemble import Ensemble, initial_state
from capsule_id.inference.sampling.moves import block_move, delayed_move
from capsule_id.inference.sampling.proposal import BlockProposal
from capsule_id.inference.sampling.refinement import NO_MASS, effective_size, refined
from capsule_id.inference.sampling.transport import LARGEST_MAP, Transported

#: Draws of the first round and of each later one, largest number of rounds.
FIRST_DRAWS, DRAWS, ROUNDS = 2048, 1024, 6
#: Steps of the chains that draw from an emulated posterior.
STEPS = 40
#: Rounds end where the effective share of so many draws, weighted by exact over emulated posterior, is this large.
CHECKED, ENOUGH = 256, 0.6
#: New places of exact motions near each draw of a round, and their distance from it in standard deviations of the draws.
PLACES, NOISE = 2, 0.4
#: Last rounds, their walkers, their steps of delayed acceptance, and the share of steps by differential evolution.
LAST_ROUNDS, WALKERS, LAST_STEPS, OTHER = 2, 128, 15, 0.5
#: Draws of the wide proposal count where the emulated log-posterior is at most this far below that of the walkers.
FAR = 15.0
#: Rounds that adapt the proposal to the emulated posterior of a later round, and maps that follow each of the last ones.
AGAIN, MAPS = 3, 2


class Emulable(Protocol):
    """A density whose motions can be emulated; see ``capsule_id.inference.target.marginal.MarginalPosterior``."""

    normal_priors: np.ndarray

    def parts(self, v: np.ndarray) -> np.ndarray: ...

    def motions(self, v: np.ndarray) -> list[np.ndarray]: ...

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> Self: ...


class Places(NamedTuple):
    """Draws v (n, d) of a chain, from which walkers begin."""

    v: np.ndarray

    def draw(self, random: np.random.RandomState, size: int) -> np.ndarray:
        """(size, d)"""
        return self.v[random.choice(len(self.v), size, replace=size > len(self.v))]


class Known(NamedTuple):
    """Exact motions (w, k) of every experiment with trials at v (w, d)."""

    v: np.ndarray
    motions: list[np.ndarray]

    def more(self, target: Emulable, v: np.ndarray) -> "Known":
        """With the motions at further v (w, d)."""
        pairs = zip(self.motions, target.motions(v), strict=True)
        return Known(np.concatenate([self.v, v]), [np.concatenate(pair) for pair in pairs])


class Emulation(NamedTuple):
    """An emulated posterior, the motions that it knows, the proposal that is adapted to it, and draws of it."""

    target: Emulable
    known: Known
    proposal: BlockProposal
    start: Places

    def draw(self, number: int, random: np.random.RandomState) -> np.ndarray:
        """``number`` draws (w, d) of the emulated posterior, by chains that go on from ``start``."""
        found = [self.start.v]
        while sum(map(len, found)) < number:
            state = initial_state(found[-1], random)
            ensemble = Ensemble(self.target.parts, state, block_move(self.proposal)).run(STEPS, store=False)
            found.append(ensemble.state.coords)
        return np.concatenate(found)[:number]


def emulation(
    target: Emulable,
    first: BlockProposal,
    large: list[bool],
    random: np.random.RandomState,
    known: Known | None = None,
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
    adaptations, last_rounds = (None, LAST_ROUNDS) if known is None else (AGAIN, 0)
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
    for _ in range(last_rounds):
        emulated = target.emulated(*known)
        proposal, drawn = _follow(emulated, proposal, drawn, large, random)
        known = known.more(target, _last_places(target, emulated, proposal, drawn, random))
    emulated = target.emulated(*known)
    proposal, drawn = _follow(emulated, proposal, drawn, large, random)
    return Emulation(emulated, known, proposal, Places(drawn))


def _first_motions(target: Emulable, first: BlockProposal, random: np.random.RandomState) -> Known:
    v = first.draw(random, FIRST_DRAWS)
    v = v[np.all(np.isfinite(v), axis=1)]
    motions = target.motions(v)
    if any(np.sum(np.all(np.isfinite(own), axis=1)) < 2 * v.shape[1] for own in motions):
        raise RuntimeError(NO_MASS)
    return Known(v, motions)


def _draws(target: Emulable, proposal: BlockProposal, random: np.random.RandomState) -> np.ndarray:
    """``DRAWS`` draws of ``target``: the last places of as many walkers that begin with draws of ``proposal``."""
    v = proposal.draw(random, 2 * DRAWS)
    v = v[np.all(np.isfinite(v), axis=1)]
    v = v[np.all(np.isfinite(target.parts(v)), axis=1)][:DRAWS]
    if len(v) < 2 * v.shape[1]:
        raise RuntimeError(NO_MASS)
    return Ensemble(target.parts, initial_state(v, random), block_move(proposal)).run(STEPS, store=False).state.coords


def _around(v: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    """Draws v (w, d) with noise: an emulator must know what lies about its posterior, to give it its place."""
    return v + NOISE * random.multivariate_normal(np.zeros(v.shape[1]), np.cov(v.T), len(v))


def _last_places(
    target: Emulable, emulated: Emulable, proposal: BlockProposal, v: np.ndarray, random: np.random.RandomState
) -> np.ndarray:
    """Places about walkers of ``target`` that began with draws v (w, d) of ``emulated``, and draws of ``proposal``."""
    move = delayed_move(emulated.parts, proposal, STEPS, OTHER)
    ensemble = Ensemble(target.parts, initial_state(v[:WALKERS], random), move).run(LAST_STEPS, store=False)
    walkers = ensemble.state.coords
    wide = proposal.draw(random, 2 * DRAWS)
    wide = wide[np.all(np.isfinite(wide), axis=1)]
    least = np.median(np.sum(emulated.parts(walkers), axis=1)) - FAR
    wide = wide[np.sum(emulated.parts(wide), axis=1) > least][:DRAWS]
    return np.concatenate([wide, *(_around(walkers, random) for _ in range(DRAWS // len(walkers)))])


def _follow(
    target: Emulable, proposal: BlockProposal, v: np.ndarray, large: list[bool], random: np.random.RandomState
) -> tuple[BlockProposal, np.ndarray]:
    """Proposal with maps of the large blocks that follow a chain of ``target`` from draws v (w, d), and its last places.

    Draws of a chain determine a map better than weighted draws: few of these hold most of the weight.
    """
    for _ in range(MAPS):
        ensemble = Ensemble(target.parts, initial_state(v, random), block_move(proposal)).run(STEPS)
        v = ensemble.state.coords
        drawn = np.concatenate([v, ensemble.chain[STEPS // 2]])
        equal = np.full(len(drawn), 1.0 / len(drawn))
        pairs = zip(proposal.blocks, proposal.densities, large, strict=True)
        maps = [Transported(drawn[:, b], equal) if own and len(b) <= LARGEST_MAP else q for b, q, own in pairs]
        proposal = BlockProposal(proposal.blocks, maps)
    return proposal, v
