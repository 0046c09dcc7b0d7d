"""Taylor series of the motion inside one mode, and the changes of mode on a step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.jet import jet

from capsule_id.physics.drive import Drive
from capsule_id.physics.forces import spring_and_damper
from capsule_id.physics.friction import (
    DEGREE,
    FrictionLaw,
    FrictionSeries,
    Series,
    divide,
    horner,
    increase,
    mean,
    sliding_friction,
)
from capsule_id.physics.model import CapsuleParameters

# friction series: Taylor coefficients of friction along a step, for a law that is known only as functions of speed.
#
# With R the law in the direction of motion and x(s) the speed, the chain rule gives one recursion per derivative of R:
#
#     G_n(s) = R^(n)(x(s)),   G_n' = G_(n+1) x'   ->   k G_n[k] = sum over j = 1..k of j x_j G_(n+1)[k - j]
#
# It starts from R^(n) at the speed of the step's start, by Taylor-mode differentiation, so it is exact to rounding.


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


# taylor: Taylor series of the capsule's motion inside one mode, and how far they hold.
#
# Inside a mode (contact or not, stuck, forward or backward) the field is linear but for friction and the drive, so the
# coefficients follow from each other order by order. All arrays are (L,), a value per lane; a series is a list of
# coefficients in the scaled time s = (t - t0)/h. Written in relative coordinates, which lose no digits when the capsule
# has travelled far:
#
#     r = X1 - X2,  d = r - G (penetration of the support spring if positive),  w = r' = d' = Y1 - Y2,  X2,  v = Y2
#
# r and d are carried side by side: one is exactly 0 at the gap, the other keeps its digits where the gap is wide. So is
# b = r + G_back where there is a back spring. What a capsule lacks is None: its terms are not in the compiled program.


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


# events: Changes of mode: where on a step the first one lies, and which mode follows.
#
# In a mode these functions must stay >= 0: the gap's (d in contact, -d out of it), that of the back gap, and, while
# sliding, the velocity in the mode's direction, or, while stuck, F_forward - f and F_backward + f, f the force on the
# capsule. Each is a linear combination of the series of the step, so it is a polynomial in s. What is absent is not
# watched. Switching times of the drive are known: they end a step (``SWITCH``) and need no search.


# Kinds of events.
NONE, GAP, VELOCITY, UPPER, LOWER, BACK, SWITCH = 0, 1, 2, 3, 4, 5, 6
# The march arrives when its next leap is this small a part of the step, or, at a root that is crossed at a definite
# rate, when a leap below SURE_LEAP agrees with Newton's to SURE_AGREEMENT: the correction in ``correct`` does the rest.
LEAP_TOLERANCE = 1e-9
SURE_LEAP, SURE_AGREEMENT = 1e-3, 1e-4
# Leaps on one step. Where they do not suffice (a root closely missed) the step ends early, with nothing lost.
MAX_LEAPS = 100
# An event is met at a fraction of the step no smaller than this, so that time always goes on; ``correct`` steps back.
SMALLEST_FRACTION = 1e-9
# Coefficients of an event function below this part of its size are rounding, where only their sign would matter.
ROUNDING_NOISE = 1e-14
# |f| within this many roundings of the break-away force counts as at the threshold; the rate of |f| then decides.
THRESHOLD_ROUNDINGS = 16.0


def _divided(p: Series, s_end: jax.Array) -> Series:
    """p over that power of s which removes the root at s = 0, where p(0) = 0 exactly, as right after an event.

    There the next coefficients, if they are mere rounding, are taken as 0 too: at an onset of slip the first rate is.
    """
    scale, zero = size(p, s_end), jnp.zeros_like(p[0])
    once = p[0] == 0.0
    twice = once & (jnp.abs(p[1]) * s_end / scale <= ROUNDING_NOISE)
    thrice = twice & (jnp.abs(p[2]) * s_end**2 / scale <= ROUNDING_NOISE)
    q = [*p, zero, zero, zero]
    return [
        jnp.where(thrice, q[k + 3], jnp.where(twice, q[k + 2], jnp.where(once, q[k + 1], q[k]))) for k in range(len(p))
    ]


class _Watched(NamedTuple):
    """An event function p, scaled to size 1, and its bend: p(0) + p'(0) s - bend s^2 <= p(s), anywhere on the step."""

    value: Series
    slope: Series
    scale: jax.Array
    p2: jax.Array
    rest: jax.Array

    def at(self, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(p, p') at s; the divisions keep XLA from evaluating them once per use."""
        return horner(self.value, s) / self.scale, horner(self.slope, s) / self.scale


def _watched(p: Series, level: jax.Array, s_end: jax.Array) -> _Watched:
    """p with p_2 - rest <= p''/2 <= p_2 + rest on 0..s_end; level is a constant that p is compared with."""
    power, rest = s_end, jnp.zeros_like(s_end)
    for k in range(3, len(p)):
        rest = rest + (0.5 * k * (k - 1)) * jnp.abs(p[k]) * power
        power = power * s_end
    scale = level + size(p)
    return _Watched(p, [k * x for k, x in enumerate(p)][1:], scale, p[2] / scale, rest / scale)


def _leap(p0: jax.Array, p1: jax.Array, bend: jax.Array) -> jax.Array:
    """First root tau >= 0 of the minorant p0 + p1 tau - bend tau^2, inf where it has none: p has no root before."""
    p0 = jnp.maximum(p0, 0.0)
    root2 = p1 * p1 + 4.0 * bend * p0
    root = jnp.sqrt(jnp.maximum(root2, 0.0))
    falling = p1 < 0.0
    tau = jnp.where(falling, 2.0 * p0, p1 + root) / jnp.where(falling, root - p1, 2.0 * bend)
    return jnp.where(jnp.where(falling, root2 >= 0.0, bend > 0.0), tau, jnp.inf)


def _sure(p0: jax.Array, p1: jax.Array, tau: jax.Array) -> jax.Array:
    """Whether the leap tau differs so little from Newton's that the root is certain and simple."""
    return jnp.abs(p0 + p1 * tau) <= SURE_AGREEMENT * p0


def first_event(
    constants: Constants, mode: Mode, step: StepSeries, b: jax.Array | None, s_end: jax.Array, active: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(s, kind): where the step ends and why; s = s_end and NONE if nothing happens before.

    Marches from the left, each leap to the root of a quadratic minorant of each event function on what is left of the
    step, so no root can be passed, double ones included. b (L,) m: the back gap at the start of the step.
    """
    sliding = mode.sigma != 0.0
    middle = 0.5 * (constants.F_forward - constants.F_backward)
    level = jnp.where(sliding, 0.0, 0.5 * (constants.F_forward + constants.F_backward))
    gaps = []
    if constants.k2 is not None:
        gaps.append((GAP, _gap([jnp.where(mode.contact, x, -x) for x in step.d], s_end)))
    if mode.back is not None and b is not None:
        gaps.append((BACK, _gap([jnp.where(mode.back, -x, x) for x in (b, *step.d[1:])], s_end)))
    speed = _divided([mode.sigma * x for x in step.v], s_end)
    # While stuck level - (f - middle) and level + (f - middle), while sliding sigma Y2, written as level + sign * p.
    force = [step.f[0] - middle, *step.f[1:]]
    other = _watched([jnp.where(sliding, a, -b) for a, b in zip(speed, force, strict=True)], level, s_end)
    base = level / other.scale

    def leap(carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        s, kind, going, leaps = carry
        p0, p1 = other.at(s)
        to_upper = _leap(base + p0, p1, other.rest - other.p2)
        to_lower = jnp.where(sliding, jnp.inf, _leap(base - p0, -p1, other.rest + other.p2))
        tau, sign = jnp.minimum(to_upper, to_lower), jnp.where(to_upper <= to_lower, 1.0, -1.0)
        sure = _sure(base + sign * p0, sign * p1, tau)
        which = jnp.where(sliding, VELOCITY, jnp.where(sign > 0.0, UPPER, LOWER))
        for gap_kind, gap in reversed(gaps):
            g0, g1 = gap.at(s)
            to_gap = _leap(g0, g1, gap.rest - gap.p2)
            is_gap, tau = to_gap <= tau, jnp.minimum(to_gap, tau)
            sure, which = jnp.where(is_gap, _sure(g0, g1, tau), sure), jnp.where(is_gap, gap_kind, which)
        arrived = tau <= jnp.where(sure, SURE_LEAP, LEAP_TOLERANCE) * s_end
        kind = jnp.where(going & arrived, which, kind)
        onward = s + tau
        return (
            jnp.where(going, jnp.minimum(onward, s_end), s),
            kind,
            going & ~arrived & (onward < s_end),
            leaps + 1,
        )

    start = (jnp.zeros_like(s_end), jnp.zeros(s_end.shape, jnp.int32), active, jnp.int32(0))
    s, kind, _, _ = jax.lax.while_loop(lambda carry: jnp.any(carry[2]) & (carry[3] < MAX_LEAPS), leap, start)
    return jnp.clip(s, SMALLEST_FRACTION * s_end, s_end), kind


def _gap(p: Series, s_end: jax.Array) -> _Watched:
    """The event function of a gap: p, without its root at the start of the step."""
    return _watched(_divided(p, s_end), jnp.zeros_like(s_end), s_end)


def motion_at(constants: Constants, state: CapsuleState, mode: Mode, kind: jax.Array) -> jax.Array:
    """(L,) sigma of the mode that follows from a state: the sign of v or, where v = 0, that of f if it breaks away.

    mode : the contacts; its sigma does not matter
    kind : (L,) the event; after UPPER or LOWER f is at the threshold of a capsule at rest, whatever rounding says

    f is the force on the capsule but for friction.
    """
    spring_force = rod_force(constants, state, mode)
    f = force_on_capsule(constants, spring_force, state.drive)
    w_rate = rod_rate(constants, spring_force, state.drive)
    f_rate = force_rate(constants, state, mode, w_rate)
    onset = (kind == UPPER) | (kind == LOWER)
    side = jnp.where(onset, jnp.where(kind == UPPER, 1.0, -1.0), jnp.sign(f))
    threshold = jnp.where(side < 0.0, constants.F_backward, constants.F_forward)
    tolerance = (_size_of_forces(constants, state, mode) + threshold) * THRESHOLD_ROUNDINGS * jnp.finfo(float).eps
    at_threshold = onset | (jnp.abs(jnp.abs(f) - threshold) <= tolerance)
    slips = jnp.where(at_threshold, side * f_rate > 0.0, jnp.abs(f) > threshold)
    # Without friction nothing ever sticks, and a force of zero leaves the direction to its rate, then to the rod's.
    free = (constants.F_forward == 0.0) & (constants.F_backward == 0.0)
    later = jnp.where(f_rate != 0.0, jnp.sign(f_rate), jnp.where(w_rate < 0.0, -1.0, 1.0))
    direction = jnp.where(free & (jnp.abs(f) <= tolerance), later, side)
    sigma = jnp.where(slips | free, direction, 0.0)
    return jnp.where(state.v != 0.0, jnp.sign(state.v), sigma)


def force_rate(constants: Constants, state: CapsuleState, mode: Mode, w_rate: jax.Array) -> jax.Array:
    """(L,) N/s: rate of the force on the capsule but for friction; w_rate (L,) m/s^2, the rate of w."""
    rate = tangent_stiffness(constants, mode, state.r) * state.w + damping_of(constants, mode.contact) * w_rate
    if constants.reaction is None:
        return rate
    return rate - constants.reaction * constants.drive.series(state.drive, jnp.ones_like(rate), 2)[1]


def _size_of_forces(constants: Constants, state: CapsuleState, mode: Mode) -> jax.Array:
    """(L,) N: sum of the magnitudes of the forces on the capsule, which its rounding scales with."""
    terms = [constants.k1 * state.r, constants.c * state.w]
    if constants.k_cubic is not None:
        terms.append(constants.k_cubic * state.r**3)
    if constants.k2 is not None:
        terms.append(jnp.where(mode.contact, constants.k2, 0.0) * state.d)
    if constants.c2 is not None:
        terms.append(constants.c2 * state.w)
    if constants.k2_back is not None and state.b is not None and mode.back is not None:
        terms.append(jnp.where(mode.back, constants.k2_back, 0.0) * state.b)
    if constants.reaction is not None:
        terms.append(constants.reaction * constants.drive.value(state.drive))
    if constants.downhill is not None:
        terms.append(constants.downhill[1])
    return sum((jnp.abs(x) for x in terms[1:]), jnp.abs(terms[0]))


def mode_at(constants: Constants, state: CapsuleState) -> Mode:
    """The mode that any state begins in: signs of d, b, v and, where they are 0, of their first rate that is not."""
    meeting = (state.d > 0.0) | ((state.d == 0.0) & (state.w > 0.0))
    if constants.k2 is None:
        meeting = jnp.zeros_like(meeting)
    leaning = None if state.b is None else (state.b < 0.0) | ((state.b == 0.0) & (state.w < 0.0))
    sigma = motion_at(constants, state, Mode(meeting, jnp.zeros_like(state.v), leaning), jnp.full(state.d.shape, NONE))
    free = Mode(jnp.zeros_like(meeting), sigma, None if leaning is None else jnp.zeros_like(leaning))
    spring_force = rod_force(constants, state, free)
    f = force_on_capsule(constants, spring_force, state.drive)
    a2 = jnp.where(sigma != 0.0, (f - sliding_friction(constants.law, sigma, state.v)) / constants.m2, 0.0)
    w_rate = rod_rate(constants, spring_force, state.drive) - a2
    touching = (state.d == 0.0) & (state.w == 0.0) & (w_rate > 0.0)
    contact = meeting if constants.k2 is None else meeting | touching
    if leaning is None or state.b is None:
        return Mode(contact, sigma)
    return Mode(contact, sigma, leaning | ((state.b == 0.0) & (state.w == 0.0) & (w_rate < 0.0)))
