"""Pulses of a coil: P_on and P_off in turn, through a first-order lag (the coil's L/R)."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from capsule_id.parameters import DRIVES, TABLE, Parameter
from capsule_id.physics.batches import NumberOrBatch, array_module
from capsule_id.physics.series import DEGREE, Series

# A lag below this part of the period acts as a delay of the switching times: equal to first order in the lag.
SHORTEST_LAG = 1e-12
# A transient below this part of |P_on| + |P_off| has ended.
ENDED = 1e-18

State = tuple[jax.Array, ...]


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

    def rate(self, state: State) -> jax.Array:
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

    def state(self, t: jax.Array) -> State:
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

    def advanced(self, state: State, t: jax.Array, dt: jax.Array) -> State:
        """The transient decays."""
        del t
        if self.lag is None:
            return state
        transient = state[1] * jnp.exp(-dt / self._safe_lag(jnp))
        return state[0], jnp.where(jnp.abs(transient) > ENDED * self._size(), transient, 0.0)

    def value(self, state: State) -> jax.Array:
        """D, N."""
        u = self._level(state[0])
        return u if self.lag is None else u + state[1]

    def shifted(self, state: State, dt: jax.Array) -> State:
        """The change of the transient over dt, to first order."""
        if self.lag is None:
            return state
        return state[0], state[1] - jax.lax.stop_gradient(state[1] / self._safe_lag(jnp)) * dt

    def series(self, state: State, h: jax.Array, order: int) -> Series:
        """Constant, and the transient's exponential."""
        D = [self.value(state)]
        if self.lag is None:
            return D + [jnp.zeros_like(D[0])] * (order - 1)
        term, ratio = state[1], -h / self._safe_lag(jnp)
        for k in range(1, order):
            term = term * ratio * (1.0 / k)
            D.append(term)
        return D

    def next_switch(self, state: State) -> jax.Array:
        """The end of this half-period."""
        return self._end(state[0])

    def switched(self, state: State) -> State:
        """The next half-period; D is continuous where there is a lag."""
        half = state[0] + 1.0
        if self.lag is None:
            return (half,)
        jump = self._level(half) - self._level(state[0])
        return half, jnp.where(self._lagging(), state[1] - jump, 0.0)
