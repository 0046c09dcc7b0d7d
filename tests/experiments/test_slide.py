"""Eq. (1) and the slide that follows from it: against SciPy's quadrature and against the dilogarithm."""

from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest
from bench import G
from scipy import integrate, special

from capsule_id.experiments.friction import paper_friction_fit, unit_law
from capsule_id.physics.forces import slide_distance

MU, V_S = 0.66, 0.30
RATIOS = np.geomspace(1e-3, 50.0, 25)  # v / v_s


def by_quadrature(speed: float) -> float:
    value, _ = integrate.quad(lambda u: 2.0 * u / (G * MU * (1.0 + np.exp(-u / V_S))), 0, speed, epsrel=1e-13, epsabs=0)
    return value


def by_dilogarithm(speed: np.ndarray) -> np.ndarray:
    """2 v_s^2/(g mu) (w^2/2 + w ln(1 + e^-w) - Li2(-e^-w) - pi^2/12), w = v/v_s."""
    w = speed / V_S
    bracket = w**2 / 2.0 + w * np.log1p(np.exp(-w)) - special.spence(1.0 + np.exp(-w)) - np.pi**2 / 12.0
    return 2.0 * V_S**2 / (G * MU) * bracket


@pytest.mark.parametrize("xp", [np, jnp])
def test_slide_by_quadrature(xp: object) -> None:
    expected = [by_quadrature(v) for v in RATIOS * V_S]
    np.testing.assert_allclose(
        slide_distance(unit_law(MU, V_S), 1.0 / G, xp.asarray(RATIOS * V_S)), expected, rtol=1e-12
    )  # type: ignore[arg-type]


def test_slide_by_dilogarithm() -> None:
    """The closed form loses digits to cancellation below v_s, where terms near 1 leave w^2/4: an absolute bound."""
    speed = RATIOS * V_S
    scale = 2.0 * V_S**2 / (G * MU)
    np.testing.assert_allclose(
        slide_distance(unit_law(MU, V_S), 1.0 / G, speed), by_dilogarithm(speed), rtol=1e-12, atol=4e-15 * scale
    )


def test_limits() -> None:
    """A slow push sees mu all the way, a fast one mu/2 but for a fixed start."""
    slow, fast = slide_distance(unit_law(MU, V_S), 1.0 / G, np.array([1e-6 * V_S, 1e4 * V_S]))
    assert slow == pytest.approx((1e-6 * V_S) ** 2 / (2.0 * G * MU), rel=1e-6)
    assert fast == pytest.approx((1e4 * V_S) ** 2 / (G * MU), rel=1e-6)
    law = unit_law(MU, V_S)
    assert law.forward(0.0) == MU
    assert law.backward(0.2) == law.forward(0.2) == pytest.approx(0.5 * MU * (1.0 + np.exp(-0.2 / V_S)), rel=1e-15)


def test_paper_fit_recovers_its_own_curve() -> None:
    speed = np.array([0.0, 0.0, 0.1, 0.3, 0.5])
    fit = paper_friction_fit(speed, unit_law(MU, V_S).forward(speed))
    assert fit["mu"] == pytest.approx(MU, rel=1e-7)
    assert fit["v_s"] == pytest.approx(V_S, rel=1e-6)
    assert paper_friction_fit(np.zeros(2), np.array([0.6, 0.7])) == {"mu": pytest.approx(0.65)}
    assert paper_friction_fit(np.array([0.3, 0.3]), np.array([0.5, 0.5])) == {}


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize(("lowest", "error"), [(0.15, 2e-8), (1e-3, 2e-6)])
def test_many_slides_share_panels(lowest: float, error: float, xp: ModuleType) -> None:
    """The error is largest where v_s is small beside the largest speed."""
    for v_s in (0.01, 0.1, 1.0):
        speed, law = np.linspace(1.0, lowest, 97), unit_law(MU, v_s)
        alone = np.concatenate([slide_distance(law, 1.0 / G, part) for part in np.split(speed, 97)])
        np.testing.assert_allclose(slide_distance(law, 1.0 / G, xp.asarray(speed)), alone, rtol=error)
