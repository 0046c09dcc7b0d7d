"""Densities of the log-posterior: whole for the point fit, with every scatter integrated out for the sampler."""

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import wrightomega

from capsule_id.console import stop_if_interrupted
from capsule_id.experiments.base import Experiment, ValuesBySymbol
from capsule_id.experiments.friction_model import EQUATION_1
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference.curvature import require_width
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import HEAVY, LogPosterior, Scale, half_ensemble
from capsule_id.physics.batches import in_batches
from capsule_id.precision import COMPILE

# quadrature: Quadrature nodes of the integrals over scatters.
#
# The nodes are fixed before the sampler starts, so that the integrated posterior is one smooth function. Each
# window covers all values where a conditional density exceeds e^-``DEPTH`` of its maximum. The walkers of this test
# extend from the point fit to points of negligible posterior mass. The number of nodes grows until two interlaced
# grids agree.
#
# A scatter that the readings hardly distinguish from zero has a left tail as long as its prior's. The nodes are
# therefore equidistant in t with u = log(scatter) = t - exp(bend - t). Right of ``bend``, t equals u. Left of it the
# exponential tail becomes double exponential (Takahasi & Mori 1974).


#: One value for each walker and scatter.
PerScatter = Float[np.ndarray, "w scatters"]

#: Densities below e^-DEPTH of their maximum are neglected; those below e^-CORE count as a tail.
DEPTH, CORE = 21.0, 3.0
#: Absolute and relative tolerance of log-integrals on interlaced grids; the relative one allows for rounding.
TOLERANCE, ROUNDING = 3e-9, 1e-13
#: Integrals may be inaccurate where a block's log-posterior is this far below that of the point fit.
NO_MASS = 20.0
#: Numbers of nodes to try. The list is short, so that similar rigs share compiled code. The last is used untested.
NODES = (64, 128, 256, 512, 1024)
#: First window about the point fit, in u, and largest number of times that it is narrowed.
REACH, ROUNDS = 40.0, 12
#: Narrowing stops when a round leaves every walker's window wider than this fraction of the previous one.
SETTLED = 0.9


@dataclass(frozen=True)
class Grid:
    """Nodes t = start + step k, k = 0 .. nodes - 1, for every scatter.

    ``start`` and ``step`` are (scatters,) or (w, scatters), ``bend`` is (scatters,), -inf for u = t.
    """

    start: np.ndarray
    step: np.ndarray
    bend: np.ndarray
    nodes: int

    def shifted(self, by: "float | np.ndarray") -> "Grid":
        """Return the grid shifted by this fraction of the step."""
        return replace(self, start=self.start + by * self.step)

    def coarser(self, nodes: int) -> "Grid":
        """Return a grid of ``nodes`` nodes, at most as many as now, on the same interval."""
        nodes = min(nodes, self.nodes)
        return replace(self, step=self.step * (self.nodes - 1) / (nodes - 1), nodes=nodes)


def position(t: Any, bend: Any, xp: ModuleType = jnp) -> Any:
    """Return u at t."""
    return t - xp.exp(bend - t)


def log_stretch(t: Any, bend: Any, xp: ModuleType = jnp) -> Any:
    """Return log du/dt at t."""
    return xp.log1p(xp.exp(bend - t))


#: (located u (w, ...), grid) -> log-posterior terms without scatters (w, blocks); log-densities of t at the nodes (w,
#: scatters, nodes); logarithms of their integrals (w, scatters).
Terms = Callable[[np.ndarray, Grid], tuple[np.ndarray, np.ndarray, np.ndarray]]


def add_to_blocks(
    known: Float[np.ndarray, "w blocks"], block: Int[np.ndarray, " scatters"], integrals: PerScatter
) -> Float[np.ndarray, "w blocks"]:
    """(w, blocks) log-posterior: terms ``known`` without scatters plus integrals (w, scatters) by ``block``."""
    total = known.T.copy()
    np.add.at(total, block, integrals.T)
    return total.T


def choose_grid(
    terms: Terms,
    centre: Float[np.ndarray, " scatters"],
    block: Int[np.ndarray, " scatters"],
    probes: Float[np.ndarray, "w ..."],
) -> Grid:
    """Choose windows and number of nodes for scatters with value ``centre`` (scatters,) at the point fit.

    Parameters
    ----------
    block : (scatters,) column of each scatter in the terms without scatters
    probes : (w, ...) walkers, the point fit first; the integrals are accurate at those with posterior mass
    """
    low, core, high, mass = _windows(terms, centre, block, probes)
    bend = np.min(np.where(mass, core, np.inf), axis=0)
    low, high = np.min(np.where(mass, low, np.inf), axis=0), np.max(np.where(mass, high, -np.inf), axis=0)
    # Wright's omega solves t - exp(bend - t) = u: t = u + omega(bend - u).
    start, end = low + wrightomega(bend - low), high + wrightomega(bend - high)
    grids = [Grid(start, (end - start) / (nodes - 1), bend, nodes) for nodes in NODES]
    return next((grid for grid in grids[:-1] if agree(terms, grid, probes, mass)), grids[-1])


def _windows(
    terms: Terms,
    centre: Float[np.ndarray, " scatters"],
    block: Int[np.ndarray, " scatters"],
    probes: Float[np.ndarray, "w ..."],
) -> tuple[PerScatter, PerScatter, PerScatter, Bool[np.ndarray, "w scatters"]]:
    """Lowest u with density, lowest outside the tail, highest u, and whether the walker has mass in its block.

    Each array is (w, scatters). Each walker's window starts at ``REACH`` and narrows separately.
    """
    low = np.broadcast_to(centre - REACH, (len(probes), len(centre)))
    width, straight = np.full(low.shape, 2.0 * REACH), np.full(len(centre), -np.inf)
    for _ in range(ROUNDS):
        grid = Grid(low, width / (NODES[0] - 1), straight, NODES[0])
        known, density, integral = terms(probes, grid)
        # A walker without density keeps its window, because it has no mass either.
        density = np.where(np.any(np.isfinite(density), axis=-1, keepdims=True), density, 0.0)
        density = np.where(np.isfinite(density), density, -np.inf)
        density = density - np.max(density, axis=-1, keepdims=True)
        core = low + np.argmax(density > -CORE, axis=-1) * grid.step
        # The maximum may lie between two nodes, so the window includes one more node on either side.
        first = np.maximum(np.argmax(density > -DEPTH, axis=-1) - 1, 0)
        last = np.minimum(NODES[0] - np.argmax(density[..., ::-1] > -DEPTH, axis=-1), NODES[0] - 1)
        settled = np.all((last - first) * grid.step > SETTLED * width)
        low, width = low + first * grid.step, (last - first) * grid.step
        if settled:
            break
    posterior = add_to_blocks(known, block, integral)[:, block]
    if not np.all(np.isfinite(posterior[0])):
        raise RuntimeError("the posterior is not finite at the point fit: no scatter can be integrated out there")
    return low, core, low + width, posterior > posterior[0] - NO_MASS


def agree(
    terms: Terms,
    grid: Grid,
    probes: Float[np.ndarray, "w ..."],
    mass: Bool[np.ndarray, "w scatters"],
    tolerance: float = TOLERANCE,
) -> bool:
    """Whether shifting the nodes by half their distance leaves every log-integral with posterior mass unchanged."""
    integral, shifted = terms(probes, grid)[2][mass], terms(probes, grid.shifted(0.5))[2][mass]
    return bool(np.all(np.abs(integral - shifted) < tolerance + ROUNDING * np.abs(integral)))


# marginal: Log-posterior with every scatter integrated out, which the sampler uses.
#
# Each scatter belongs to the readings of one kind or one record. Given all other parameters the scatters are
# therefore independent, and each integral is one-dimensional. A sum over equidistant nodes in u = log(scatter)
# converges faster than any power of the node distance. The integrated posterior has light tails and few dimensions.
# The same sums give an exact draw of the scatters from their conditional distributions: a node, drawn by weight, of
# a randomly shifted grid.


#: Smallest and largest distance from the point fit of the walkers that determine the nodes, in standard deviations.
#: The largest is wide because few trials give the heavy tails of Student's t.
NEAREST, FARTHEST = 0.5, 500.0
#: Largest distance where scatters act together: only one scatter is integrated out there, and motions far from the
#: point fit take very many steps.
FARTHEST_WITH_KINKS = 20.0
#: Numbers of nodes to try for an emulated posterior, and the largest error of its log-integrals: the errors of the emulator
#: are larger. Grids are compared at this number of places, where the log-density is at most ``NO_MASS`` below the best.
EMULATED_NODES, EMULATED_ERROR, PLACES = (16, 32, 64, 128), 0.02, 512


#: Rows that are evaluated together where each takes ``HEAVY`` work, and fewer of more work: more would leave the caches.
ROWS_TOGETHER = 8


@dataclass(frozen=True)
class Layout:
    """Static structure of the integrated log-posterior.

    Attributes
    ----------
    scatter, located : indices of the entries of u that are integrated out, and of the others
    block : block of every entry of u, see ``LogPosterior.blocks``
    nodes : number of nodes of every integral
    """

    scatter: tuple[int, ...]
    located: tuple[int, ...]
    block: tuple[int, ...]
    nodes: int

    @property
    def blocks(self) -> int:
        return max(self.block) + 1


class MarginalPosterior:
    """Posterior of the located parameters of ``target``, with its scatters integrated out.

    Attributes
    ----------
    names : (d,) of all parameters, as in ``target``
    dimension : number of located parameters
    blocks : indices, among the located parameters, of each factor of the posterior
    centre, covariance : (dimension,), (dimension, dimension) Laplace approximation of u
    event_driven : for each block whether a motion of the capsule belongs to it
    normal_priors : (2, dimension) centre and width of the prior of u where it is normal; NaN elsewhere
    theta, work : those of ``target``: constrained values, and time of an evaluation
    can_be_emulated : whether there are motions to compute, and all of them are trials of a few numbers each
    scaled : ``LogPosterior.scaled``, indices among the located parameters
    kept : (2, scatters) block of each scatter and its place among the scatters of that block, see ``factors``
    """

    def __init__(self, target: LogPosterior, fit: PointFit) -> None:
        self.target, self.names, self._layout = target, target.names, _layout(target)
        self.theta, self.work = target.theta, target.work
        slow = [e for e in target.experiments if e.event_driven]
        self.can_be_emulated = bool(slow) and all(isinstance(e, Progression) for e in slow)
        self._located, self._scatter = np.array(self._layout.located), np.array(self._layout.scatter, dtype=int)
        self._label = np.array(self._layout.block)
        self.dimension = len(self._located)
        self.rows = rows_of(target)
        self.centre, self.covariance = fit.u[self._located], fit.covariance[np.ix_(self._located, self._located)]
        require_width(located := [self.names[i] for i in self._located], self.centre, self.covariance)
        priors = target.priors.at(self._located, np)
        self.normal_priors = np.where(priors.lognormal, np.stack([priors.centre, priors.width]), np.nan)
        own = (np.flatnonzero(self._label[self._located] == i) for i in range(self._layout.blocks))
        self.blocks = [block for block in own if len(block)]
        moved = [row.name for e in target.experiments if e.event_driven for row in e.parameters]
        self.event_driven = [bool({located[i] for i in block} & set(moved)) for block in self.blocks]
        at = partial(np.searchsorted, self._located)
        self.scaled = [Scale(int(at(scatter)), at(own), at(other)) for scatter, own, other in target.scaled]
        # A scatter whose block has no located parameter depends on nothing: it is drawn with the first block.
        own_block = np.where(self._label[self._scatter] < len(self.blocks), self._label[self._scatter], 0)
        before = np.tril(own_block[:, None] == own_block, -1)
        self.kept = np.stack([own_block, np.sum(before, axis=1)])
        self.grid = choose_grid(self._terms, fit.u[self._scatter], self._label[self._scatter], self._probes())

    @property
    def fingerprint(self) -> str:
        """SHA-256 of names, friction laws, the layout of ``factors`` and all numbers of the density."""
        laws = {getattr(e, "friction", EQUATION_1).source for e in self.target.experiments}
        digest = hashlib.sha256(repr((self.names, sorted(laws), self.kept.tolist())).encode())
        for leaf in jax.tree.leaves(self.target):
            digest.update(np.ascontiguousarray(leaf).tobytes())
        return digest.hexdigest()

    def parts(self, v: np.ndarray) -> np.ndarray:
        """(w, blocks) log-posterior of the located u (w, dimension), block by block; up to the evidence."""

        def one(v: np.ndarray) -> np.ndarray:
            known, _, integrals = self._terms(v, self.grid)
            return add_to_blocks(known, self._label[self._scatter], integrals)

        values = in_batches(one, v, self.rows)
        # Scatters without located parameters in their block add a constant.
        return np.where(np.isfinite(values), values, -np.inf)[:, : len(self.blocks)]

    def motions(self, v: np.ndarray) -> list[np.ndarray]:
        """Motions of every experiment with trials at located u (w, dimension), (w, k) each."""
        return [e.motions_of_draws(draws) for e, draws in self._trials(v)]

    def emulated(self, v: np.ndarray, motions: Sequence[np.ndarray]) -> "MarginalPosterior":
        """The posterior with emulators of the motions, fitted to ``motions`` at located u (w, dimension)."""
        pairs = zip(self._trials(v), motions, strict=True)
        emulated = {e.label: e.with_emulator(draws, own) for (e, draws), own in pairs}
        experiments = [emulated.get(e.label, e) for e in self.target.experiments]
        changed = copy(self)
        changed.target = LogPosterior(self.target.rig, experiments)
        known = v[-PLACES:]
        density = np.sum(changed.parts(known), axis=1)
        mass = np.repeat((density >= np.max(density) - NO_MASS)[:, None], len(self._scatter), axis=1)
        grids = [self.grid.coarser(nodes) for nodes in EMULATED_NODES]
        fine = (grid for grid in grids if agree(changed._terms, grid, known, mass, EMULATED_ERROR))
        changed.grid = next(fine, self.grid)
        return changed

    def _trials(self, v: np.ndarray) -> list[tuple[Progression, list[ValuesBySymbol]]]:
        """Every experiment with trials, and its values by symbol at located u (w, dimension); scatters are 1."""
        u = np.zeros((len(v), len(self.names)))
        u[:, self._located] = v
        values = [self.target.mapping(theta) for theta in self.target.theta(u)]
        return [(e, [e.local(one) for one in values]) for e in trials_of(self.target)]

    def factors(self, v: np.ndarray) -> np.ndarray:
        """(w, blocks, 2 + k) of the located u (w, dimension), block by block, for the sampler.

        Log-posterior; then one draw of the block's scatters: log-posterior with them, and their u. A place always has the
        same draw, because its random numbers are a hash of its coordinates.
        """
        return self._drawn(v, uniform_at(v, 2 * len(self._scatter)))

    def whole(self, located: np.ndarray, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The whole u (..., d) and its log-posterior (...) from the located u (..., dimension) and their ``factors``."""
        u = np.empty((*located.shape[:-1], len(self.names)))
        block, place = self.kept
        u[..., self._located], u[..., self._scatter] = located, factors[..., block, 2 + place]
        return u, np.sum(factors[..., 1], axis=-1)

    def restore(self, v: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Complete located ``v`` (w, dimension) with random draws of the scatters: return u (w, d) and its log-posterior."""
        random = np.random.default_rng(seed).uniform(size=(len(v), 2 * len(self._scatter)))
        return self.whole(v, self._drawn(v, random))

    def _drawn(self, v: np.ndarray, random: np.ndarray) -> np.ndarray:
        """``factors`` with two random numbers per scatter, (w, 2 scatters) in [0, 1).

        A scatter is a node, drawn by weight, of a randomly shifted grid. This draw is as exact as the sum over the
        nodes, because the sum does not depend on the shift.
        """
        grid, label, blocks = self.grid, self._label[self._scatter], len(self.blocks)
        size = self._layout.blocks

        def one(rows: np.ndarray) -> np.ndarray:
            """(rows, 2 size + scatters) log-posterior of each block without and with its scatters, and the scatters."""
            v, shift, chance = np.split(rows, [self.dimension, self.dimension + len(label)], axis=1)
            shifted = grid.shifted(shift - 0.5)
            known, terms, integrals = self._terms(v, shifted)
            highest = np.max(terms, axis=-1, keepdims=True)
            # No walker accepts a place without density: its draw has no effect.
            sums = np.cumsum(np.exp(np.where(np.isfinite(highest), terms - highest, 0.0)), axis=-1)
            node = np.sum(sums < chance[..., None] * sums[..., -1:], axis=-1)
            t = shifted.start + node * grid.step
            chosen = np.take_along_axis(terms, node[..., None], axis=-1)[..., 0] - log_stretch(t, grid.bend, np)
            sums_by_block = [add_to_blocks(known, label, values) for values in (integrals, chosen)]
            return np.concatenate([*sums_by_block, position(t, grid.bend, np)], axis=1)

        parts, density, scatters = np.split(
            in_batches(one, np.concatenate([v, random], axis=1), self.rows), [size, 2 * size], axis=1
        )
        block, place = self.kept
        found = np.zeros((len(v), blocks, 2 + np.max(place, initial=-1) + 1))
        # Blocks without located parameters add a constant to the density, and their scatters belong to the first.
        found[:, :, 0] = np.where(np.isfinite(parts), parts, -np.inf)[:, :blocks]
        found[:, :, 1] = density[:, :blocks]
        found[:, 0, 1] += np.sum(density[:, blocks:], axis=1)
        found[:, block, 2 + place] = scatters
        return found

    def _terms(self, v: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate ``conditional`` at (w, dimension), in batches."""
        layout = replace(self._layout, nodes=grid.nodes)
        size = (len(v), len(self._scatter))
        start, step = np.broadcast_to(grid.start, size), np.broadcast_to(grid.step, size)
        batches = [np.minimum(np.arange(i, i + self.rows), len(v) - 1) for i in range(0, len(v), self.rows)]
        parts = [conditional(layout, self.target, v[i], start[i], step[i], grid.bend) for i in batches]
        known, terms, integrals = (np.concatenate(each)[: len(v)] for each in zip(*parts, strict=True))
        return known, terms, integrals

    def _probes(self) -> np.ndarray:
        """(4 rows, dimension) located u: the point fit, and walkers at growing distances from it, twice.

        Distances are in Laplace standard deviations, separately for each block.
        """
        direction = np.random.default_rng(0).standard_normal((4 * self.rows, self.dimension))
        for block in self.blocks:
            direction[:, block] /= np.linalg.norm(direction[:, block], axis=1, keepdims=True)
        farthest = FARTHEST_WITH_KINKS if self.target.kinked else FARTHEST
        radius = np.concatenate([[0.0], np.geomspace(NEAREST, farthest, 2 * self.rows - 1)])
        return self.centre + np.tile(radius, 2)[:, None] * direction @ np.linalg.cholesky(self.covariance).T


def uniform_at(v: Float[np.ndarray, "w d"], number: int) -> Float[np.ndarray, "w number"]:
    """Numbers uniform in [0, 1) that depend on the place alone: bits of a hash of its coordinates."""
    hashes = b"".join(hashlib.shake_128(row.tobytes()).digest(8 * number) for row in v)
    return (np.frombuffer(hashes, np.uint64).reshape(len(v), number) >> 11) * 2.0**-53


def trials_of(target: LogPosterior) -> list[Progression]:
    """Its experiments with trials, whose motions can be emulated."""
    return [e for e in target.experiments if isinstance(e, Progression)]


def rows_of(target: LogPosterior) -> int:
    """Rows of one evaluation of the density of ``target``: half an ensemble; where it is heavy, whole groups of rows."""
    half = half_ensemble(int(np.sum(~target.integrated)))
    return half if target.work < HEAVY else -(-half // ROWS_TOGETHER) * ROWS_TOGETHER


def rows_together(target: LogPosterior) -> int:
    """Rows of a batch within a program: fewer, the more work each takes."""
    return max(min(ROWS_TOGETHER, ROWS_TOGETHER * HEAVY // target.work), 1)


def density_of(target: LogPosterior) -> Callable[[np.ndarray], np.ndarray]:
    """Return the log-posterior of ``target``, scatters not integrated out: u (w, d) -> (w,), -inf where not finite."""
    terms = terms_of(target)
    return lambda u: np.sum(terms(u), axis=1)


def terms_of(target: LogPosterior) -> Callable[[np.ndarray], np.ndarray]:
    """Return the terms of ``density_of``, u (w, d) -> (w, 1 + scatters): without the integrated scatters, and of each.

    It is the sampler's program with every scatter at its first node, so that the fit compiles no program of its own.
    """
    layout = _layout(target)
    located, scatter = np.array(layout.located), np.array(layout.scatter, dtype=int)
    straight = np.full(len(scatter), -np.inf)

    def one(u: np.ndarray) -> np.ndarray:
        start = u[:, scatter]
        known, of_nodes, _ = conditional(layout, target, u[:, located], start, np.ones(start.shape), straight)
        found = np.concatenate([np.sum(known, axis=1, keepdims=True), np.asarray(of_nodes)[:, :, 0]], axis=1)
        return np.where(np.isfinite(found), found, -np.inf)

    return lambda u: in_batches(one, u, rows_of(target))


def _layout(target: LogPosterior) -> Layout:
    """Layout with a number of nodes that suffices for most rigs."""
    # A block of scatters alone has no located parameter, so it follows the other blocks.
    blocks = sorted(target.blocks, key=lambda block: bool(np.all(target.integrated[block])))
    label = np.zeros(target.dimension, dtype=int)
    for i, block in enumerate(blocks):
        label[block] = i
    scatter, located = np.flatnonzero(target.integrated), np.flatnonzero(~target.integrated)
    return Layout(tuple(scatter.tolist()), tuple(located.tolist()), tuple(label.tolist()), NODES[0])


@partial(jax.jit, static_argnums=0, compiler_options=COMPILE)
def conditional(layout: Layout, target: LogPosterior, v: Any, start: Any, step: Any, bend: Any) -> tuple[Any, ...]:
    """Log-posterior of the located v (w, dimension) with scatters at their nodes; one model run per walker.

    Parameters
    ----------
    start, step : (w, scatters) first node and distance of the nodes, in t
    bend : (scatters,)

    Returns
    -------
    Logarithms of: terms without scatters (w, blocks); densities of t at the nodes (w, scatters, nodes);
    their integrals (w, scatters).
    """
    of_row = partial(_conditional, layout, target, bend)
    if target.work < HEAVY:
        return jax.vmap(of_row)(v, start, step)
    # JAX joins no batches of outputs without elements, which a target without scatters has.
    together = rows_together(target) if layout.scatter else None
    return jax.lax.map(lambda row: of_row(*row), (v, start, step), batch_size=together)


def _conditional(
    layout: Layout, target: LogPosterior, bend: Any, v: Any, start: Any, step: Any
) -> tuple[Any, Any, Any]:
    scatter, located = np.array(layout.scatter, dtype=int), np.array(layout.located)
    # Forward models do not read scatters, so their zeros have no effect.
    u = jnp.zeros(len(layout.block)).at[located].set(v)
    values = target.constrain(u)
    t = start[:, None] + step[:, None] * jnp.arange(layout.nodes)[None]
    nodes = position(t, bend[:, None])
    sizes = jnp.exp(nodes)
    terms = target.priors.at(scatter[:, None]).terms(nodes, sizes) + log_stretch(t, bend[:, None])
    known = [target.priors.terms(u, values)[located]]
    known_block = [layout.block[i] for i in layout.located]
    rows, row_scatter = [], []
    for group in target.groups:
        symbols, entries = group.experiments.scatters, dict(group.entries)
        places = [None if s is None else [layout.scatter.index(i) for i in entries[s]] for s in symbols]
        own = tuple(jnp.zeros(len(group.members)) if p is None else sizes[jnp.array(p)] for p in places)

        def one(experiment: Experiment, theta: ValuesBySymbol, own: Any) -> Any:
            summaries = experiment.summaries({**theta, **target.constants})
            return tuple(part.log_density(s) for part, s in zip(summaries, own, strict=True))

        densities = jax.vmap(one)(group.experiments, group.local(values, without=symbols), own)
        for place, value in zip(places, densities, strict=True):
            if place is None:
                known.append(value)
                known_block += [layout.block[entry[0]] for entry in zip(*entries.values(), strict=True)]
            else:
                rows.append(value)
                row_scatter += place
    parts = _sum_by(jnp.concatenate(known), known_block, layout.blocks)
    if rows:
        terms = terms + _sum_by(jnp.concatenate(rows), row_scatter, len(scatter))
    return parts, terms, jnp.log(step) + jax.nn.logsumexp(terms, axis=-1)


def left_out(target: LogPosterior, theta: Float[np.ndarray, "w d"]) -> list[np.ndarray]:
    """Terms (w, blocks) of the leave-one-out density of every experiment at constrained values (w, d)."""

    def of_rows(rows: np.ndarray) -> np.ndarray:
        stop_if_interrupted()
        return np.asarray(_left_out(target, rows))

    quick = [e for e in target.experiments if not e.event_driven]
    ends = np.cumsum([len(e.blocks(e.n)) for e in quick])
    rows = iter(np.split(in_batches(of_rows, theta, rows_of(target)), ends[:-1], axis=1) if quick else ())
    values = [target.mapping(row) for row in theta] if len(quick) < len(target.experiments) else []

    def of_motions(e: Experiment) -> np.ndarray:
        stop_if_interrupted()
        # A motion takes milliseconds, and minutes to compile once more. Its lanes may wait for the threads of ``pool``.
        with ThreadPoolExecutor() as threads:
            return np.stack(list(threads.map(lambda own: e.left_out(e.local(own)), values)))

    return [of_motions(e) if e.event_driven else next(rows) for e in target.experiments]


@partial(jax.jit, compiler_options=COMPILE)
def _left_out(target: LogPosterior, theta: Any) -> Any:
    """(w, terms) of the experiments without motions, in their order."""

    def of_row(values: Any) -> Any:
        found = {}
        for group in target.groups:
            if not group.experiments.event_driven:
                own = group.local(values) | {n: jnp.full(len(group.members), x) for n, x in target.constants.items()}
                terms = jax.vmap(lambda e, own: e.left_out(own, jnp))(group.experiments, own)
                found |= zip(group.members, terms, strict=True)
        return jnp.concatenate([found[i] for i in sorted(found)])

    return jax.lax.map(of_row, theta, batch_size=rows_together(target))


def _sum_by(values: Any, label: Sequence[int], number: int) -> Any:
    """Sum the rows of ``values`` (m, ...) with equal label by gathering: (number, ...)."""
    members = [[i for i, own in enumerate(label) if own == j] for j in range(number)]
    width = max(map(len, members))
    index = np.array([row + [len(label)] * (width - len(row)) for row in members])
    padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
    return jnp.sum(padded[index], axis=1)
