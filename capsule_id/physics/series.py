"""Polynomials in the scaled time s of a Taylor step: lists of coefficients, one array (L,) per order.

XLA recomputes a cheap expression in every place that uses it, which for recursions grows without bound. It never
recomputes a division by a value that is known only at run time. So a quantity that is used often ends in such a
division (``divide``), on purpose, and so does its tangent: without it a step costs ten times as much.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax

# Degree of the series of a step.
DEGREE = 12

Series = list[jax.Array]


class FrictionSeries(NamedTuple):
    """Sliding friction F along one step, with the sign of the direction; zero in lanes whose capsule is stuck.

    start : (L,) N, F at the start of the step
    rate : (acceleration (L,) m/s^2, mass (L,) kg) -> (L,) 1/s, how fast F changes: it bounds the first guess of a step
    extend : coefficients v_0 .. v_k of the velocity -> coefficient F_k; called once for each k = 1, 2, ... in order
    """

    start: jax.Array
    rate: Callable[[jax.Array, jax.Array], jax.Array]
    extend: Callable[[Series], jax.Array]


@jax.custom_jvp
def divide(a: jax.Array, b: jax.Array) -> jax.Array:
    """a/b, whose tangent is one division as well."""
    return a / b


@divide.defjvp
def _divide_jvp(
    primals: tuple[jax.Array, jax.Array], tangents: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    (a, b), (da, db) = primals, tangents
    q = divide(a, b)
    change = da - q * db
    # Several tangents share one b; a division by a shared value would be turned into a multiplication.
    return q, change / (b + 0.0 * change)


def horner(p: Series, s: jax.Array | float) -> jax.Array:
    """Value of the polynomial with coefficients p at s."""
    value = p[-1]
    for x in reversed(p[:-1]):
        value = value * s + x
    return value


def increase(p: Series, s: jax.Array) -> jax.Array:
    """p(s) - p(0) for s > 0."""
    return divide(horner(p[1:], s), 1.0 / s)


def mean(p: Series, s: jax.Array) -> jax.Array:
    """Mean of the polynomial over 0..s."""
    return horner([x * (1.0 / (k + 1)) for k, x in enumerate(p)], s)
