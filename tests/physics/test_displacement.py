"""Displacement after many periods: against a plain run, in derivatives, and where a run fails."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.physics.drives import Pulses
from capsule_id.physics.forces import CoulombStribeck, Scaled, friction_law, scaled
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import displacement, simulate
from tests.capsule_cases import jit_quickly

PERIOD = 1e-3 * np.array([40.0, 60.0, 80.0, 100.0, 140.0])
COUNT = np.array([60.0, 50.0, 40.0, 3.0, 1.0])
P = CapsuleParameters(m1=0.074, m2=0.193, k1=250.0, k2=0.0, c=0.5, mu=0.28, v_s=0.1, G=np.inf, ratio=0.8)
#: The remaining periods count as equal once the state changes by 1e-5 over one: m after 60 periods of 0.2 mm.
TOLERANCE = 1e-6


@pytest.mark.parametrize(
    "drive",
    [
        Pulses(P_on=-1.2, period=PERIOD, duty=0.3, lag=0.008, reaction=1.0),
        pytest.param(Excitation(P_d=1.5, Omega=2.0 * np.pi / PERIOD), marks=pytest.mark.full),
    ],
    ids=["pulses", "harmonic"],
)
def test_it_is_the_end_of_a_plain_run(drive: Pulses | Excitation) -> None:
    times = np.stack([np.zeros(5), PERIOD * COUNT], axis=1)
    plain = simulate(P, drive, times, (1e-3, 0.0, 0.0, 0.0))
    found = displacement(P, drive, friction_law(P), PERIOD, COUNT, 1e-3)
    assert np.ptp(np.asarray(plain.X2)[:, -1]) > 5e-3
    np.testing.assert_allclose(found.X2, np.asarray(plain.X2)[:, -1], rtol=0.0, atol=TOLERANCE)
    np.testing.assert_array_equal(found.status, plain.status)


@pytest.mark.full
def test_derivatives_are_those_of_the_displacement() -> None:
    def X2(theta: jax.Array) -> jax.Array:
        k1, mu, P_on, lag = theta
        p = CapsuleParameters(0.074, 0.193, k1, 0.0, 0.5, mu, 0.1, np.inf, ratio=0.8)
        drive = Pulses(P_on, PERIOD, 0.3, lag=lag, reaction=1.0)
        return displacement(p, drive, friction_law(p), jnp.asarray(PERIOD), jnp.asarray(COUNT)).X2

    theta = np.array([250.0, 0.28, -1.2, 0.008])
    steps = 1e-6 * np.diag(theta)
    values = np.asarray(jax.jit(jax.vmap(X2))(np.concatenate([theta + steps, theta - steps])))
    differences = ((values[:4] - values[4:]) / 2e-6).T
    found = np.asarray(jit_quickly(jax.jacfwd(X2))(theta)) * theta
    np.testing.assert_allclose(found, differences, rtol=0.0, atol=1e-4 * np.max(np.abs(differences)))


def test_a_factor_scales_any_law_alike() -> None:
    law = CoulombStribeck(mu=0.3, N=2.6, v_s=0.1, mu_back=0.4, ratio=0.7, viscous=0.2)
    own, general = scaled(law, 1.3), Scaled(law, 1.3)
    speed = np.linspace(0.0, 1.0, 5)
    # Eq. (1) keeps its own Taylor recursion.
    assert own == replace(law, N=1.3 * 2.6, viscous=1.3 * 0.2)
    for direction in ("forward", "backward"):
        expected = 1.3 * getattr(law, direction)(speed)
        for made in (own, general, scaled(general, 1.0)):
            np.testing.assert_allclose(getattr(made, direction)(speed), expected, rtol=1e-14)


@pytest.mark.full
def test_a_run_that_cannot_start_has_no_displacement() -> None:
    drive = Pulses(P_on=-1.2, period=PERIOD, duty=0.3, lag=np.array([0.008, -1.0, 0.008, 0.008, 0.008]))
    found = displacement(P, drive, friction_law(P), PERIOD, COUNT)
    np.testing.assert_array_equal(np.isnan(found.X2), [False, True, False, False, False])
    assert int(np.asarray(found.status)[1]) == Status.INVALID
