"""A misfit's density at many values of its scatter, against SciPy at each of them."""

from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from capsule_id.experiments.misfit import (
    MANY_NUISANCES,
    MANY_READINGS,
    VARIANCES,
    Misfit,
    Moments,
    conditional_draw,
    conditional_mean,
)

RNG = np.random.default_rng(5)
RAW, DESIGN = RNG.standard_normal(7), RNG.standard_normal((7, 3))
SCATTERS = np.array([[0.1, 0.7], [2.0, 5.0]])
ONE_VARIANCE = Misfit(RAW, 0.3, 1.5, DESIGN)
CASES = {
    "one variance": ONE_VARIANCE,
    "no nuisance": Misfit(RAW, 0.0, 1.0, np.zeros((7, 0))),
    "unequal": Misfit(RAW, np.linspace(0.1, 2.0, 7), np.linspace(1.0, 3.0, 7), DESIGN),
    "many nuisances": Misfit(RAW, 0.3, np.linspace(1.0, 3.0, 7), RNG.standard_normal((7, MANY_NUISANCES + 2))),
    "unequal, no nuisance": Misfit(RAW, 0.2, np.linspace(1.0, 3.0, 7), np.zeros((7, 0))),
}


def by_scipy(misfit: Misfit, scatter: float) -> float:
    variance = (misfit.fixed_variance + (misfit.scale * scatter) ** 2) * np.ones(7)
    covariance = np.diag(variance) + misfit.design @ misfit.design.T
    return float(stats.multivariate_normal.logpdf(misfit.raw, np.zeros(7), covariance))


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("case", CASES)
def test_density_at_many_scatters(case: str, xp: object) -> None:
    misfit = CASES[case]
    expected = [[by_scipy(misfit, s) for s in row] for row in SCATTERS]
    for part in (misfit, misfit.summary()):
        found = part.log_density(SCATTERS, xp)  # type: ignore[arg-type]
        np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-12)
        assert float(part.log_density(0.7, xp)) == pytest.approx(expected[0][1], rel=1e-12)  # type: ignore[arg-type]


def test_moments_only_where_one_variance_holds() -> None:
    kinds = {case: isinstance(misfit.summary(), Moments) for case, misfit in CASES.items()}
    assert kinds == {case: case in ("one variance", "no nuisance") for case in CASES}


def test_the_ordinate_normalises() -> None:
    """The scaled misfit's ``log_measure`` and the density at many scatters say the same of an integrated abscissa."""
    misfit = Misfit(RAW, 0.3, 1.5, DESIGN, (0.2, 1.0))
    measure = misfit.at(0.7, np).log_measure
    np.testing.assert_allclose(measure, 0.5 * np.log((0.3 + 1.5**2 * 0.49) / (0.2 + 0.49)))
    for part in (misfit, misfit.summary()):
        difference = float(part.log_density(0.7, np)) - float(ONE_VARIANCE.log_density(0.7, np))
        assert difference == pytest.approx(np.sum(measure), rel=1e-12)


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("columns", [0, 2, MANY_NUISANCES + 2])
@pytest.mark.parametrize("ratio", [1.0, 7.0, 30.0])
def test_many_readings_of_unequal_variance(columns: int, ratio: float, xp: ModuleType) -> None:
    """As summed one by one, at scatters far below, within and far above the reading errors."""
    rng, n = np.random.default_rng(3), 4 * MANY_READINGS
    scale = rng.permutation(np.geomspace(1.0, ratio, n)) ** 2
    variance = 4e-4 * scale
    raw, design = np.sqrt(variance) * rng.standard_normal(n), scale[:, None] * rng.standard_normal((n, columns))
    misfit, scatters = Misfit(raw, variance, scale, design), np.geomspace(1e-5, 1.0, 7)
    summed = misfit.summary(xp)
    assert np.shape(summed.yy) == (VARIANCES,)
    expected = misfit.log_density(scatters, np)
    np.testing.assert_allclose(summed.log_density(scatters, xp), expected, rtol=1e-9, atol=1e-5)


def test_a_draw_of_nuisances_whose_precision_is_lost_in_rounding() -> None:
    """Two nearly equal columns, readings without noise: the drawn sum is known, and NumPy finds no root of the precision."""
    design = 1e9 * np.column_stack([np.ones(20), 1.0 + 1e-12 * np.arange(20)])
    aa, ay = design.T @ design, design.T @ (design @ np.array([0.3, 0.4]))
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(np.eye(2) + aa - 1e-12 * np.trace(aa) * np.eye(2))
    for shift in (0.0, 1e-12):
        draw = conditional_draw(ay, aa - shift * np.trace(aa) * np.eye(2), np.random.default_rng(0))
        assert np.isfinite(draw).all()
        assert np.sum(draw) == pytest.approx(0.7, rel=1e-3)


def test_a_mean_of_nuisances_whose_precision_is_lost_in_rounding() -> None:
    """Two nuisances with one effect, and readings without noise (before: "Singular matrix")."""
    mean, log_det = conditional_mean(np.full(2, 1e20), np.full((2, 2), 1e20), np)
    assert np.sum(mean) == pytest.approx(1.0)
    assert float(log_det) == pytest.approx(np.log(1e20))
