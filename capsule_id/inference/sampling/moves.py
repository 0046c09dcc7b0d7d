"""Ensemble moves; a pilot run chooses among them by measured autocorrelation time."""

from typing import Any

import emcee
import numpy as np

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
        _, blobs = model.compute_log_prob_fn(new)
        # emcee drops the axis where there is one block only.
        old = np.asarray(state.blobs)
        factors = proposal.log_density(state.coords) - proposal.log_density(new)
        old_parts, new_parts = old.reshape(factors.shape), np.reshape(blobs, factors.shape)
        accepted = np.log(model.random.uniform(size=factors.shape)) < new_parts - old_parts + factors
        coords = state.coords.copy()
        for i, block in enumerate(proposal.blocks):
            # A draw outside the domain has the density 0.
            accepted[:, i] &= np.all(np.isfinite(drawn[:, block]), axis=1)
            coords[:, block] = np.where(accepted[:, i, None], new[:, block], coords[:, block])
        parts = np.where(accepted, new_parts, old_parts)
        new_state = emcee.State(coords, log_prob=np.sum(parts, axis=1), blobs=parts.reshape(old.shape))
        return new_state, np.mean(accepted, axis=1)


def block_move(proposal: BlockProposal) -> Moves:
    """Block moves, with one step in ten by differential evolution, which needs no covariance."""
    return [(BlockMove(proposal), 0.9), (emcee.moves.DEMove(), 0.1)]


def other_moves() -> dict[str, Moves]:
    """Return the moves that need no proposal density."""
    return {
        # One snooker step in ten (ter Braak & Vrugt 2008).
        "differential evolution + snooker": [(emcee.moves.DEMove(), 0.9), (emcee.moves.DESnookerMove(), 0.1)],
        "stretch": [(emcee.moves.StretchMove(), 1.0)],
    }
