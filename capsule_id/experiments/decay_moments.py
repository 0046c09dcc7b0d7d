"""Moments of a uniformly sampled decay in O(sqrt(n)) transcendental functions, to rounding the same as by summation.

The two viscous solutions at t_j = j h are the real and the imaginary part of z^j, z = exp((-gamma + i omega) h). Their
sums and products are geometric series; sum_j y_j z^j is a polynomial, evaluated with j = B a + b (baby and giant
steps): one matrix product instead of n complex exponentials.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np


class UniformDecay:
    """The record once folded into a matrix; ``moments`` is then cheap to evaluate in a batch.

    Parameters
    ----------
    values : (n,) readings at 0, h, 2h, ...
    step : h, s
    """

    def __init__(self, values: np.ndarray, step: float) -> None:
        self.n, self.step = len(values), step
        self.baby = max(int(np.sqrt(self.n)), 1)
        self.giant = -(-self.n // self.baby)
        folded = np.zeros(self.baby * self.giant)
        folded[: self.n] = values
        self.folded = folded.reshape(self.giant, self.baby)
        self.sum, self.square = float(np.sum(values)), float(values @ values)

    def moments(self, gamma: Any, omega: Any) -> tuple[Any, Any, Any]:
        """y'y (), A'y (3,) and A'A (3, 3) for A = [Re z^j, Im z^j, 1]."""
        rate = (-gamma + 1j * omega) * self.step
        inner = jnp.exp(rate * jnp.arange(self.baby))
        outer = jnp.exp(rate * self.baby * jnp.arange(self.giant))
        rows = self.folded @ jnp.stack([inner.real, inner.imag], axis=-1)
        projection = jnp.sum(outer * (rows[:, 0] + 1j * rows[:, 1]))
        plain, squared = self._series(rate), self._series(2.0 * rate)
        modulus = self._series(-2.0 * gamma * self.step)
        cc, ss = 0.5 * (modulus + squared.real), 0.5 * (modulus - squared.real)
        cs = 0.5 * squared.imag
        aa = jnp.stack(
            [
                jnp.stack([cc, cs, plain.real]),
                jnp.stack([cs, ss, plain.imag]),
                jnp.stack([plain.real, plain.imag, jnp.full_like(cc, self.n)]),
            ]
        )
        return self.square, jnp.stack([projection.real, projection.imag, jnp.full_like(cc, self.sum)]), aa

    def _series(self, exponent: Any) -> Any:
        """Sum of exp(exponent j) over j = 0 .. n-1."""
        return jnp.expm1(exponent * self.n) / jnp.expm1(exponent)


def uniform_step(time: np.ndarray) -> float | None:
    """The sampling step, s, where every sample stands on the grid to 1e-9 of it (file rounding excluded); else None."""
    step = float((time[-1] - time[0]) / (len(time) - 1))
    grid = time[0] + step * np.arange(len(time))
    return step if np.max(np.abs(time - grid)) < 1e-9 * step + 1e-12 else None
