"""The drive on the rod: the force at any time, and what a Taylor step needs of it.

A drive is a frozen pytree with the methods of ``Drive``; both engines, the energy balance and the sensors use nothing
else. Its ``parameters`` are the rows of the parameter table that name its leaves and state what they admit. Other
drives: ``capsule_id.physics.drives``.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from capsule_id.parameters import DRIVES, TABLE, Parameter
from capsule_id.physics.batches import NumberOrBatch, array_module
from capsule_id.physics.friction import Series

Piece = tuple[jax.Array, ...]


class Drive(Protocol):
    """A force on the rod as a function of time, analytic in time on each of its pieces.

    parameters : the rows of the leaves, each with the sign that it admits
    prescribed : the drive states the motion of the rod, not the force on it: ``force_at`` and ``series`` then are the
        acceleration of the rod, m/s^2
    reaction : share of the force that pushes the capsule back, 1; None: 0

    What stands here is a drive of one piece, whose class adds ``force_at`` and ``series``.
    """

    parameters: ClassVar[tuple[Parameter, ...]]
    prescribed: ClassVar[bool] = False

    @property
    def reaction(self) -> Any: ...

    def force_at(self, t: Any, piece: Any = None) -> Any:
        """Force in N at the times t, s; leaves and t broadcast; NumPy and JAX.

        piece : the force follows the analytic piece that holds at this time, s; default t itself
        """
        ...

    def series(self, piece: Piece, t: jax.Array, h: Any, order: int) -> Series:
        """Coefficients 0 .. order - 1 of the force in N about t (L,) on a piece, in the scaled time s = (t' - t)/h."""
        ...

    def frequency(self) -> Any:
        """(L,) or () rad/s, how fast the force changes; 0 where only pieces are known."""
        return jnp.zeros(())

    def covers(self, begin: Any, end: Any) -> Any:
        """(L,) bool: whether the drive is well-formed and defined from begin to end (L,), s; NumPy and JAX."""
        return begin <= end

    def rate(self, piece: Piece, t: jax.Array) -> Any:
        """(L,) or () 1/s, how fast the force changes from t (L,) on: it bounds the first guess of a step."""
        del piece, t
        return 0.0

    def piece(self, t: jax.Array) -> Piece:
        """What holds on the piece at the time t (L,); every entry (L,). The last one is the time at which it ends, s,
        differentiable, infinite for the last piece. Empty: there is one piece alone."""
        del t
        return ()

    def following(self, piece: Piece) -> Piece:
        """The next piece."""
        return piece


class PeriodicDrive(Drive, Protocol):
    """What a drive with a period adds: motions can settle under it."""

    @property
    def period(self) -> Any:
        """s; () or (batch,)."""
        ...

    @property
    def amplitude(self) -> Any:
        """The largest force, N; () or (batch,)."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Excitation(Drive):
    """The drive P_d cos(Omega t + phase) on the rod: P_d in N, Omega in rad/s, phase in rad; leaves () or (batch,).

    reaction : share of the force that pushes the capsule back, 1: 0 for a force from outside, 1 for an actuator
        between rod and capsule
    """

    P_d: NumberOrBatch
    Omega: NumberOrBatch
    phase: NumberOrBatch = 0.0
    reaction: NumberOrBatch | None = 0.0

    parameters: ClassVar[tuple[Parameter, ...]] = tuple(TABLE[name] for name in DRIVES["harmonic"])

    @property
    def period(self) -> Any:
        """2 pi / Omega, s; Omega must not be 0."""
        return 2.0 * jnp.pi / self.Omega

    @property
    def amplitude(self) -> Any:
        """|P_d|, N."""
        return abs(self.P_d)

    def cosine(self, t: Any) -> Any:
        """cos(Omega t + phase) at the times t, s."""
        angle = self.Omega * t + self.phase
        return array_module(angle).cos(angle)

    def force_at(self, t: Any, piece: Any = None) -> Any:
        """P_d cos(Omega t + phase), N."""
        del piece
        return self.P_d * self.cosine(t)

    def frequency(self) -> Any:
        """|Omega|."""
        return jnp.abs(self.Omega)

    def rate(self, piece: Piece, t: jax.Array) -> Any:
        """|Omega|."""
        del piece, t
        return jnp.abs(self.Omega)

    def series(self, piece: Piece, t: jax.Array, h: Any, order: int) -> Series:
        """The coefficients follow from D'' = -Omega^2 D."""
        del piece
        cosine, sine = cos_sin(self.Omega * t + self.phase)
        angle = jnp.asarray(self.Omega * h)
        turn = -(angle**2)
        D: Series = [jnp.asarray(self.P_d * cosine), jnp.asarray(-self.P_d * angle * sine)]
        for k in range(2, order):
            D.append(D[k - 2] * turn * (1.0 / (k * (k - 1))))
        return D[:order]


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
