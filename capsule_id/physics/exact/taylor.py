"""Taylor series of the capsule's motion inside one mode, and how far they hold.

Inside a mode (contact or not, stuck, forward or backward) the field is linear but for friction and the drive, so the
coefficients follow from each other order by order. All arrays are (L,), a value per lane; a series is a list of
coefficients in the scaled time s = (t - t0)/h. Written in relative coordinates, which lose no digits when the capsule
has travelled far:

    r = X1 - X2,  d = r - G (penetration of the support spring if positive),  w = r' = d' = Y1 - Y2,  X2,  v = Y2

r and d are carried side by side: one is exactly 0 at the gap, the other keeps its digits where the gap is wide. So is
b = r + G_back where there is a back spring. What a capsule lacks is None: its terms are not in the compiled program.
"""

from typing import Any, NamedTuple

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
# A gap that is infinite counts as this wide, m: no run reaches it.
OUT_OF_REACH = 1e6
# Sizes of motions, in m or m/s, are never smaller than this: it keeps their quotients away from underflow.
VANISHING = 1e-150


class Constants(NamedTuple):
    """What is constant along a run, every leaf (L,), SI: parameters, drive, friction law and its break-away forces.

    F_forward, F_backward : N; the capsule is stuck while Y2 = 0 and -F_backward <= force on it <= F_forward
    k2, k2_back, k_cubic, c2, reaction : None where the spring, the term or the force is absent
    downhill : weights of rod and capsule along the slope, N, towards -X; None on level ground
    """

    m1: jax.Array
    m2: jax.Array
    k1: jax.Array
    k2: jax.Array | None
    c: jax.Array
    G: jax.Array
    drive: Drive
    law: FrictionLaw
    F_forward: jax.Array
    F_backward: jax.Array
    k_cubic: jax.Array | None = None
    c2: jax.Array | None = None
    k2_back: jax.Array | None = None
    G_back: jax.Array | None = None
    reaction: jax.Array | None = None
    downhill: tuple[jax.Array, jax.Array] | None = None


class CapsuleState(NamedTuple):
    """Time (s), relative state (m, m/s), the drive's state there; every leaf (L,). b is None without a back spring."""

    t: jax.Array
    r: jax.Array
    d: jax.Array
    w: jax.Array
    X2: jax.Array
    v: jax.Array
    drive: tuple[jax.Array, ...]
    b: jax.Array | None = None


class Mode(NamedTuple):
    """Discrete choices: contact (bool), sigma (+1.0 forward, -1.0 backward, 0.0 stuck), every leaf (L,).

    back : (bool) contact with the back spring; None without one
    """

    contact: jax.Array
    sigma: jax.Array
    back: jax.Array | None = None


class StepSeries(NamedTuple):
    """One step's series in s: w, v, d (as the state) and f, the force on the capsule; h (L,) s is the unit of time.

    last : (L,) bool, s = 1 is the time at which the step had to end
    """

    h: jax.Array
    last: jax.Array
    w: Series
    v: Series
    d: Series
    f: Series


def constants_of(p: CapsuleParameters, e: Drive, law: FrictionLaw) -> Constants:
    """The constants of a run from lanes of parameters, drive and friction law."""
    m1, m2, k1, c = (jnp.asarray(leaf) for leaf in (p.m1, p.m2, p.k1, p.c))
    still = jnp.zeros_like(m1)
    F_forward, F_backward = (jnp.broadcast_to(F, still.shape) for F in (law.forward(still), law.backward(still)))
    k2, G = _contact(p.k2, p.G)
    k2_back, G_back = _contact(p.k2_back, p.G_back)
    c2 = None if k2 is None or p.c2 is None else jnp.where(k2 > 0.0, p.c2, 0.0)
    downhill = None
    if p.slope is not None:
        along = jnp.asarray(p.g * jnp.sin(p.slope))
        downhill = m1 * along, m2 * along
    k_cubic = None if p.k_cubic is None else jnp.asarray(p.k_cubic)
    general = (k_cubic, c2, k2_back, G_back, e.reaction, downhill)
    return Constants(m1, m2, k1, k2, c, still if G is None else G, e, law, F_forward, F_backward, *general)


def _contact(stiffness: Any, gap: Any) -> tuple[jax.Array | None, jax.Array | None]:
    """Stiffness and gap of a spring, both None where it is absent; an infinite gap becomes a wide one."""
    if stiffness is None or gap is None:
        return None, None
    within_reach = jnp.isfinite(gap)
    return jnp.where(within_reach, stiffness, 0.0), jnp.where(within_reach, gap, OUT_OF_REACH)


def step_rate(constants: Constants, state: CapsuleState, mode: Mode, friction_rate: jax.Array) -> jax.Array:
    """(L,) 1/s: inverse of a step of the order of the mode's fastest time scale, beyond which no series is worth it."""
    free = jnp.zeros_like(constants.m1) if constants.drive.prescribed else 1.0 / constants.m1
    compliance = free + jnp.where(mode.sigma != 0.0, 1.0 / constants.m2, 0.0)
    stiffness = jnp.abs(tangent_stiffness(constants, mode, state.r))
    oscillation = jnp.sqrt(stiffness * compliance)
    damping = damping_of(constants, mode.contact)
    return (oscillation + damping * compliance + constants.drive.rate(state.drive) + friction_rate) / STEP_GUESS


def stiffness_of(constants: Constants, mode: Mode) -> jax.Array:
    """(L,) N/m: df/dr in the mode, but for the cubic spring."""
    stiffness = constants.k1
    if constants.k2 is not None:
        stiffness = stiffness + jnp.where(mode.contact, constants.k2, 0.0)
    if constants.k2_back is not None and mode.back is not None:
        stiffness = stiffness + jnp.where(mode.back, constants.k2_back, 0.0)
    return stiffness


def tangent_stiffness(constants: Constants, mode: Mode, r: jax.Array) -> jax.Array:
    """(L,) N/m: df/dr in the mode at r (L,)."""
    stiffness = stiffness_of(constants, mode)
    return stiffness if constants.k_cubic is None else stiffness + 3.0 * constants.k_cubic * r * r


def damping_of(constants: Constants, contact: jax.Array) -> jax.Array:
    """(L,) N s/m: df/dw in the mode."""
    return constants.c if constants.c2 is None else constants.c + jnp.where(contact, constants.c2, 0.0)


def rod_force(constants: Constants, state: CapsuleState, mode: Mode) -> jax.Array:
    """f in N in the mode: springs, supports and dampers, what the rod puts on the capsule."""
    f = spring_and_damper(constants, state.r, state.w)
    if constants.k2 is not None:
        f = f + jnp.where(mode.contact, constants.k2, 0.0) * state.d
    if constants.c2 is not None:
        f = f + jnp.where(mode.contact, constants.c2, 0.0) * state.w
    if constants.k2_back is not None and state.b is not None and mode.back is not None:
        f = f + jnp.where(mode.back, constants.k2_back, 0.0) * state.b
    return f


def force_on_capsule(constants: Constants, f: jax.Array, drive: tuple[jax.Array, ...]) -> jax.Array:
    """Force along the ground on the capsule, N, but for friction: f, the reaction of the drive, the slope."""
    if constants.reaction is not None:
        f = f - constants.reaction * constants.drive.value(drive)
    return f if constants.downhill is None else f - constants.downhill[1]


def rod_rate(constants: Constants, f: jax.Array, drive: tuple[jax.Array, ...]) -> jax.Array:
    """Y1' in m/s^2."""
    force = constants.drive.value(drive)
    if constants.drive.prescribed:
        return force
    net = force - f
    return (net if constants.downhill is None else net - constants.downhill[0]) / constants.m1


def series(constants: Constants, state: CapsuleState, mode: Mode, left: jax.Array) -> StepSeries:
    """Series of degree DEGREE about the state, in the mode; left (L,) s bounds the step."""
    sliding = mode.sigma != 0.0
    stiffness, damping = stiffness_of(constants, mode), damping_of(constants, mode.contact)
    friction = friction_series(constants.law, mode.sigma, state.v, (constants.F_forward, constants.F_backward))
    f0 = rod_force(constants, state, mode)
    on_capsule = force_on_capsule(constants, f0, state.drive)
    friction_rate = friction.rate((on_capsule - friction.start) / constants.m2, constants.m2)
    guess = step_rate(constants, state, mode, jnp.where(sliding, friction_rate, 0.0))
    rate, rate_left = jax.lax.stop_gradient((guess, 1.0 / left))
    h = 1.0 / jnp.maximum(rate, rate_left)
    m1, m2 = divide(constants.m1, h), jnp.where(sliding, divide(constants.m2, h), jnp.inf)
    D = constants.drive.series(state.drive, h, DEGREE + 1)
    cubic = None if constants.k_cubic is None else _Cubic(constants, state.r)
    d, w, v, f = [state.d], [state.w], [state.v], [f0]
    # The force on the capsule; the list of f itself where nothing is added to f.
    total = f if on_capsule is f0 else [on_capsule]

    def extend(k: int) -> None:
        """Coefficient k of the forces from those of d and w."""
        f.append(stiffness * d[k] + damping * w[k])
        if cubic is not None:
            f[k] = f[k] + cubic.extend(d)
        if total is not f:
            total.append(f[k] if constants.reaction is None else f[k] - constants.reaction * D[k])

    for k in range(DEGREE):
        if k > 0:
            d.append(h * w[k - 1] * (1.0 / k))
            extend(k)
        F = friction.extend(v) if k > 0 else friction.start
        v.append(divide(total[k] - F, m2 * (k + 1)))
        if constants.drive.prescribed:
            w.append(h * D[k] * (1.0 / (k + 1)) - v[k + 1])
        else:
            net = D[k] - f[k] if constants.downhill is None or k > 0 else D[k] - f[k] - constants.downhill[0]
            w.append(divide(net, m1 * (k + 1)) - v[k + 1])
    d.append(h * w[DEGREE - 1] * (1.0 / DEGREE))
    extend(DEGREE)
    return StepSeries(h, rate_left >= rate, w, v, d, total)


class _Cubic:
    """Series of k_cubic r^3 by two Cauchy products an order; the constant term is in f already."""

    def __init__(self, constants: Constants, r: jax.Array) -> None:
        # r^2 is kept over m2: see series.py on divisions.
        self.m2, self.r, self.square = constants.m2, r, [divide(r * r, constants.m2)]
        self.stiffness = jnp.asarray(constants.k_cubic) * constants.m2

    def extend(self, d: Series) -> jax.Array:
        """Coefficient k = len(d) - 1; r and d differ in their first coefficient only."""
        r, k = [self.r, *d[1:]], len(d) - 1
        self.square.append(divide(sum((r[j] * r[k - j] for j in range(1, k + 1)), r[0] * r[k]), self.m2))
        return self.stiffness * sum((self.square[j] * r[k - j] for j in range(1, k + 1)), self.square[0] * r[k])


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
    dt = step.h * s
    per = 1.0 / dt
    t, way, X2 = state.t + dt, divide(mean(step.w, s), per), state.X2 + divide(mean(step.v, s), per)
    w, v = state.w + increase(step.w, s), state.v + increase(step.v, s)
    drive = constants.drive.advanced(state.drive, t, dt)
    return CapsuleState(t, state.r + way, state.d + way, w, X2, v, drive, None if state.b is None else state.b + way)
