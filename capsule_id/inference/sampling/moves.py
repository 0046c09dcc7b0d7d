"""Ensemble moves; a pilot run chooses among them by measured autocorrelation time."""

from collections.abc import Callable, Sequence
from typing import Any

import emcee
import numpy as np
from emcee.model import Model

from capsule_id.inference.sampling.proposal import BlockProposal

#: emcee's moves with their weights.
Moves = list[tuple[Any, float]]


class BlockMove(emcee.moves.Move):
    """Independence Metropolis–Hastings of all blocks of parameters in every step, each accepted separately.

    The posterior is a product over blocks. emcee stores its factors as blobs, so that one evaluation suffices for all
    blocks. Each block has its own proposal. It is fixed before the recorded chain starts, so that detailed balance holds.

    Parameters
    ----------
    proposal : density of every block, in the order of the factors
    """

    def __init__(self, proposal: BlockProposal) -> None:
        self.proposal = proposal

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Make one emcee step: return the new state and the share of accepted blocks, (w,)."""
        proposal = self.proposal
        drawn = proposal.draw(model.random, len(state.coords))
        new = np.where(np.isfinite(drawn), drawn, state.coords)
        factors = proposal.log_density(state.coords) - proposal.log_density(new)
        # A draw outside the domain has the density 0.
        inside = [np.all(np.isfinite(drawn[:, block]), axis=1) for block in proposal.blocks]
        return accept(model, state, new, np.where(np.stack(inside, axis=1), factors, -np.inf), proposal.blocks)


class DelayedMove(emcee.moves.Move):
    """Delayed acceptance of all blocks of parameters (Christen & Fox 2005): proposals from an emulated posterior.

    A step is a chain of ``steps`` block moves on the emulated posterior. The exact posterior accepts its end, or not.
    An error of the emulator costs acceptance only: the chain converges to the exact posterior.

    Parameters
    ----------
    parts : (w, d) -> (w, blocks), emulated log-density of each block
    proposal : see ``BlockMove``
    """

    def __init__(self, parts: Callable[[np.ndarray], np.ndarray], proposal: BlockProposal, steps: int) -> None:
        self.parts, self.steps, self.blocks = parts, steps, proposal.blocks
        self._inner = BlockMove(proposal)

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Make one emcee step: return the new state and the share of accepted blocks, (w,)."""

        def log_density(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            found = self.parts(v)
            return np.sum(found, axis=1), found

        emulated = Model(model.log_prob_fn, log_density, model.map_fn, model.random)
        total, before = log_density(state.coords)
        end = emcee.State(state.coords, log_prob=total, blobs=before)
        with np.errstate(invalid="ignore"):  # a place without emulated density stays, until another move leaves it
            for _ in range(self.steps):
                end, _ = self._inner.propose(emulated, end)
            factors = before - end.blobs
        return accept(model, state, end.coords, factors, self.blocks)


def accept(
    model: Any, state: emcee.State, new: np.ndarray, factors: np.ndarray, blocks: Sequence[np.ndarray]
) -> tuple[emcee.State, np.ndarray]:
    """Accept or refuse each block of the proposals ``new`` (w, d) by Metropolis–Hastings.

    Return the new state and the share of accepted blocks, (w,).

    Parameters
    ----------
    factors : (w, blocks) log of the proposal density of the old place over that of the new one
    """
    _, blobs = model.compute_log_prob_fn(new)
    # emcee drops the axis where there is one block only.
    old = np.asarray(state.blobs)
    old_parts, new_parts = old.reshape(factors.shape), np.reshape(blobs, factors.shape)
    accepted = np.log(model.random.uniform(size=factors.shape)) < new_parts - old_parts + factors
    coords = state.coords.copy()
    for i, block in enumerate(blocks):
        coords[:, block] = np.where(accepted[:, i, None], new[:, block], coords[:, block])
    parts = np.where(accepted, new_parts, old_parts)
    new_state = emcee.State(coords, log_prob=np.sum(parts, axis=1), blobs=parts.reshape(old.shape))
    return new_state, np.mean(accepted, axis=1)


def block_move(proposal: BlockProposal) -> Moves:
    """Block moves, with one step in ten by differential evolution, which needs no covariance."""
    return [(BlockMove(proposal), 0.9), (emcee.moves.DEMove(), 0.1)]


def delayed_move(parts: Callable[[np.ndarray], np.ndarray], proposal: BlockProposal, steps: int) -> Moves:
    """Delayed acceptance, with one step in ten by differential evolution, which needs no emulator."""
    return [(DelayedMove(parts, proposal, steps), 0.9), (emcee.moves.DEMove(), 0.1)]


def other_moves() -> dict[str, Moves]:
    """Return the moves that need no proposal density."""
    return {
        # One snooker step in ten (ter Braak & Vrugt 2008).
        "differential evolution + snooker": [(emcee.moves.DEMove(), 0.9), (emcee.moves.DESnookerMove(), 0.1)],
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
