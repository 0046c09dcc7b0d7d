"""Forward derivatives of the general capsule in every leaf, through all events and switching times."""

from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.physics.drives import Pulses, RecordedDrive, RodMotion
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import jit_quickly

#: Every term acts, and both contacts close.
P = CapsuleParameters(
    m1=0.106, m2=0.52, k1=1100.0, k2=12e3, c=3.0, mu=0.5, v_s=0.25, G=7e-4, g=9.81, k_cubic=2e8, c2=6.0,
    k2_back=9e3, G_back=9e-4, slope=-0.04, N0=0.8, mu_back=0.7, ratio=0.7, viscous=0.6,
)  # fmt: skip
KNOTS = np.linspace(0.0, 0.6, 31)
DRIVES: dict[str, Any] = {
    "harmonic": Excitation(P_d=5.0, Omega=36.0, phase=0.4, reaction=0.6),
    "pulses": Pulses(P_on=8.0, period=0.17, duty=0.55, P_off=-1.5, phase=0.7, lag=0.012, reaction=0.6),
    "jumps": Pulses(P_on=8.0, period=0.17, duty=0.55, P_off=-1.5, phase=4.4),
    "recorded": RecordedDrive(KNOTS, 6.0 * np.cos(35.0 * KNOTS) + np.sin(80.0 * KNOTS), 0.6),
    "motion": RodMotion.through(KNOTS, 2.5e-3 * np.sin(35.0 * KNOTS)),
}
TIMES = np.linspace(0.0, 0.58, 9)
START = (2e-4, 1e-2, 0.0, 3e-3)
STEPS = (1e-5, 1e-6, 1e-7)
RELATIVE = 1e-4
#: Derivatives below this part of the motion, for a change of the leaf by its size, are noise in the differences.
INSENSITIVE = 1e-3
#: Sizes of leaves that may be zero or say nothing about their scale.
SIZES = {"phase": 1.0, "slope": 0.1, "lag": 0.01, "reaction": 1.0, "X1": 1e-3, "Y1": 0.1}


def directions(e: Any) -> list[tuple[str, CapsuleParameters, Any]]:
    """(leaf, step in the capsule's leaves, step in the drive's leaves) of the size of the leaf, one leaf at a time."""
    rng = np.random.default_rng(3)
    nothing = jax.tree.map(lambda x: np.zeros_like(np.asarray(x, float)), (P, e))
    found = []
    for owner in (0, 1):
        for field in (field for field in fields((P, e)[owner]) if field.name != "forces"):
            value = np.asarray(getattr((P, e)[owner], field.name), float)
            # Of a record every sample moves; of its times only those within.
            moved = rng.standard_normal(value.shape) * (0.02 if field.name == "times" else 1.0) if value.ndim else 1.0
            moved = moved * np.clip(np.arange(value.size), 0, 1) if field.name == "times" else moved
            size = SIZES.get(field.name, 1.0 if field.name == "times" else np.abs(value).max())
            pair = list(nothing)
            pair[owner] = replace(pair[owner], **{field.name: moved * size * np.ones_like(value)})
            found.append((field.name, *pair))
    return found


@pytest.mark.full
@pytest.mark.parametrize(
    "kind", ["pulses", *(pytest.param(kind, marks=pytest.mark.slow) for kind in DRIVES if kind != "pulses")]
)
def test_every_leaf_against_central_differences(kind: str) -> None:
    """One program: a lane per leaf, whose tangent is that leaf's own; against differences of a plain batch."""
    e = DRIVES[kind]
    names, *steps = zip(*directions(e), strict=True)
    d_p, d_e = (jax.tree.map(lambda *leaves: np.stack(leaves), *column) for column in steps)
    L = len(names)
    p, drive = jax.tree.map(lambda x: np.broadcast_to(x, (L, *np.shape(x))), (P, e))

    def states(p: CapsuleParameters, e: Any) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        t = simulate(p, e, TIMES, START)
        return jnp.stack([t.X1, t.Y1, t.X2, t.Y2]), (t.status, t.contacts, t.contacts_back)

    tangent = jit_quickly(lambda a, b: jax.jvp(states, a, b, has_aux=True))
    motion, derivative, (status, contacts, back) = tangent((p, drive), (d_p, d_e))
    derivative = np.asarray(derivative)
    np.testing.assert_array_equal(status, Status.OK)
    assert np.isfinite(derivative).all()
    assert int(contacts[0]) > 3
    assert int(back[0]) > 2
    # A leaf that does not act on this motion, as mu_back without backward sliding, moves it by rounding alone.
    floor = INSENSITIVE * np.abs(motion).max(axis=2)
    # The motion of a prescribed rod depends on its own leaves alone: only the capsule's is compared.
    rows = slice(2, None) if e.prescribed else slice(None)
    errors = []
    for h in STEPS:
        # A lag of zero has a derivative to one side only.
        back_to = np.array([0.0 if name == "lag" and np.all(drive.lag == 0.0) else -h for name in names])
        ends = [np.asarray(states(*moved((p, drive), (d_p, d_e), step))[0]) for step in (np.full(L, h), back_to)]
        difference = (ends[0] - ends[1]) / (h - back_to)[:, None]
        error = np.abs(derivative - difference).max(axis=2) / np.maximum(np.abs(derivative).max(axis=2), floor)
        errors.append(error[rows])
    worst = dict(zip(names, np.min(errors, axis=0).max(axis=0), strict=True))
    # A difference to one side is of first order in its step.
    bar = {name: 1e-3 if kind == "jumps" and name == "lag" else RELATIVE for name in names}
    assert {name: x for name, x in worst.items() if not x < bar[name]} == {}


def moved(point: Any, direction: Any, step: np.ndarray) -> Any:
    """``point`` moved by ``step`` (L,) along ``direction``."""
    return jax.tree.map(lambda x, d: x + step.reshape(-1, *[1] * (np.ndim(d) - 1)) * d, point, direction)
