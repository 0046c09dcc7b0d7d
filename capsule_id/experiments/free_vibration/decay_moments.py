"""Moments of a uniformly sampled decay with O(sqrt(n)) transcendental functions, equal to sums up to rounding.

The two viscous solutions at t_j = j h are the real and the imaginary part of z^j, z = exp((-gamma + i omega) h). Their
sums and products are geometric series. The polynomial sum_j y_j z^j is evaluated with j = B a + b (baby-step
giant-step). This needs one matrix product instead of n complex exponentials.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np


def fold(values: np.ndarray) -> np.ndarray:
    """Reshape the record (n,) to (giant, baby), rows of about sqrt(n); the last row is padded with zeros."""
    baby = max(int(np.sqrt(len(values))), 1)
    giant = -(-len(values) // baby)
    return np.pad(values, (0, baby * giant - len(values))).reshape(giant, baby)


def decay_moments(folded: Any, n: int, step: Any, gamma: Any, omega: Any) -> tuple[Any, Any, Any]:
    """Moments y'y (), A'y (3,) and A'A (3, 3) for A = [Re z^j, Im z^j, 1], j = 0 .. n-1.

    Parameters
    ----------
    folded : (giant, baby) of ``fold``
    step : h, s
    gamma, omega : 1/s and rad/s
    """
    giant, baby = folded.shape
    rate = (-gamma + 1j * omega) * step
    inner = jnp.exp(rate * jnp.arange(baby))
    outer = jnp.exp(rate * baby * jnp.arange(giant))
    rows = folded @ jnp.stack([inner.real, inner.imag], axis=-1)
    projection = jnp.sum(outer * (rows[:, 0] + 1j * rows[:, 1]))
    plain, squared, modulus = (_series(q, n) for q in (rate, 2.0 * rate, -2.0 * gamma * step))
    cc, ss, cs = 0.5 * (modulus + squared.real), 0.5 * (modulus - squared.real), 0.5 * squared.imag
    aa = jnp.array([[cc, cs, plain.real], [cs, ss, plain.imag], [plain.real, plain.imag, n]])
    return jnp.sum(folded**2), jnp.array([projection.real, projection.imag, jnp.sum(folded)]), aa


def _series(exponent: Any, n: int) -> Any:
    """Sum of exp(exponent j) over j = 0 .. n-1."""
    return jnp.expm1(exponent * n) / jnp.expm1(exponent)


def uniform_step(time: np.ndarray) -> float | None:
    """Sampling step, s, where every sample lies on the grid to 1e-9 of a step plus file rounding; else None."""
    step = float((time[-1] - time[0]) / (len(time) - 1))
    grid = time[0] + step * np.arange(len(time))
    return step if np.max(np.abs(time - grid)) < 1e-9 * step + 1e-12 else None
