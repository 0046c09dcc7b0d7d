"""Emulator of the motions of an experiment: a smooth function of its parameters, fitted to exact motions.

Ridge regression on random Fourier features (A. Rahimi, B. Recht, *Random features for large-scale kernel machines*,
Advances in Neural Information Processing Systems 20, 2007, 1177). It approximates Gaussian-process regression with a
Matérn kernel of smoothness 5/2. The sampler uses it for proposals only; exact motions decide on every one of them.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

#: Number of features, correlation length in sds of the training inputs, and ridge penalty of a weight.
FEATURES, LENGTH, RIDGE = 2000, 8.0, 1e-3
#: Coefficients of the series of a cosine in the square.
COSINE = [(-1.0) ** k / math.factorial(2 * k) for k in range(10)]
#: Rows of a block of the normal equations.
ROWS = 2048
#: Degrees of freedom of the random frequencies: twice the smoothness of the kernel.
FREEDOM = 5.0


class Emulator(eqx.Module):
    """Motions (k,) as a function of parameters (p,) by symbol.

    Attributes
    ----------
    symbols, positive : (p,) inputs; positive ones enter by their logarithms
    centre, scale : (p,) mean and sd of the training inputs
    frequencies, phases : (p, features) and (features,)
    weights : (features + 1 + p, k)
    """

    symbols: tuple[str, ...] = eqx.field(static=True)
    positive: tuple[bool, ...] = eqx.field(static=True)
    centre: np.ndarray
    scale: np.ndarray
    frequencies: np.ndarray
    phases: np.ndarray
    weights: np.ndarray

    def __init__(
        self, positive: Mapping[str, bool], draws: Sequence[Mapping[str, Any]], motions: Float[np.ndarray, "n k"]
    ) -> None:
        """Fit to the ``motions`` at ``draws``; rows that are not finite are left out.

        Parameters
        ----------
        positive : inputs by symbol, and whether each is positive
        """
        self.symbols, self.positive = tuple(positive), tuple(positive.values())
        x = np.array([[draw[symbol] for symbol in self.symbols] for draw in draws], dtype=float)
        x = np.where(self.positive, np.log(np.where(self.positive, x, 1.0)), x)
        known = np.all(np.isfinite(motions), axis=1)
        x, y = x[known], motions[known]
        self.centre, self.scale = np.mean(x, axis=0), np.std(x, axis=0)
        rng = np.random.default_rng(0)
        spread = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, FEATURES)) / LENGTH
        self.frequencies = spread * rng.standard_normal((x.shape[1], FEATURES))
        self.phases = rng.uniform(0.0, 2.0 * np.pi, FEATURES)
        size = FEATURES + 1 + x.shape[1]
        square, product = RIDGE * np.eye(size), np.zeros((size, y.shape[1]))
        for i in range(0, len(x), ROWS):  # all rows at once would need gigabytes
            f = self._features(x[i : i + ROWS], np)
            square += f.T @ f
            product += f.T @ y[i : i + ROWS]
        self.weights = np.linalg.solve(square, product)

    def __call__(self, theta: Mapping[str, Any]) -> Any:
        """Motions (k,) at parameters by symbol, () each."""
        values = [theta[symbol] for symbol in self.symbols]
        pairs = zip(values, self.positive, strict=True)
        x = jnp.stack([jnp.log(value) if positive else jnp.asarray(value) for value, positive in pairs])
        return (self._features(x[None], jnp) @ self.weights)[0]

    def _features(self, x: Any, xp: Any) -> Any:
        """(n, features + 1 + p) of inputs (n, p)."""
        z = (x - self.centre[None]) / self.scale[None]
        waves = _cosine(z @ self.frequencies + self.phases[None], xp)
        return xp.concatenate([waves, xp.ones((len(z), 1)), z], axis=1)


def _cosine(x: Any, xp: Any) -> Any:
    """Cosine of x (...) within 1e-8, by its series; XLA's own takes ten times as long on a CPU."""
    turns = x / (2.0 * np.pi)
    square = (2.0 * np.pi * (turns - xp.round(turns))) ** 2
    found = COSINE[-1] * xp.ones_like(square)
    for coefficient in COSINE[-2::-1]:
        found = found * square + coefficient
    return found
