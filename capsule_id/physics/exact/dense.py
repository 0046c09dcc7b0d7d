"""Dense output: the steps' polynomials are kept in rows, and samples are read off them window by window.

rows (K, WIDTH, L): per step t0, h, r, X2 at its start and the series of w and v; starts (K, L): t0 again, inf where a
lane took no step. Each lane has its own pointer to its next sample, since lanes advance at their own pace.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from capsule_id.physics.exact.taylor import CapsuleState, StepSeries
from capsule_id.physics.friction import DEGREE, horner, mean
from capsule_id.physics.model import Initial

# Numbers in a row: t0, h, r, X2, and two series.
WIDTH = 4 + 2 * (DEGREE + 1)
# Samples of a lane read off at once.
WINDOW = 64


class Samples(NamedTuple):
    """times (L, n + WINDOW), padded with inf; values (L, 4, n + WINDOW) of X1, Y1, X2, Y2; next sample (L,) int32."""

    times: Float[jax.Array, "L padded"]
    values: Float[jax.Array, "L 4 padded"]
    next: Int[jax.Array, " L"]


def samples_at(times: Float[jax.Array, "L n"], initial: Initial, valid: Bool[jax.Array, " L"]) -> Samples:
    """No sample taken yet but the first, which is the initial state."""
    L, n = times.shape
    padded = jnp.concatenate([times, jnp.full((L, WINDOW), jnp.inf)], axis=1)
    values = jnp.full((L, 4, n + WINDOW), jnp.nan)
    first = jnp.where(valid[:, None], jnp.stack([jnp.asarray(x) for x in initial], axis=1), jnp.nan)
    return Samples(padded, values.at[:, :, 0].set(first), jnp.ones(L, jnp.int32))


def row_of(state: CapsuleState, step: StepSeries) -> Float[jax.Array, "width L"]:
    """(WIDTH, L): the step's polynomial."""
    return jnp.stack([state.t, step.h, state.r, state.X2, *step.w, *step.v])


def values_of(row: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """(X1, Y1, X2, Y2) at t from rows (WIDTH, ...)."""
    w, v = list(row[4 : 5 + DEGREE]), list(row[5 + DEGREE :])
    s = (t - row[0]) / row[1]
    r, X2 = row[2] + (t - row[0]) * mean(w, s), row[3] + (t - row[0]) * mean(v, s)
    Y2 = horner(v, s)
    return X2 + r, horner(w, s) + Y2, X2, Y2


def _row_at(starts: Float[jax.Array, "K L"], t: Float[jax.Array, "L window"]) -> Int[jax.Array, "L window"]:
    """(L, WINDOW) int32: the last row that starts at or before t (L, WINDOW), by bisection in starts (K, L)."""
    lane = jnp.arange(t.shape[0])[:, None]
    length = starts.shape[0]

    def halve(i: jax.Array, index: jax.Array) -> jax.Array:
        probe = index + (1 << (length - 1).bit_length()) // (2 << i)
        return jnp.where((probe < length) & (starts[jnp.minimum(probe, length - 1), lane] <= t), probe, index)

    return jax.lax.fori_loop(0, (length - 1).bit_length(), halve, jnp.zeros(t.shape, jnp.int32))


def read_off(
    samples: Samples,
    rows: Float[jax.Array, "K width L"],
    starts: Float[jax.Array, "K L"],
    reached: Float[jax.Array, " L"],
) -> Samples:
    """Take every sample up to ``reached`` (L,) off the rows."""
    starts, reached = jax.lax.stop_gradient((starts, reached))
    L, length = samples.times.shape
    # A row's coefficients side by side: read one lane at a time they would each cost a line of the cache.
    table = jnp.reshape(jnp.swapaxes(rows, 1, 2), (-1, WIDTH))
    slice_times = jax.vmap(lambda row, at: jax.lax.dynamic_slice(row, (at,), (WINDOW,)))
    write = jax.vmap(lambda out, x, at: jax.lax.dynamic_update_slice(out, x, (jnp.int32(0), at)))

    def pending(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        _, at = carry
        upcoming = jnp.take_along_axis(samples.times, jnp.minimum(at, length - 1)[:, None], axis=1)[:, 0]
        return jnp.any(upcoming <= reached)

    def window(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        values, at = carry
        t = slice_times(samples.times, at)
        covered = t <= reached[:, None]
        row = table[_row_at(starts, jax.lax.stop_gradient(t)) * L + jnp.arange(L, dtype=jnp.int32)[:, None]]
        taken = jnp.stack(values_of(jnp.moveaxis(row, -1, 0), jnp.where(covered, t, 0.0)), axis=1)
        taken = jnp.where(covered[:, None, :], taken, jnp.nan)
        return write(values, taken, at), at + jnp.sum(covered, axis=1, dtype=jnp.int32)

    values, at = jax.lax.while_loop(pending, window, (samples.values, samples.next))
    return Samples(samples.times, values, at)
