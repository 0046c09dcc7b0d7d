"""Drives of several pieces: pulses through a lag, a recorded force, a prescribed motion of the rod."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.parameters import CAPSULE_LEAVES, DRIVES, ROUNDING, TABLE, Parameter
from capsule_id.physics.batches import NumberOrBatch, Record, array_module
from capsule_id.physics.forces import DEGREE, Series
from capsule_id.physics.model import CapsuleParameters, Drive, Excitation, Piece

# pulses: Pulses of a coil: P_on and P_off in turn, through a first-order lag (the coil's L/R).


# A lag below this part of the period acts as a delay of the switching times: equal to first order in the lag.
SHORTEST_LAG = ROUNDING
# A transient below this part of |P_on| + |P_off| has ended.
ENDED = 1e-18


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pulses(Drive):
    """The drive lag D' = u - D on the rod, u = P_on while frac(t/period + phase/(2 pi)) < duty, else P_off.

    P_on, P_off : N        period, lag : s        duty : 1        phase : rad; leaves () or (batch,)
    reaction : share of the force that pushes the capsule back, 1

    frac(x) = x - floor(x); u is continuous from the right. duty <= 0 is always off, duty >= 1 always on. The drive
    begins at t = 0: D(0) = P_off; without lag D = u from t = 0 on.

    At lag = 0 the derivative in lag is one-sided: that of a delay of the switching times by lag. It leaves out the
    transient of the start, and how a capsule breaks away during a transient.

    A piece is the number of the half-period, even while on, and where there is a lag the transient D - u at a time.
    """

    P_on: NumberOrBatch
    period: NumberOrBatch
    duty: NumberOrBatch
    P_off: NumberOrBatch = 0.0
    phase: NumberOrBatch = 0.0
    lag: NumberOrBatch | None = 0.0
    reaction: NumberOrBatch | None = 0.0

    parameters: ClassVar[tuple[Parameter, ...]] = tuple(TABLE[name] for name in DRIVES["pulses"])

    @property
    def amplitude(self) -> Any:
        """The larger magnitude of P_on and P_off, N."""
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

    def covers(self, begin: Any, end: Any) -> Any:
        """Whether the run begins at t = 0 or later."""
        return (begin >= 0.0) & (begin <= end)

    def rate(self, piece: Piece, t: jax.Array) -> Any:
        """1/lag while the transient lasts; the smaller it is, the less its high orders matter."""
        if self.lag is None:
            return 0.0
        share = jnp.abs(self._transient(piece, t)) / self._size()
        lasts = self._lagging() & (share > 0.0)
        # XLA vectorises exponential and logarithm, but no power.
        root = jnp.exp(jnp.log(jnp.where(lasts, share, 1.0)) * (1.0 / DEGREE))
        return jnp.where(lasts, root / self._safe_lag(jnp), 0.0)

    def _size(self) -> jax.Array:
        size = jnp.abs(self.P_on) + jnp.abs(self.P_off)
        return jnp.where(size > 0.0, size, 1.0)

    def piece(self, t: jax.Array) -> Piece:
        """The number of the half-period; with a lag a time and the transient then; the end."""
        x = t / self.period + self._turn()
        cycle = jnp.floor(x)
        half = 2.0 * cycle + jnp.where(x - cycle < self.duty, 0.0, 1.0)
        # Rounding may leave t in a piece that ends at t.
        for _ in range(2):
            half = jnp.where(self._end(half) <= t, half + 1.0, half)
        if self.lag is None:
            return half, self._end(half)
        transient = self.force_at(t, self._middle(half)) - self._level(half)
        return half, t, jnp.where(self._lagging(), transient, 0.0), self._end(half)  # pyright: ignore[reportReturnType]

    def following(self, piece: Piece) -> Piece:
        """The next half-period; D is continuous where there is a lag."""
        half = piece[0] + 1.0
        if self.lag is None:
            return half, self._end(half)
        transient = self._transient(piece, piece[-1]) + self._level(piece[0]) - self._level(half)
        return half, piece[-1], jnp.where(self._lagging(), transient, 0.0), self._end(half)

    def _transient(self, piece: Piece, t: jax.Array) -> jax.Array:
        """D - u at t, N: it decays."""
        transient = piece[2] * jnp.exp((piece[1] - t) / self._safe_lag(jnp))
        return jnp.where(jnp.abs(transient) > ENDED * self._size(), transient, 0.0)

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
        return jnp.where((self.duty > 0.0) & (self.duty < 1.0), end, jnp.inf)  # pyright: ignore[reportReturnType]

    def series(self, piece: Piece, t: jax.Array, h: Any, order: int) -> Series:
        """Constant, and the transient's exponential."""
        level = self._level(piece[0])
        if self.lag is None:
            return [level] + [jnp.zeros_like(level)] * (order - 1)
        terms, ratio = [self._transient(piece, t)], -h / self._safe_lag(jnp)
        for k in range(1, order):
            terms.append(terms[-1] * ratio * (1.0 / k))
        return [level + terms[0], *terms[1:]]


# recorded: Drives that are given by a record: a force, or the motion of the rod itself.


Samples = np.ndarray | jax.Array  # (n,) or (batch, n)


class _Lines(Record, Drive):
    """A drive whose value is a straight line between known times, with or without jumps there.

    A piece is its number, its begin, the value there, its slope, and its end.
    """

    times: Samples

    def _line(self, index: Any) -> tuple[Any, Any, Any]:
        """Begin of a piece, the value there, and its slope."""
        raise NotImplementedError

    def _index(self, t: Any) -> Any:
        """Index of the last time at or before t (...), at most that of the last piece; times (..., n)."""
        xp = array_module(self.times, t)
        t = xp.asarray(t)
        passed = xp.sum(_aligned(self.times, t) <= t[..., None], axis=-1)
        return xp.clip(passed - 1, 0, max(self.times.shape[-1] - 2, 0))

    def force_at(self, t: Any, piece: Any = None) -> Any:
        """The value on the line that holds at the time ``piece``, N, or m/s^2 where the motion is prescribed."""
        begin, value, slope = self._line(self._index(t if piece is None else piece))
        return value + slope * (t - begin)

    def covers(self, begin: Any, end: Any) -> Any:
        """Whether the samples are finite, times increase, and the run stays within them."""
        xp, times = array_module(self.times, begin), self.times
        fine = xp.all(xp.diff(times, axis=-1) > 0.0, axis=-1) & (times.shape[-1] > 1)
        for name in self.samples:
            fine = fine & xp.isfinite(getattr(self, name)).all(axis=-1)
        return fine & (begin <= end) & (times[..., 0] <= begin) & (end <= times[..., -1])

    def piece(self, t: jax.Array) -> Piece:
        """The line at t."""
        return self._at(self._index(jax.lax.stop_gradient(t)))

    def following(self, piece: Piece) -> Piece:
        """The next line."""
        return self._at(piece[0].astype(int) + 1)

    def _at(self, index: jax.Array) -> Piece:
        last = index >= self.times.shape[-1] - 2
        end = jnp.where(last, jnp.finfo(float).max, _sample(self.times, index + 1))
        return index.astype(float), *self._line(index), end  # pyright: ignore[reportReturnType]

    def series(self, piece: Piece, t: jax.Array, h: Any, order: int) -> Series:
        """A straight line."""
        _, begin, value, slope, _ = piece
        return [value + slope * (t - begin), slope * h, *[jnp.zeros_like(t)] * (order - 2)][:order]


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
            raise InputError(
                "a recorded motion needs two or more finite times, and a finite position for each",
                f"shapes {t.shape} and {x.shape}",
                "remove what is not finite",
            )
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
        begin, x, y, half, sixth = self._cubic(self._index(t))
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


def capsule_and_drive(values: Mapping[str, Any], drive: str) -> tuple[CapsuleParameters, Excitation | Pulses]:
    """The model's parameters and the drive of that name (see ``DRIVES``), from values by symbol, SI, () or (batch,)."""
    p = CapsuleParameters(**{name: values[name] for name in CAPSULE_LEAVES if name in values})
    own = {name: values[name] for name in DRIVES[drive]}
    return p, Excitation(**own) if drive == "harmonic" else Pulses(**own)
