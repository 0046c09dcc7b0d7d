"""What goes into a simulation of the capsule and what comes out of it.

    CapsuleParameters, Excitation, times, initial state -> simulate -> Trajectory

State (X1, Y1, X2, Y2): absolute position and velocity of the rod (m1) and of the capsule (m2); r = X1 - X2.

    m1 X1'' = P_d cos(Omega t + phase) - f        f = k1 r + c (Y1 - Y2) + [r >= G] k2 (r - G)
    m2 X2'' = f - F_s(Y2)                         F_s = mu/2 (1 + exp(-|Y2|/v_s)) (m1 + m2) g sign(Y2)
    stuck while Y2 = 0 and |f| <= F_b = mu (m1 + m2) g

(the paper's eqs. (1) and (2), read as the text below eq. (1) says: "stick-slip" semantics). ``CoulombStribeck``
generalises F_s by mu_back, ratio and viscous.
"""

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import reduce
from operator import and_
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.errors import InputError
from capsule_id.parameters import CAPSULE_LEAVES, TABLE
from capsule_id.physics.batches import NumberOrBatch, lanes_of, run_lanes
from capsule_id.physics.drive import Drive
from capsule_id.physics.drive import Excitation as Excitation
from capsule_id.physics.friction import CoulombStribeck, FrictionLaw, friction_law
from capsule_id.precision import require_float64

if TYPE_CHECKING:
    from capsule_id.physics.smooth.engine import Smoothing

require_float64()

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
    g : acceleration of gravity, m/s^2
    mu_back : static friction coefficient of backward sliding, 1; None: as mu
    ratio : kinetic over static friction, 1       viscous : viscous friction of the ground, N s/m
    """

    m1: NumberOrBatch
    m2: NumberOrBatch
    k1: NumberOrBatch
    k2: NumberOrBatch
    c: NumberOrBatch
    mu: NumberOrBatch
    v_s: NumberOrBatch
    G: NumberOrBatch
    g: NumberOrBatch = 9.81
    mu_back: NumberOrBatch | None = None
    ratio: NumberOrBatch = 0.5
    viscous: NumberOrBatch = 0.0


def admissible(p: CapsuleParameters, e: Drive, law: FrictionLaw) -> jax.Array:
    """(L,) bool: every leaf (L,) is finite and of the sign that its row of the parameter table admits.

    The break-away forces are N >= 0 too. The parameters of eq. (1) are judged where they are leaves of the law.
    """
    own = tuple(row for symbol, row in CAPSULE_LEAVES.items() if symbol not in _OWN_FRICTION)
    leaves = [
        (row, getattr(owner, row.symbol))
        for owner, rows in ((p, own), (e, e.parameters), (law, law.parameters))
        for row in rows
    ]
    still = jnp.zeros_like(jnp.asarray(p.m1))
    leaves += [(TABLE["mu"], threshold(still)) for threshold in (law.forward, law.backward)]
    return reduce(and_, (row.admits(jnp.asarray(leaf)) for row, leaf in leaves if leaf is not None))


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
    INVALID = 3
    NOT_FINITE = 4

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
        "shorten the run, raise max_steps, or check stiffness and masses."
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

    @property
    def x_rel(self) -> jax.Array:
        """X1 - X2, (n,), m: positive towards the support spring."""
        return self.X1 - self.X2


def _check_choices(model: str, semantics: str, smoothing: "Smoothing | None") -> None:
    """Refuse unknown words, and what the exact model does not have."""
    if model not in ("exact", "smooth"):
        raise InputError('model must be "exact" or "smooth"', repr(model), "choose one of the two")
    if semantics not in ("stick-slip", "eq2"):
        raise InputError('semantics must be "stick-slip" or "eq2"', repr(semantics), "choose one of the two")
    if model == "exact" and semantics == "eq2":
        remedy = 'use model="smooth" for eq. (2) to the letter'
        raise InputError("the exact model has stick-slip semantics only", 'semantics="eq2"', remedy)
    if model == "exact" and smoothing is not None:
        raise InputError("the exact model has no smoothing", repr(smoothing), 'leave it out or use model="smooth"')


def simulate(
    p: CapsuleParameters,
    e: Drive,
    times: ArrayLike,
    initial: Initial | None = None,
    model: Literal["exact", "smooth"] = "exact",
    semantics: Literal["stick-slip", "eq2"] = "stick-slip",
    smoothing: "Smoothing | None" = None,
    *,
    friction: FrictionLaw | None = None,
    max_steps: int = MAX_STEPS,
) -> Trajectory:
    """Motion of the capsule at the given times.

    Parameters
    ----------
    p, e : parameters and drive; any leaf may carry a leading batch axis of one common length
    times : (n,) or (batch, n), s, increasing; times[0] is the start
    initial : (X1, Y1, X2, Y2) at times[0], each () or (batch,); default at rest at the origin
    model : "exact" (event-driven) or "smooth" (smoothed Heavisides)
    semantics : "stick-slip", or "eq2" (eq. (2) to the letter; smooth model only, for comparison)
    smoothing : widths of the smooth model; default the certified ones
    friction : a friction law in place of eq. (1); it replaces mu, v_s and the normal force of p. Leaves () or (batch,)
    max_steps : bound on the steps of a lane, after which it is given up with ``Status.TOO_MANY_STEPS``

    The number of parameters follows the public contract. Works under ``jit`` and ``vmap`` and is differentiable in
    forward mode in every float leaf, those of ``friction`` included; the smooth model in reverse mode too. Concrete
    batches are split into chunks of lanes that run on all cores; under a transformation the batch stays whole.

    The engines, ``exact.kernel(max_steps)`` and ``smooth.kernel(smoothing, semantics, max_steps)``, return a function
    ``(p, e, law, initial, times) -> Trajectory`` of lanes: every leaf (L,), times (L, n), fields (L, n) and (L,),
    status and counters int32. Samples are NaN only in lanes whose status is not ``usable``. Bad values give a status,
    not an exception.

    Raises
    ------
    InputError
        Unknown model or semantics, "eq2" or smoothing with the exact model, leaves whose shapes do not agree, times
        that do not increase.
    """
    _check_choices(model, semantics, smoothing)
    (p, e, friction, initial), grid, batched = lanes_of((p, e, friction, initial or (0.0, 0.0, 0.0, 0.0)), times)
    # JAX cannot batch and differentiate a function of a tree that holds None.
    lanes = (p if p.mu_back is not None else replace(p, mu_back=p.mu), e, friction_law(p, friction), initial)
    if model == "exact":
        from capsule_id.physics.exact import engine as exact

        return run_lanes(exact.kernel(max_steps), lanes, grid, batched)
    from capsule_id.physics.smooth import engine as smooth

    return run_lanes(smooth.kernel(smoothing, semantics, max_steps), lanes, grid, batched)
