"""Taylor series of the motion inside one mode, and the changes of mode on a step."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.jet import jet

from capsule_id.errors import InputError
from capsule_id.parameters import SAME
from capsule_id.physics.forces import (
    DEGREE,
    Force,
    FrictionLaw,
    FrictionSeries,
    Series,
    along_ground,
    divide,
    forces_of,
    horner,
    increase,
    mean,
    sliding_friction,
    total,
    weights_along,
)
from capsule_id.physics.model import CapsuleParameters, Drive

# friction series: Taylor coefficients of friction along a step, for a law that is known only as functions of speed.
#
# With R the law in the direction of motion and x(s) the speed, the chain rule gives one recursion per derivative of R:
#
#     G_n(s) = R^(n)(x(s)),   G_n' = G_(n+1) x'   ->   k G_n[k] = sum over j = 1..k of j x_j G_(n+1)[k - j]
#
# It starts from R^(n) at the speed of the step's start, by Taylor-mode differentiation, so it is exact to rounding.


def by_chain_rule(law: FrictionLaw, sigma: jax.Array, v: jax.Array) -> FrictionSeries:
    """Friction from the velocity v (L,), m/s, on, in the direction sigma (L,), from the law's derivatives there."""
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


# forces: Their Taylor series, from the formulas of their classes.


class Taylor:
    """A power series whose coefficients follow from those of others, order by order.

    It has +, - and * with series, numbers and arrays, and whole powers. Anything else done to it is a ``TypeError``.

    rule : k -> coefficient k, asked once for each k in order        unit : (L,) 1.0, known at run time only
    """

    # Arithmetic of NumPy arrays is left to the methods below; a comparison is an error too.
    __array_ufunc__ = __eq__ = __bool__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self, rule: Callable[[int], Any], unit: jax.Array) -> None:
        self.rule, self.unit, self.known = rule, unit, []

    def __getitem__(self, k: int) -> Any:
        while len(self.known) <= k:
            self.known.append(self.rule(len(self.known)))
        return self.known[k]

    def __add__(self, other: Any) -> "Taylor":
        if isinstance(other, Taylor):
            return Taylor(lambda k: self[k] + other[k], self.unit)
        return Taylor(lambda k: self[0] + other if k == 0 else self[k], self.unit)

    def __mul__(self, other: Any) -> "Taylor":
        if not isinstance(other, Taylor):
            return Taylor(lambda k: self[k] * other, self.unit)
        return Taylor(lambda k: divide(total(self[j] * other[k - j] for j in range(k + 1)), self.unit), self.unit)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "Taylor":
        return -1.0 * self

    def __sub__(self, other: Any) -> "Taylor":
        return self + -1.0 * other

    def __rsub__(self, other: Any) -> "Taylor":
        return -1.0 * self + other

    def __pow__(self, n: Any) -> "Taylor":
        if not isinstance(n, int) or n < 1:
            return NotImplemented
        return self if n == 1 else self * self ** (n - 1)


def on_series(force: Force, d: Taylor, w: Taylor) -> Taylor:
    """The force, N, along +X on the capsule, from the series of d and w.

    Raises
    ------
    InputError
        A formula that a Taylor series does not have: the force need not be analytic.
    """
    try:
        found = force.side * (force.elastic(d) + force.damping(d, force.side * w))
    except TypeError:
        raise InputError(
            "the exact engine takes forces made of +, - and * and whole powers (int) of d and w only",
            f"the formulas of {type(force).__name__}",
            'use simulate with model="smooth", or engine = "smooth" in [model] for a fit',
        ) from None
    return found if isinstance(found, Taylor) else Taylor(lambda k: found if k == 0 else 0.0, d.unit)


# taylor: Taylor series of the capsule's motion inside one mode, and how far they hold.
#
# Inside a mode (contacts or not, stuck, forward or backward) the field is analytic and mostly linear, so the
# coefficients follow from each other order by order. All arrays are (L,), a value per lane; a series is a list of
# coefficients in the scaled time s = (t - t0)/h. Written in relative coordinates, which lose no digits when the capsule
# has travelled far:
#
#     r = X1 - X2,  gaps: d = side r - G of each contact (its penetration if positive),  w = r' = Y1 - Y2,  X2,  v = Y2
#
# r and each d are carried side by side: one is exactly 0 at the gap, the other keeps its digits where the gap is wide.
# What a capsule lacks is None or missing: its terms are not in the compiled program.


# A step ends where the last coefficients of the series, relative to the sum of all, would exceed this.
SERIES_TOLERANCE = 1e-9
# First guess of a step, in units of the fastest time scale of the mode; the coefficients then cut it.
STEP_GUESS = 3.0
# Leading coefficients that measure the size of a motion; later ones may be large only because the guess was.
LEADING = 4
# Sizes of motions, in m or m/s, are never smaller than this: it keeps their quotients away from underflow.
VANISHING = 1e-150


class Constants(NamedTuple):
    """What is constant along a run, every leaf (L,), SI: masses, forces, drive, friction law, its break-away forces.

    F_forward, F_backward : N; the capsule is stuck while Y2 = 0 and -F_backward <= force on it <= F_forward
    reaction : None where the force is absent
    downhill : weights of rod and capsule along the slope, N, towards -X; None on level ground
    """

    m1: jax.Array
    m2: jax.Array
    forces: tuple[Force, ...]
    drive: Drive
    law: FrictionLaw
    F_forward: jax.Array
    F_backward: jax.Array
    reaction: jax.Array | None = None
    downhill: tuple[jax.Array, jax.Array] | None = None

    @property
    def contacts(self) -> list[Force]:
        """The forces with a gap, in the order of the state's gaps and the mode's contacts."""
        return [force for force in self.forces if force.gap is not None]


class CapsuleState(NamedTuple):
    """Time (s), relative state (m, m/s), the piece of the drive, penetrations of the contacts (m); every leaf (L,)."""

    t: jax.Array
    r: jax.Array
    w: jax.Array
    X2: jax.Array
    v: jax.Array
    drive: tuple[jax.Array, ...]
    gaps: tuple[jax.Array, ...]


class Mode(NamedTuple):
    """Discrete choices: sigma (+1.0 forward, -1.0 backward, 0.0 stuck), contacts closed (bool); every leaf (L,)."""

    sigma: jax.Array
    contacts: tuple[jax.Array, ...]


class StepSeries(NamedTuple):
    """One step's series in s: w, v, r (as the state) and f, the force on the capsule; h (L,) s is the unit of time.

    last : (L,) bool, s = 1 is the time at which the step had to end
    """

    h: jax.Array
    last: jax.Array
    w: Series
    v: Series
    r: Series
    f: Series


def constants_of(p: CapsuleParameters, e: Drive, law: FrictionLaw) -> Constants:
    """The constants of a run from lanes of parameters, drive and friction law.

    Raises
    ------
    InputError
        A force of the user's own on a prescribed rod: no series of a motion would show where that of the force ends.
    """
    if p.forces and e.prescribed:
        raise InputError(
            "the exact engine takes no further forces where the motion of the rod is prescribed",
            ", ".join(type(force).__name__ for force in p.forces),
            'use simulate with model="smooth"',
        )
    m1, m2 = jnp.asarray(p.m1), jnp.asarray(p.m2)
    still = jnp.zeros_like(m1)
    F_forward, F_backward = (jnp.broadcast_to(F, still.shape) for F in (law.forward(still), law.backward(still)))
    forces = jax.tree.map(jnp.asarray, forces_of(p))
    return Constants(m1, m2, forces, e, law, F_forward, F_backward, e.reaction, weights_along(p))


def step_rate(constants: Constants, state: CapsuleState, mode: Mode, friction_rate: jax.Array) -> jax.Array:
    """(L,) 1/s: inverse of a step of the order of the mode's fastest time scale, beyond which no series is worth it."""
    free = jnp.zeros_like(constants.m1) if constants.drive.prescribed else 1.0 / constants.m1
    compliance = free + jnp.where(mode.sigma != 0.0, 1.0 / constants.m2, 0.0)
    stiffness, damping = slopes(constants, state, mode)
    oscillation = jnp.sqrt(jnp.abs(stiffness) * compliance)
    return (
        oscillation + damping * compliance + constants.drive.rate(state.drive, state.t) + friction_rate
    ) / STEP_GUESS


def drive_at(constants: Constants, state: CapsuleState) -> jax.Array:
    """(L,) N: the drive, or the acceleration of a prescribed rod, m/s^2."""
    return constants.drive.series(state.drive, state.t, 1.0, 1)[0]


def acting(constants: Constants, r: Any, gaps: Sequence[Any], mode: Mode) -> Iterator[tuple[Force, Any, Any]]:
    """(force, its d, whether it acts) of every force, from r and the penetrations of the contacts."""
    contacts = iter(zip(gaps, mode.contacts, strict=True))
    for force in constants.forces:
        yield (force, r, True) if force.gap is None else (force, *next(contacts))


def terms(constants: Constants, state: CapsuleState, mode: Mode) -> list[jax.Array]:
    """The parts of f in N in the mode: what the rod puts on the capsule, elastic and damping, force by force."""
    return [  # pyright: ignore[reportReturnType]
        jnp.where(acts, force.side * part, 0.0)
        for force, d, acts in acting(constants, state.r, state.gaps, mode)
        for part in (force.elastic(d), force.damping(d, force.side * state.w))
    ]


def rod_force(constants: Constants, state: CapsuleState, mode: Mode) -> jax.Array:
    """f in N in the mode."""
    return total(terms(constants, state, mode))


def slopes(constants: Constants, state: CapsuleState, mode: Mode) -> tuple[jax.Array, jax.Array]:
    """(L,) N/m and N s/m: df/dr and df/dw in the mode."""

    def f(r: jax.Array, w: jax.Array, gaps: tuple[jax.Array, ...]) -> jax.Array:
        return rod_force(constants, state._replace(r=r, w=w, gaps=gaps), mode)

    one, none = jnp.ones_like(state.r), jnp.zeros_like(state.r)
    sides = tuple(force.side * one for force in constants.contacts)
    directions = (one, none, sides), (none, one, jax.tree.map(jnp.zeros_like, sides))
    stiffness, damping = (jax.jvp(f, (state.r, state.w, state.gaps), along)[1] for along in directions)
    return stiffness, damping


def touching(constants: Constants, mode: Mode, side: float) -> jax.Array:
    """(L,) bool: whether a contact on this side of the rod is closed."""
    closed = jnp.zeros(mode.sigma.shape, bool)
    for force, contact in zip(constants.contacts, mode.contacts, strict=True):
        closed = closed | (contact & force.present) if force.side == side else closed
    return closed


def driven(constants: Constants, state: CapsuleState, mode: Mode) -> tuple[jax.Array, jax.Array]:
    """(force along the ground on the capsule but for friction, N; Y1', m/s^2), each (L,), in the mode."""
    D = drive_at(constants, state)
    rod, capsule = along_ground(rod_force(constants, state, mode), D, constants.reaction, constants.downhill)
    return capsule, D if constants.drive.prescribed else rod / constants.m1


def series(constants: Constants, state: CapsuleState, mode: Mode, left: jax.Array) -> StepSeries:
    """Series of degree DEGREE about the state, in the mode; left (L,) s bounds the step."""
    sliding = mode.sigma != 0.0
    own: Any = getattr(constants.law, "series", None)
    breakaway, at = (constants.F_forward, constants.F_backward), (mode.sigma, state.v)
    friction = by_chain_rule(constants.law, *at) if own is None else own(*at, breakaway)
    friction_rate = friction.rate((driven(constants, state, mode)[0] - friction.start) / constants.m2, constants.m2)
    guess = step_rate(constants, state, mode, jnp.where(sliding, friction_rate, 0.0))
    rate, rate_left = jax.lax.stop_gradient((guess, 1.0 / left))
    h = 1.0 / jnp.maximum(rate, rate_left)
    m1, m2 = divide(constants.m1, h), jnp.where(sliding, divide(constants.m2, h), jnp.inf)
    drive = constants.drive.series(state.drive, state.t, h, DEGREE + 1)

    def of(start: jax.Array, rule: Callable[[int], Any]) -> Taylor:
        return Taylor(lambda k: start if k == 0 else rule(k), jnp.where(left > 0.0, 1.0, 2.0))

    def next_v(k: int) -> jax.Array:
        F = friction.extend(v.known[:k]) if k > 1 else friction.start
        return divide(on_capsule[k - 1] - F, m2 * k)

    def next_w(k: int) -> jax.Array:
        rod = h * drive[k - 1] * (1.0 / k) if constants.drive.prescribed else divide(on_rod[k - 1], m1 * k)
        return rod - v[k]

    v, w = of(state.v, next_v), of(state.w, next_w)
    r = of(state.r, lambda k: h * w[k - 1] * (1.0 / k))
    gaps = [
        of(d, lambda k, side=force.side: side * r[k]) for force, d in zip(constants.contacts, state.gaps, strict=True)
    ]
    parts = [(on_series(force, d, w), acts) for force, d, acts in acting(constants, r, gaps, mode)]
    f = of(rod_force(constants, state, mode), lambda k: total(jnp.where(acts, part[k], 0.0) for part, acts in parts))
    D = of(drive[0], drive.__getitem__)
    on_rod, on_capsule = along_ground(f, D, constants.reaction, constants.downhill)
    orders = [(w[k], v[k], r[k], on_capsule[k]) for k in range(DEGREE + 1)]
    return StepSeries(h, rate_left >= rate, *map(list, zip(*orders, strict=True)))


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
    gaps = tuple(d + force.side * way for force, d in zip(constants.contacts, state.gaps, strict=True))
    return CapsuleState(t, state.r + way, w, X2, v, state.drive, gaps)


# events: Changes of mode: where on a step the first one lies, and which mode follows.
#
# In a mode these functions must stay >= 0: each contact's (d in contact, -d out of it), and, while sliding, the
# velocity in the mode's direction, or, while stuck, F_forward - f and F_backward + f, f the force on the capsule. Each
# is a linear combination of the series of the step, so it is a polynomial in s. What is absent is not watched.
# Switching times of the drive are known: they end a step (``SWITCH``) and need no search.


# Kinds of events; that of contact i is GAP + i.
NONE, VELOCITY, UPPER, LOWER, SWITCH, GAP = range(6)
# The march arrives when its next leap is only ``SAME`` of the step, or, at a root that is crossed at a definite rate, when
# a leap below SURE_LEAP agrees with Newton's to SURE_AGREEMENT: the correction in ``correct`` does the rest. An event is met
# at a fraction of the step no smaller than ``SAME``, so that time always goes on; ``correct`` steps back.
SURE_LEAP, SURE_AGREEMENT = 1e-3, 1e-4
# Leaps on one step. Where they do not suffice (a root closely missed) the step ends early, with nothing lost.
MAX_LEAPS = 100
# Coefficients of an event function below this part of its size are rounding, where only their sign would matter.
ROUNDING_NOISE = 1e-14
# An event function below this at the start of a step has its root there, scaled to size 1; rounding is far smaller.
PASSED = -1e-9
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
    constants: Constants,
    mode: Mode,
    step: StepSeries,
    gaps: tuple[jax.Array, ...],
    s_end: jax.Array,
    active: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """(s, kind): where the step ends and why; s = s_end and NONE if nothing happens before.

    Marches from the left, each leap to the root of a quadratic minorant of each event function on what is left of the
    step, so no root can be passed, double ones included. gaps : penetrations (L,), m, at the start of the step.
    """
    sliding = mode.sigma != 0.0
    middle = 0.5 * (constants.F_forward - constants.F_backward)
    level = jnp.where(sliding, 0.0, 0.5 * (constants.F_forward + constants.F_backward))
    watched = []
    for force, d, contact in zip(constants.contacts, gaps, mode.contacts, strict=True):
        inward = jnp.where(contact, 1.0, -1.0)
        gap = [inward * d, *((inward * force.side) * x for x in step.r[1:])]
        watched.append(_watched(_divided(gap, s_end), jnp.zeros_like(s_end), s_end))
    speed = _divided([mode.sigma * x for x in step.v], s_end)
    # While stuck level - (f - middle) and level + (f - middle), while sliding sigma Y2, written as level + sign * p.
    force = [step.f[0] - middle, *step.f[1:]]
    other = _watched([jnp.where(sliding, a, -b) for a, b in zip(speed, force, strict=True)], level, s_end)
    base = level / other.scale

    def leap(carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        s, kind, going, leaps = carry
        p0, p1 = other.at(s)
        # An event function that begins below 0 has its root at the start, at no rate: a drive that sets in there.
        to_upper = jnp.where(sliding & (p0 < PASSED), 0.0, _leap(base + p0, p1, other.rest - other.p2))
        to_lower = jnp.where(sliding, jnp.inf, _leap(base - p0, -p1, other.rest + other.p2))
        tau, sign = jnp.minimum(to_upper, to_lower), jnp.where(to_upper <= to_lower, 1.0, -1.0)
        sure = _sure(base + sign * p0, sign * p1, tau)
        which = jnp.where(sliding, VELOCITY, jnp.where(sign > 0.0, UPPER, LOWER))
        for gap_kind, gap in reversed(list(enumerate(watched, GAP))):
            g0, g1 = gap.at(s)
            to_gap = jnp.where(g0 < PASSED, 0.0, _leap(g0, g1, gap.rest - gap.p2))
            is_gap, tau = to_gap <= tau, jnp.minimum(to_gap, tau)
            sure, which = jnp.where(is_gap, _sure(g0, g1, tau), sure), jnp.where(is_gap, gap_kind, which)
        arrived = tau <= jnp.where(sure, SURE_LEAP, SAME) * s_end
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
    return jnp.clip(s, SAME * s_end, s_end), kind


def motion_at(constants: Constants, state: CapsuleState, mode: Mode, kind: jax.Array) -> jax.Array:
    """(L,) sigma of the mode that follows from a state: the sign of v or, where v = 0, that of f if it breaks away.

    mode : the contacts; its sigma does not matter
    kind : (L,) the event; after UPPER or LOWER f is at the threshold of a capsule at rest, whatever rounding says

    f is the force on the capsule but for friction.
    """
    f, w_rate = driven(constants, state, mode)
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
    stiffness, damping = slopes(constants, state, mode)
    rate = stiffness * state.w + damping * w_rate
    if constants.reaction is None:
        return rate
    return rate - constants.reaction * constants.drive.series(state.drive, state.t, 1.0, 2)[1]


def _size_of_forces(constants: Constants, state: CapsuleState, mode: Mode) -> jax.Array:
    """(L,) N: sum of the magnitudes of the forces on the capsule, which its rounding scales with."""
    forces = terms(constants, state, mode)
    if constants.reaction is not None:
        forces.append(constants.reaction * drive_at(constants, state))
    if constants.downhill is not None:
        forces.append(constants.downhill[1])
    return total(map(jnp.abs, forces))


def mode_at(constants: Constants, state: CapsuleState) -> Mode:
    """The mode that any state begins in: signs of gaps, v and, where they are 0, of their first rate that is not."""
    inward = [(d, force.side * state.w, force.side) for force, d in zip(constants.contacts, state.gaps, strict=True)]
    meeting = tuple((d > 0.0) | ((d == 0.0) & (rate > 0.0)) for d, rate, _ in inward)
    sigma = motion_at(constants, state, Mode(jnp.zeros_like(state.v), meeting), jnp.full(state.r.shape, NONE))
    free = Mode(sigma, tuple(map(jnp.zeros_like, meeting)))
    f, rod_rate = driven(constants, state, free)
    a2 = jnp.where(sigma != 0.0, (f - sliding_friction(constants.law, sigma, state.v)) / constants.m2, 0.0)
    w_rate = rod_rate - a2
    touching = ((d == 0.0) & (rate == 0.0) & (side * w_rate > 0.0) for d, rate, side in inward)
    return Mode(sigma, tuple(x | y for x, y in zip(meeting, touching, strict=True)))
