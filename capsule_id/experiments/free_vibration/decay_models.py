"""Models of free decays with viscous, viscous and dry (closed forms), or viscous and quadratic damping (numerical).

m1 x'' + c x' + [F_dry sign(x')] + [c_q x'|x'|] + k1 x = 0, capsule at rest, x = x_rel about its equilibrium.
gamma = c/(2 m1), omega = sqrt(k1/m1 - gamma^2). Only underdamped decays are modelled.
"""

from functools import partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

#: Largest phase of one Runge–Kutta step of the quadratically damped decay, rad. The error per period is then below 1e-6
#: of the amplitude.
STEP_PHASE = 0.1


def rates(k1: Any, c: Any, m1: Any, xp: ModuleType = jnp) -> tuple[Any, Any]:
    """Decay rate gamma, 1/s, and frequency omega, rad/s (NaN where overdamped)."""
    gamma = c / (2.0 * m1)
    return gamma, xp.sqrt(k1 / m1 - gamma**2)


def viscous_basis(time: Any, k1: Any, c: Any, m1: Any, xp: ModuleType = jnp) -> Any:
    """(n, 2) the two solutions exp(-gamma t) cos(omega t), exp(-gamma t) sin(omega t)."""
    gamma, omega = rates(k1, c, m1, xp)
    envelope = xp.exp(-gamma * time)
    return xp.stack([envelope * xp.cos(omega * time), envelope * xp.sin(omega * time)], axis=-1)


@partial(jax.jit, static_argnames="half_cycles")
def dry_decay(
    time: np.ndarray, k1: Any, c: Any, m1: Any, F_dry: Any, amplitude: Any, turning_time: Any, half_cycles: int
) -> Any:
    """Decay with viscous and dry damping: each half cycle lasts pi/omega and is viscous about +-F_dry/k1.

    Parameters
    ----------
    time : (n,) s
    amplitude : x_rel at the turning point at ``turning_time``, m, positive; the decay sticks where |x| <= F_dry/k1
    half_cycles : static bound on the number of half cycles covered by ``time``

    Returns
    -------
    x_rel (n,), m. Samples before ``turning_time`` lie on the half cycle that ends there.
    """
    gamma, omega = rates(k1, c, m1)
    half_period = jnp.pi / omega
    ratio, shift = jnp.exp(-gamma * half_period), F_dry / k1

    def next_amplitude(a: Any, _: None) -> tuple[Any, Any]:
        # Amplitudes are positive on the side of their own half cycle. A stuck rod keeps its position.
        return jnp.where(a > shift, ratio * a - shift * (1.0 + ratio), -a), a

    before = (amplitude + shift * (1.0 + ratio)) / ratio
    _, after = jax.lax.scan(next_amplitude, amplitude, None, length=half_cycles)
    amplitudes = jnp.concatenate([jnp.asarray(before)[None], after])
    phase = (time - turning_time) / half_period
    index = jnp.clip(jnp.floor(phase).astype(int), -1, half_cycles - 1)
    tau = time - turning_time - index * half_period
    a = amplitudes[index + 1]
    shape = jnp.exp(-gamma * tau) * (jnp.cos(omega * tau) + gamma / omega * jnp.sin(omega * tau))
    moving = shift + (a - shift) * shape
    side = jnp.where(index % 2 == 0, 1.0, -1.0)
    return side * jnp.where(a > shift, moving, a)


@partial(jax.jit, static_argnames="substeps")
def quadratic_decay(
    time: np.ndarray, k1: Any, c: Any, m1: Any, c_q: Any, x_start: Any, y_start: Any, substeps: int
) -> Any:
    """Decay with viscous and quadratic damping (n,), m, by Runge–Kutta 4 with ``substeps`` steps between samples."""

    def rate(state: Any) -> Any:
        x, y = state
        return jnp.stack([y, -(k1 * x + c * y + c_q * y * jnp.abs(y)) / m1])

    def step(state: Any, h: Any) -> Any:
        a = rate(state)
        b = rate(state + 0.5 * h * a)
        d = rate(state + 0.5 * h * b)
        e = rate(state + h * d)
        return state + h / 6.0 * (a + 2.0 * b + 2.0 * d + e)

    def sample(state: Any, gap: Any) -> tuple[Any, Any]:
        state = jax.lax.fori_loop(0, substeps, lambda _, s: step(s, gap / substeps), state)
        return state, state[0]

    start = jnp.stack([jnp.asarray(x_start, dtype=float), jnp.asarray(y_start, dtype=float)])
    _, x = jax.lax.scan(sample, start, jnp.diff(time))
    return jnp.concatenate([start[:1], x])
