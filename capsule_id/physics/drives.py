"""Drives of several pieces: pulses through a lag, a recorded force, a prescribed motion of the rod."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.parameters import DRIVES, TABLE, Parameter
from capsule_id.physics.batches import NumberOrBatch, Record, array_module
from capsule_id.physics.friction import DEGREE, Series

# pulses: Pulses of a coil: P_on and P_off in turn, through a first-order lag (the coil's L/R).


# A lag below this part of the period acts as a delay of the switching times: equal to first order in the lag.
SHORTEST_LAG = 1e-12
# A transient below this part of |P_on| + |P_off| has ended.
ENDED = 1e-18

PulseState = tuple[jax.Array, ...]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pulses:
    """The drive lag D' = u - D on the rod, u = P_on while frac(t/period + phase/(2 pi)) < duty, else P_off.

    P_on, P_off : N        period, lag : s        duty : 1        phase : rad; leaves () or (batch,)
    reaction : share of the force that pushes the capsule back, 1

    frac(x) = x - floor(x); u is continuous from the right. duty <= 0 is always off, duty >= 1 always on. The drive
    begins at t = 0: D(0) = P_off; without lag D = u from t = 0 on.

    At lag = 0 the derivative in lag is one-sided: that of a delay of the switching times by lag. It leaves out the
    transient of the start, and how a capsule breaks away during a transient.

    The engine carries the number of the half-period, even while on, and the transient D - u.
    """

    P_on: NumberOrBatch
    period: NumberOrBatch
    duty: NumberOrBatch
    P_off: NumberOrBatch = 0.0
    phase: NumberOrBatch = 0.0
    lag: NumberOrBatch | None = 0.0
    reaction: NumberOrBatch | None = 0.0

    parameters: ClassVar[tuple[Parameter, ...]] = tuple(TABLE[name] for name in DRIVES["pulses"])
    prescribed: ClassVar[bool] = False

    @property
    def amplitude(self) -> Any:
        """The larger of |P_on| and |P_off|, N."""
        return array_module(self.P_on).maximum(abs(self.P_on), abs(self.P_off))

    def force_at(self, t: Any, piece: Any = None) -> Any:
        """D(t) in closed form, N: the periodic solution, and what is left of the start; t >= 0."""
        piece = t if piece is None else piece
        xp = array_module(self.P_on, self.period, self.duty, self.phase, t)
        x = piece / self.period + self._turn()
        cycle = xp.floor(x)
        on = x - cycle < self.duty
        u = xp.where(on, self.P_on, self.P_off)
        if self.lag is None:
            return u
        begin = (cycle - self._turn()) * self.period
        settled = self._settled(xp, t - begin, on)
        start = self._turn() - xp.floor(self._turn())
        first = self._settled(xp, start * self.period, start < self.duty)
        D = self.P_off + (self.P_on - self.P_off) * (settled - first * xp.exp(-t / self._safe_lag(xp)))
        return xp.where(self._lagging(), D, u)

    def _settled(self, xp: Any, since: Any, on: Any) -> Any:
        """(D - P_off)/(P_on - P_off) of the periodic solution, at the time ``since`` of the cycle's begin, s."""
        lag, share = self._safe_lag(xp), xp.clip(self.duty, 0.0, 1.0)
        a, whole = self.period / lag, xp.expm1(-self.period / lag)
        # The other piece is not used; the bound keeps its exponential finite.
        rising = 1.0 - xp.expm1(-a * (1.0 - share)) / whole * xp.exp(xp.minimum(-since / lag, 1.0))
        falling = xp.expm1(-a * share) / whole * xp.exp(xp.minimum((share * self.period - since) / lag, 1.0))
        return xp.where(on, rising, falling)

    def _turn(self) -> Any:
        return self.phase / (2.0 * jnp.pi)

    def _time_constant(self) -> Any:
        return 0.0 if self.lag is None else self.lag

    def _lagging(self) -> Any:
        return self._time_constant() > SHORTEST_LAG * self.period

    def _safe_lag(self, xp: Any) -> Any:
        return xp.where(self._lagging(), self._time_constant(), self.period)

    def frequency(self) -> jax.Array:
        """0: the pieces bound the steps."""
        return jnp.zeros_like(jnp.asarray(self.period))

    def covers(self, begin: Any, end: Any) -> Any:
        """Whether the run begins at t = 0 or later."""
        return (begin >= 0.0) & (begin <= end)

    def rate(self, state: PulseState) -> jax.Array:
        """1/lag while the transient lasts; the smaller it is, the less its high orders matter."""
        if self.lag is None:
            return jnp.zeros_like(state[0])
        share = jnp.abs(state[1]) / self._size()
        lasts = self._lagging() & (share > 0.0)
        # XLA vectorises exponential and logarithm, but no power.
        root = jnp.exp(jnp.log(jnp.where(lasts, share, 1.0)) * (1.0 / DEGREE))
        return jnp.where(lasts, root / self._safe_lag(jnp), 0.0)

    def _size(self) -> jax.Array:
        size = jnp.abs(self.P_on) + jnp.abs(self.P_off)
        return jnp.where(size > 0.0, size, 1.0)

    def state(self, t: jax.Array) -> PulseState:
        """The number of the half-period, and the transient where there is a lag."""
        x = t / self.period + self._turn()
        cycle = jnp.floor(x)
        half = 2.0 * cycle + jnp.where(x - cycle < self.duty, 0.0, 1.0)
        # Rounding may leave t in a piece that ends at t.
        for _ in range(2):
            half = jnp.where(self._end(half) <= t, half + 1.0, half)
        if self.lag is None:
            return (half,)
        transient = self.force_at(t, self._middle(half)) - self._level(half)
        return half, jnp.where(self._lagging(), transient, 0.0)

    def _middle(self, half: jax.Array) -> jax.Array:
        """The middle of a piece, s."""
        cycle, share = jnp.floor(0.5 * half), jnp.clip(self.duty, 0.0, 1.0)
        within = jnp.where(half == 2.0 * cycle, 0.5 * share, 0.5 * (1.0 + share))
        return (cycle + within - self._turn()) * self.period

    def _level(self, half: jax.Array) -> jax.Array:
        """u in a half-period, N."""
        return jnp.where(half == 2.0 * jnp.floor(0.5 * half), self.P_on, self.P_off)

    def _end(self, half: jax.Array) -> jax.Array:
        """The time at which a half-period ends, s; never where the force does not switch."""
        cycle = jnp.floor(0.5 * half)
        edge = cycle + jnp.where(half == 2.0 * cycle, self.duty, 1.0)
        end = (edge - self._turn()) * self.period
        if self.lag is not None:
            end = end + jnp.where(self._lagging(), 0.0, self.lag)
        return jnp.where((self.duty > 0.0) & (self.duty < 1.0), end, jnp.inf)

    def advanced(self, state: PulseState, t: jax.Array, dt: jax.Array) -> PulseState:
        """The transient decays."""
        del t
        if self.lag is None:
            return state
        transient = state[1] * jnp.exp(-dt / self._safe_lag(jnp))
        return state[0], jnp.where(jnp.abs(transient) > ENDED * self._size(), transient, 0.0)

    def value(self, state: PulseState) -> jax.Array:
        """D, N."""
        u = self._level(state[0])
        return u if self.lag is None else u + state[1]

    def shifted(self, state: PulseState, dt: jax.Array) -> PulseState:
        """The change of the transient over dt, to first order."""
        if self.lag is None:
            return state
        return state[0], state[1] - jax.lax.stop_gradient(state[1] / self._safe_lag(jnp)) * dt

    def series(self, state: PulseState, h: jax.Array, order: int) -> Series:
        """Constant, and the transient's exponential."""
        D = [self.value(state)]
        if self.lag is None:
            return D + [jnp.zeros_like(D[0])] * (order - 1)
        term, ratio = state[1], -h / self._safe_lag(jnp)
        for k in range(1, order):
            term = term * ratio * (1.0 / k)
            D.append(term)
        return D

    def next_switch(self, state: PulseState) -> jax.Array:
        """The end of this half-period."""
        return self._end(state[0])

    def switched(self, state: PulseState) -> PulseState:
        """The next half-period; D is continuous where there is a lag."""
        half = state[0] + 1.0
        if self.lag is None:
            return (half,)
        jump = self._level(half) - self._level(state[0])
        return half, jnp.where(self._lagging(), state[1] - jump, 0.0)


# recorded: Drives that are given by a record: a force, or the motion of the rod itself.


State = tuple[jax.Array, ...]
Samples = np.ndarray | jax.Array  # (n,) or (batch, n)


class _Lines(Record):
    """A drive whose value is a straight line between known times, with or without jumps there.

    The engine carries the number of the piece, the value, its slope, and the end of the piece.
    """

    times: Samples

    def _line(self, index: Any) -> tuple[Any, Any, Any]:
        """Begin of a piece, the value there, and its slope."""
        raise NotImplementedError

    def _piece(self, t: Any) -> Any:
        """Index of the last time at or before t (...), at most that of the last piece; times (..., n)."""
        xp = array_module(self.times, t)
        t = xp.asarray(t)
        passed = xp.sum(_aligned(self.times, t) <= t[..., None], axis=-1)
        return xp.clip(passed - 1, 0, max(self.times.shape[-1] - 2, 0))

    def force_at(self, t: Any, piece: Any = None) -> Any:
        """The value on the line that holds at the time ``piece``, N, or m/s^2 where the motion is prescribed."""
        begin, value, slope = self._line(self._piece(t if piece is None else piece))
        return value + slope * (t - begin)

    def frequency(self) -> jax.Array:
        """0: the pieces bound the steps."""
        return jnp.zeros(self.times.shape[:-1])

    def covers(self, begin: Any, end: Any) -> Any:
        """Whether the samples are finite, times increase, and the run stays within them."""
        xp, times = array_module(self.times, begin), self.times
        fine = xp.all(xp.diff(times, axis=-1) > 0.0, axis=-1) & (times.shape[-1] > 1)
        for name in self.samples:
            fine = fine & xp.isfinite(getattr(self, name)).all(axis=-1)
        return fine & (begin <= end) & (times[..., 0] <= begin) & (end <= times[..., -1])

    def rate(self, state: State) -> jax.Array:
        """0: a straight line needs no short step."""
        return jnp.zeros_like(state[0])

    def state(self, t: jax.Array) -> State:
        """Number of the piece, value, slope and end of the piece."""
        index = self._piece(jax.lax.stop_gradient(t))
        begin, value, slope = self._line(index)
        return self._state(index, value + slope * (t - begin), slope)

    def _state(self, index: jax.Array, value: jax.Array, slope: jax.Array) -> State:
        last = index >= self.times.shape[-1] - 2
        end = jnp.where(last, jnp.finfo(float).max, _sample(self.times, index + 1))
        return index.astype(float), value, slope, end

    def advanced(self, state: State, t: jax.Array, dt: jax.Array) -> State:
        """Along the line."""
        del t
        return state[0], state[1] + state[2] * dt, state[2], state[3]

    def value(self, state: State) -> jax.Array:
        """The value, N or m/s^2."""
        return state[1]

    def shifted(self, state: State, dt: jax.Array) -> State:
        """The change of the value over dt, to first order."""
        return state[0], state[1] + jax.lax.stop_gradient(state[2]) * dt, state[2], state[3]

    def series(self, state: State, h: jax.Array, order: int) -> Series:
        """A straight line."""
        return [state[1], state[2] * h, *[jnp.zeros_like(h)] * (order - 2)]

    def next_switch(self, state: State) -> jax.Array:
        """The end of this piece."""
        return state[3]

    def switched(self, state: State) -> State:
        """The begin of the next piece."""
        index = state[0].astype(int) + 1
        _, value, slope = self._line(index)
        return self._state(index, value, slope)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RecordedDrive(_Lines):
    """A force on the rod by straight lines between points, for example K times the recorded current.

    times : (n,) or (batch, n), s, increasing; a run must not begin before the first or end after the last
    force : (n,) or (batch, n), N
    reaction : share of the force that pushes the capsule back, 1; () or (batch,)
    """

    times: Samples
    force: Samples
    reaction: NumberOrBatch | None = 0.0

    samples: ClassVar[tuple[str, ...]] = ("times", "force")
    parameters: ClassVar[tuple[Parameter, ...]] = (TABLE["reaction"],)
    prescribed: ClassVar[bool] = False

    def _line(self, index: Any) -> tuple[Any, Any, Any]:
        begin, force = _sample(self.times, index), _sample(self.force, index)
        slope = (_sample(self.force, index + 1) - force) / (_sample(self.times, index + 1) - begin)
        return begin, force, slope


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RodMotion(_Lines):
    """The motion of the rod itself: a shaken base, or a position-controlled inner mass.

    Only the capsule's equation is left; m1 then counts for the normal force alone and may be 0. Between the points X1
    is the cubic with the given positions and velocities at both ends, so its acceleration is a straight line.
    ``RodMotion.through`` takes the velocities from a spline.

    times : (n,) or (batch, n), s, increasing; a run must not begin before the first or end after the last
    X1, Y1 : (n,) or (batch, n), position and velocity of the rod, m and m/s
    """

    times: Samples
    X1: Samples
    Y1: Samples

    samples: ClassVar[tuple[str, ...]] = ("times", "X1", "Y1")
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    prescribed: ClassVar[bool] = True
    reaction: ClassVar[None] = None

    @staticmethod
    def through(times: ArrayLike, X1: ArrayLike) -> "RodMotion":
        """The motion on the cubic spline with continuous acceleration (not-a-knot) through a record.

        times : (n,), s, increasing        X1 : (n,) or (batch, n), m

        Raises
        ------
        InputError
            Fewer than two points, times that do not increase, values that are not finite.
        """
        from scipy.interpolate import CubicSpline

        t, x = np.asarray(times, float), np.asarray(X1, float)
        if t.ndim != 1 or len(t) < 2 or x.shape[-1:] != t.shape or not (np.isfinite(t).all() and np.isfinite(x).all()):
            rule = "a recorded motion needs two or more finite times, and a finite position for each"
            raise InputError(rule, f"shapes {t.shape} and {x.shape}", "remove what is not finite")
        if not np.all(np.diff(t) > 0.0):
            raise InputError(
                "times must increase", "found a step that is not positive", "sort them, drop repeated ones"
            )
        return RodMotion(t, x, CubicSpline(t, x, axis=-1)(t, 1))

    def _cubic(self, index: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Begin of a piece, and there position, velocity, half the acceleration, a sixth of the jerk."""
        begin, x, y = (_sample(a, index) for a in (self.times, self.X1, self.Y1))
        end, x_end, y_end = (_sample(a, index + 1) for a in (self.times, self.X1, self.Y1))
        span = end - begin
        mean = (x_end - x) / span
        return begin, x, y, (3.0 * mean - 2.0 * y - y_end) / span, (y + y_end - 2.0 * mean) / span**2

    def _line(self, index: Any) -> tuple[Any, Any, Any]:
        begin, _, _, half, sixth = self._cubic(index)
        return begin, 2.0 * half, 6.0 * sixth

    def rod(self, t: Any) -> tuple[Any, Any]:
        """Position and velocity of the rod at the times t, m and m/s."""
        begin, x, y, half, sixth = self._cubic(self._piece(t))
        tau = t - begin
        return x + tau * (y + tau * (half + tau * sixth)), y + tau * (2.0 * half + tau * 3.0 * sixth)


def _aligned(samples: Any, t: Any) -> Any:
    """Samples (..., n) with as many axes as t[..., None]."""
    return samples.reshape((1,) * (t.ndim + 1 - samples.ndim) + samples.shape)


def _sample(samples: Samples, index: Any) -> Any:
    """samples (..., n) at index (...); beyond the last point it is the last."""
    xp = array_module(samples, index)
    n = samples.shape[-1]
    index = xp.clip(xp.asarray(index), 0, n - 1)
    table = xp.broadcast_to(_aligned(xp.asarray(samples), index), (*index.shape, n))
    return xp.take_along_axis(table, index[..., None], axis=-1)[..., 0]
