"""The exact engine against truths that need no program: closed forms, quadrature, matrix exponentials, energy."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

from capsule_id.errors import InputError
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import energy_balance, simulate
from tests.capsule_cases import Cases, states_of
from tests.scipy_capsule import simulate_scipy

M1, M2, g = 0.11, 0.53, 9.81
OUT_OF_REACH = 1e3


def test_free_flight_between_impacts() -> None:
    """Without spring and damper the rod flies under the drive alone; the capsule holds it against a stiff support."""
    p = CapsuleParameters(m1=M1, m2=M2, k1=0.0, k2=2e4, c=0.0, mu=50.0, v_s=0.3, G=1e-3)
    P_d, Omega, Y1 = 0.02, 7.0, 0.04
    times = np.linspace(0.0, 0.023, 9)
    t = simulate(p, Excitation(P_d, Omega), times, (0.0, Y1, 0.0, 0.0))
    a = P_d / M1
    flight = Y1 * times + a / Omega**2 * (1.0 - np.cos(Omega * times))
    assert flight[-1] < p.G
    np.testing.assert_allclose(t.X1, flight, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(t.Y1, Y1 + a / Omega * np.sin(Omega * times), rtol=0.0, atol=1e-13)
    np.testing.assert_array_equal(t.X2, 0.0)


@pytest.mark.parametrize(("mu", "m_star", "rod_after"), [(50.0, M1, -1.0), (0.0, M1 * M2 / (M1 + M2), None)])
def test_undamped_impact_is_a_half_sine(mu: float, m_star: float, rod_after: float | None) -> None:
    """Contact lasts pi sqrt(m*/k2); the rod rebounds elastically off a held or off a free capsule."""
    k2, V, G = 2e4, 0.1, 1e-3
    p = CapsuleParameters(m1=M1, m2=M2, k1=0.0, k2=k2, c=0.0, mu=mu, v_s=0.3, G=G)
    begin, duration = G / V, np.pi * np.sqrt(m_star / k2)
    middle, end = begin + 0.5 * duration, begin + duration
    t = simulate(p, Excitation(0.0, 1.0), np.array([0.0, begin, middle, end, end + 0.01]), (0.0, V, 0.0, 0.0))
    depth = V * np.sqrt(m_star / k2)
    np.testing.assert_allclose(t.x_rel[1:4], [G, G + depth, G], rtol=0.0, atol=1e-12)
    after = rod_after * V if rod_after is not None else V * (M1 - M2) / (M1 + M2)
    capsule = 0.0 if rod_after is not None else V * 2.0 * M1 / (M1 + M2)
    np.testing.assert_allclose(t.Y1[3:], after, rtol=1e-9)
    np.testing.assert_allclose(t.Y2[3:], capsule, rtol=1e-9, atol=1e-15)
    assert int(t.contacts) == 1


def test_coulomb_slide() -> None:
    """With v_s beyond reach friction is mu N: the slide is v^2/(2 mu g) for a capsule that carries its rod's weight."""
    v, mu = 0.4, 0.3
    p = CapsuleParameters(m1=M1, m2=M2, k1=0.0, k2=0.0, c=0.0, mu=mu, v_s=1e9, G=OUT_OF_REACH)
    deceleration = mu * (M1 + M2) * g / M2
    t = simulate(p, Excitation(0.0, 1.0), np.linspace(0.0, 1.0, 5), (0.0, 0.0, 0.0, v))
    np.testing.assert_allclose(t.X2[1:], v**2 / (2.0 * deceleration), rtol=1e-9)
    np.testing.assert_array_equal(t.Y2[1:], 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_stribeck_slide(sign: float) -> None:
    """d = integral of m2 v/F_s(v) from 0 to v, the quadrature that stands for a push."""
    v, mu, v_s = 0.5, 0.66, 0.2
    p = CapsuleParameters(m1=M1, m2=M2, k1=0.0, k2=0.0, c=0.0, mu=mu, v_s=v_s, G=OUT_OF_REACH)
    weight = (M1 + M2) * g
    d, _ = quad(lambda u: M2 * u / (0.5 * mu * weight * (1.0 + np.exp(-u / v_s))), 0.0, v, epsabs=1e-14, epsrel=1e-13)
    t = simulate(p, Excitation(0.0, 1.0), np.array([0.0, 1.0]), (0.0, 0.0, 0.0, sign * v))
    assert float(t.X2[-1]) == pytest.approx(sign * d, rel=1e-8)


@pytest.mark.parametrize(("v_s", "P_d"), [(1e-3, 4.0), pytest.param(3e-3, 20.0, marks=pytest.mark.full)])
def test_friction_that_falls_within_a_small_speed(v_s: float, P_d: float) -> None:
    """Against SciPy: a step must not pass the rise of the friction before a stop. Before: 5 and 0.06 mm off, status OK."""
    rig = {"m1": M1, "m2": M2, "k1": 1420.0, "k2": 0.0, "c": 3.89, "mu": 0.3, "v_s": v_s, "G": 1.0}
    times = np.linspace(0.0, 0.4, 5)
    t = simulate(CapsuleParameters(**rig), Excitation(P_d, 34.56), times)
    expected, _ = simulate_scipy(
        {**rig, "g": g, "P_d": P_d, "Omega": 34.56}, times, rtol=1e-11, atol=1e-13, max_step=1e-3
    )
    np.testing.assert_allclose(states_of(t)[:, 2], expected[:, 2], rtol=0.0, atol=2e-8)


def _oscillator(A: np.ndarray, start: np.ndarray, times: np.ndarray) -> np.ndarray:
    return np.array([expm(A * t) @ start for t in times])


def test_a_capsule_below_the_threshold_sticks_forever_and_its_rod_is_a_linear_oscillator() -> None:
    k1, c, P_d, Omega = 1420.0, 3.89, 0.8, 73.58
    p = CapsuleParameters(m1=M1, m2=M2, k1=k1, k2=56410.0, c=c, mu=0.66, v_s=0.3, G=2e-3)
    times = np.linspace(0.0, 3.0, 40)
    t = simulate(p, Excitation(P_d, Omega), times)
    A = np.array([[0, 1, 0, 0], [-k1 / M1, -c / M1, P_d / M1, 0], [0, 0, 0, -Omega], [0, 0, Omega, 0]])
    expected = _oscillator(A, np.array([0.0, 0.0, 1.0, 0.0]), times)
    np.testing.assert_allclose(t.X1, expected[:, 0], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(t.Y1, expected[:, 1], rtol=0.0, atol=1e-10)
    np.testing.assert_array_equal(t.X2, 0.0)
    assert int(t.events) == 0


def test_without_friction_rod_and_capsule_are_a_linear_oscillator() -> None:
    k1, c, P_d, Omega = 1420.0, 3.89, 2.0, 30.0
    p = CapsuleParameters(m1=M1, m2=M2, k1=k1, k2=2e4, c=c, mu=0.0, v_s=0.3, G=OUT_OF_REACH)
    times = np.linspace(0.0, 1.5, 30)
    t = simulate(p, Excitation(P_d, Omega), times)
    A = np.zeros((6, 6))
    A[0, 1] = A[2, 3] = 1.0
    A[1, :4] = np.array([-k1, -c, k1, c]) / M1
    A[3, :4] = np.array([k1, c, -k1, -c]) / M2
    A[1, 4], A[4, 5], A[5, 4] = P_d / M1, -Omega, Omega
    expected = _oscillator(A, np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0]), times)[:, :4]
    np.testing.assert_allclose(states_of(t)[:, [0, 2]], expected[:, [0, 2]], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(states_of(t)[:, [1, 3]], expected[:, [1, 3]], rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(
    "name", ["fig6_k2_1", *(pytest.param(one, marks=pytest.mark.full) for one in ("fig10_Om_26.58", "fig11_Pd_1.2"))]
)
def test_energy_is_balanced_over_a_hundred_periods(cases: Cases, name: str) -> None:
    p, e, T = cases.one(name)
    balance = energy_balance(p, e, (0.0, 100.0 * T))
    assert balance.relative_residual < 1e-9
    assert min(balance.drive, balance.damper, balance.friction) > 0.0


def test_energy_of_a_batch_and_of_a_run_that_ends_early(cases: Cases) -> None:
    balance = energy_balance(cases.p, cases.e, (0.0, 0.5), max_steps=2000)
    assert balance.drive.shape == cases.T.shape
    assert (balance.relative_residual < 1e-9).all()
    with pytest.raises(InputError, match="TOO_MANY_STEPS"):
        energy_balance(cases.p, cases.e, (0.0, 500.0), max_steps=2000)
