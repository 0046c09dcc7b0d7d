"""The smoothed model: eq. (2) with smoothed Heaviside functions, differentiable in forward and in reverse mode."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from operator import and_
from typing import Literal

import jax
import jax.numpy as jnp

from capsule_id.physics.forces import (
    Array,
    FrictionLaw,
    along_ground,
    forces_of,
    rod_on_capsule,
    smooth_abs,
    smooth_heaviside,
    smooth_ramp,
    total,
    weights_along,
)
from capsule_id.physics.model import MAX_STEPS, CapsuleParameters, Drive, Initial, Trajectory, admissible
from capsule_id.physics.smooth.march import Field, Problem, differentiable_run

# friction: The smoothed stick-slip rule, and the force gate of eq. (2) to the letter; any friction law, forces in N.


def breakaway(law: FrictionLaw) -> jax.Array:
    """F_b, N: the law's resistance at speed 0, the mean of both directions."""
    still = jnp.zeros(())
    return 0.5 * (law.forward(still) + law.backward(still))


def _corner(rounding: Array, F_b: Array) -> jax.Array:
    """Width of the threshold's corner, N. Without friction any width gives zero force; 1 N keeps quotients finite."""
    width = jnp.asarray(rounding * F_b)
    return jnp.where(width > 0.0, width, 1.0)


def friction_smooth(law: FrictionLaw, F_b: Array, Y2: Array, f: Array, widths: tuple[Array, Array]) -> jax.Array:
    """Smoothed stick-slip rule: a gate in velocity *and* force without creep.

    friction = x clipped softly to [-backward, forward],   x = f + sqrt(F_b^2 + f^2) Y2 / velocity.

    In the words of eq. (2): the argument |f| - F_b of its Heaviside functions is shifted by the velocity, so that a
    capsule in motion is always in the sliding branch. Where |x| is below the threshold, friction - f drags Y2 to zero
    at the rate sqrt(F_b^2 + f^2) / (m2 velocity): the capsule at rest stays at rest under every |f| below
    (1 - rounding) F_b, where a friction of the form F_s tanh(Y2 / velocity) creeps at Y2 ~ velocity f / F_b.

    At Y2 = 0: f inside the thresholds, the threshold outside; slope in Y2 there sqrt(F_b^2 + f^2) / velocity inside,
    0 outside. |Y2| >= sqrt(2) velocity (1 + rounding): exactly the law's resistance with the sign of Y2, so also at
    Y2 -> +-infinity; at f -> +-infinity with Y2 = 0 the threshold with the sign of f. Limit velocity -> 0: the exact
    rule, for every ``rounding``.

    F_b : ``breakaway(law)``, computed once per run
    widths : (velocity, m/s; rounding: the half-width of the clip's corner as a fraction of F_b)
    """
    velocity, rounding = widths
    speed = smooth_abs(Y2, velocity)
    forward, backward = law.forward(speed), law.backward(speed)
    square = F_b * F_b + f * f
    # At f = 0 without friction the root has no derivative: nothing holds the capsule, the pull is zero.
    pull = jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
    x = f + pull * Y2 / velocity
    corner = _corner(rounding, F_b)
    return x - smooth_ramp(x - forward, corner) + smooth_ramp(-x - backward, corner)


def force_gate(law: FrictionLaw, F_b: Array, f: Array, rounding: Array) -> jax.Array:
    """H2 (1 - H1) + H3 H1 of eq. (2), smoothed: 1 where |f| exceeds the threshold, 0 below, in force alone.

    With f the whole force on the capsule, contact included, H2 and H3 are one function, H(|f| - F_b).
    At f = 0 and f inside (1 - rounding) of the threshold 0, at the threshold 1/2 with slope 15 / (16 rounding F_b),
    at +-infinity 1 with slope 0. This is the gate of eq. (2) to the letter, whose limit is not the stick-slip rule.
    """
    still = jnp.zeros(())
    corner = _corner(rounding, F_b)
    return smooth_heaviside(f - law.forward(still), corner) + smooth_heaviside(-f - law.backward(still), corner)


# engine: The smoothed model: eq. (2) with smoothed Heaviside functions, differentiable in forward and in reverse mode.
#
#     m1 Y1' = P_d cos(Omega t + phase) - f,  f = k1 r + c (Y1 - Y2) + k2 R(r - G)     R: H1 smoothed over a penetration
#     m2 Y2' = f - friction(Y2, f),           X1' = Y1,  X2' = Y2                       semantics "stick-slip"
#     m2 Y2' = gate(f) (f - F_s(Y2)),         X1' = Y1,  X2' = gate(f) Y2               semantics "eq2"
#
# The general capsule has the further terms of ``physics.model``; c2 acts through H1. The pieces of a drive end steps;
# derivatives in its switching times are those of the exact model only.
#
# "stick-slip" switches in velocity and force (``friction_smooth``) and tends to the exact model as the widths go
# to zero. "eq2" switches in force alone, as eq. (2) is printed; it tends to a sliding mode on |f| = F_b, a different
# motion, and is offered so that the difference can be shown.


Semantics = Literal["stick-slip", "eq2"]
# First step, as a fraction of the fastest time scale known before the run.
FIRST_STEP = 0.05
# A step never spans more than this angle of the drive (rad), so that no pair of stages can alias it.
DRIVE_ANGLE = 0.5
# (p, e, law, smoothing): what the field depends on, so what a derivative can be taken in.
System = tuple[CapsuleParameters, Drive, FrictionLaw, "Smoothing"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Smoothing:
    """Widths of the smoothed model, the same for every lane of a batch.

    The defaults are certified: the mean velocity over ten periods from rest is within 2 % (+1e-6 m/s) of the exact one
    on all 25 reference cases (worst 0.4 %), and on 98 % of random capsules around them; ``smoothing_bias``
    measures the difference for given parameters.

    velocity : half-width of the stick-slip switch in Y2, m/s
    penetration : half-width of the contact's Heaviside function in r - G, m
    rounding : half-width of the corner at the friction threshold, as a fraction of the threshold, 1
    tolerance : of the solver: error per step over the largest velocity (and stretch of the spring) so far, 1
    """

    velocity: Array = 5e-4
    penetration: Array = 3e-6
    rounding: Array = 0.02
    tolerance: Array = 2e-5


def field_of(system: System, semantics: Semantics, piece: jax.Array | None = None) -> Field:
    """The field on the piece of the drive that holds at the time ``piece`` (L,), s.

    The limit of "stick-slip" is the exact model. "eq2" is eq. (2) to the letter, with its force gate smoothed over
    ``rounding``: for comparison only.
    """
    p, e, law, widths = system
    F_b, weights = breakaway(law), weights_along(p)

    def field(t: jax.Array, r: jax.Array, Y1: jax.Array, Y2: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        D = e.force_at(t, piece)
        rod, f = along_ground(rod_on_capsule(p, r, Y1 - Y2, widths.penetration), D, e.reaction, weights)
        Y1_rate = D if e.prescribed else rod / p.m1
        if semantics == "stick-slip":
            held = friction_smooth(law, F_b, Y2, f, (widths.velocity, widths.rounding))
            return Y1_rate, Y2, (f - held) / p.m2
        gate, forth = force_gate(law, F_b, f, widths.rounding), smooth_heaviside(Y2, widths.velocity)
        speed = smooth_abs(Y2, widths.velocity)
        sliding = forth * law.forward(speed) - (1.0 - forth) * law.backward(speed)
        return Y1_rate, gate * Y2, gate * (f - sliding) / p.m2

    return field


def _nearest(p: CapsuleParameters, side: float) -> jax.Array:
    """(L,) m: the least gap of the contacts on a side of the rod, infinite without one."""
    gaps = [
        jnp.where(force.present, force.gap, jnp.inf)
        for force in forces_of(p)
        if force.gap is not None and force.side == side
    ]
    return reduce(jnp.minimum, gaps, jnp.full_like(p.m1, jnp.inf))  # pyright: ignore[reportArgumentType]


def _problem(system: System, semantics: Semantics) -> Problem:
    p, e, law, widths = system
    lightness = 1.0 / p.m1 + 1.0 / p.m2
    # Rates of springs, damper, drive and friction, 1/s; the switch's own rate needs no small first step.
    resistance, slope = jax.jvp(law.forward, (jnp.zeros_like(p.m1),), (jnp.ones_like(p.m1),))
    friction_rate = 2.0 * p.g * jnp.abs(slope) / jnp.where(resistance > 0.0, resistance, jnp.inf)  # pyright: ignore[reportOperatorIssue]
    springs, d = [force.elastic for force in forces_of(p)], widths.penetration + jnp.zeros_like(p.m1)
    stiffness = jax.jvp(lambda d: total(elastic(d) for elastic in springs), (d,), (jnp.ones_like(d),))[1]
    fastest = jnp.sqrt(jnp.abs(stiffness) * lightness) + p.c * lightness + e.frequency() + friction_rate
    fine = [jnp.isfinite(width) & (width > 0.0) for width in vars(widths).values()]
    return Problem(
        field=partial(field_of, system, semantics),
        drive=e,
        gaps=(_nearest(p, 1.0), _nearest(p, -1.0)),
        first=FIRST_STEP / fastest,
        longest=DRIVE_ANGLE / e.frequency(),
        floors=(jnp.asarray(widths.velocity), jnp.asarray(widths.penetration)),
        tolerance=jnp.asarray(widths.tolerance),
        valid=reduce(and_, fine, admissible(p, e, law)),
    )


@lru_cache(maxsize=32)
def _compiled(semantics: Semantics, max_steps: int) -> Callable[..., Trajectory]:
    march = differentiable_run(partial(_problem, semantics=semantics), max_steps)

    @jax.jit
    def lanes(
        smoothing: Smoothing,
        p: CapsuleParameters,
        e: Drive,
        law: FrictionLaw,
        initial: Initial,
        times: jax.Array,
    ) -> Trajectory:
        shape = times.shape[:1]
        widths = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, float), shape), smoothing)
        system = (*jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (p, e, law)), widths)
        times = jnp.asarray(times, float)
        record = march(system, times, jnp.stack(initial))
        X1, Y1, X2, Y2 = record.samples
        none = jnp.zeros_like(record.steps)
        contacts, back = record.closings
        return Trajectory(times, X1, Y1, X2, Y2, contacts, record.status, record.steps, none, back)

    return lanes


def kernel(
    smoothing: Smoothing | None = None, semantics: Semantics = "stick-slip", max_steps: int = MAX_STEPS
) -> Callable[..., Trajectory]:
    """The smoothed engine on lanes: ``(p, e, law, initial, times) -> Trajectory``, see ``model.simulate``.

    smoothing : widths, default the certified ones; they are traced, all as float64: new widths need no compilation
    max_steps : bound on the steps that a lane may try
    """
    widths = jax.tree.map(lambda width: jnp.asarray(width, float), smoothing or Smoothing())
    return partial(_compiled(semantics, max_steps), widths)
