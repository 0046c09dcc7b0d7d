"""Motion of the capsule by either engine: its samples, bias of the smoothed engine, energy, displacement of many runs."""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.physics.batches import CHUNK, folded, is_traced, lanes_of, run_lanes
from capsule_id.physics.drives import RodMotion
from capsule_id.physics.exact import engine as exact
from capsule_id.physics.exact.taylor import constants_of
from capsule_id.physics.forces import CoulombStribeck, FrictionLaw, downhill, forces_of, friction_law, sliding_friction
from capsule_id.physics.model import (
    MAX_STEPS,
    CapsuleParameters,
    Drive,
    Initial,
    PeriodicDrive,
    Status,
    Trajectory,
    pressed,
    without_absent,
)
from capsule_id.physics.smooth import engine as smooth
from capsule_id.physics.smooth.engine import Smoothing

# m/s. The bar "2 % + 1e-6 m/s" reads 2 % of (|v| + this): a capsule that hardly advances is not judged by a quotient.
VELOCITY_SCALE = 5e-5


def _check_choices(model: str, semantics: str, smoothing: Smoothing | None) -> None:
    """Refuse unknown words, and what the exact model does not have."""
    if model not in ("exact", "smooth"):
        raise InputError('model must be "exact" or "smooth"', repr(model), "choose one of the two")
    if semantics not in ("stick-slip", "eq2"):
        raise InputError('semantics must be "stick-slip" or "eq2"', repr(semantics), "choose one of the two")
    if model == "exact" and semantics == "eq2":
        raise InputError(
            "the exact model has stick-slip semantics only",
            'semantics="eq2"',
            'use model="smooth" for eq. (2) to the letter',
        )
    if model == "exact" and smoothing is not None:
        raise InputError("the exact model has no smoothing", repr(smoothing), 'leave it out or use model="smooth"')


def _check_values(p: CapsuleParameters, e: Drive, law: FrictionLaw, times: np.ndarray) -> None:
    """Refuse lanes without a normal force, and times outside the drive."""
    carried = np.asarray(pressed(p, law))
    if isinstance(law, CoulombStribeck) and not (carried | np.isnan(law.N)).all():
        N = float(np.asarray(law.N)[~carried & ~np.isnan(law.N)][0])
        raise InputError(
            "the normal force (m1 + m2) g cos(slope) + N0 must be positive",
            f"N = {N:.3g} N",
            "reduce the slope, or raise N0",
        )
    covered = np.asarray(e.covers(times[:, 0], times[:, -1]))
    if not covered.all():
        begin, end = times[~covered][0, [0, -1]]
        raise InputError(
            f"the drive {type(e).__name__} must cover the run, and its own times must increase",
            f"times from {begin:g} to {end:g} s",
            "shorten the run, or correct the drive",
        )


def simulate(
    p: CapsuleParameters,
    e: Drive,
    times: ArrayLike,
    initial: Initial | None = None,
    model: Literal["exact", "smooth"] = "exact",
    semantics: Literal["stick-slip", "eq2"] = "stick-slip",
    smoothing: Smoothing | None = None,
    *,
    friction: FrictionLaw | None = None,
    max_steps: int = MAX_STEPS,
) -> Trajectory:
    """Motion of the capsule at the given times.

    Parameters
    ----------
    p, e : parameters and drive (``Excitation``, ``Pulses``, ``RecordedDrive``, ``RodMotion``); any leaf may carry a
        leading batch axis of one common length
    times : (n,) or (batch, n), s, increasing; times[0] is the start
    initial : (X1, Y1, X2, Y2) at times[0], each () or (batch,); default at rest at the origin. A prescribed rod
        starts from its own X1 and Y1 instead
    model : "exact" (event-driven) or "smooth" (smoothed Heavisides)
    semantics : "stick-slip", or "eq2" (eq. (2) to the letter; smooth model only, for comparison)
    smoothing : widths of the smooth model; default the certified ones
    friction : a friction law in place of eq. (1); it replaces mu, v_s and the normal force of p. Leaves () or (batch,)
    max_steps : bound on the steps of a lane, after which it is given up with ``Status.TOO_MANY_STEPS``

    The number of parameters follows the public contract. Works under ``jit`` and ``vmap`` and is differentiable in
    forward mode in every float leaf, those of ``friction`` included; the smooth model in reverse mode too. Concrete
    batches are split into chunks of lanes that run on all cores; under a transformation the batch stays whole.

    The engines, ``partial(exact.kernel, max_steps)`` and ``smooth.kernel(smoothing, semantics, max_steps)``, return a function
    ``(p, e, law, initial, times) -> Trajectory`` of lanes: every leaf (L,), times (L, n), fields (L, n) and (L,),
    status and counters int32. Samples are NaN only in lanes whose status is not ``usable``. Bad values give a status,
    not an exception.

    Raises
    ------
    InputError
        Unknown model or semantics, "eq2" or smoothing with the exact model, leaves whose shapes do not agree, times
        that do not increase; concrete values with a normal force N <= 0, or times outside the drive.
    """
    _check_choices(model, semantics, smoothing)
    given = (*without_absent(p, e), friction, initial or (0.0, 0.0, 0.0, 0.0))
    (p, e, friction, initial), grid, batched = lanes_of(given, times)
    law = friction_law(p, friction)
    if not is_traced((p, e, law, grid)):
        _check_values(p, e, law, np.asarray(grid))
    if isinstance(e, RodMotion):
        initial = (*e.rod(grid[:, 0]), initial[2], initial[3])
    lanes = (p, e, law, initial)
    if model == "exact":
        return run_lanes(partial(exact.kernel, max_steps), lanes, grid, batched)
    return run_lanes(smooth.kernel(smoothing, semantics, max_steps), lanes, grid, batched)


@dataclass(frozen=True)
class SmoothingBias:
    """Both models over the same periods from rest; arrays (L,), one entry per lane (L = 1 where none was given).

    exact, smooth : mean velocity of the capsule, m/s        largest : largest |X2 - exact X2| at a period's end, m
    exact_contacts, smooth_contacts : closings of the gap    usable : whether both runs are complete
    """

    smoothing: Smoothing
    periods: int
    exact: np.ndarray
    smooth: np.ndarray
    largest: np.ndarray
    exact_contacts: np.ndarray
    smooth_contacts: np.ndarray
    usable: np.ndarray

    @property
    def bias(self) -> np.ndarray:
        """(L,), m/s: smooth - exact; NaN where a run is not usable."""
        return np.where(self.usable, self.smooth - self.exact, np.nan)

    @property
    def relative(self) -> np.ndarray:
        """(L,), 1: |bias| / (|exact| + 5e-5 m/s); the certified widths stay below 0.02."""
        return np.abs(self.bias) / (np.abs(self.exact) + VELOCITY_SCALE)


def smoothing_bias(
    p: CapsuleParameters,
    e: PeriodicDrive,
    smoothing: Smoothing | None = None,
    periods: int = 10,
    semantics: Literal["stick-slip", "eq2"] = "stick-slip",
) -> SmoothingBias:
    """Bias of the smoothed model for these parameters, over ``periods`` periods from rest.

    p, e : leaves () or (batch,)        smoothing : default the certified widths

    Raises
    ------
    InputError
        Without a period (Omega = 0 has none), or where ``periods`` is no whole number from 1 on.
    """
    if periods < 1 or periods != int(periods):
        raise InputError(
            "the bias is measured over at least one period, and whole ones", f"periods = {periods}", "give 1 or more"
        )
    smoothing = smoothing or Smoothing()
    (p, e), _, _ = lanes_of((p, e), np.zeros(1))
    with np.errstate(divide="ignore"):
        period = np.asarray(getattr(e, "period", np.nan))
    if not np.all((period > 0.0) & (period < np.inf)):
        raise InputError("the bias is measured per period of the drive", "Omega <= 0", "give a drive with a period")
    times = period[:, None] * np.arange(periods + 1)
    exact = simulate(p, e, times)
    smooth = simulate(p, e, times, model="smooth", semantics=semantics, smoothing=smoothing)
    return SmoothingBias(
        smoothing,
        periods,
        _mean_velocity(exact),
        _mean_velocity(smooth),
        np.max(np.abs(np.asarray(smooth.X2) - np.asarray(exact.X2)), axis=1),
        np.asarray(exact.contacts),
        np.asarray(smooth.contacts),
        np.isfinite(np.asarray(exact.X2[:, -1])) & np.isfinite(np.asarray(smooth.X2[:, -1])),
    )


def _mean_velocity(t: Trajectory) -> np.ndarray:
    return np.asarray((t.X2[:, -1] - t.X2[:, 0]) / (t.times[:, -1] - t.times[:, 0]))


# displacement: Displacement of the capsule after many periods of a drive, as a progression test measures it.
#
# A lane runs in blocks of periods. Once the motion repeats from period to period, the remaining periods add the same
# displacement each. After every block the lanes that go on are sorted by their steps per period and form new chunks, so
# that few lanes wait for slower ones.

#: Periods of a block: short, because the motion is compared with its repetition only at the end of a block.
BLOCK = 3
#: Lanes of one call: so many that few wait for slower ones.
TOGETHER = 1024
#: The motion repeats where the state changes by less than this part of itself over one period, dimensionless.
REPEATS = 1e-5
#: Bound on the steps of a block, 300 per period. Plausible motions need 15 to 45 per period; a motion that needs far
#: more keeps its whole chunk waiting.
BLOCK_STEPS = 300 * BLOCK


class Displacement(NamedTuple):
    """Displacement X2 after the periods, m, NaN where the run failed, and a ``Status`` code; (L,) each."""

    X2: Any
    status: Any


class _Lane(NamedTuple):
    """A run in progress; (L,) each.

    Attributes
    ----------
    done, state : periods done, and (X1, Y1, X2, Y2) then
    active, status : whether the lane goes on; ``Status`` code
    effort : steps per period in the last block; before the first block the period, s, which orders lanes alike
    """

    done: Any
    state: tuple[Any, ...]
    active: Any
    status: Any
    effort: Any


def displacement(
    p: CapsuleParameters, e: Drive, law: FrictionLaw, period: Any, count: Any, r0: Any = 0.0
) -> Displacement:
    """X2 after ``count`` periods of ``e`` from rest at x_rel = ``r0``, by the exact engine.

    Parameters
    ----------
    p, e, law : leaves () or (L,)
    period, count : (L,) period of the drive, s, and number of periods
    r0 : () or (L,), m

    A lane with a block of more than ``BLOCK_STEPS`` steps is given up with ``Status.TOO_MANY_STEPS``. Its displacement
    is NaN, so that a log-posterior which needs it is -inf.

    Works under ``jit`` and ``vmap``, and is differentiable in forward mode.
    """
    given = (*without_absent(p, e), law, r0, period, count)
    lanes, xp = np.shape(period)[0], jnp if is_traced(given) else np
    given = jax.tree.map(lambda leaf: xp.broadcast_to(xp.asarray(leaf, float), (lanes,)), given)
    if xp is jnp:
        return _run(*given)
    # Lanes without periods fill the last part, so that one program serves any number of lanes.
    *others, count = jax.tree.map(lambda leaf: np.pad(leaf, (0, -lanes % TOGETHER), "edge"), given)
    count[lanes:] = 0.0
    found = run_lanes(lambda *own: _run(*own[:-1], own[-1][:, 0]), tuple(others), count[:, None], True, TOGETHER)
    return jax.tree.map(lambda leaf: leaf[:lanes], found)


def _in_chunks(*given: Any) -> Displacement:
    """Run lanes (L,), ``CHUNK`` at a time, until none goes on; arguments as those of ``displacement``."""
    lanes = given[-1].shape[0]
    *system, r0, period, count = jax.tree.map(lambda x: jnp.pad(x, (0, -lanes % CHUNK), "edge"), given)
    zero = jnp.zeros_like(period)
    active = (count > 0.0) & (jnp.arange(len(zero)) < lanes)
    state = _Lane(zero, (r0 + zero, zero, zero, zero), active, jnp.zeros(zero.shape, jnp.int32), stop_gradient(period))

    def advance(state: _Lane) -> _Lane:
        """One block of every active lane; the lanes of a chunk need about as many steps each."""
        order = jnp.argsort(jnp.where(state.active, state.effort, jnp.inf))  # pyright: ignore[reportArgumentType]

        def chunk(i: Any, state: _Lane) -> _Lane:
            index = jax.lax.dynamic_slice_in_dim(order, i * CHUNK, CHUNK)
            part, own = jax.tree.map(lambda x: x[index], (state, (*system, period, count)))
            return jax.tree.map(lambda x, new: x.at[index].set(new), state, _block(part, *own))

        return jax.lax.fori_loop(0, -(-jnp.sum(state.active) // CHUNK), chunk, state)

    last = jax.lax.while_loop(lambda state: jnp.any(state.active), advance, state)
    X2 = jnp.where(last.status <= Status.GRAZING, last.state[2], jnp.nan)
    return Displacement(X2[:lanes], last.status[:lanes])


def _block(lane: _Lane, p: CapsuleParameters, e: Drive, law: FrictionLaw, period: Any, count: Any) -> _Lane:
    """Run a chunk of lanes for a block of periods; lanes that are not active stay as they are."""
    omega = 2.0 * np.pi / period
    ahead = jnp.where(lane.active, jnp.minimum(float(BLOCK), count - lane.done), 0.0)
    begin, end = lane.done * period, (lane.done + ahead) * period
    times = jnp.stack([begin, end - jnp.where(ahead > 1.0, period, 0.0), end], 1)
    t = simulate(p, e, times, lane.state, friction=law, max_steps=BLOCK_STEPS)
    ends = [(x[:, 1], x[:, 2]) for x in (t.X1, t.Y1, t.X2, t.Y2)]
    before, after = (jnp.stack([X1 - X2, (Y1 - Y2) / omega, Y2 / omega]) for X1, Y1, X2, Y2 in zip(*ends, strict=True))
    change, size = (jnp.sum(stop_gradient(x) ** 2, axis=0) for x in (after - before, after))
    repeats = (ahead > 1.0) & (change <= REPEATS**2 * size)
    done = lane.done + ahead
    left = jnp.where(repeats, count - done, 0.0) * (ends[2][1] - ends[2][0])
    new = (ends[0][1] + left, ends[1][1], ends[2][1] + left, ends[3][1])  # pyright: ignore[reportOperatorIssue]
    state = tuple(jnp.where(lane.active, x, y) for x, y in zip(new, lane.state, strict=True))
    status = jnp.where(lane.active, jnp.maximum(lane.status, t.status), lane.status)
    active = lane.active & (status <= Status.GRAZING) & ~repeats & (done < count)  # pyright: ignore[reportOperatorIssue]
    return _Lane(done, state, active, status, t.steps / jnp.maximum(ahead, 1.0))


_run = jax.jit(folded(_in_chunks))


# energy: Energy balance of a run: the work of the drive is stored, or lost in damper and friction.
#
# The steps' polynomials are kept, and the powers are integrated over each step by Gauss-Legendre quadrature: nothing of
# the engine's own recursion is used, so the balance checks series, events and changes of mode at once.

# Quadrature nodes per step: exact for the square of a velocity polynomial of degree 12.
NODES = 16


@dataclass(frozen=True)
class EnergyBalance:
    """Energies in J over a run, numbers or arrays (batch,).

    drive : work of the drive on rod and capsule    stored : change of kinetic, elastic and potential energy
    damper, friction : dissipated, never negative   status : a ``Status`` code
    """

    drive: np.ndarray
    damper: np.ndarray
    friction: np.ndarray
    stored: np.ndarray
    status: np.ndarray

    @property
    def relative_residual(self) -> np.ndarray:
        """|drive - damper - friction - stored| / (|drive| + damper + friction + |stored|)."""
        turnover = np.abs(self.drive) + self.damper + self.friction + np.abs(self.stored)
        return np.abs(self.drive - self.damper - self.friction - self.stored) / np.maximum(
            turnover, np.finfo(float).tiny
        )


def energy_balance(
    p: CapsuleParameters,
    e: Drive,
    span: tuple[float, float],
    initial: Initial | None = None,
    *,
    friction: FrictionLaw | None = None,
    max_steps: int = 20_000,
) -> EnergyBalance:
    """Energy balance of the exact model over span = (begin, end), s; leaves () or (batch,).

    friction : a law in place of the capsule's own, see ``simulate``

    Keeps every step: 240 bytes times max_steps times lanes of memory.

    Raises
    ------
    InputError
        A lane that does not run to the end (status in the message), a prescribed rod, shapes that do not agree.
    """
    if e.prescribed:
        raise InputError("an energy balance needs a force as drive", type(e).__name__, "give a drive that is a force")
    given = (*without_absent(p, e), friction, initial if initial is not None else (0.0, 0.0, 0.0, 0.0))
    begin, end = span
    (p, e, friction, begun), times, batched = lanes_of(given, np.asarray((begin, end)))
    law = friction_law(p, friction)
    rows, starts, status = jax.device_get(_recorded(max_steps, p, e, law, begun, times))
    if not all(Status(int(code)).usable for code in status):
        worst = Status(int(status.max()))
        raise InputError("every lane must run to the end of the span", worst.name, worst.sentence)
    taken = np.isfinite(starts)
    rows = np.moveaxis(np.where(taken[:, None, :], rows, 1.0), 1, 0)
    begins = np.where(taken, starts, times[:, 1])
    half = 0.5 * (np.concatenate([begins[1:], times[None, :, 1]]) - begins)
    node, weight = np.polynomial.legendre.leggauss(NODES)
    t = begins[..., None] + half[..., None] * (1.0 + node)
    X1, Y1, X2, Y2 = (np.asarray(x) for x in exact.values_of(jnp.asarray(rows[..., None]), jnp.asarray(t)))
    # A law may compute with JAX: its leaves stand as (step, lane, node), like the speeds.
    columns_p, columns_e, columns_law = jax.tree.map(lambda leaf: np.asarray(leaf)[None, :, None], (p, e, law))

    def total(power: np.ndarray) -> np.ndarray:
        return np.sum(power * weight * half[..., None], axis=(0, 2))

    # The middle of a step names the piece of the drive: its ends belong to two.
    driven = Y1 if e.reaction is None else Y1 - columns_e.reaction * Y2
    work = total(columns_e.force_at(t, begins[..., None] + half[..., None]) * driven)
    damper = total(_damped(columns_p, X1 - X2, Y1 - Y2))
    rubbed = total(np.asarray(sliding_friction(columns_law, np.sign(Y2), Y2)) * Y2)
    last = rows[:, np.maximum(taken.sum(axis=0) - 1, 0), np.arange(len(status))]
    end = exact.values_of(jnp.asarray(last), jnp.asarray(times[:, 1]))
    change = _stored(p, *(np.asarray(x) for x in end)) - _stored(p, *(np.asarray(x) for x in begun))
    fields = (work, damper, rubbed, change, status)
    return EnergyBalance(*(fields if batched else (x[0] for x in fields)))


def _damped(p: CapsuleParameters, r: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Power lost in dampers, W, at the nodes (step, lane, node); a contact is closed in a whole step or not at all."""
    power = np.zeros_like(r)
    for force in forces_of(p):
        d, closed = r, True
        if force.gap is not None:
            d = force.side * r - force.reach
            closed = (d >= 0.0).mean(axis=-1, keepdims=True) > 0.5
        power += closed * force.damping(d, force.side * w) * (force.side * w)
    return power


def _stored(p: CapsuleParameters, X1: np.ndarray, Y1: np.ndarray, X2: np.ndarray, Y2: np.ndarray) -> np.ndarray:
    node, weight = np.polynomial.legendre.leggauss(NODES)
    stored = 0.5 * (p.m1 * Y1**2 + p.m2 * Y2**2) + downhill(p, p.m1) * X1 + downhill(p, p.m2) * X2
    columns = jax.tree.map(lambda leaf: np.asarray(leaf)[:, None], p)
    for force in forces_of(columns):
        r = (X1 - X2)[:, None]
        d = r if force.gap is None else np.maximum(force.side * r - force.reach, 0.0)
        # The integral of the force from 0 to d: exact for polynomials up to degree 31.
        stored = stored + (0.5 * d * weight * force.elastic(0.5 * d * (1.0 + node))).sum(axis=-1)
    return stored


@partial(jax.jit, static_argnums=0)
def _recorded(
    max_steps: int, p: CapsuleParameters, e: Drive, law: FrictionLaw, initial: Initial, times: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(rows (max_steps, WIDTH, L), starts (max_steps, L), status (L,)) of all steps of a run."""
    constants = constants_of(p, e, law)
    begin, end = jnp.asarray(times[:, 0]), jnp.asarray(times[:, 1])
    lanes = exact.initial_lanes(p, constants, begin, end, initial)
    lanes, rows, starts = exact.march(constants, end, jnp.full(end.shape, max_steps), lanes, max_steps)
    return rows, starts, lanes.status
