"""Taylor coefficients of friction along a step, for a law that is known only as functions of speed.

With R the law in the direction of motion and x(s) the speed, the chain rule gives one recursion per derivative of R:

    G_n(s) = R^(n)(x(s)),   G_n' = G_(n+1) x'   ->   k G_n[k] = sum over j = 1..k of j x_j G_(n+1)[k - j]

It starts from R^(n) at the speed of the step's start, by Taylor-mode differentiation, so it is exact to rounding.
"""

import jax
import jax.numpy as jnp
from jax.experimental.jet import jet

from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.series import DEGREE, FrictionSeries, Series, divide


def friction_series(
    law: FrictionLaw, sigma: jax.Array, v: jax.Array, breakaway: tuple[jax.Array, jax.Array]
) -> FrictionSeries:
    """Friction from the velocity v (L,), m/s, on, in the direction sigma (L,): the law's own series if it has one.

    breakaway : forward(0) and backward(0), each (L,), N, computed once per run
    """
    own = getattr(law, "series", None)
    return by_chain_rule(law, sigma, v) if own is None else own(sigma, v, breakaway)


def by_chain_rule(law: FrictionLaw, sigma: jax.Array, v: jax.Array) -> FrictionSeries:
    """The series of any law, from its derivatives at the speed of the step's start."""
    backward = sigma < 0.0
    unit = jnp.where(sigma != 0.0, sigma, jnp.inf)

    def resistance(speed: jax.Array) -> jax.Array:
        return jnp.where(backward, law.backward(speed), law.forward(speed))

    speed = jnp.abs(sigma) * jnp.abs(v)
    direction = [jnp.ones_like(v), *[jnp.zeros_like(v)] * (DEGREE - 2)]
    value, derivatives = jet(resistance, (speed,), (direction,))
    G = [[divide(x, jnp.abs(unit))] for x in (value, *derivatives)]

    def rate(acceleration: jax.Array, mass: jax.Array) -> jax.Array:
        """From v' = (f - R)/m: the rate |R'|/m of its linear part, and sqrt(|R'' v'|/m) of its quadratic part."""
        slope, bend = jnp.abs(G[1][0]), jnp.abs(G[2][0] * acceleration)
        return slope / mass + jnp.sqrt(bend / mass)

    def extend(v: Series) -> jax.Array:
        k = len(v) - 1
        for n in range(k - 1, -1, -1):
            order = k - n
            G[n].append(divide(sum(j * v[j] * G[n + 1][order - j] for j in range(1, order + 1)), order * unit))
        return sigma * G[0][k]

    return FrictionSeries(sigma * G[0][0], rate, extend)
