"""Taylor series of the capsule's motion inside one mode, and how far they hold.

Inside a mode (contact or not, stuck, forward or backward) the field is linear but for exp(-|Y2|/v_s) and the drive, so
the coefficients follow from each other by one Cauchy product per order. All arrays are (L,), a value per lane; a
series is a list of coefficients in the scaled time s = (t - t0)/h. Written in relative coordinates, which lose no
digits when the capsule has travelled far:

    r = X1 - X2,  d = r - G (penetration of the support spring if positive),  w = r' = d' = Y1 - Y2,  X2,  v = Y2

r and d are carried side by side: one is exactly 0 at the gap, the other keeps its digits where the gap is wide.

XLA recomputes a cheap expression in every place that uses it, which for recursions grows without bound, but never a
division by a value known only at run time. So every quantity that is used often ends in such a division (``over``), on
purpose, and so does its tangent: without it a step costs ten times as much.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from capsule_id.physics.model import CapsuleParameters, Excitation

ORDER = 12
# A step ends where the last coefficients of the series, relative to the sum of all, would exceed this.
SERIES_TOLERANCE = 1e-9
# First guess of a step, in units of the fastest time scale of the mode; the coefficients then cut it.
STEP_GUESS = 3.0
# Coefficients that tell the size of a motion; the later ones may be large only because the guess was.
LEADING = 4
# Motions smaller than this, in m or m/s, are none: keeps quotients of sizes away from underflow.
VANISHING = 1e-150

Series = list[jax.Array]


class Rig(NamedTuple):
    """What is constant along a run, every leaf (L,), SI: the parameters, the drive, F_b = mu (m1 + m2) g."""

    m1: jax.Array
    m2: jax.Array
    k1: jax.Array
    k2: jax.Array
    c: jax.Array
    F_b: jax.Array
    v_s: jax.Array
    G: jax.Array
    P_d: jax.Array
    Omega: jax.Array
    phase: jax.Array


class State(NamedTuple):
    """Time (s), relative state (m, m/s), cosine and sine of the drive's phase there; every leaf (L,)."""

    t: jax.Array
    r: jax.Array
    d: jax.Array
    w: jax.Array
    X2: jax.Array
    v: jax.Array
    C: jax.Array
    S: jax.Array


class Mode(NamedTuple):
    """Discrete choices: contact (bool), sigma (+1.0 forward, -1.0 backward, 0.0 stuck), every leaf (L,)."""

    contact: jax.Array
    sigma: jax.Array


class Motion(NamedTuple):
    """One step's series in s: w, v, d (as the state) and f, the spring's force; h (L,) s is the unit of time.

    last : (L,) bool, s = 1 is the end of the run
    """

    h: jax.Array
    last: jax.Array
    w: Series
    v: Series
    d: Series
    f: Series


def rig_of(p: CapsuleParameters, e: Excitation) -> Rig:
    """The constants of a run from lanes of parameters and excitation."""
    F_b = p.mu * (p.m1 + p.m2) * p.g
    return Rig(*map(jnp.asarray, (p.m1, p.m2, p.k1, p.k2, p.c, F_b, p.v_s, p.G, e.P_d, e.Omega, e.phase)))


@jax.custom_jvp
def over(a: jax.Array, b: jax.Array) -> jax.Array:
    """a/b, whose tangent is one division as well."""
    return a / b


@over.defjvp
def _over_jvp(
    primals: tuple[jax.Array, jax.Array], tangents: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    (a, b), (da, db) = primals, tangents
    q = over(a, b)
    change = da - q * db
    # Several tangents share one b; a division by a shared value would be turned into a multiplication.
    return q, change / (b + 0.0 * change)


# pi/2 in two parts, the first with 33 bits so that its multiples are exact; sine and cosine on |x| <= pi/4 (fdlibm).
_HALF_PI = (1.57079632673412561417, 6.07710050650619224932e-11)
_SINE = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COSINE = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


@jax.custom_jvp
def cos_sin(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(cos x, sin x) to 2 ulp for |x| < 1e5; XLA's own cannot be vectorised on a CPU and cost a fifth of a step."""
    q = jnp.round(x * (2.0 / jnp.pi))
    y = (x - q * _HALF_PI[0]) - q * _HALF_PI[1]
    z = y * y
    sine, cosine = jnp.full_like(z, _SINE[0]), jnp.full_like(z, _COSINE[0])
    for S, C in zip(_SINE[1:], _COSINE[1:], strict=True):
        sine, cosine = sine * z + S, cosine * z + C
    sine, cosine = y + y * z * sine, 1.0 - 0.5 * z + z * z * cosine
    quadrant = q - 4.0 * jnp.floor(0.25 * q)
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    c = jnp.where(odd, sine, cosine) * jnp.where((quadrant == 1.0) | (quadrant == 2.0), -1.0, 1.0)
    s = jnp.where(odd, cosine, sine) * jnp.where(quadrant >= 2.0, -1.0, 1.0)
    one = c * c + s * s
    return c / one, s / one


@cos_sin.defjvp
def _cos_sin_jvp(
    primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    c, s = cos_sin(primals[0])
    return (c, s), (-s * tangents[0], c * tangents[0])


def step_rate(rig: Rig, mode: Mode, F_rate: jax.Array) -> jax.Array:
    """(L,) 1/s: inverse of a step of the order of the mode's fastest time scale, beyond which no series is worth it.

    F_rate : (L,) 1/s, how fast friction changes, relative to its share that depends on speed
    """
    compliance = 1.0 / rig.m1 + jnp.where(mode.sigma != 0.0, 1.0 / rig.m2, 0.0)
    stiffness = rig.k1 + jnp.where(mode.contact, rig.k2, 0.0)
    return (jnp.sqrt(stiffness * compliance) + rig.c * compliance + jnp.abs(rig.Omega) + F_rate) / STEP_GUESS


def friction(rig: Rig, sigma: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(F_s, u): sliding friction in N for the direction sigma at the velocity v, and u = exp(-sigma v/v_s)."""
    u = jnp.exp(-sigma * v / rig.v_s)
    return sigma * (0.5 * rig.F_b) * (1.0 + u), u


def spring_force(rig: Rig, state: State, contact: jax.Array) -> jax.Array:
    """f in N: springs, support and damper, what the rod puts on the capsule."""
    return rig.k1 * state.r + rig.c * state.w + jnp.where(contact, rig.k2, 0.0) * state.d


def series(rig: Rig, state: State, mode: Mode, left: jax.Array) -> Motion:
    """Series of degree ORDER about the state, in the mode; left (L,) s bounds the step."""
    sliding = mode.sigma != 0.0
    stiffness = rig.k1 + jnp.where(mode.contact, rig.k2, 0.0)
    F0, u0 = friction(rig, mode.sigma, state.v)
    f0 = spring_force(rig, state, mode.contact)
    F_rate = jnp.where(sliding, u0 * jnp.abs(f0 - F0) / (rig.m2 * rig.v_s), 0.0)
    rate, rate_left = jax.lax.stop_gradient((step_rate(rig, mode, F_rate), 1.0 / left))
    h = 1.0 / jnp.maximum(rate, rate_left)
    half, m2 = mode.sigma * (0.5 * rig.F_b), jnp.where(sliding, over(rig.m2, h), jnp.inf)
    m1, v_s, turn = over(rig.m1, h), jnp.where(sliding, -mode.sigma * rig.v_s, jnp.inf), -((rig.Omega * h) ** 2)
    D: Series = [rig.P_d * state.C, -rig.P_d * rig.Omega * h * state.S]
    d, w, v, f = [state.d], [state.w], [state.v], [f0]
    F, u = F0, [u0]
    for k in range(ORDER):
        if k > 0:
            d.append(h * w[k - 1] * (1.0 / k))
            f.append(stiffness * d[k] + rig.c * w[k])
            product = sum((j * v[j] * u[k - j] for j in range(2, k + 1)), v[1] * u[k - 1])
            u.append(over(product, k * v_s))
            F = half * u[k]
        if k > 1:
            D.append(D[k - 2] * turn * (1.0 / (k * (k - 1))))
        v.append(over(f[k] - F, m2 * (k + 1)))
        w.append(over(D[k] - f[k], m1 * (k + 1)) - v[k + 1])
    d.append(h * w[ORDER - 1] * (1.0 / ORDER))
    f.append(stiffness * d[ORDER] + rig.c * w[ORDER])
    return Motion(h, rate_left >= rate, w, v, d, f)


def size(p: Series, s: jax.Array | float = 1.0) -> jax.Array:
    """Size of a motion from its leading coefficients, taken up to the scaled time s."""
    return horner([jnp.abs(x) for x in p[:LEADING]], s) + VANISHING


def trusted(motion: Motion) -> jax.Array:
    """(L,) the s <= 1 up to which the series of w and v hold to SERIES_TOLERANCE of their leading terms' size."""
    last = [jnp.maximum(jnp.abs(p[-1]), jnp.abs(p[-2])) / size(p) for p in (motion.w, motion.v)]
    excess = jnp.maximum(jnp.maximum(*last), SERIES_TOLERANCE) / SERIES_TOLERANCE
    return jnp.exp(jnp.log(excess) * (-1.0 / (ORDER - 1)))


def horner(p: Series, s: jax.Array | float) -> jax.Array:
    """Value of the polynomial with coefficients p at s."""
    value = p[-1]
    for x in reversed(p[:-1]):
        value = value * s + x
    return value


def gain(p: Series, s: jax.Array) -> jax.Array:
    """Increase of the polynomial from 0 to s > 0."""
    return over(horner(p[1:], s), 1.0 / s)


def mean(p: Series, s: jax.Array) -> jax.Array:
    """Mean of the polynomial over 0..s."""
    return horner([x * (1.0 / (k + 1)) for k, x in enumerate(p)], s)


def advance(rig: Rig, state: State, motion: Motion, s: jax.Array) -> State:
    """The state at the scaled time s of the step."""
    per = 1.0 / (motion.h * s)
    t, way, X2 = state.t + motion.h * s, over(mean(motion.w, s), per), state.X2 + over(mean(motion.v, s), per)
    w, v = state.w + gain(motion.w, s), state.v + gain(motion.v, s)
    return State(t, state.r + way, state.d + way, w, X2, v, *cos_sin(rig.Omega * t + rig.phase))
