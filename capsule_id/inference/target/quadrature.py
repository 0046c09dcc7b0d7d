"""Where the integrals over scatters have their nodes.

The nodes are fixed before the sampler starts, so that the integrated posterior is one smooth function. Every window
reaches as far as any conditional density, at walkers from the point fit out to where the posterior has no mass left,
stands above e^-``DEPTH`` of its maximum; the nodes are as many as it takes for two interlaced grids to agree.

A scatter that the readings hardly tell from zero has a left tail as long as its prior's. The nodes are therefore
equidistant in t with u = log(scatter) = t - exp(bend - t): right of ``bend`` that is u itself, left of it the tail is
drawn together, exponential to double exponential (Takahasi & Mori 1974).
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

#: Densities below e^-DEPTH of their maximum are left out; those below e^-CORE of it are a tail.
DEPTH, CORE = 21.0, 3.0
#: Interlaced grids agree when no log-integral differs by more than the first, and the second of its size: rounding.
TOLERANCE, ROUNDING = 3e-9, 1e-13
#: Where the log-posterior of a block is this far below that of the point fit, integrals need not hold.
NO_MASS = 20.0
#: Numbers of nodes to try: few, so that rigs of one structure share compiled code. The last is taken as it is.
NODES = (64, 128, 256, 512, 1024)
#: The first window about the point fit, in u, and how often it is narrowed at most.
REACH, ROUNDS = 40.0, 12
#: A window is found when a round makes no walker's narrower than this part of it.
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
        """All nodes moved by that part of the step."""
        return replace(self, start=self.start + by * self.step)


def position(t: Any, bend: Any, xp: ModuleType = jnp) -> Any:
    """u at t."""
    return t - xp.exp(bend - t)


def log_stretch(t: Any, bend: Any, xp: ModuleType = jnp) -> Any:
    """log du/dt at t."""
    return xp.log1p(xp.exp(bend - t))


#: (located u (w, ...), grid) -> what is known without scatters (w, blocks), log-densities of t at the nodes (w,
#: scatters, nodes), and the logarithms of their integrals (w, scatters).
Terms = Callable[[np.ndarray, Grid], tuple[np.ndarray, np.ndarray, np.ndarray]]


def add_to_blocks(
    known: Float[np.ndarray, "w blocks"], block: Int[np.ndarray, " scatters"], integrals: PerScatter
) -> Float[np.ndarray, "w blocks"]:
    """(w, blocks) log-posterior: what is ``known`` without scatters and the integrals (w, scatters), ``block`` each."""
    total = known.T.copy()
    np.add.at(total, block, integrals.T)
    return total.T


def choose_grid(
    terms: Terms,
    centre: Float[np.ndarray, " scatters"],
    block: Int[np.ndarray, " scatters"],
    probes: Float[np.ndarray, "w ..."],
) -> Grid:
    """Windows and number of nodes for scatters that are ``centre`` (scatters,) at the point fit.

    Parameters
    ----------
    block : (scatters,) in which column of what is known without scatters each belongs
    probes : (w, ...) walkers, the point fit first; where the posterior has mass at them, the integrals will hold
    """
    low, core, high, mass = _windows(terms, centre, block, probes)
    bend = np.min(np.where(mass, core, np.inf), axis=0)
    low, high = np.min(np.where(mass, low, np.inf), axis=0), np.max(np.where(mass, high, -np.inf), axis=0)
    # Wright's omega solves t - exp(bend - t) = u: t = u + omega(bend - u).
    start, end = low + wrightomega(bend - low), high + wrightomega(bend - high)
    grids = [Grid(start, (end - start) / (nodes - 1), bend, nodes) for nodes in NODES]
    return next((grid for grid in grids[:-1] if _agree(terms, grid, probes, mass)), grids[-1])


def _windows(
    terms: Terms,
    centre: Float[np.ndarray, " scatters"],
    block: Int[np.ndarray, " scatters"],
    probes: Float[np.ndarray, "w ..."],
) -> tuple[PerScatter, PerScatter, PerScatter, Bool[np.ndarray, "w scatters"]]:
    """Lowest u with density, lowest outside the tail, highest u, and whether the walker has mass in its block.

    (w, scatters) each. The windows are narrowed walker by walker, from ``REACH`` on.
    """
    low = np.broadcast_to(centre - REACH, (len(probes), len(centre)))
    width, straight = np.full(low.shape, 2.0 * REACH), np.full(len(centre), -np.inf)
    for _ in range(ROUNDS):
        grid = Grid(low, width / (NODES[0] - 1), straight, NODES[0])
        known, density, integral = terms(probes, grid)
        # A walker without density anywhere keeps its window; it has no mass either.
        density = np.where(np.any(np.isfinite(density), axis=-1, keepdims=True), density, 0.0)
        density = np.where(np.isnan(density), -np.inf, density)
        density = density - np.max(density, axis=-1, keepdims=True)
        core = low + np.argmax(density > -CORE, axis=-1) * grid.step
        # The maximum may stand between two nodes: one more on either side.
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


def _agree(terms: Terms, grid: Grid, probes: Float[np.ndarray, "w ..."], mass: Bool[np.ndarray, "w scatters"]) -> bool:
    """No integral where the posterior has mass changes when the nodes are shifted by half their distance."""
    integral, shifted = terms(probes, grid)[2][mass], terms(probes, grid.shifted(0.5))[2][mass]
    return bool(np.all(np.abs(integral - shifted) < TOLERANCE + ROUNDING * np.abs(integral)))
