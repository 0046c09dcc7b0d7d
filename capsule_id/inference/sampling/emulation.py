"""Emulation of a posterior whose motions take long: exact motions near the posterior, and emulators fitted to them.

Each round draws from the emulated posterior of the round before and adds the exact motions there, so that the emulators
learn where the posterior is. (J. A. Christen, C. Fox, *Markov chain Monte Carlo using an approximation*, Journal of
Computational and Graphical Statistics 14, 2005, 795.)
"""

from typing import NamedTuple, Protocol, Self

import numpy as np

from capsule_id.inference.sampling.ensemble import Ensemble, initial_state
from capsule_id.inference.sampling.moves import block_move
from capsule_id.inference.sampling.proposal import BlockProposal
from capsule_id.inference.sampling.refinement import NO_MASS, effective_size, refined
from capsule_id.inference.sampling.transport import LARGEST_MAP, Transported

#: Draws of the first round and of each later one, largest number of rounds.
FIRST_DRAWS, DRAWS, ROUNDS = 2048, 1024, 8
#: Steps of the chains that draw from an emulated posterior.
STEPS = 40
#: Rounds end where the effective share of so many draws, weighted by exact over emulated posterior, is this large.
CHECKED, ENOUGH = 256, 0.6
#: Rounds that adapt the proposal to the emulated posterior of a later round, and maps that follow the last one.
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


class Emulation(NamedTuple):
    """An emulated posterior, the proposal that is adapted to it, and draws of it."""

    target: Emulable
    proposal: BlockProposal
    start: Places


def emulation(target: Emulable, first: BlockProposal, large: list[bool], random: np.random.RandomState) -> Emulation:
    """Emulate ``target``, beginning with draws of ``first``, the Laplace approximation; see ``refined`` for ``large``.

    Raises
    ------
    RuntimeError
        If hardly any draw has finite motions, or a finite log-density.
    """
    v = first.draw(random, FIRST_DRAWS)
    v = v[np.all(np.isfinite(v), axis=1)]
    motions, proposal = target.motions(v), first
    if any(np.sum(np.all(np.isfinite(own), axis=1)) < 2 * v.shape[1] for own in motions):
        raise RuntimeError(NO_MASS)
    for number in range(ROUNDS):
        emulated = target.emulated(v, motions)
        rounds = AGAIN if number else None
        proposal = refined(emulated.parts, proposal, target.normal_priors, random, large, rounds)
        drawn = _draws(emulated, proposal, random)
        checked = drawn[:CHECKED]
        log_weight = np.sum(target.parts(checked), axis=1) - np.sum(emulated.parts(checked), axis=1)
        if np.any(np.isfinite(log_weight)) and effective_size(log_weight) >= ENOUGH * len(checked):
            break
        motions = [np.concatenate(pair) for pair in zip(motions, target.motions(drawn), strict=True)]
        v = np.concatenate([v, drawn])
    proposal, drawn = _follow(emulated, proposal, drawn, large, random)
    return Emulation(emulated, proposal, Places(drawn))


def _draws(target: Emulable, proposal: BlockProposal, random: np.random.RandomState) -> np.ndarray:
    """``DRAWS`` draws of ``target``: the last places of as many walkers that begin with draws of ``proposal``."""
    v = proposal.draw(random, 2 * DRAWS)
    v = v[np.all(np.isfinite(v), axis=1)]
    v = v[np.all(np.isfinite(target.parts(v)), axis=1)][:DRAWS]
    if len(v) < 2 * v.shape[1]:
        raise RuntimeError(NO_MASS)
    return Ensemble(target.parts, initial_state(v, random), block_move(proposal)).run(STEPS, store=False).state.coords


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
