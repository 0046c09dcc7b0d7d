"""Forward and reverse mode through a march, on the grid of steps that the march itself has chosen.

``jax.custom_jvp`` states the tangent of a run; the tangent map T is linear and is handed to JAX together with its
transpose, so that ``jax.jvp``, ``jacfwd``, ``grad`` and ``vjp`` all work and cost a loop over the steps really taken.
(A plain while loop has no reverse mode; a bounded scan would pay for ``max_steps`` steps in every batched run.)

The derivative is that of the discrete solution: the grid is held fixed, each step and the interpolation are
differentiated exactly. So both modes agree to rounding, and both agree with the derivative of the smoothed model to
the accuracy of the solution. The state is stored once a segment; the sweeps march through a segment again to recover
its grid. First derivatives only.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from capsule_id.physics.smooth.march import (
    Build,
    MarchState,
    Record,
    checkpoints,
    initial_lanes,
    inside,
    replay,
    run,
    running,
    segment,
)
from capsule_id.physics.smooth.rosenbrock import StateArray, derivative

# The sweeps hold that many states at a time, and at most that many idle steps at the end.
STEPS_PER_CHECKPOINT = 256
Tangent = tuple[Any, StateArray]  # of (system, initial state)


@jax.custom_jvp
def _first_order_only(tree: Any) -> Any:
    return tree


@_first_order_only.defjvp
def _refuse(_primals: tuple[Any], _tangents: tuple[Any]) -> Any:
    raise NotImplementedError("the smoothed model has first derivatives only: take differences of jax.grad instead")


def _tangent_maps(
    build: Build,
    inputs: tuple[Any, jax.Array, StateArray],
    max_steps: int,
) -> tuple[Callable[[Tangent], jax.Array], Callable[[jax.Array], Tangent]]:
    """The linear map from tangents of (system, initial state) to those of the samples (4, L, n), and its transpose."""
    system, times, y = inputs
    end = times[:, -1]

    def piece(
        begin: MarchState,
    ) -> tuple[Callable[[Any, StateArray], tuple[StateArray, jax.Array]], MarchState, jax.Array]:
        """The segment from ``begin`` as a function of (system, state there), its end, and which samples it holds."""
        rows, lanes = segment(build, system, end, begin, max_steps, STEPS_PER_CHECKPOINT)
        return lambda a, b: replay(build(a), b, rows[:, 0], times), lanes, inside(rows, lanes, times)

    def forward(tangent: Tangent) -> jax.Array:
        def body(carry: tuple[MarchState, StateArray, jax.Array]) -> tuple[MarchState, StateArray, jax.Array]:
            lanes, d_y, out = carry
            function, after, held = piece(lanes)
            d_y, d_samples = jax.jvp(function, (system, lanes.y), (tangent[0], d_y))[1]
            return after, d_y, jnp.where(held[None], d_samples, out)

        first = jnp.zeros((4, *times.shape)).at[:, :, 0].set(tangent[1])
        carry = (initial_lanes(build(system), times, y), tangent[1], first)
        return jax.lax.while_loop(lambda c: running(end, c[0]), body, carry)[2]

    def backward(cotangent: jax.Array) -> Tangent:
        count, store = checkpoints(build, system, times, y, max_steps, STEPS_PER_CHECKPOINT)

        def body(carry: tuple[jax.Array, Any, StateArray]) -> tuple[jax.Array, Any, StateArray]:
            k, c_system, c_y = carry
            begin = jax.tree.map(lambda rows: rows[k - 1], store)
            function, _, held = piece(begin)
            more, c_y = jax.vjp(function, system, begin.y)[1]((c_y, jnp.where(held[None], cotangent, 0.0)))
            return k - 1, jax.tree.map(jnp.add, c_system, more), c_y

        none = jax.tree.map(jnp.zeros_like, (system, y))
        _, c_system, c_y = jax.lax.while_loop(lambda c: c[0] > 0, body, (count, *none))
        # A lane that has failed has NaN cotangents at samples that no segment holds.
        poison = jnp.where(jnp.any(jnp.isnan(cotangent), axis=(0, 2)), jnp.nan, 0.0)
        lanes_first = jax.tree.map(lambda leaf: leaf + poison.reshape(-1, *[1] * (leaf.ndim - 1)), c_system)
        return lanes_first, c_y + cotangent[:, :, 0] + poison[None]

    return forward, backward


def _apply_linear(
    forward: Callable[[Tangent], jax.Array], backward: Callable[[jax.Array], Tangent], tangent: Tangent, like: jax.Array
) -> jax.Array:
    """``forward(tangent)``, transposed by ``backward``.

    JAX's carrier of a linear map with a transpose of one's own that also batches is ``custom_linear_solve``: the
    solution of [[1, 0], [-T, 1]] (u, v) = (tangent, 0) is (tangent, T tangent). Its ``matvec`` is used only for
    derivatives of the matrix, so for second derivatives, which ``_first_order_only`` refuses; the identity stands in.
    """

    def solve(_: Callable[[Any], Any], b: tuple[Tangent, jax.Array]) -> tuple[Tangent, jax.Array]:
        return b[0], b[1] + forward(b[0])

    def transposed(_: Callable[[Any], Any], b: tuple[Tangent, jax.Array]) -> tuple[Tangent, jax.Array]:
        return jax.tree.map(jnp.add, b[0], backward(b[1])), b[1]

    leaves, structure = jax.tree.flatten((tangent, jnp.zeros_like(like)))
    # The transpose rule wants every part of the right-hand side to depend on the tangents, also those that are zero.
    # A select that never selects makes them so without spreading a NaN from one lane to the others.
    link = jnp.where(False, sum(jnp.sum(leaf) for leaf in leaves), 0.0)
    right_hand_side = jax.tree.unflatten(structure, [leaf + link for leaf in leaves])
    return jax.lax.custom_linear_solve(lambda u: u, right_hand_side, solve, transposed)[1]


def differentiable_run(build: Build, max_steps: int) -> Callable[[Any, jax.Array, StateArray], Record]:
    """``march.run`` with first derivatives in system, times and the initial state, forward and reverse mode.

    A lane that fails has NaN derivatives wherever its samples are NaN.
    """

    @jax.custom_jvp
    def function(system: Any, times: jax.Array, y: StateArray) -> Record:
        return run(build, system, times, y, max_steps)

    @function.defjvp
    def _(
        primals: tuple[Any, jax.Array, StateArray], tangents: tuple[Any, jax.Array, StateArray]
    ) -> tuple[Record, Record]:
        record = function(*primals)
        system, times, y = _first_order_only(primals)
        d_system, d_times, d_y = tangents
        samples = _first_order_only(record.samples)
        field = build(jax.tree.map(lambda leaf: leaf[:, None], system)).field()
        rate = derivative(field, times, samples)
        # A later start from the same state is the same start from a state moved back along the field.
        d_y = d_y - rate[:, :, 0] * d_times[None, :, 0]
        forward, backward = _tangent_maps(build, (system, times, y), max_steps)
        d_samples = _apply_linear(forward, backward, (d_system, d_y), samples) + rate * d_times[None]
        d_samples = d_samples * jnp.where(jnp.isfinite(samples), 1.0, jnp.nan)
        counts = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, jax.dtypes.float0), record[1:])
        return record, Record(d_samples, *counts)

    return function
