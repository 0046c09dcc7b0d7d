"""Displacement of the capsule after many periods of a drive, as a progression test measures it.

A lane runs in blocks of periods. Once the motion repeats from period to period, the remaining periods add the same
displacement each. After every block the lanes that go on are sorted by their steps per period and form new chunks, so
that few lanes wait for slower ones.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from capsule_id.physics.batches import CHUNK, folded, is_traced, run_lanes
from capsule_id.physics.forces import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Drive, Status, without_absent
from capsule_id.physics.simulation import simulate

#: Periods of a block: short, because the motion is compared with its repetition only at the end of a block.
BLOCK = 3
#: Lanes of one call: so many that few wait for slower ones.
TOGETHER = 1024
#: The motion repeats where the state changes by less than this part of itself over one period, dimensionless.
REPEATS = 1e-5
#: Bound on the steps of a block, 300 per period. Plausible motions need 15 to 45 per period; a motion that needs far
#: more keeps its whole chunk waiting.
BLOCK_STEPS = 300 * BLOCK


class Displacement(NamedTuple):
    """Displacement X2 after the periods, m, NaN where the run failed, and a ``Status`` code; (L,) each."""

    X2: Any
    status: Any


class _Lane(NamedTuple):
    """A run in progress; (L,) each.

    Attributes
    ----------
    done, state : periods done, and (X1, Y1, X2, Y2) then
    active, status : whether the lane goes on; ``Status`` code
    effort : steps per period in the last block; before the first block the period, s, which orders lanes alike
    """

    done: Any
    state: tuple[Any, ...]
    active: Any
    status: Any
    effort: Any


def displacement(
    p: CapsuleParameters, e: Drive, law: FrictionLaw, period: Any, count: Any, r0: Any = 0.0
) -> Displacement:
    """X2 after ``count`` periods of ``e`` from rest at x_rel = ``r0``, by the exact engine.

    Parameters
    ----------
    p, e, law : leaves () or (L,)
    period, count : (L,) period of the drive, s, and number of periods
    r0 : () or (L,), m

    A lane with a block of more than ``BLOCK_STEPS`` steps is given up with ``Status.TOO_MANY_STEPS``. Its displacement
    is NaN, so that a log-posterior which needs it is -inf.

    Works under ``jit`` and ``vmap``, and is differentiable in forward mode.
    """
    given = (*without_absent(p, e), law, r0, period, count)
    lanes, xp = np.shape(period)[0], jnp if is_traced(given) else np
    given = jax.tree.map(lambda leaf: xp.broadcast_to(xp.asarray(leaf, float), (lanes,)), given)
    if xp is jnp:
        return _run(*given)
    # Lanes without periods fill the last part, so that one program serves any number of lanes.
    *others, count = jax.tree.map(lambda leaf: np.pad(leaf, (0, -lanes % TOGETHER), "edge"), given)
    count[lanes:] = 0.0
    found = run_lanes(lambda *own: _run(*own[:-1], own[-1][:, 0]), tuple(others), count[:, None], True, TOGETHER)
    return jax.tree.map(lambda leaf: leaf[:lanes], found)


def _in_chunks(*given: Any) -> Displacement:
    """Run lanes (L,), ``CHUNK`` at a time, until none goes on; arguments as those of ``displacement``."""
    lanes = given[-1].shape[0]
    *system, r0, period, count = jax.tree.map(lambda x: jnp.pad(x, (0, -lanes % CHUNK), "edge"), given)
    zero = jnp.zeros_like(period)
    active = (count > 0.0) & (jnp.arange(len(zero)) < lanes)
    state = _Lane(zero, (r0 + zero, zero, zero, zero), active, jnp.zeros(zero.shape, jnp.int32), stop_gradient(period))

    def advance(state: _Lane) -> _Lane:
        """One block of every active lane; the lanes of a chunk need about as many steps each."""
        order = jnp.argsort(jnp.where(state.active, state.effort, jnp.inf))  # pyright: ignore[reportArgumentType]

        def chunk(i: Any, state: _Lane) -> _Lane:
            index = jax.lax.dynamic_slice_in_dim(order, i * CHUNK, CHUNK)
            part, own = jax.tree.map(lambda x: x[index], (state, (*system, period, count)))
            return jax.tree.map(lambda x, new: x.at[index].set(new), state, _block(part, *own))

        return jax.lax.fori_loop(0, -(-jnp.sum(state.active) // CHUNK), chunk, state)

    last = jax.lax.while_loop(lambda state: jnp.any(state.active), advance, state)
    X2 = jnp.where(last.status <= Status.GRAZING, last.state[2], jnp.nan)
    return Displacement(X2[:lanes], last.status[:lanes])


def _block(lane: _Lane, p: CapsuleParameters, e: Drive, law: FrictionLaw, period: Any, count: Any) -> _Lane:
    """Run a chunk of lanes for a block of periods; lanes that are not active stay as they are."""
    omega = 2.0 * np.pi / period
    ahead = jnp.where(lane.active, jnp.minimum(float(BLOCK), count - lane.done), 0.0)
    begin, end = lane.done * period, (lane.done + ahead) * period
    times = jnp.stack([begin, end - jnp.where(ahead > 1.0, period, 0.0), end], 1)
    t = simulate(p, e, times, lane.state, friction=law, max_steps=BLOCK_STEPS)
    ends = [(x[:, 1], x[:, 2]) for x in (t.X1, t.Y1, t.X2, t.Y2)]
    before, after = (jnp.stack([X1 - X2, (Y1 - Y2) / omega, Y2 / omega]) for X1, Y1, X2, Y2 in zip(*ends, strict=True))
    change, size = (jnp.sum(stop_gradient(x) ** 2, axis=0) for x in (after - before, after))
    repeats = (ahead > 1.0) & (change <= REPEATS**2 * size)
    done = lane.done + ahead
    left = jnp.where(repeats, count - done, 0.0) * (ends[2][1] - ends[2][0])
    new = (ends[0][1] + left, ends[1][1], ends[2][1] + left, ends[3][1])  # pyright: ignore[reportOperatorIssue]
    state = tuple(jnp.where(lane.active, x, y) for x, y in zip(new, lane.state, strict=True))
    status = jnp.where(lane.active, jnp.maximum(lane.status, t.status), lane.status)
    active = lane.active & (status <= Status.GRAZING) & ~repeats & (done < count)  # pyright: ignore[reportOperatorIssue]
    return _Lane(done, state, active, status, t.steps / jnp.maximum(ahead, 1.0))


_run = jax.jit(folded(_in_chunks))
