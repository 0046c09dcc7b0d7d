"""Taylor series of the capsule's motion inside one mode, and how far they hold.

Inside a mode (contact or not, stuck, forward or backward) the field is linear but for friction and the drive, so the
coefficients follow from each other order by order. All arrays are (L,), a value per lane; a series is a list of
coefficients in the scaled time s = (t - t0)/h. Written in relative coordinates, which lose no digits when the capsule
has travelled far:

    r = X1 - X2,  d = r - G (penetration of the support spring if positive),  w = r' = d' = Y1 - Y2,  X2,  v = Y2

r and d are carried side by side: one is exactly 0 at the gap, the other keeps its digits where the gap is wide.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from capsule_id.physics.drive import Drive
from capsule_id.physics.exact.friction_series import friction_series
from capsule_id.physics.forces import spring_and_damper
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters
from capsule_id.physics.series import DEGREE, Series, divide, horner, increase, mean

# A step ends where the last coefficients of the series, relative to the sum of all, would exceed this.
SERIES_TOLERANCE = 1e-9
# First guess of a step, in units of the fastest time scale of the mode; the coefficients then cut it.
STEP_GUESS = 3.0
# Leading coefficients that measure the size of a motion; later ones may be large only because the guess was.
LEADING = 4
# Sizes of motions, in m or m/s, are never smaller than this: it keeps their quotients away from underflow.
VANISHING = 1e-150


class Constants(NamedTuple):
    """What is constant along a run, every leaf (L,), SI: parameters, drive, friction law and its break-away forces.

    F_forward, F_backward : N; the capsule is stuck while Y2 = 0 and -F_backward <= f <= F_forward
    """

    m1: jax.Array
    m2: jax.Array
    k1: jax.Array
    k2: jax.Array
    c: jax.Array
    G: jax.Array
    drive: Drive
    law: FrictionLaw
    F_forward: jax.Array
    F_backward: jax.Array


class CapsuleState(NamedTuple):
    """Time (s), relative state (m, m/s), the drive's state there; every leaf (L,)."""

    t: jax.Array
    r: jax.Array
    d: jax.Array
    w: jax.Array
    X2: jax.Array
    v: jax.Array
    drive: tuple[jax.Array, ...]


class Mode(NamedTuple):
    """Discrete choices: contact (bool), sigma (+1.0 forward, -1.0 backward, 0.0 stuck), every leaf (L,)."""

    contact: jax.Array
    sigma: jax.Array


class StepSeries(NamedTuple):
    """One step's series in s: w, v, d (as the state) and f, the force of the rod; h (L,) s is the unit of time.

    last : (L,) bool, s = 1 is the end of the run
    """

    h: jax.Array
    last: jax.Array
    w: Series
    v: Series
    d: Series
    f: Series


def constants_of(p: CapsuleParameters, e: Drive, law: FrictionLaw) -> Constants:
    """The constants of a run from lanes of parameters, drive and friction law."""
    m1, m2, k1, k2, c, G = (jnp.asarray(leaf) for leaf in (p.m1, p.m2, p.k1, p.k2, p.c, p.G))
    still = jnp.zeros_like(m1)
    F_forward, F_backward = (jnp.broadcast_to(F, still.shape) for F in (law.forward(still), law.backward(still)))
    return Constants(m1, m2, k1, k2, c, G, e, law, F_forward, F_backward)


def step_rate(constants: Constants, mode: Mode, friction_rate: jax.Array) -> jax.Array:
    """(L,) 1/s: inverse of a step of the order of the mode's fastest time scale, beyond which no series is worth it."""
    compliance = 1.0 / constants.m1 + jnp.where(mode.sigma != 0.0, 1.0 / constants.m2, 0.0)
    oscillation = jnp.sqrt(stiffness_of(constants, mode.contact) * compliance)
    return (oscillation + constants.c * compliance + constants.drive.rate() + friction_rate) / STEP_GUESS


def stiffness_of(constants: Constants, contact: jax.Array) -> jax.Array:
    """(L,) N/m: df/dr in the mode."""
    return constants.k1 + jnp.where(contact, constants.k2, 0.0)


def rod_force(constants: Constants, state: CapsuleState, contact: jax.Array) -> jax.Array:
    """f in N in the mode: springs, support and damper, what the rod puts on the capsule."""
    held = spring_and_damper(constants, state.r, state.w)
    return held + jnp.where(contact, constants.k2, 0.0) * state.d


def series(constants: Constants, state: CapsuleState, mode: Mode, left: jax.Array) -> StepSeries:
    """Series of degree DEGREE about the state, in the mode; left (L,) s bounds the step."""
    sliding = mode.sigma != 0.0
    stiffness = stiffness_of(constants, mode.contact)
    friction = friction_series(constants.law, mode.sigma, state.v, (constants.F_forward, constants.F_backward))
    f0 = rod_force(constants, state, mode.contact)
    friction_rate = friction.rate((f0 - friction.start) / constants.m2, constants.m2)
    guess = step_rate(constants, mode, jnp.where(sliding, friction_rate, 0.0))
    rate, rate_left = jax.lax.stop_gradient((guess, 1.0 / left))
    h = 1.0 / jnp.maximum(rate, rate_left)
    m1, m2 = divide(constants.m1, h), jnp.where(sliding, divide(constants.m2, h), jnp.inf)
    D = constants.drive.series(state.drive, h, DEGREE)
    d, w, v, f = [state.d], [state.w], [state.v], [f0]
    for k in range(DEGREE):
        if k > 0:
            d.append(h * w[k - 1] * (1.0 / k))
            f.append(stiffness * d[k] + constants.c * w[k])
        F = friction.extend(v) if k > 0 else friction.start
        v.append(divide(f[k] - F, m2 * (k + 1)))
        w.append(divide(D[k] - f[k], m1 * (k + 1)) - v[k + 1])
    d.append(h * w[DEGREE - 1] * (1.0 / DEGREE))
    f.append(stiffness * d[DEGREE] + constants.c * w[DEGREE])
    return StepSeries(h, rate_left >= rate, w, v, d, f)


def size(p: Series, s: jax.Array | float = 1.0) -> jax.Array:
    """Size of a motion from its leading coefficients, taken up to the scaled time s."""
    return horner([jnp.abs(x) for x in p[:LEADING]], s) + VANISHING


def trusted(step: StepSeries) -> jax.Array:
    """(L,) the s <= 1 up to which the series of w and v hold to SERIES_TOLERANCE of their leading terms' size."""
    last = [jnp.maximum(jnp.abs(p[-1]), jnp.abs(p[-2])) / size(p) for p in (step.w, step.v)]
    excess = jnp.maximum(jnp.maximum(*last), SERIES_TOLERANCE) / SERIES_TOLERANCE
    return jnp.exp(jnp.log(excess) * (-1.0 / (DEGREE - 1)))


def advance(constants: Constants, state: CapsuleState, step: StepSeries, s: jax.Array) -> CapsuleState:
    """The state at the scaled time s of the step."""
    per = 1.0 / (step.h * s)
    t, way, X2 = state.t + step.h * s, divide(mean(step.w, s), per), state.X2 + divide(mean(step.v, s), per)
    w, v = state.w + increase(step.w, s), state.v + increase(step.v, s)
    return CapsuleState(t, state.r + way, state.d + way, w, X2, v, constants.drive.state(t))
