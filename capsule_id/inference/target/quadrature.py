"""Quadrature nodes of the integrals over scatters.

The nodes are fixed before the sampler starts, so that the integrated posterior is one smooth function. Each window
covers all values where a conditional density exceeds e^-``DEPTH`` of its maximum. The walkers of this test extend from
the point fit to points of negligible posterior mass. The number of nodes grows until two interlaced grids agree.

A scatter that the readings hardly distinguish from zero has a left tail as long as its prior's. The nodes are
therefore equidistant in t with u = log(scatter) = t - exp(bend - t). Right of ``bend``, t equals u. Left of it the
exponential tail becomes double exponential (Takahasi & Mori 1974).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import wrightomega

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
