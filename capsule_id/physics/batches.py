"""One lane axis for everything: broadcasting, chunks of lanes, threads.

An engine works on lanes: every leaf (L,), times (L, n). The user's arguments are broadcast to that form. A concrete
batch is then split into chunks of CHUNK lanes which run from as many threads as there are cores. Every chunk is
padded to full width, so that a lane is always computed by the same program, and its result is the same to the last bit
whichever batch it stands in. Traced values are never split.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from types import ModuleType
from typing import Any, ClassVar, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Float
from numpy.typing import ArrayLike

from capsule_id.errors import InputError

Tree = TypeVar("Tree")
Result = TypeVar("Result")
# A number, or one for each lane: shape () or (batch,).
NumberOrBatch = float | np.ndarray | jax.Array
Times = jax.Array | np.ndarray

# Lanes per call of an engine: enough to fill the vector units, few enough for the second-level cache.
CHUNK = 64


class Record:
    """Base of a pytree whose leaves ``samples`` are (n,) or (batch, n); all its other leaves are () or (batch,)."""

    samples: ClassVar[tuple[str, ...]]


def _sample_axes(tree: object) -> list[int]:
    """For each leaf 1 if it has an axis of samples, else 0."""

    def axes(node: Any) -> Any:
        if not isinstance(node, Record):
            return 0
        given = {
            name: jax.tree.map(lambda _, name=name: int(name in node.samples), x) for name, x in vars(node).items()
        }
        return type(node)(**given)

    return jax.tree.leaves(jax.tree.map(axes, tree, is_leaf=lambda node: isinstance(node, Record)))


def array_module(*values: object) -> ModuleType:
    """``jax.numpy`` if one of ``values`` is a JAX array, else ``numpy``: formulas that serve both use it."""
    return jnp if any(isinstance(value, jax.Array) for value in values) else np


def is_traced(tree: object) -> bool:
    """Whether a leaf is a JAX tracer, so that its value cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def lanes_of(tree: Tree, times: ArrayLike) -> tuple[Tree, Times, bool]:
    """(tree, times, whether a batch axis was given): leaves () or (batch,) become (L,), times (n,) become (L, n).

    Samples of a ``Record`` become (L, n) as well.

    Raises
    ------
    InputError
        A leaf or ``times`` of another shape, batch axes of different lengths, concrete times that do not increase or
        are not finite, values traced in single precision.
    """
    xp = jnp if is_traced((tree, times)) else np
    leaves, structure = jax.tree.flatten(tree)
    if any(isinstance(leaf, jax.core.Tracer) and leaf.dtype == jnp.float32 for leaf in (*leaves, times)):
        raise InputError(
            "traced values must be float64",
            "float32",
            "import capsule_id.physics.model, or set jax_enable_x64, before the first jax.jit",
        )
    leaves = [xp.asarray(leaf, float) for leaf in leaves]
    grid = xp.asarray(times, float)
    if grid.ndim not in (1, 2) or grid.shape[-1] == 0:
        raise InputError("times must have shape (n,) or (batch, n)", str(grid.shape), "give at least one time")
    if xp is np and not bool(np.isfinite(grid).all()):
        raise InputError("times must be finite", "an infinite or undefined time", "leave it out")
    if xp is np and not bool(np.all(np.diff(grid, axis=-1) > 0.0)):
        raise InputError("times must increase", "found a step that is not positive", "sort them, drop repeated ones")
    own = _sample_axes(tree)
    ranks = [leaf.ndim - axes for leaf, axes in zip(leaves, own, strict=True)]
    if any(rank not in (0, 1) for rank in ranks):
        shape = next(leaf.shape for leaf, rank in zip(leaves, ranks, strict=True) if rank not in (0, 1))
        raise InputError("a leaf must have shape () or (batch,)", str(shape), "use one batch axis, or jax.vmap")
    sizes = {
        *(leaf.shape[0] for leaf, rank in zip(leaves, ranks, strict=True) if rank == 1),
        *(grid.shape[:1] if grid.ndim == 2 else ()),
    }
    if len(sizes) > 1:
        raise InputError("all batch axes must have one length", f"lengths {sorted(sizes)}", "make them agree")
    lanes = sizes.pop() if sizes else 1
    batched = grid.ndim == 2 or any(rank == 1 for rank in ranks)
    if lanes == 0:
        raise InputError("a batch must hold at least one lane", "length 0", "leave the call out")
    spread = [
        # A new axis is enough where there is one lane, and takes a tenth of the time.
        leaf[None] if lanes == 1 and rank == 0 else xp.broadcast_to(leaf, (lanes, *leaf.shape[rank:]))
        for leaf, rank in zip(leaves, ranks, strict=True)
    ]
    return jax.tree.unflatten(structure, spread), xp.broadcast_to(grid, (lanes, grid.shape[-1])), batched


@jax.jit
def _first_lane(tree: Tree) -> Tree:
    """``tree`` without the axis of lanes. One program: each slice outside of programs takes a tenth of the time of a run."""
    return jax.tree.map(lambda leaf: leaf[0], tree)


def run_lanes(
    kernel: Callable[..., Result], tree: tuple[Any, ...], times: Times, batched: bool, width: int = CHUNK
) -> Result:
    """Run ``kernel(*tree, times)`` on lanes from ``lanes_of``; drop the lane axis where ``batched`` is false.

    width : lanes of one call; another width is another program, whose results may differ in the last bit
    """
    if not batched:
        return _first_lane(kernel(*tree, times))
    size = times.shape[0]
    if is_traced((tree, times)):
        return kernel(*tree, times)
    chunks = [np.minimum(np.arange(start, start + width), size - 1) for start in range(0, size, width)]

    def run(index: np.ndarray) -> Result:
        return jax.block_until_ready(kernel(*jax.tree.map(lambda leaf: leaf[index], (*tree, times))))

    results = [run(chunks[0])] if len(chunks) == 1 else list(pool().map(run, chunks))
    return jax.tree.map(lambda *parts: jnp.asarray(np.concatenate([np.asarray(x) for x in parts])[:size]), *results)


def folded(run: Callable[..., Result]) -> Callable[..., Result]:
    """``run``, all of whose leaves have lanes (L, ...), in such a way that the axis of a ``jax.vmap`` joins the lanes.

    A loop inside a loop over lanes would copy its buffers at every step.
    """

    def call(*args: Any) -> Result:
        # A tree that holds None cannot be batched and differentiated at once.
        leaves, structure = jax.tree.flatten(args)

        @custom_vmap
        def on_leaves(*leaves: jax.Array) -> Any:
            return run(*jax.tree.unflatten(structure, leaves))

        @on_leaves.def_vmap
        def _(size: int, batched: list[bool], *leaves: jax.Array) -> tuple[Any, Any]:
            if not any(batched):
                out = run(*jax.tree.unflatten(structure, leaves))
                return out, jax.tree.map(lambda _: False, out)
            full = [
                x if flag else jnp.broadcast_to(x, (size, *x.shape)) for x, flag in zip(leaves, batched, strict=True)
            ]
            out = on_leaves(*(x.reshape(-1, *x.shape[2:]) for x in full))
            out = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), out)
            return out, jax.tree.map(lambda _: True, out)

        return on_leaves(*leaves)

    return call


def in_batches(
    function: Callable[[np.ndarray], np.ndarray], points: Float[np.ndarray, "m d"], rows: int
) -> Float[np.ndarray, "m ..."]:
    """Evaluate ``function`` at points (m, d) in batches of exactly ``rows`` rows, on all cores; (m, ...).

    A fixed number of rows needs one compilation only.
    """
    return np.asarray(run_lanes(function, (), points, batched=True, width=rows))


@lru_cache(maxsize=1)
def pool() -> ThreadPoolExecutor:
    """Threads, as many as cores, that compiled functions are called from."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="capsule-lanes")
