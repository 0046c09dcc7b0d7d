"""Forces, each written once: friction of the ground, those between rod and capsule, the smoothed steps. SI, elementwise."""

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
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

    def backward(self, speed: Any) -> Any:
        """Resistance of a capsule that slides towards negative X2, N."""


#: A step is short enough for friction that changes over a speed of v_s and of this part of the speed at its start.
BRAKING = 6.0


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
            # The fall of the friction near v_s counts before the capsule is that slow: a step must not pass it.
            width = self.v_s + jnp.abs(v) / BRAKING
            return jnp.where(sliding, jnp.abs(acceleration) / width, 0.0) + viscous / mass

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


# grazing: Where contacts begin: the load at which a rod on a capsule at rest just reaches the support spring.


def grazing_load(
    m1: float | np.ndarray,
    k1: float | np.ndarray,
    c: float | np.ndarray,
    G: float | np.ndarray,
    Omega: float | np.ndarray,
) -> np.ndarray:
    """P_graze = G k1 sqrt((1 - rho^2)^2 + (2 zeta rho)^2), N, with rho = Omega sqrt(m1/k1), zeta = c/(2 sqrt(k1 m1)).

    The amplitude of the settled linear motion is G at this load. It holds while the capsule rests: |f| <= F_b all the
    time. Written as G |k1 - m1 Omega^2 + i c Omega|, so that k1 = 0 is no exception.

    Parameters
    ----------
    m1, k1, c, G, Omega : kg, N/m, N s/m, m, rad/s; numbers, or arrays that broadcast
    """
    return np.asarray(G * np.hypot(k1 - m1 * np.asarray(Omega) ** 2, c * np.asarray(Omega)))


# steps: Smoothed Heaviside function, its integral, sign and |x|; every width is positive.
#
# Each is a C2 step of compact support: outside its width the smoothed function *is* the exact one, and its slope and
# curvature stay below 15 / (16 width) and 5 / (2 sqrt(3) width^2). All functions work elementwise.


Array = jax.Array | float


def _scaled(x: Array, width: Array) -> jax.Array:
    """x / width clipped to [-1, 1]."""
    return jnp.minimum(jnp.maximum(jnp.asarray(x) / width, -1.0), 1.0)


def smooth_sign(x: Array, width: Array) -> jax.Array:
    """sgn_w(x) = s (15 - 10 s^2 + 3 s^4) / 8 with s = x / width clipped to [-1, 1]; odd, C2.

    At 0: value 0, slope 15 / (8 width), curvature 0. At and beyond +-width, so at +-infinity: +-1, all derivatives 0.
    """
    s = _scaled(x, width)
    q = s * s
    return s * (1.875 + q * (0.375 * q - 1.25))


def smooth_heaviside(x: Array, width: Array) -> jax.Array:
    """H_w(x) = (1 + sgn_w(x)) / 2. At 0: 1/2, slope 15 / (16 width). At -infinity 0, at +infinity 1, slopes 0."""
    return 0.5 * (1.0 + smooth_sign(x, width))


def smooth_abs(x: Array, width: Array) -> jax.Array:
    """|x|_w = x sgn_w(x), C2. At 0: value and slope 0, curvature 15 / (4 width). Beyond +-width: |x|, slopes +-1."""
    return x * smooth_sign(x, width)


def smooth_ramp(x: Array, width: Array) -> jax.Array:
    """R_w(x), the integral of H_w from -infinity: max(x, 0) rounded off over +-width, C3.

    At 0: 5 width / 32, slope 1/2, curvature 15 / (16 width). At -infinity 0 with slope 0; at +infinity x with slope 1
    (from +-width on, to rounding). With H_w it makes a support force that has a potential: contact conserves energy.
    """
    s = _scaled(x, width)
    q = s * s
    rounded = (0.03125 * width) * (5.0 + 16.0 * s + q * (15.0 + q * (q - 5.0)))
    return rounded + jnp.maximum(x - width, 0.0)


# forces: The forces between rod and capsule. All that computes with them (both engines, events, energy balance,
# accelerometer) asks their classes, so a further one is a further class and nothing else.
#
# Sign: f is the force that the rod puts on the capsule. p has the fields of ``CapsuleParameters``; a field that is None
# is absent. The leaves of p and of the drive broadcast with the state, so leaves (batch,) need a last axis of length 1
# beside samples (batch, n).


#: A gap is far beyond a motion from this multiple of its largest |r| on, and from this size on, m.
FAR, FAR_GAP = 20.0, 0.1
#: An infinite gap counts as this wide, m: no run reaches it.
OUT_OF_REACH = 1e6
#: Newton steps from the linear to the nonlinear equilibrium; a cubic share of one half needs five.
NEWTON_STEPS = 8


class Force:
    """A force between rod and capsule: a frozen pytree of leaves () or (batch,) with the formulas of the force.

    ``CapsuleParameters(..., forces=(force, ...))`` takes any number of them. With a gap it is a contact, which acts
    while d = side r - gap >= 0; without one it acts always, with d = r. The formulas work elementwise on NumPy and JAX
    arrays. The exact engine evaluates them on Taylor series: made of +, - and * and whole powers (a Python ``int``, no
    leaf) of d and w they are exact there; all others it refuses, and any on a prescribed rod. The smoothed engine takes any.

    parameters : a row for each leaf that is to be checked, with the leaf's name as its symbol
    """

    parameters: ClassVar[tuple[Parameter, ...]] = ()

    #: m, infinite where it is never closed; None: no contact.
    gap: Any = None
    #: 1.0: a contact pushes the capsule forward; -1.0: backward, behind a gap on the other side of the rod.
    side: float = 1.0
    #: Whether there is something to meet: the closings of a contact that is not present do not count.
    present: Any = True

    def elastic(self, d: Any) -> Any:
        """The conservative part, N, at the stretch or penetration d, m."""
        return 0.0

    def damping(self, d: Any, w: Any) -> Any:
        """The part that dissipates, N, at d, m, and its rate w, m/s; 0 at w = 0."""
        return 0.0

    @property
    def reach(self) -> Any:
        """``gap`` of a contact with ``OUT_OF_REACH`` in the place of infinity, m."""
        return array_module(self.gap).minimum(self.gap, OUT_OF_REACH)

    def on_capsule(self, r: Any, w: Any, penetration: Any = None) -> Any:
        """The force along +X on the capsule, N, at r = X1 - X2, m, and w = Y1 - Y2, m/s.

        penetration : half-width, m, over which a contact is smoothed: d is rounded off to R_w(d), and what is damped
            fades in with H_w(d), so that beyond this width the smoothed force is the exact one; None: the exact one

        For k d: 5 k penetration / 32 at d = 0, the largest deviation; the energy that it stores is of second order.
        """
        if self.gap is None:
            return self.elastic(r) + self.damping(r, w)
        d = self.side * r - self.reach
        if penetration is None:
            xp, acts = array_module(d), d >= 0.0
            pressed, share = xp.where(acts, d, 0.0), 1.0
        else:
            # Off the contact the formula stands at a harmless point: its derivatives may be infinite at 0.
            xp, acts, share = jnp, d > -penetration, smooth_heaviside(d, penetration)
            pressed = jnp.where(acts, smooth_ramp(d, penetration), penetration)
        force = self.elastic(pressed) + share * self.damping(pressed, self.side * w)
        return self.side * xp.where(acts, force, 0.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spring(Force):
    """k d^power + c w: the rod's spring and damper, or a support behind the gap G; without stiffness no support.

    k : N/m^power        c : N s/m, None: no damper        G : m, None: no contact        side : -1.0 for a back spring
    """

    k: NumberOrBatch
    c: NumberOrBatch | None = None
    G: NumberOrBatch | None = None
    power: int = field(default=1, metadata={"static": True})
    side: float = field(default=1.0, metadata={"static": True})

    @property
    def gap(self) -> Any:
        """G."""
        return self.G

    @property
    def present(self) -> Any:
        """Whether a support has a stiffness."""
        return self.G is None or self.k > 0.0

    def elastic(self, d: Any) -> Any:
        """k d^power."""
        return self.k * d**self.power

    def damping(self, d: Any, w: Any) -> Any:
        """c w."""
        return 0.0 if self.c is None else (self.c * self.present) * w


def forces_of(p: Any) -> tuple[Force, ...]:
    """All forces between rod and capsule: k1 r + c w, k_cubic r^3, the supports, and those of ``p.forces``."""
    found: list[Force] = [Spring(p.k1, p.c)]
    if p.k_cubic is not None:
        found.append(Spring(p.k_cubic, power=3))
    if p.k2 is not None and p.G is not None:
        found.append(Spring(p.k2, p.c2, p.G))
    if p.k2_back is not None and p.G_back is not None:
        found.append(Spring(p.k2_back, None, p.G_back, side=-1.0))
    return (*found, *(p.forces or ()))


def rod_on_capsule(p: Any, r: Any, w: Any, penetration: Any = None) -> Any:
    """f, N: the sum of the forces; see ``Force.on_capsule``.

    f = k1 r + k_cubic r^3 + c w + [r >= G] (k2 (r - G) + c2 w) + [r <= -G_back] k2_back (r + G_back)
    """
    return total(force.on_capsule(r, w, penetration) for force in forces_of(p))


def total(terms: Iterable[Any]) -> Any:
    """The sum of one or more terms."""
    first, *others = terms
    return sum(others, first)


def warn_of_far_gap(G: Any, r: Any) -> None:
    """Warn where every gap ``G``, m, is far beyond the motion ``r``, m; an infinite one means no spring."""
    moved = np.abs(np.asarray(r))
    gap, reach = float(np.min(G)), float(np.max(moved[np.isfinite(moved)], initial=0.0))
    if np.isfinite(moved).any() and max(FAR * reach, FAR_GAP) < gap < np.inf:
        text = f"the gap is {1e3 * gap:.4g} mm and the largest |x_rel| {1e3 * reach:.3g} mm: no contact. Is it in m?"
        warnings.warn(text, stacklevel=3)


def downhill(p: Any, mass: Any) -> Any:
    """Weight of a mass along the slope, N, towards -X; NumPy and JAX."""
    return mass * p.g * array_module(p.slope).sin(p.slope) if p.slope is not None else 0.0


def weights_along(p: Any) -> tuple[Any, Any] | None:
    """Weights of rod and capsule along the slope, N, towards -X; None on level ground."""
    return None if p.slope is None else (downhill(p, p.m1), downhill(p, p.m2))


def along_ground(f: Any, D: Any, reaction: Any, weights: tuple[Any, Any] | None) -> tuple[Any, Any]:
    """Forces along +X on rod and capsule, N, but for friction: f, the drive D and its reaction, the weights."""
    rod, capsule = D - f, f if reaction is None else f - reaction * D
    return (rod, capsule) if weights is None else (rod - weights[0], capsule - weights[1])


def equilibrium(p: Any) -> Any:
    """x_rel, m, of the rod at rest with the drive off and no contact: k1 r + k_cubic r^3 = -m1 g sin(slope)."""
    load = -downhill(p, p.m1)
    r = load / p.k1
    free = [force.elastic for force in forces_of(p) if force.gap is None]
    for _ in range(NEWTON_STEPS if len(free) > 1 else 0):
        pull, slope = jax.jvp(lambda r: total(elastic(r) for elastic in free), (r,), (jnp.ones_like(r),))
        r = r - (pull - load) / slope
    return r
