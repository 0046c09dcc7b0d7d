"""The parameters mu_back, ratio and viscous of the capsule: against SciPy, closed forms, and the paper's case."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.physics.forces import CoulombStribeck, friction_law, slide_distance
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import assert_both_ways_as_scipy, jit_quickly, states_of
from tests.scipy_capsule import simulate_scipy

PAPER = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
GENERAL = replace(PAPER, v_s=0.05, mu_back=0.4, ratio=0.7, viscous=2.5)
E = Excitation(P_d=4.0, Omega=34.56)
TIMES = 2.0 * np.pi / 34.56 * np.linspace(0.0, 4.0, 33)


def in_a_batch(p: CapsuleParameters) -> CapsuleParameters:
    """Leaves (1,): all batches share one compiled program."""
    return jax.tree.map(lambda leaf: np.full(1, leaf), p)


def resistance(p: CapsuleParameters, mu: float, speed: float) -> float:
    """The law as PHYSICS states it, N; by NumPy, apart from the package."""
    N = (p.m1 + p.m2) * p.g
    return float(N * mu * (p.ratio + (1.0 - p.ratio) * np.exp(-speed / p.v_s)) + p.viscous * speed)


def test_the_general_law_against_scipy() -> None:
    pair = (lambda v: resistance(GENERAL, GENERAL.mu, v)), (lambda v: resistance(GENERAL, GENERAL.mu_back, v))
    given = {**vars(GENERAL), **vars(E)}
    expected, contacts = simulate_scipy(given, TIMES, rtol=1e-12, atol=1e-15, max_step=5e-4, law=pair)
    t = simulate(in_a_batch(GENERAL), E, TIMES)
    assert_both_ways_as_scipy(t, expected, contacts)


@pytest.mark.parametrize("leaf", ["mu_back", "ratio", "viscous"])
def test_each_parameter_changes_the_motion_in_both_engines(leaf: str) -> None:
    """The smoothed engine follows the exact one, and neither ignores the parameter."""
    with_all, without = in_a_batch(GENERAL), in_a_batch(replace(GENERAL, **{leaf: getattr(PAPER, leaf)}))
    if leaf == "mu_back":
        without = in_a_batch(replace(GENERAL, mu_back=GENERAL.mu))
    end = TIMES[[0, -1]]
    for model, far in (("exact", 0.02), ("smooth", 0.02)):
        moved, other = (float(simulate(p, E, end, model=model).X2[0, -1]) for p in (with_all, without))
        assert abs(moved - other) > far * abs(moved), model
    exact, smooth = (float(simulate(with_all, E, end, model=model).X2[0, -1]) for model in ("exact", "smooth"))
    assert smooth == pytest.approx(exact, rel=0.02)


@pytest.mark.full
def test_mu_back_is_as_mu_by_default_and_a_number_of_its_own_otherwise() -> None:
    """The derivative in mu moves both directions by default; it holds a stated mu_back."""

    def end(mu: jax.Array, mu_back: jax.Array | None) -> jax.Array:
        return simulate(replace(PAPER, mu=mu, mu_back=mu_back), E, TIMES[[0, -1]]).X2[-1]

    mu, one, zero = jnp.asarray(0.66), jnp.asarray(1.0), jnp.asarray(0.0)
    both, alone, back = jit_quickly(
        lambda mu: (
            jax.jvp(lambda m: end(m, None), (mu,), (one,)),
            jax.jvp(end, (mu, mu), (one, zero)),
            jax.jvp(end, (mu, mu), (zero, one)),
        )
    )(mu)
    assert float(both[0]) == pytest.approx(float(alone[0]), rel=1e-12)
    assert float(both[1]) == pytest.approx(float(alone[1] + back[1]), rel=1e-9)
    assert abs(float(back[1])) > 1e-3 * abs(float(both[1]))
    swept = np.array([0.5, 0.66])
    default, stated = (
        simulate(replace(PAPER, mu=swept, mu_back=mu_back), E, TIMES[[0, -1]]).X2[:, -1] for mu_back in (None, swept)
    )
    np.testing.assert_array_equal(default, stated)


def test_a_slide_against_constant_and_viscous_friction() -> None:
    """m v' = -(F + b v) in closed form; ratio = 1 makes v_s irrelevant."""
    p = replace(PAPER, ratio=1.0, viscous=3.0)
    m, v = 0.64, np.array([0.05, 0.3, 1.0])
    F = 0.66 * m * 9.81
    expected = m / 3.0 * (v - F / 3.0 * np.log1p(3.0 * v / F))
    np.testing.assert_allclose(slide_distance(friction_law(p), m, v), expected, rtol=1e-12)


def test_inadmissible_values() -> None:
    for leaf in ("mu_back", "ratio", "viscous"):
        t = simulate(replace(PAPER, **{leaf: np.array([0.1, -0.1, np.nan])}), E, [0.0, 0.01])
        np.testing.assert_array_equal(t.status, [Status.OK] + [Status.INVALID] * 2)


def test_a_law_without_mu_back_slides_alike_both_ways() -> None:
    law = CoulombStribeck(0.5, 6.0, 0.3)
    assert law.backward(0.2) == law.forward(0.2)
    assert CoulombStribeck(0.5, 6.0, 0.3, 0.25).backward(0.2) == 0.5 * law.forward(0.2)


def test_lanes_do_not_depend_on_each_other() -> None:
    values = {"mu": [0.7, 0.66], "mu_back": [0.3, 0.4], "ratio": [0.5, 0.7], "viscous": [0.5, 2.5], "v_s": [0.1, 0.05]}
    batch = simulate(replace(GENERAL, **{name: np.array(pair) for name, pair in values.items()}), E, TIMES)
    np.testing.assert_array_equal(states_of(batch)[1], states_of(simulate(in_a_batch(GENERAL), E, TIMES))[0])
