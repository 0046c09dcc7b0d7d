"""Energy balance of a run: the work of the drive is stored, or lost in damper and friction.

The steps' polynomials are kept, and the powers are integrated over each step by Gauss-Legendre quadrature: nothing of
the engine's own recursion is used, so the balance checks series, events and changes of mode at once.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.errors import InputError
from capsule_id.physics.batches import lanes_of
from capsule_id.physics.exact.engine import initial_lanes, march, values_of
from capsule_id.physics.exact.taylor import constants_of
from capsule_id.physics.forces import FrictionLaw, downhill, forces_of, friction_law, sliding_friction
from capsule_id.physics.model import CapsuleParameters, Drive, Initial, Status, without_absent

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
    (p, e, friction, begun), times, batched = lanes_of(given, np.asarray(span))
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
    X1, Y1, X2, Y2 = (np.asarray(x) for x in values_of(jnp.asarray(rows[..., None]), jnp.asarray(t)))
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
    end = values_of(jnp.asarray(last), jnp.asarray(times[:, 1]))
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
    lanes = initial_lanes(p, constants, begin, end, initial)
    lanes, rows, starts = march(constants, end, jnp.full(end.shape, max_steps), lanes, max_steps)
    return rows, starts, lanes.status
