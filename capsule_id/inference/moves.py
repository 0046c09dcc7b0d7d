"""Ensembles of the sampler: diagnostics of their chains, their moves, and their storage on disk."""

import hashlib
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from pathlib import Path
from typing import Any

import emcee
import h5py
import numpy as np
from jaxtyping import Float
from scipy import special, stats

from capsule_id.console import stop_if_interrupted
from capsule_id.inference.curvature import Random
from capsule_id.inference.proposal import BlockProposal
from capsule_id.inference.target import Scale
from capsule_id.output import replace_file

# diagnostics: Convergence diagnostics of ensemble samplers. Independent chains are whole ensembles, not the walkers
# of one.


#: Stored draws of independent ensembles.
Draws = Float[np.ndarray, "ensemble draw walker d"]

#: Summation window of autocovariances, in autocorrelation times (Sokal 1997, section 3); beyond it they are noise.
WINDOW = 5.0
#: Probabilities of the quantiles whose effective sample size is that of the tails (Vehtari et al. 2021, section 4.3).
TAILS = (0.05, 0.95)


def in_range(draws: Draws) -> Draws:
    """The draws over a power of two for each parameter: their squares do not overflow, and no digit changes.

    Draws of a parameter that no reading bounds may be as large as 1e150.
    """
    return np.ldexp(draws, -np.frexp(np.max(np.abs(draws), axis=(0, 1, 2)))[1])


def integrated_time(draws: Draws) -> Float[np.ndarray, "ensemble d"]:
    """(ensemble, d) integrated autocorrelation time of every ensemble, in draws, by emcee's estimator, for the ESS.

    NaN where a walker never moved (after a few draws only).
    """
    with np.errstate(invalid="ignore"):
        return np.stack([emcee.autocorr.integrated_time(chain, tol=0, quiet=True) for chain in in_range(draws)])


def ensemble_time(draws: Draws) -> Float[np.ndarray, "ensemble d"]:
    """(ensemble, d) integrated autocorrelation time without emcee's bias in short chains, for the stopping rule.

    Autocovariances are about the mean of the whole ensemble and averaged over its walkers. emcee takes each walker's
    own mean, which underestimates tau by a fraction 10 tau/N: by 20 % at N = 50 tau (tested). The sum stops at the
    first lag above ``WINDOW`` tau (Sokal 1997, section 3).

    Parameters
    ----------
    draws : (ensemble, draw, walker, d)
    """
    n = draws.shape[1]
    centred = draws - np.mean(draws, axis=(1, 2), keepdims=True)
    spectrum = np.abs(np.fft.rfft(centred, n=2 * n, axis=1)) ** 2
    covariance = np.mean(np.fft.irfft(spectrum, n=2 * n, axis=1)[:, :n], axis=2) / np.arange(n, 0, -1)[:, None]
    # Draws that never change have the longest time.
    first = np.broadcast_to(covariance[:, :1], covariance.shape)
    share = np.divide(covariance, first, out=np.ones_like(covariance), where=first > 0.0)
    sums = 2.0 * np.cumsum(share, axis=1) - 1.0
    enough = np.arange(n)[:, None] >= WINDOW * sums
    enough[:, -1] = True
    return np.take_along_axis(sums, np.argmax(enough, axis=1)[:, None], axis=1)[:, 0]


def pooled_time(draws: Draws) -> Float[np.ndarray, " d"]:
    """(d,) integrated autocorrelation time of the normal scores, over the walkers of all ensembles together.

    Covariances are about the mean of all ensembles: where they disagree, the time is long. Of values themselves a single
    walker far out in a tail would decide the time.
    """
    ensembles, number, walkers, d = draws.shape
    return ensemble_time(np.moveaxis(normal_scores(draws), 0, 1).reshape(1, number, ensembles * walkers, d))[0]


def normal_scores(draws: Draws) -> Draws:
    """Normal scores of the ranks of every parameter over all ensembles (Vehtari et al. 2021, section 4.1)."""
    flat = draws.reshape(-1, draws.shape[-1])
    return special.ndtri((stats.rankdata(flat, axis=0) - 0.375) / (len(flat) + 0.25)).reshape(draws.shape)


def split_rhat(draws: Draws) -> Float[np.ndarray, " d"]:
    """(d,) split R-hat (Gelman et al., Bayesian Data Analysis, section 11.4) across independent ensembles.

    Each half of an ensemble, its walkers pooled, is one chain; ``draws`` (ensemble, draw, walker, d).
    """
    half = draws.shape[1] // 2
    draws = in_range(draws)
    halves = np.concatenate([draws[:, :half], draws[:, draws.shape[1] - half :]])
    chains = halves.reshape(len(halves), -1, draws.shape[-1])
    n = chains.shape[1]
    within = np.mean(np.var(chains, axis=1, ddof=1), axis=0)
    between = n * np.var(np.mean(chains, axis=1), axis=0, ddof=1)
    return np.sqrt(((n - 1) / n * within + between / n) / within)


def effective_sample_size(draws: Draws, tau: Float[np.ndarray, "ensemble d"]) -> Float[np.ndarray, " d"]:
    """(d,) draws divided by the integrated autocorrelation time ``tau`` (ensemble, d), summed over ensembles.

    It never exceeds the number of draws, because the estimate of tau from a few draws may be 0.
    """
    return np.sum(draws.shape[1] * draws.shape[2] / np.maximum(tau, 1.0), axis=0)


def bulk_and_tail_size(draws: Draws) -> Float[np.ndarray, "2 d"]:
    """(2, d) effective sample sizes of the bulk and of the tails (Vehtari et al. 2021, sections 4.1 and 4.3).

    Bulk: of the normal scores of the ranks over all ensembles. Tails: the smaller one of the two indicators that a
    draw lies below the 5 % or the 95 % quantile. Both use ``ensemble_time``, which holds for short chains.
    """
    flat = draws.reshape(-1, draws.shape[-1])
    tails = [np.asarray(draws <= edge, dtype=float) for edge in np.quantile(flat, TAILS, axis=0)]
    bulk, *ends = (effective_sample_size(x, ensemble_time(x)) for x in (normal_scores(draws), *tails))
    return np.stack([bulk, np.min(ends, axis=0)])


def geyer_size(draws: Draws) -> Float[np.ndarray, " d"]:
    """(d,) effective sample sizes of the means, every walker a chain, as ArviZ has them (Vehtari et al. 2021, section 3).

    The sum of autocorrelations ends before the first negative pair of lags, and no pair counts more than one before it.
    """
    half = draws.shape[1] // 2
    draws = in_range(draws)
    halves = np.concatenate([draws[:, :half], draws[:, draws.shape[1] - half :]])
    chains = np.moveaxis(halves, 1, 2).reshape(-1, half, draws.shape[-1])
    means = np.mean(chains, axis=1, keepdims=True)
    spectrum = np.abs(np.fft.rfft(chains - means, n=2 * half, axis=1)) ** 2
    covariance = np.mean(np.fft.irfft(spectrum, n=2 * half, axis=1)[:, :half], axis=0) / half
    within = covariance[0] * half / max(half - 1, 1)
    rho = 1.0 - (within - covariance) / (covariance[0] + np.var(means[:, 0], axis=0, ddof=1))
    rho[0] = 1.0
    times = []
    for own in rho.T:
        used = own[: max(half - 1, 2)]
        pairs = used[:-1:2] + used[1::2]
        last = int(np.argmax(np.append(pairs[:-1] < 0.0, True)))
        least = 0.0 if np.any(pairs[last : last + 1] < 0.0) else -1.0
        times.append(2.0 * np.sum(np.minimum.accumulate(pairs[:last])) - 1.0 + max(own[2 * last], least))
    number = chains.shape[0] * half
    return number / np.maximum(times, 1.0 / np.log10(number))


# moves: Ensemble moves.


#: Share of the delayed moves whose inner chain is a random walk, its number of steps, and a step in sds of the posterior.
LOCAL, WALK, SHORT = 0.3, 5, 0.15
#: Share of the delayed moves whose inner chain rescales, and the sd of the logarithm of a factor.
RESCALED, FACTOR = 0.2, 0.7
#: emcee's moves with their weights.
Moves = list[tuple[Any, float]]
#: (w, d) -> (w, blocks), log-density of each block; or (w, blocks, k), log-density and what else is kept of each block.
Parts = Callable[[np.ndarray], np.ndarray]
#: After a step: places (w, d), ``Parts`` there, and which blocks were accepted, (w, blocks).
Step = tuple[np.ndarray, np.ndarray, np.ndarray]


class BlockMove(emcee.moves.Move):
    """Independence Metropolis–Hastings of all blocks of parameters in every step, each accepted separately.

    The posterior is a product over blocks. emcee stores its factors as blobs, so that one evaluation suffices for all
    blocks. Each block has its own proposal. It is fixed before the recorded chain starts, so that detailed balance holds.

    Parameters
    ----------
    proposal : density of every block, in the order of the factors
    """

    def __init__(self, proposal: BlockProposal) -> None:
        self.proposal, self.blocks = proposal, proposal.blocks

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Make one emcee step: return the new state and the share of accepted blocks, (w,)."""
        parts, exact = _parts(state.blobs, self.blocks), _exact(model, self.blocks)
        coords, parts, accepted = self.step(exact, state.coords, parts, model.random)
        return _state(state, coords, parts), np.mean(accepted, axis=1)

    def step(self, log_density: Parts, coords: np.ndarray, parts: np.ndarray, random: Random) -> Step:
        proposal = self.proposal
        # A draw outside the domain has the density 0.
        new, inside = proposal.draw_inside(random, len(coords), coords)
        factors = np.where(inside, proposal.log_density(coords) - proposal.log_density(new), -np.inf)
        return accept(random, coords, parts, new, log_density(new), factors, proposal.blocks)


class RandomWalk:
    """Metropolis steps of all blocks of parameters, each accepted separately.

    Parameters
    ----------
    blocks : indices of the parameters of each block
    covariance : (d, d) of a step; only the blocks are used
    """

    def __init__(self, blocks: Sequence[np.ndarray], covariance: np.ndarray) -> None:
        self.blocks = blocks
        self._roots = [np.linalg.cholesky(covariance[np.ix_(block, block)]) for block in blocks]

    def step(self, log_density: Parts, coords: np.ndarray, parts: np.ndarray, random: Random) -> Step:
        new = coords.copy()
        for block, root in zip(self.blocks, self._roots, strict=True):
            new[:, block] += random.standard_normal((len(new), len(block))) @ root.T
        none = np.zeros((len(new), len(self.blocks)))
        return accept(random, coords, parts, new, log_density(new), none, self.blocks)


class Rescaling:
    """Metropolis steps that change a scale and its factors, or the factors and what balances them, but not the motion.

    A step multiplies the scale and divides its factors by the same number; or it adds a number to all factors, and
    divides what they balance by the exponential of its product with the scale. Where readings determine only products,
    no other step goes far along the hyperbola on which one is constant.

    Parameters
    ----------
    blocks : indices of the parameters of each block
    scaled : each in one block
    """

    def __init__(self, blocks: Sequence[np.ndarray], scaled: Sequence[Scale]) -> None:
        self.blocks = blocks
        self._scaled = [(next(i for i, block in enumerate(blocks) if one.scatter in block), one) for one in scaled]

    def step(self, log_density: Parts, coords: np.ndarray, parts: np.ndarray, random: Random) -> Step:
        new, factors = coords.copy(), np.zeros((len(coords), len(self.blocks)))
        rescales = random.uniform() < 0.5
        for block, (scale, own, balanced) in self._scaled:
            t = random.standard_normal(len(new))
            if rescales:
                new[:, scale] += FACTOR * t
                new[:, own] *= np.exp(-FACTOR * t)[:, None]
                factors[:, block] -= len(own) * FACTOR * t  # the Jacobian
            else:
                new[:, own] += t[:, None]
                new[:, balanced] -= (np.exp(new[:, scale]) * t)[:, None]
        return accept(random, coords, parts, new, log_density(new), factors, self.blocks)


class DelayedMove(emcee.moves.Move):
    """Delayed acceptance of all blocks of parameters (Christen & Fox 2005): proposals from an emulated posterior.

    A step is a chain of ``steps`` inner steps on the emulated posterior. The exact posterior accepts its end, or not.
    An error of the emulator costs acceptance only: the chain converges to the exact posterior.

    Parameters
    ----------
    emulated : (w, d) -> (w, blocks), emulated log-density of each block
    inner : steps that leave the emulated posterior unchanged
    """

    def __init__(self, emulated: Parts, inner: BlockMove | RandomWalk | Rescaling, steps: int) -> None:
        self.emulated, self.inner, self.steps = emulated, inner, steps

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Make one emcee step: return the new state and the share of accepted blocks, (w,)."""
        blocks, end = self.inner.blocks, state.coords
        begin = emulated = self.emulated(end)
        with np.errstate(invalid="ignore"):  # a walker at the emulated density 0 stays, until another move takes it on
            for _ in range(self.steps):
                end, emulated, _ = self.inner.step(self.emulated, end, emulated, model.random)
            before, found = _parts(state.blobs, blocks), _exact(model, blocks)(end)
            coords, parts, accepted = accept(model.random, state.coords, before, end, found, begin - emulated, blocks)
        moved = [np.any(end[:, block] != state.coords[:, block], axis=1) for block in blocks]
        return _state(state, coords, parts), np.mean(accepted & np.stack(moved, axis=1), axis=1)


def accept(
    random: Random,
    coords: np.ndarray,
    parts: np.ndarray,
    new: np.ndarray,
    new_parts: np.ndarray,
    factors: np.ndarray,
    blocks: Sequence[np.ndarray],
) -> Step:
    """Accept or refuse each block of the proposals ``new`` (w, d) by Metropolis–Hastings.

    Parameters
    ----------
    coords, parts : places (w, d) of the walkers, and ``Parts`` there
    new_parts : ``Parts`` at ``new``
    factors : (w, blocks) log of the proposal density of the old place over that of the new one
    """
    old, found = (np.reshape(each, (*factors.shape, -1)) for each in (parts, new_parts))
    accepted = np.log(random.uniform(size=factors.shape)) < found[..., 0] - old[..., 0] + factors
    coords = coords.copy()
    for i, block in enumerate(blocks):
        coords[:, block] = np.where(accepted[:, i, None], new[:, block], coords[:, block])
    parts = np.where(accepted[..., None], found, old)
    return coords, parts.reshape(np.shape(new_parts)), accepted


def _exact(model: Any, blocks: Sequence[np.ndarray]) -> Parts:
    """The density that emcee samples, block by block, with what is kept."""
    return lambda v: _parts(model.compute_log_prob_fn(v)[1], blocks)


def _parts(blobs: Any, blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Log-density of each block, and what else is kept of it, from emcee's blobs; (w, blocks, k)."""
    return np.reshape(blobs, (len(blobs), len(blocks), -1))


def _state(before: emcee.State, coords: np.ndarray, parts: np.ndarray) -> emcee.State:
    log_prob = np.sum(parts[..., 0], axis=1)
    return emcee.State(coords, log_prob=log_prob, blobs=parts.reshape(np.asarray(before.blobs).shape))


def block_move(proposal: BlockProposal) -> Moves:
    """Block moves, with one step in ten by differential evolution, which needs no covariance."""
    return [(BlockMove(proposal), 0.9), (emcee.moves.DEMove(), 0.1)]


def delayed_moves(
    emulated: Parts,
    proposal: BlockProposal,
    near: np.ndarray,
    steps: int,
    scaled: Sequence[Scale] = (),
    other: float = 0.1,
) -> Moves:
    """Delayed acceptance by chains of ``steps`` block moves, and of short random walks, with some differential evolution.

    A walker where the emulated density is too small rejects almost every distant proposal. The error of an emulator is
    nearly the same at a place nearby, so that a short walk is accepted.

    Parameters
    ----------
    near : (n, d) draws; the steps of a walk have a share of their covariance
    scaled : see ``Rescaling``; some chains rescale these
    other : share of steps by differential evolution, which needs no emulator
    """
    walk = RandomWalk(proposal.blocks, SHORT**2 * np.atleast_2d(np.cov(near.T)))
    share = RESCALED if scaled else 0.0
    rescaling = [(DelayedMove(emulated, Rescaling(proposal.blocks, scaled), WALK), share * (1.0 - other))]
    return [
        (DelayedMove(emulated, BlockMove(proposal), steps), (1.0 - LOCAL - share) * (1.0 - other)),
        (DelayedMove(emulated, walk, WALK), LOCAL * (1.0 - other)),
        *(rescaling if scaled else []),
        (emcee.moves.DEMove(), other),
    ]


# ensemble: One emcee ensemble that stores its own state and advances draw by draw.
#
# emcee keeps the state of a run only in ``run_mcmc``. Saving after every draw requires iteration, and an iterated run
# must keep its own state between calls.


class Ensemble:
    """Walkers that sample one log-density with given moves.

    Parameters
    ----------
    parts : log-density of each block, and what else is kept of it; the log-density is the sum over the blocks
    state : positions of the walkers and state of their random numbers
    moves : see ``capsule_id.inference.moves``
    backend : storage of the draws; None: in memory
    """

    def __init__(self, parts: Parts, state: emcee.State, moves: Moves, backend: Any = None) -> None:
        def log_density(v: np.ndarray) -> np.ndarray:
            """(w, 1 + blocks k): log-density, then the parts, which emcee stores as blobs for ``BlockMove``."""
            found = np.atleast_3d(parts(v))
            return np.concatenate([np.sum(found[..., 0], axis=1, keepdims=True), found.reshape(len(v), -1)], axis=1)

        walkers, dimension = state.coords.shape
        self.state = state
        # Ensembles run side by side, and emcee's moves keep numbers of the ensemble that they work for.
        own = [(copy(move), weight) for move, weight in moves]
        self._sampler = emcee.EnsembleSampler(
            walkers, dimension, log_density, vectorize=True, moves=own, backend=backend
        )

    @property
    def stored(self) -> int:
        """Number of stored draws."""
        return int(self._sampler.iteration)

    @property
    def chain(self) -> np.ndarray:
        """(draw, walker, d) stored draws."""
        return np.asarray(self._sampler.get_chain())

    @property
    def parts(self) -> np.ndarray:
        """(draw, walker, blocks k) parts of the stored draws, in one axis."""
        blobs = np.asarray(self._sampler.get_blobs())
        return blobs.reshape(*blobs.shape[:2], -1)

    @property
    def acceptance(self) -> np.ndarray:
        """(walker,) share of accepted proposals among the stored draws."""
        return self._sampler.backend.accepted / self._sampler.iteration

    def run(self, draws: int, thin: int = 1, store: bool = True) -> "Ensemble":
        """Make ``draws`` more draws of ``thin`` steps each and return the ensemble itself."""
        if draws > 0:
            for state in self._sampler.sample(self.state, iterations=draws, thin_by=thin, store=store):
                self.state = state
                stop_if_interrupted()
        return self


def initial_state(positions: np.ndarray, random: Random) -> emcee.State:
    """State of walkers at ``positions`` (w, d), with the current state of ``random``."""
    return emcee.State(positions, random_state=random.get_state())


class OpenBackend(emcee.backends.HDFBackend):
    """emcee's HDF5 backend on an open file, which may be in memory; emcee's own opens a file on disk six times a step."""

    def __init__(self, file: h5py.File, name: str) -> None:
        super().__init__(file.filename, name)
        self._file = file

    def open(self, mode: str = "r") -> AbstractContextManager[h5py.File]:
        return nullcontext(self._file)

    @property
    def initialized(self) -> bool:
        """Whether the file has draws of this ensemble; emcee asks for a file on disk."""
        return self.name in self._file


# chain store: Storage of chains that survives termination of the process at any moment.
#
# emcee writes every draw into an HDF5 file in several steps (coordinates, random state, counter), and HDF5 ends the
# process where the disk is full. The file is therefore in memory; its copies on disk are made between draws.


#: Time between two copies, s.
SAVE_EVERY = 5.0
#: Length of the digest of a copy, bytes.
_DIGEST = hashlib.sha256().digest_size
#: By so much the file in memory grows at a time, bytes.
_GROWTH = 2**22


class ChainStore:
    """Context manager of the HDF5 file in memory that emcee writes, and of its copy on disk.

    Parameters
    ----------
    store : the copy, from which an interrupted run resumes; one without a valid digest is discarded
    fingerprint : of the sampled density and the seed; a copy with another one is discarded
    """

    def __init__(self, store: Path, fingerprint: str) -> None:
        self._store, self._next = store, time.monotonic() + SAVE_EVERY
        saved = store.read_bytes() if store.exists() else b""
        content = saved[_DIGEST:]
        valid = content and hashlib.sha256(content).digest() == saved[:_DIGEST]
        self._file = h5py.File.in_memory(content if valid else None, block_size=_GROWTH)
        if self._file.attrs.setdefault("fingerprint", fingerprint) != fingerprint:
            self._file.close()
            self._file = h5py.File.in_memory(block_size=_GROWTH)
            self._file.attrs["fingerprint"] = fingerprint

    def __enter__(self) -> "ChainStore":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def backend(self, name: str) -> OpenBackend:
        """emcee backend for the draws of one ensemble."""
        return OpenBackend(self._file, name)

    def between_draws(self) -> None:
        """Copy the file if the last copy is old enough; call this only while emcee is not writing."""
        if time.monotonic() >= self._next:
            self.save()

    def save(self) -> None:
        """Copy the file now; a single rename makes the copy atomic.

        Raises
        ------
        OutputError
            If the disk is full; the last copy stays.
        """
        self._file.flush()
        content = self._file.id.get_file_image()
        # The copy before it, this one, and the result, which is about as large.
        replace_file(self._store, hashlib.sha256(content).digest() + content, 3 * len(content))
        self._next = time.monotonic() + SAVE_EVERY
