"""The settled motion of a drive: period, direction, contacts, mean velocity, and the paper's label P-<n>-<F|B|S>-<m>."""

from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.errors import InputError
from capsule_id.parameters import LONGEST_PERIOD, STANDING
from capsule_id.physics.batches import CHUNK, is_traced, lanes_of, run_lanes
from capsule_id.physics.exact.engine import RunState, initial_lanes, kernel, run, take_step
from capsule_id.physics.exact.taylor import CapsuleState, StepSeries, constants_of, touching
from capsule_id.physics.forces import FrictionLaw, friction_law, horner
from capsule_id.physics.model import (
    MAX_STEPS,
    CapsuleParameters,
    Drive,
    Excitation,
    Initial,
    PeriodicDrive,
    Status,
    without_absent,
)

# Initial state at rest at the origin.
REST: Initial = (0.0, 0.0, 0.0, 0.0)
# Periods over which the Lyapunov exponent of an aperiodic motion is a mean.
EXPONENT_PERIODS = 100


# periods: What happens within single periods of the drive: closings of the gap, and the work of the drive.
#
# Every period of every motion is a lane of its own, started from the state at its beginning, so that 48 periods of one
# motion are computed side by side. An opening in one period and the closing that follows in the next are joined
# afterwards.


# Quadrature nodes per step for the drive's work: exact up to degree 15, where the series of velocity end at 12.
_NODE, _WEIGHT = (0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(8), (1.0, 0.0), strict=True))


class SpanRecord(NamedTuple):
    """Contacts and work of one span per lane, every leaf (L,).

    closings : closings of the gap, those after an opening shorter than ``merge`` left out
    lead : time of the first closing if no opening stands before it in the span, else inf
    opened : time of the last opening, -inf if there is none
    work : of the drive on rod and capsule, J
    status : a ``Status`` code
    """

    closings: jax.Array
    lead: jax.Array
    opened: jax.Array
    work: jax.Array
    status: jax.Array


def observe(
    p: CapsuleParameters,
    e: Drive,
    law: FrictionLaw,
    times: np.ndarray,
    states: np.ndarray,
    merge_contacts: float,
    max_steps: int,
    width: int = CHUNK,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(closings, work, status): contacts that close and work in each period, and the gravest status of each motion.

    Parameters
    ----------
    p, e, law : lanes, every leaf (lanes,); seven arguments, because the engine's inputs are unpacked
    times : (lanes, periods + 1), s, the ends of the periods
    states : (4, lanes, periods + 1), X1, Y1, X2, Y2 there; NaN where a run was given up
    merge_contacts : s; an opening shorter than this does not part two contacts
    width : lanes of one call, see ``run_lanes``

    Returns
    -------
    (lanes, periods), int; (lanes, periods), J; (lanes,)
    """
    lanes, periods = times.shape[0], times.shape[1] - 1
    begin = tuple(np.nan_to_num(x[:, :-1]).ravel() for x in states)
    p, e, law = jax.tree.map(lambda leaf: np.repeat(leaf, periods), (p, e, law))
    spans = np.stack([times[:, :-1].ravel(), times[:, 1:].ravel()], axis=1)
    bound = np.full(lanes * periods, max_steps, np.int32)
    merge = np.full(lanes * periods, merge_contacts)
    spans_of_lanes = run_lanes(_kernel, (p, e, law, (begin, merge, bound)), spans, batched=True, width=width)
    closings, lead, opened, work, status = (np.array(x).reshape(lanes, periods) for x in spans_of_lanes)
    # The last opening in the periods before each one.
    last = np.concatenate([np.full((lanes, 1), -np.inf), np.maximum.accumulate(opened, axis=1)[:, :-1]], axis=1)
    closings -= lead - last < merge_contacts
    return closings, work, status.max(axis=1)


@jax.jit
def _kernel(
    p: CapsuleParameters,
    e: Drive,
    law: FrictionLaw,
    given: tuple[Initial, jax.Array, jax.Array],
    times: jax.Array,
) -> SpanRecord:
    """Contacts and work in times (L, 2); given: states at the beginning, merge (L,) s, bound (L,) on the steps."""
    initial, merge, bound = given
    constants, end = constants_of(p, e, law), times[:, 1]
    lanes = initial_lanes(p, constants, times[:, 0], end, initial)
    never = jnp.full(end.shape, jnp.inf)
    blank = SpanRecord(lanes.contacts, never, -never, jnp.zeros(end.shape), lanes.status)

    def one(carry: tuple[RunState, SpanRecord]) -> tuple[RunState, SpanRecord]:
        lanes, record = carry
        after, step = take_step(constants, end, bound, lanes)
        t = after.state.t
        held, holds = (touching(constants, moment.mode, 1.0) for moment in (lanes, after))
        closed, opened = holds & ~held, held & ~holds
        record = SpanRecord(
            record.closings + (closed & ~(t - record.opened < merge)),
            jnp.where(closed & jnp.isinf(record.opened), t, record.lead),
            jnp.where(opened, t, record.opened),
            # A lane that has ended adds nothing.
            record.work + jnp.where(lanes.active, _work(constants.drive, lanes.state, step, t), 0.0),
            after.status,
        )
        return after, record

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0].active), one, (lanes, blank))[1]


def _work(drive: Drive, state: CapsuleState, step: StepSeries, t: jax.Array) -> jax.Array:
    """(L,) J: work of the drive over the step from ``state`` to the time t, by Gauss-Legendre quadrature."""
    dt = t - state.t

    def power(node: jax.Array) -> jax.Array:
        since = node * dt
        s = since / step.h
        Y2 = horner(step.v, s)
        driven = horner(step.w, s) + Y2
        driven = driven if drive.reaction is None else driven - drive.reaction * Y2
        return drive.series(state.drive, state.t + since, 1.0, 1)[0] * driven

    return dt * jnp.sum(_WEIGHT[:, None] * jax.vmap(power)(jnp.asarray(_NODE)), axis=0)


# exponent: The largest Lyapunov exponent, from the exact derivatives of the engine through every event.
#
# A tangent of the Poincaré map is carried along and brought back to unit length once a period; the exponent is the mean
# rate at which its logarithm grows. Coordinates: (x_rel, its rate, Y2) at the drive's phase. X2 is left out: a motion
# that is shifted as a whole is the same motion; its tangent neither grows nor decays and would hide all others.
# In a capsule that sticks Y2 and its tangent are 0, and the map has one dimension less.


# Excitation periods in which the tangent turns into the direction that grows most, before its growth counts.
ALIGNMENT = 16
# The tangent's direction at the start; any that is not special.
DIRECTION = (0.8, -0.5, 0.33)


def largest_exponent(
    p: CapsuleParameters,
    e: PeriodicDrive,
    initial: Initial = REST,
    periods: int = EXPONENT_PERIODS,
    max_steps: int = MAX_STEPS,
    friction: FrictionLaw | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Largest Lyapunov exponent of motions that start at ``initial`` (a settled state, as ``settle(...).end``), and status.

    Parameters
    ----------
    p, e : parameters and drive; leaves () or (batch,), concrete; the period positive
    initial : (X1, Y1, X2, Y2) at the drive's phase, each () or (batch,); default at rest at the origin
    periods, max_steps : see ``Settling``; growth counts after 16 periods in which the tangent aligns
    friction : a law in place of the capsule's own, see ``simulate``

    Returns
    -------
    (lanes,) 1/s, NaN where a lane failed, -inf where every tangent dies out; (lanes,) the gravest ``Status`` code,
    ``GRAZING`` where a derivative on the way does not exist.

    For a periodic orbit the limit is log|largest Floquet multiplier| / (n T), which is negative where it is stable.

    Raises
    ------
    InputError
        Shapes that do not agree.
    """
    (p, e, friction, (X1, Y1, X2, Y2)), _, _ = lanes_of((*without_absent(p, e), friction, initial), np.zeros(1))
    law = friction_law(p, friction)
    T = np.asarray(e.period)
    begin = tuple(np.nan_to_num(x) for x in (X1 - X2, Y1 - Y2, Y2))
    # A period of a drive that is settled: a lag begins with the force between the pulses.
    span = T[:, None] * np.array([DROPPED, DROPPED + 1.0])
    grow = partial(_growth, np.int32(periods), np.int32(max_steps))
    growth, status = (np.asarray(x) for x in run_lanes(grow, (p, e, law, begin), span, batched=True))
    return np.where(status <= Status.GRAZING, growth / (periods * T), np.nan), status


@jax.jit
def _growth(
    periods: jax.Array,
    max_steps: jax.Array,
    p: CapsuleParameters,
    e: PeriodicDrive,
    law: FrictionLaw,
    begin: tuple[jax.Array, ...],
    span: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """(logarithm of the tangent's growth over ``periods``, status), each (L,); begin: x_rel, rate, Y2, each (L,).

    Seven arguments, because the engine's inputs are unpacked.
    """
    # Lengths in m: a velocity counts as the displacement that it makes in 1/Omega.
    Omega = 2.0 * jnp.pi / jnp.asarray(e.period)
    unit = jnp.stack([jnp.ones_like(Omega), Omega, Omega])

    def period(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        x_rel, rate, Y2 = y
        bound = jnp.broadcast_to(max_steps, x_rel.shape)
        t = run(p, e, law, (x_rel, rate + Y2, jnp.zeros_like(x_rel), Y2), span, span[:, 1], bound)
        return jnp.stack([t.x_rel[:, -1], (t.Y1 - t.Y2)[:, -1], t.Y2[:, -1]]), t.status

    def one(k: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        y, tangent, total, status = carry
        y, moved, now = jax.jvp(period, (y,), (tangent * unit,), has_aux=True)
        moved = moved / unit
        length = jnp.sqrt(jnp.sum(moved**2, axis=0))
        total = total + jnp.where(k < ALIGNMENT, 0.0, jnp.log(length))
        # A tangent that has died out stays zero; its logarithm is -inf.
        moved = moved / jnp.where(length > 0.0, length, 1.0)[None]
        return y, moved, total, jnp.where(status <= Status.GRAZING, jnp.maximum(status, now), status)

    y = jnp.stack(begin)
    tangent = jnp.broadcast_to(jnp.asarray(DIRECTION)[:, None], y.shape)
    # A capsule that sticks has no tangent in velocity.
    tangent = tangent.at[2].set(jnp.where(y[2] == 0.0, 0.0, tangent[2]))
    blank = (y, tangent, jnp.zeros_like(span[:, 0]), jnp.zeros(span.shape[0], jnp.int32))
    _, _, total, status = jax.lax.fori_loop(0, ALIGNMENT + periods, one, blank)
    return total, status


# response: The settled motion in one line: period, direction, contacts, mean velocity, and the paper's label
# P-<n>-<F|B|S>-<m>.
#
# simulate the dropped and the observed periods -> Poincaré section -> period -> contacts and work of periods -> Settled
#
# ``response`` returns the label of a motion; ``settle`` returns its Poincaré section too, for sweeps and maps.


# Excitation periods left out, and observed.
DROPPED, OBSERVED = 300, 48
# At least so many times as many periods must be observed as the longest one that is searched for has.
REPEATS = 3
# Two points of the Poincaré section are the same within these (m, m/s), and within this part of the motion's size.
SAME_POSITION, SAME_VELOCITY, SAME_RELATIVE = 1e-7, 1e-4, 1e-3


@dataclass(frozen=True)
class Settling:
    """How motions are settled and observed.

    dropped, observed : excitation periods left out, and observed; the longest period searched for is the least of 16
        and a third of ``observed``
    merge_contacts : s; contacts parted by less than this count as one (0, the default: every closing counts)
    exponent_periods : periods over which the Lyapunov exponent of an aperiodic motion is a mean, 0 to leave it out
    max_steps : bound on the steps of a lane, see ``simulate``

    Raises
    ------
    InputError
        A number that is negative or not whole, or fewer than 3 periods observed.
    """

    dropped: int = DROPPED
    observed: int = OBSERVED
    merge_contacts: float = 0.0
    exponent_periods: int = EXPONENT_PERIODS
    max_steps: int = MAX_STEPS

    def __post_init__(self) -> None:
        for name, least, rule, remedy in (
            ("dropped", 0, "not be negative", "give 0 or more"),
            ("exponent_periods", 0, "not be negative", "give 0 or more"),
            ("merge_contacts", 0, "not be negative", "give 0 or more"),
            ("observed", REPEATS, f"be at least {REPEATS}", "observe more periods"),
            ("max_steps", 1, "be positive", "give 1 or more"),
        ):
            value = getattr(self, name)
            if not value >= least:
                raise InputError(f"{name} must {rule}", str(value), remedy)
            if name != "merge_contacts" and not (np.isfinite(value) and value == int(value)):
                raise InputError(f"{name} must be a whole number", str(value), "give a whole number")


SETTLING = Settling()


@dataclass(frozen=True)
class Response:
    """The settled motion; with a batch every field is an array (batch,).

    label : "P-<period>-<direction>-<contacts>"; "aperiodic"; "not settled" where a motion without a period has a negative
        Lyapunov exponent: it approaches a period, and more periods must be dropped; "failed" where the run was given up
    period : in excitation periods, 1..16; 0 for the other labels
    direction : "F" forward, "B" backward, "S" standing (it advances less than 1e-7 m in an excitation period), "" where failed
    contacts_per_period : closings of the gap per excitation period
    mean_velocity : of the capsule over the observed periods, m/s
    status : a ``Status`` code
    work_per_period : work of the drive per excitation period, J
    lyapunov : largest Lyapunov exponent of a motion without a period, 1/s; NaN for all others, see ``largest_exponent``
    """

    label: str | np.ndarray
    period: int | np.ndarray
    direction: str | np.ndarray
    contacts_per_period: float | np.ndarray
    mean_velocity: float | np.ndarray
    status: int | np.ndarray
    work_per_period: float | np.ndarray
    lyapunov: float | np.ndarray


@dataclass(frozen=True)
class Settled(Response):
    """Settled motions with their Poincaré sections, every field an array (lanes, ...).

    x_rel, rate, Y2 : (lanes, observed + 1), m and m/s: X1 - X2, Y1 - Y2 and Y2 at the drive's phase at the start
    efficiency : (lanes,) advance of the capsule per work of the drive, m/J; 0 for a motion that stands
    """

    x_rel: np.ndarray
    rate: np.ndarray
    Y2: np.ndarray
    efficiency: np.ndarray

    @property
    def end(self) -> Initial:
        """(X1, Y1, X2, Y2) at the end with the capsule put back to X2 = 0: where a neighbouring motion may start."""
        x_rel, rate, Y2 = (np.nan_to_num(x[:, -1]) for x in (self.x_rel, self.rate, self.Y2))
        return x_rel, rate + Y2, np.zeros_like(x_rel), Y2


def response(
    p: CapsuleParameters,
    e: PeriodicDrive,
    *,
    settling: Settling = SETTLING,
    max_steps: int | None = None,
    friction: FrictionLaw | None = None,
) -> Response:
    """Settled motion from rest: 300 excitation periods dropped, 48 observed.

    Parameters
    ----------
    p, e : parameters and drive (``Excitation`` or ``Pulses``); any leaf may carry a batch axis (batch,). The period of
        the drive must be positive.
    settling : other numbers of periods, the rule for micro-contacts
    max_steps : bound on the steps of a lane, in the place of that of ``settling``
    friction : a law in place of eq. (1), see ``simulate``; leaves () or (batch,)

    Raises
    ------
    InputError
        Traced values (a label is a string), a drive without a positive period, shapes that do not agree.
    """
    if is_traced((p, e, friction)):
        raise InputError("response needs concrete values", "a traced value", "call it outside of jit, vmap and jvp")
    p, e = without_absent(p, e)
    _, _, batched = lanes_of((p, e, friction), np.zeros(1))
    if max_steps is not None:
        settling = replace(settling, max_steps=max_steps)
    seen = settle(p, e, settling=settling, friction=friction)
    columns = (getattr(seen, field.name) for field in fields(Response))
    return Response(*(column if batched else column[0].item() for column in columns))


def settle(
    p: CapsuleParameters,
    e: PeriodicDrive,
    initial: Initial = REST,
    settling: Settling = SETTLING,
    width: int = CHUNK,
    friction: FrictionLaw | None = None,
) -> Settled:
    """Settled motions of a batch (a single motion is a batch of one), from ``initial`` or from rest.

    Parameters
    ----------
    p, e : as in ``response``, concrete
    initial : (X1, Y1, X2, Y2), each () or (batch,); default at rest at the origin
    width : lanes of one call of the engine, see ``run_lanes``
    friction : a law in place of eq. (1), see ``simulate``; leaves () or (batch,)

    Raises
    ------
    InputError
        A drive without a positive period, a merging time that would take in whole periods, shapes that do not agree.
    """
    (p, e, friction, initial), _, _ = lanes_of((p, e, friction, initial), np.zeros(1))
    law = friction_law(p, friction)
    T = periods_of(e)
    if not settling.merge_contacts < 0.5 * T.min():
        rule = "merge_contacts must be less than half a period of the drive"
        raise InputError(rule, f"{settling.merge_contacts} s", f"give less than {0.5 * T.min():.3g} s")
    # One period before the observed ones: its last contact may take in the first of those.
    before = min(settling.dropped, 1)
    section = T[:, None] * np.arange(settling.dropped - before, settling.dropped + settling.observed + 1)
    # The start comes first, which the section begins with where (almost) nothing is dropped.
    times = np.concatenate([np.zeros((len(T), 1)), section], axis=1) if settling.dropped > 1 else section
    t = run_lanes(partial(kernel, settling.max_steps), (p, e, law, initial), times, batched=True, width=width)
    states = np.stack([np.asarray(x)[:, -section.shape[1] :] for x in (t.X1, t.Y1, t.X2, t.Y2)])
    seen = observe(p, e, law, section, states, settling.merge_contacts, settling.max_steps, width)
    states, closings, work = states[:, :, before:], seen[0][:, before:], seen[1][:, before:]
    status = np.maximum(np.asarray(t.status), seen[2])
    found = [_describe(states[:, i], 2.0 * np.pi / T[i], closings[i], int(status[i])) for i in range(len(T))]
    label, period, direction, per_period = (np.array(column) for column in zip(*found, strict=True))
    X1, Y1, X2, Y2 = states
    velocity = (X2[:, -1] - X2[:, 0]) / (settling.observed * T)
    work = np.where(np.isfinite(velocity), work.mean(axis=1), np.nan)
    # Without a drive there is neither work nor advance.
    efficiency = np.where(direction == "S", 0.0, velocity * T / np.where(work == 0.0, np.inf, work))
    label, exponent = with_exponents(p, e, tuple(states[:, :, -1]), label, settling, friction)
    columns = (label, period, direction, per_period, velocity, status, work, exponent)
    return Settled(*columns, x_rel=X1 - X2, rate=Y1 - Y2, Y2=Y2, efficiency=efficiency)


def periods_of(e: PeriodicDrive) -> np.ndarray:
    """(lanes,) s: the periods of the drive.

    Raises
    ------
    InputError
        A drive without a period, a frequency or a period that is not positive.
    """
    name = "Omega" if isinstance(e, Excitation) else "period"
    value = np.asarray(getattr(e, name, np.nan))
    wrong = ~((value > 0.0) & (value < np.inf))
    if np.any(wrong):
        remedy = "a response needs a period: use simulate"
        raise InputError(
            f"{name} must be positive and finite", f"{type(e).__name__} with {value[wrong].ravel()[0]}", remedy
        )
    return np.asarray(e.period)


def with_exponents(
    p: CapsuleParameters,
    e: PeriodicDrive,
    ends: tuple[np.ndarray, ...],
    label: np.ndarray,
    settling: Settling,
    friction: FrictionLaw | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(label, exponent) of lanes that end in the states ``ends``, (lanes,) and (lanes,) 1/s.

    Aperiodic motions have an exponent, all others NaN. Those with a negative one are "not settled".
    """
    found, chosen = np.full(len(label), np.nan), label == "aperiodic"
    if settling.exponent_periods and chosen.any():
        p, e, friction, (X1, Y1, X2, Y2) = jax.tree.map(lambda leaf: leaf[chosen], (p, e, friction, ends))
        numbers = settling.exponent_periods, settling.max_steps
        found[chosen] = largest_exponent(p, e, (X1, Y1, X2, Y2), *numbers, friction)[0]
    return np.where(found < 0.0, "not settled", label), found


def _describe(state: np.ndarray, Omega: float, contacts: np.ndarray, status: int) -> tuple[str, int, str, float]:
    """(label, period, direction, contacts per period) of one lane: state (4, n + 1), contacts (n,) of n periods."""
    if not Status(status).usable:
        return "failed", 0, "", float("nan")
    X1, Y1, X2, Y2 = state
    observed = len(contacts)
    advance = (X2[-1] - X2[0]) / observed
    direction = "S" if abs(advance) < STANDING else "F" if advance > 0.0 else "B"
    period = period_of(X1 - X2, Y1 - Y2, Y2, Omega)
    if period == 0:
        return "aperiodic", 0, direction, float(contacts.mean())
    whole = observed // period * period
    per_period = Fraction(int(contacts[-whole:].sum()), whole)
    return f"P-{period}-{direction}-{per_period}", period, direction, float(per_period)


def period_of(x_rel: np.ndarray, rate: np.ndarray, Y2: np.ndarray, Omega: float) -> int:
    """Period in excitation periods of points (n,) of the Poincaré section (m, m/s, m/s); 0 if they do not repeat.

    The tolerance is absolute, and for small motions relative to the largest distance from the origin. Periods up to 16
    are searched for that are observed three times.
    """
    scale = SAME_RELATIVE * float(np.max(np.hypot(x_rel, rate / Omega)))
    for n in range(1, min(LONGEST_PERIOD, (len(x_rel) - 1) // REPEATS) + 1):
        dx, dw = np.abs(x_rel[n:] - x_rel[:-n]), np.abs([rate[n:] - rate[:-n], Y2[n:] - Y2[:-n]])
        if dx.max() <= min(SAME_POSITION, scale) and dw.max() <= min(SAME_VELOCITY, scale * Omega):
            return n
    return 0
