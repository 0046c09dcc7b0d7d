"""Friction between capsule and ground, on numbers, arrays and Taylor series."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.parameters import TABLE, Parameter
from capsule_id.physics.batches import NumberOrBatch, array_module

# series: Polynomials in the scaled time s of a Taylor step: lists of coefficients, one array (L,) per order.
#
# XLA recomputes a cheap expression in every place that uses it, which for recursions grows without bound. It never
# recomputes a division by a value that is known only at run time. So a quantity that is used often ends in such a
# division (``divide``), on purpose, and so does its tangent: without it a step costs ten times as much.


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


# friction: Friction between capsule and ground: the law of sliding resistance, the slide to rest.
#
# A friction law is a class with the methods of ``FrictionLaw``. ``simulate(p, e, times, friction=law)`` takes any such
# law, in both engines; nothing else has to be changed. Forces in N, velocities in m/s, masses in kg.


#: Panels that many slides share, finer towards rest: 2e-8 relative where v_s is a tenth of the largest speed.
PANELS = 128
# Gauss-Legendre nodes and weights on (0, 1): of a slide, where 48 give 1e-12 relative up to v = 50 v_s (tests: the
# dilogarithm), and of a panel.
(_NODES, _WEIGHTS), (_PANEL_NODES, _PANEL_WEIGHTS) = (
    (0.5 * (points + 1.0), 0.5 * weights) for points, weights in map(np.polynomial.legendre.leggauss, (48, 4))
)


class FrictionLaw(Protocol):
    """The resistance of the ground, N >= 0, at a sliding speed >= 0, m/s: a frozen pytree without internal state.

    Both methods work elementwise and are analytic on speed >= 0. The value at speed 0 is the break-away force. Leaves
    are () or (batch,); ``parameters`` has one row per leaf, with the leaf's name as its symbol.

    A law may have a method ``series(sigma, v, breakaway) -> FrictionSeries``, its own Taylor recursion. It is optional
    and only saves time: without it the exact engine takes the law's derivatives from automatic differentiation.
    sigma (L,) is the direction, v (L,) m/s the velocity; breakaway are forward(0) and backward(0), each (L,).
    """

    parameters: ClassVar[tuple[Parameter, ...]]

    def forward(self, speed: Any) -> Any:
        """Resistance of a capsule that slides towards positive X2, N."""
        ...

    def backward(self, speed: Any) -> Any:
        """Resistance of a capsule that slides towards negative X2, N."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CoulombStribeck:
    """Eq. (1) generalised: mu N (ratio + (1 - ratio) exp(-|Y2| / v_s)) + viscous |Y2|, with mu_back backward.

    The paper's eq. (1) is the default: ratio 1/2, no viscous part, mu_back as mu. Units: N in N, v_s in
    m/s, viscous in N s/m, mu, mu_back and ratio in 1. With N = 1 N, and viscous divided by the weight, the value is the
    friction coefficient.

    At speed 0: F_b = mu N with slope viscous - (1 - ratio) F_b / v_s. At infinite speed: ratio F_b + viscous |Y2|.
    """

    mu: NumberOrBatch
    N: NumberOrBatch
    v_s: NumberOrBatch
    mu_back: NumberOrBatch | None = None
    ratio: NumberOrBatch = 0.5
    viscous: NumberOrBatch = 0.0

    parameters: ClassVar[tuple[Parameter, ...]] = (
        TABLE["mu"],
        Parameter("N", "N", "normal force of capsule and rod on the ground", "N", sign="not negative", sampled=False),
        TABLE["v_s"],
        TABLE["mu_back"],
        TABLE["ratio"],
        TABLE["viscous"],
    )

    def __post_init__(self) -> None:
        if self.mu_back is None:
            object.__setattr__(self, "mu_back", self.mu)

    def forward(self, speed: Any) -> Any:
        """Resistance at ``speed``, N; NumPy and JAX."""
        return self._resistance(self.mu, speed)

    def backward(self, speed: Any) -> Any:
        """Resistance at ``speed``, N; NumPy and JAX."""
        return self._resistance(self.mu_back, speed)

    def _resistance(self, mu: Any, speed: Any) -> Any:
        exponent = -speed / self.v_s
        weakening = self.ratio + (1.0 - self.ratio) * array_module(exponent).exp(exponent)
        return mu * self.N * weakening + self.viscous * speed

    def series(self, sigma: jax.Array, v: jax.Array, breakaway: tuple[jax.Array, jax.Array]) -> FrictionSeries:
        """Friction along a step: u = exp(-sigma v/v_s) obeys u' = -sigma v' u / v_s, one Cauchy product per order."""
        sliding = sigma != 0.0
        direction = jnp.where(sliding, sigma, jnp.inf)
        F_b = jnp.where(sigma < 0.0, breakaway[1], breakaway[0])
        kinetic, fading = F_b * sigma * self.ratio, divide((1.0 - self.ratio) * F_b, direction)
        viscous = divide(self.viscous, jnp.abs(direction))
        v_s = jnp.where(sliding, -sigma * self.v_s, jnp.inf)
        u = [jnp.exp(-sigma * v / self.v_s)]

        def rate(acceleration: jax.Array, mass: jax.Array) -> jax.Array:
            return jnp.where(sliding, u[0] * jnp.abs(acceleration) / self.v_s, 0.0) + viscous / mass

        def extend(v: Series) -> jax.Array:
            k = len(v) - 1
            product = sum((j * v[j] * u[k - j] for j in range(2, k + 1)), v[1] * u[k - 1])
            u.append(divide(product, k * v_s))
            return fading * u[k] + viscous * v[k]

        return FrictionSeries(kinetic + fading * u[0] + viscous * v, rate, extend)


def normal_force(m1: Any, m2: Any, g: Any, slope: Any = None, N0: Any = None) -> Any:
    """N = (m1 + m2) g cos(slope) + N0, N; None: level ground, and the weight alone. NumPy and JAX."""
    N = (m1 + m2) * g
    N = N if slope is None else N * array_module(slope).cos(slope)
    return N if N0 is None else N + N0


def friction_law(p: Any, friction: FrictionLaw | None = None) -> FrictionLaw:
    """``friction``, or eq. (1) with the parameters and weight of the capsule p, a ``CapsuleParameters``."""
    if friction is not None:
        return friction
    own = {row.symbol: getattr(p, row.symbol) for row in CoulombStribeck.parameters if row.symbol != "N"}
    return CoulombStribeck(N=normal_force(p.m1, p.m2, p.g, p.slope, p.N0), **own)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scaled:
    """Any law with its resistance multiplied by ``factor``, 1."""

    law: FrictionLaw
    factor: Any

    parameters: ClassVar[tuple[Parameter, ...]] = ()

    def forward(self, speed: Any) -> Any:
        """Resistance of a capsule that slides towards positive X2, N."""
        return self.factor * self.law.forward(speed)

    def backward(self, speed: Any) -> Any:
        """Resistance of a capsule that slides towards negative X2, N."""
        return self.factor * self.law.backward(speed)


def scaled(law: FrictionLaw, factor: Any) -> FrictionLaw:
    """``law`` with its resistance multiplied by ``factor``; eq. (1) keeps its own Taylor recursion."""
    if isinstance(law, CoulombStribeck):
        return replace(law, N=law.N * factor, viscous=law.viscous * factor)
    return Scaled(law, factor)


def sliding_friction(law: FrictionLaw, sigma: Any, v: Any) -> jax.Array:
    """Friction in N with the sign of the direction sigma (+1, -1; 0 gives 0) at the velocity v, m/s."""
    speed = sigma * v
    return sigma * jnp.where(sigma < 0.0, law.backward(speed), law.forward(speed))


def slide_distance(law: FrictionLaw, mass: Any, speed: Any) -> Any:
    """Distance, m, of a forward slide from ``speed`` (n,) to rest: the integral of mass u du / forward(u) over 0..speed.

    mass : the sliding mass, kg; the law's leaves are (), NumPy or JAX
    """
    if speed.shape[0] <= len(_NODES):
        u = speed[:, None] * _NODES[None]
        return mass * speed * ((u / law.forward(u)) @ _WEIGHTS)
    # Many slides: the integral at the edges of panels, and between them the cubic with its slopes.
    edges = speed.max() * np.linspace(0.0, 1.0, PANELS + 1) ** 2
    low, width = edges[:-1], edges[1:] - edges[:-1]
    u = low[:, None] + width[:, None] * _PANEL_NODES[None]
    rises = width * ((u / law.forward(u)) @ _PANEL_WEIGHTS)
    slopes = edges / law.forward(edges[:, None])[..., 0]
    k = (PANELS * (speed / speed.max()) ** 0.5).astype(int).clip(0, PANELS - 1)
    s, rise = (speed - low[k]) / width[k], rises[..., k]
    first, last = width[k] * slopes[..., k], width[k] * slopes[..., k + 1]
    bend = 3.0 * rise - 2.0 * first - last + s * (first + last - 2.0 * rise)
    return mass * ((rises.cumsum(-1) - rises)[..., k] + s * (first + s * bend))
