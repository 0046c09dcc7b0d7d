"""What goes into a simulation of the capsule and what comes out of it.

    CapsuleParameters, Excitation, times, initial state -> simulate -> Trajectory

State (X1, Y1, X2, Y2): absolute position and velocity of the rod (m1) and of the capsule (m2); r = X1 - X2.

    m1 X1'' = P_d cos(Omega t + phase) - f        f = k1 r + c (Y1 - Y2) + [r >= G] k2 (r - G)
    m2 X2'' = f - F_s(Y2)                         F_s = mu/2 (1 + exp(-|Y2|/v_s)) (m1 + m2) g sign(Y2)
    stuck while Y2 = 0 and |f| <= F_b = mu (m1 + m2) g

(the paper's eqs. (1) and (2), read as the text below eq. (1) says: "stick-slip" semantics). ``CoulombStribeck``
generalises F_s by mu_back, ratio and viscous. The general capsule has more, each term absent by default; w = Y1 - Y2,
D the force of any drive:

    f = k1 r + k_cubic r^3 + c w + [r >= G] (k2 (r - G) + c2 w) + [r <= -G_back] k2_back (r + G_back)
    m1 X1'' = D - f - m1 g sin(slope)             N = (m1 + m2) g cos(slope) + N0
    m2 X2'' = F - F_s(Y2),  F = f - reaction D - m2 g sin(slope);  stuck while Y2 = 0 and F is within the break-away forces

Contacts are switched by r alone: the force may pull just before opening. Where Y2 reaches 0 the stuck rule decides with
the contacts and D of that instant (after a jump).
"""

import math
from dataclasses import dataclass, fields, replace
from enum import IntEnum, auto
from functools import reduce
from operator import and_
from typing import Any, ClassVar, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.parameters import CAPSULE_LEAVES, DRIVES, ROUNDING, TABLE, TABLE_1, Parameter
from capsule_id.physics.batches import NumberOrBatch, array_module, is_traced
from capsule_id.physics.forces import CoulombStribeck, FrictionLaw, Series, downhill, rod_on_capsule

# drives: The force on the rod at any time, and what a Taylor step needs of it.

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
    def reaction(self) -> Any:
        """Share of the force that pushes the capsule back, 1; None: 0."""

    def force_at(self, t: Any, piece: Any = None) -> Any:
        """Force in N at the times t, s; leaves and t broadcast; NumPy and JAX.

        piece : the force follows the analytic piece that holds at this time, s; default t itself
        """

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
        return self.frequency()

    def piece(self, t: jax.Array) -> Piece:
        """What holds on the piece at the time t (L,); every entry (L,). The last one is the time at which it ends, s,
        differentiable, infinite for the last piece. Empty: there is one piece alone."""
        return ()

    def following(self, piece: Piece) -> Piece:
        """The next piece."""
        return piece


class PeriodicDrive(Drive, Protocol):
    """What a drive with a period adds: motions can settle under it."""

    @property
    def period(self) -> Any:
        """s; () or (batch,)."""

    @property
    def amplitude(self) -> Any:
        """The largest force, N; () or (batch,)."""


#: In place of a frequency that is not stated. The object is compared, so that NaN may be stated.
_UNSTATED = float("nan")


@jax.tree_util.register_dataclass
@dataclass(frozen=True, init=False)
class Excitation(Drive):
    """The drive P_d cos(Omega t + phase) on the rod: P_d in N, Omega in rad/s, phase in rad; leaves () or (batch,).

    f : Hz, in place of Omega = 2 pi f
    reaction : share of the force that pushes the capsule back, 1: 0 for a force from outside, 1 for an actuator
        between rod and capsule

    Raises
    ------
    InputError
        If both Omega and f are stated, or neither.
    """

    P_d: NumberOrBatch
    Omega: NumberOrBatch
    phase: NumberOrBatch = 0.0
    reaction: NumberOrBatch | None = 0.0

    def __init__(
        self,
        P_d: NumberOrBatch,
        Omega: NumberOrBatch = _UNSTATED,
        phase: NumberOrBatch = 0.0,
        reaction: NumberOrBatch | None = 0.0,
        *,
        f: NumberOrBatch | None = None,
    ) -> None:
        if (Omega is _UNSTATED) == (f is None):
            found = "neither" if f is None else "both"
            raise InputError(
                "a harmonic drive has one frequency", f"{found} of Omega and f", "give Omega, rad/s, or f, Hz"
            )
        # JAX builds copies from all four leaves, traced or not: nothing may look at them.
        Omega = Omega if f is None else 2.0 * np.pi * f
        for name, value in {"P_d": P_d, "Omega": Omega, "phase": phase, "reaction": reaction}.items():
            object.__setattr__(self, name, value)

    @property
    def f(self) -> Any:
        """Omega / (2 pi), Hz; () or (batch,)."""
        return self.Omega / (2.0 * np.pi)

    parameters: ClassVar[tuple[Parameter, ...]] = tuple(TABLE[name] for name in DRIVES["harmonic"])

    @property
    def period(self) -> Any:
        """2 pi / Omega, s; Omega must not be 0."""
        return 2.0 * jnp.pi / self.Omega

    @property
    def amplitude(self) -> Any:
        """Magnitude of P_d, N."""
        return abs(self.P_d)

    def cosine(self, t: Any) -> Any:
        """cos(Omega t + phase) at the times t, s."""
        angle = self.Omega * t + self.phase
        return array_module(angle).cos(angle)

    def force_at(self, t: Any, piece: Any = None) -> Any:
        """P_d cos(Omega t + phase), N."""
        return self.P_d * self.cosine(t)

    def frequency(self) -> Any:
        """Magnitude of Omega, rad/s."""
        return jnp.abs(self.Omega)

    def series(self, piece: Piece, t: jax.Array, h: Any, order: int) -> Series:
        """The coefficients follow from D'' = -Omega^2 D."""
        cosine, sine = cos_sin(self.Omega * t + self.phase)
        angle = jnp.asarray(self.Omega * h)
        turn = -(angle**2)
        D: Series = [jnp.asarray(self.P_d * cosine), jnp.asarray(-self.P_d * angle * sine)]
        for k in range(2, order):
            D.append(D[k - 2] * turn * (1.0 / (k * (k - 1))))
        return D[:order]


# pi/2 in two parts, the first with so many binary places that its multiples are exact; sin(pi) is what a double leaves of
# pi.
_PLACES = 32
_HIGH = math.floor(2.0**_PLACES * np.pi / 2.0) / 2.0**_PLACES
_HALF_PI = (_HIGH, np.pi / 2.0 - _HIGH + math.sin(math.pi) / 2.0)
# Taylor coefficients of sin(x)/x - 1 and of cos(x) - 1 + x^2/2, the highest one first; the next would be below rounding on
# |x| <= pi/4.
_ORDERS = range(7, 0, -1)
_SINE = [(-1.0) ** k / math.factorial(2 * k + 1) for k in _ORDERS]
_COSINE = [-((-1.0) ** k) / math.factorial(2 * k + 2) for k in _ORDERS]


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
    odd = (quadrant == 1.0) | (quadrant > 2.0)
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


Initial = tuple[NumberOrBatch, NumberOrBatch, NumberOrBatch, NumberOrBatch]

# Bound on the steps of one lane: 348 periods of the busiest reference motion need 45,000.
MAX_STEPS = 100_000
# Leaves of the capsule that a friction law of its own replaces.
_OWN_FRICTION = frozenset(row.symbol for row in CoulombStribeck.parameters)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CapsuleParameters:
    """The capsule: every leaf a number or an array (batch,), SI.

    m1, m2 : mass of rod and capsule, kg          k1, k2 : stiffness of the rod's and of the support spring, N/m
    c : damping of the rod's spring, N s/m        mu : static friction coefficient, 1
    v_s : Stribeck velocity, m/s                  G : gap between rod and support spring, m
    g : acceleration of gravity, m/s^2            k_cubic : cubic stiffness of the rod's spring, N/m^3
    c2 : damping of the closed contact, N s/m     k2_back, G_back : stiffness and gap of a back spring, N/m and m
    slope : of the ground, rad, +X uphill         N0 : force that presses the capsule down, N, besides the weight
    mu_back : static friction coefficient of backward sliding, 1; None: as mu
    ratio : kinetic over static friction, 1       viscous : viscous friction of the ground, N s/m
    forces : further forces between rod and capsule, a tuple of ``Force``

    k2 = 0 or G = inf: no support spring, and no c2; likewise the back spring.
    """

    m1: NumberOrBatch
    m2: NumberOrBatch
    k1: NumberOrBatch
    k2: NumberOrBatch
    c: NumberOrBatch
    mu: NumberOrBatch
    v_s: NumberOrBatch
    G: NumberOrBatch
    g: NumberOrBatch = TABLE_1["g"]
    k_cubic: NumberOrBatch = 0.0
    c2: NumberOrBatch = 0.0
    k2_back: NumberOrBatch = 0.0
    G_back: NumberOrBatch = np.inf
    slope: NumberOrBatch = 0.0
    N0: NumberOrBatch = 0.0
    mu_back: NumberOrBatch | None = None
    ratio: NumberOrBatch = CoulombStribeck.ratio
    viscous: NumberOrBatch = 0.0
    forces: Any = None


AnyDrive = TypeVar("AnyDrive", bound=Drive)


def without_absent(p: CapsuleParameters, e: AnyDrive) -> tuple[CapsuleParameters, AnyDrive]:
    """p and e with None for each term that is known to be absent in all lanes: the engines leave it out.

    A traced value may be anything, so its term stays.
    """

    def absent(value: Any, nothing: float) -> bool:
        return value is None or (not is_traced(value) and bool(np.all(np.asarray(value) == nothing)))

    gone = [name for name in ("k_cubic", "c2", "slope", "N0") if absent(getattr(p, name), 0.0)]
    if absent(p.k2, 0.0) or absent(p.G, np.inf):
        gone += ["k2", "G", "c2"]
    if absent(p.k2_back, 0.0) or absent(p.G_back, np.inf):
        gone += ["k2_back", "G_back"]
    drive: Any = e
    own = {field.name for field in fields(drive)}
    off = [name for name in ("reaction", "lag") if name in own and absent(getattr(e, name), 0.0)]
    return replace(p, **dict.fromkeys(gone)), replace(drive, **dict.fromkeys(off))


def admissible(p: CapsuleParameters, e: Drive, law: FrictionLaw) -> jax.Array:
    """(L,) bool: every leaf (L,) is finite and of the sign that its row of the parameter table admits.

    The break-away forces are N >= 0 too. The parameters of eq. (1) are judged where they are leaves of the law. A
    prescribed rod needs no mass.
    """
    own = tuple(row for symbol, row in CAPSULE_LEAVES.items() if symbol not in _OWN_FRICTION)
    leaves = [
        (row, getattr(owner, row.symbol))
        for owner, rows in ((p, own), *((part, part.parameters) for part in (e, law, *(p.forces or ()))))
        for row in rows
    ]
    still = jnp.zeros_like(jnp.asarray(p.m1))
    leaves += [(TABLE["mu"], threshold(still)) for threshold in (law.forward, law.backward)]
    if e.prescribed:
        leaves = [(TABLE["c"] if row.symbol == "m1" else row, leaf) for row, leaf in leaves]
    judged = [row.admits(jnp.asarray(leaf)) for row, leaf in leaves if leaf is not None]
    return reduce(and_, [*judged, pressed(p, law)])


def pressed(p: CapsuleParameters, law: FrictionLaw) -> Any:
    """(L,) bool: the ground carries the capsule, N > 0; NumPy and JAX.

    Only a slope or N0 can lift it. A law of its own has no normal force.
    """
    if not isinstance(law, CoulombStribeck) or (p.slope is None and p.N0 is None):
        return p.m1 == p.m1
    size = (p.m1 + p.m2) * p.g + abs(0.0 if p.N0 is None else p.N0)
    return ROUNDING * size < law.N  # on a slope of 90 degrees rounding is left


def _signs() -> str:
    """The rule of ``admissible`` in words."""
    positive, not_negative = (
        ", ".join(symbol for symbol, row in CAPSULE_LEAVES.items() if row.sign == sign)
        for sign in ("positive", "not negative")
    )
    return f"{positive} > 0; {not_negative} >= 0"


class Status(IntEnum):
    """How a run ended; the value is what ``Trajectory.status`` holds, ``sentence`` says it in words."""

    OK = 0
    GRAZING = 1
    TOO_MANY_STEPS = 2
    INVALID = auto()
    NOT_FINITE = auto()

    @property
    def usable(self) -> bool:
        """Whether every sample of the run is finite and right."""
        return self <= Status.GRAZING

    @property
    def sentence(self) -> str:
        """What happened and what can be done about it."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.OK: "The run is complete.",
    Status.GRAZING: (
        "The run is complete, but an event happens at (almost) zero rate: the motion grazes, "
        "and derivatives through that event do not exist or are unreliable."
    ),
    Status.TOO_MANY_STEPS: (
        "The run was given up because it needs more steps than max_steps; the samples after that point are NaN: "
        "shorten the run, or check stiffness and masses; in Python max_steps may be larger."
    ),
    Status.INVALID: (
        "The run was not started: a parameter, the excitation, a time or the initial state is not finite or not "
        f"admissible ({_signs()}); all samples are NaN."
    ),
    Status.NOT_FINITE: "The run left the range of floating-point numbers; the samples after that point are NaN.",
}


def status_message(status: ArrayLike) -> str:
    """The sentence of the gravest status in ``status`` (a code or an array of codes), with the number of its lanes."""
    codes = np.atleast_1d(np.asarray(status))
    worst = Status(int(codes.max(initial=0)))
    if codes.size == 1 or worst is Status.OK:
        return worst.sentence
    return f"{int((codes == worst).sum())} of {codes.size} runs: {worst.sentence}"


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """Samples of a motion; with a batch every field has the batch axis in front.

    times : (n,), s                X1, Y1, X2, Y2 : (n,), m and m/s, absolute
    contacts : closings of the gap between times[0] and times[-1] (a start in contact is not a closing)
    contacts_back : closings of the back gap
    status : a ``Status`` code     steps : integration steps taken
    events : changes of mode located (0 for the smoothed model, which has none)
    """

    times: jax.Array
    X1: jax.Array
    Y1: jax.Array
    X2: jax.Array
    Y2: jax.Array
    contacts: jax.Array
    status: jax.Array
    steps: jax.Array
    events: jax.Array
    contacts_back: jax.Array

    @property
    def x_rel(self) -> jax.Array:
        """X1 - X2, (n,), m: positive towards the support spring."""
        return self.X1 - self.X2


def rod_acceleration(p: Any, drive: Drive, t: Any, r: Any, w: Any) -> Any:
    """X1'', m/s^2, at the times t: the reading of an accelerometer on the rod."""
    if drive.prescribed:
        return drive.force_at(t)
    return (drive.force_at(t) - rod_on_capsule(p, r, w) - downhill(p, p.m1)) / p.m1
