"""The solver against closed forms, SciPy and repeated experiments, and what it reports when there is no answer."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jax.tree_util import Partial

from capsule_id.inference.curvature import covariance
from capsule_id.inference.least_squares import LeastSquaresFit, Solver, _stationary, least_squares
from capsule_id.inference.target import HEAVY
from tests.inference.fit.nist_strd import PROBLEMS, best_of, covariance_of, errors_of, residual_sd_of, solve

RAT43 = next(problem for problem in PROBLEMS if problem.name == "Rat43")
DECAY_TIME = np.linspace(0.0, 4.0, 20)  # s
DECAY_TRUTH = np.array([2.0, 0.7])  # amplitude, rate in 1/s
DECAY_SD = 0.05


def _decay(b: jax.Array | np.ndarray) -> jax.Array:
    return b[0] * jnp.exp(-b[1] * DECAY_TIME)


def _decay_residual(measured: jax.Array, b: jax.Array) -> jax.Array:
    return measured - _decay(b)


def test_straight_line_equals_the_closed_form() -> None:
    x = np.array([0.0, 1.0, 2.0, 4.0, 7.0])
    y = np.array([1.1, 2.9, 5.2, 8.7, 15.3])
    fit = solve(lambda b: jnp.asarray(y) - b[0] - b[1] * x, np.array([[1.0, 1.0], [-5.0, 0.1], [0.0, 0.0]]))
    spread = np.sum((x - x.mean()) ** 2)
    slope = np.sum((x - x.mean()) * (y - y.mean())) / spread
    intercept = y.mean() - slope * x.mean()
    variance = np.sum((y - intercept - slope * x) ** 2) / 3
    expected = variance / spread * np.array([[spread / 5 + x.mean() ** 2, -x.mean()], [-x.mean(), 1.0]])
    assert not fit.stalled.any()
    np.testing.assert_allclose(fit.x, np.tile([intercept, slope], (3, 1)), rtol=1e-8)
    np.testing.assert_allclose(covariance_of(fit), expected, rtol=1e-9)
    np.testing.assert_allclose(covariance_of(fit, residual_sd=1.0), expected / variance, rtol=1e-9)


def test_scipy_agrees() -> None:
    y, x = RAT43.data.T

    def residual(b: np.ndarray) -> np.ndarray:
        return y - b[0] / (1 + np.exp(b[1] - b[2] * x)) ** (1 / b[3])

    scipy_fit = scipy.optimize.least_squares(
        residual, RAT43.starts[1], jac="3-point", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    scipy_covariance = 2 * scipy_fit.cost / (len(y) - 4) * np.linalg.inv(scipy_fit.jac.T @ scipy_fit.jac)
    fit = solve(RAT43.residual, RAT43.starts)
    # SciPy's Jacobian is by differences: seven digits.
    np.testing.assert_allclose(fit.x[best_of(fit)], scipy_fit.x, rtol=1e-7)
    np.testing.assert_allclose(covariance_of(fit), scipy_covariance, rtol=1e-6)
    assert fit.cost[best_of(fit)] == pytest.approx(scipy_fit.cost, rel=1e-12)


def _in_units(unit: jax.Array, residual_unit: jax.Array, b: jax.Array) -> jax.Array:
    return residual_unit * RAT43.residual(b * unit)


def test_units_change_nothing() -> None:
    # Powers of two are exact in floating point, so every step must be the same step of the same compiled code.
    unit = np.array([2.0**40, 2.0**-40, 1.0, 2.0**-10])
    plain = solve(Partial(_in_units, jnp.ones(4), jnp.ones(())), RAT43.starts)
    scaled = solve(Partial(_in_units, jnp.asarray(unit), jnp.asarray(2.0**30)), RAT43.starts / unit)
    np.testing.assert_allclose(scaled.x * unit, plain.x, rtol=1e-12)
    np.testing.assert_allclose(errors_of(scaled) * unit, errors_of(plain), rtol=1e-10)


def test_starts_at_or_near_zero() -> None:
    starts = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1e-12], [0.0, 3.0]])
    fit = solve(Partial(_decay_residual, _decay(DECAY_TRUTH)), starts)
    assert not fit.stalled.any()
    np.testing.assert_allclose(fit.x, np.tile(DECAY_TRUTH, (4, 1)), rtol=1e-7)


@pytest.mark.parametrize(("n", "one"), [(20, False), (HEAVY + 1, True)])
def test_starts_of_many_residuals_take_the_memory_of_one(n: int, one: bool) -> None:
    """Before: 100,000 pushes took 200 MB in the threads of the starts."""
    callers = set[int]()
    slope = np.linspace(0.0, 1.0, n)[:, None]

    def linearise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        callers.add(threading.get_ident())
        return slope @ x - 1.0, slope

    fit = least_squares(linearise, np.arange(1.0, 6.0)[:, None])
    np.testing.assert_allclose(fit.x, np.sum(slope) / np.sum(slope**2), rtol=1e-7)
    assert (callers == {threading.get_ident()}) == one


def test_tiny_steps_away_from_a_minimum_are_not_convergence() -> None:
    # An amplitude of 1e-12 leaves the rate without effect; the damping grows until no step is left.
    fit = solve(Partial(_decay_residual, _decay(DECAY_TRUTH)), np.array([[1e-12, 3.0]]))
    assert np.abs(fit.x[0] - DECAY_TRUTH).max() > 1.0
    assert fit.stalled[0]


@pytest.fixture(scope="module")
def replicates() -> list[LeastSquaresFit]:
    """400 repeated experiments: decay with normal noise of known sd."""
    rng = np.random.default_rng(20)
    clean = np.asarray(_decay(DECAY_TRUTH))
    noise = DECAY_SD * rng.standard_normal((400, len(clean)))
    return [solve(Partial(_decay_residual, jnp.asarray(y)), np.ones((1, 2))) for y in clean + noise]


@pytest.mark.full
def test_standard_errors_match_the_scatter(replicates: list[LeastSquaresFit]) -> None:
    error = np.array([fit.x[0] - DECAY_TRUTH for fit in replicates])
    pull = error / np.array([errors_of(fit, residual_sd=DECAY_SD) for fit in replicates])
    # sd of the mean of 400 pulls 0.05, of their sd 0.035: three of each.
    assert np.abs(pull.mean(axis=0)).max() < 0.15
    assert np.abs(pull.std(axis=0, ddof=1) - 1).max() < 0.106
    # Control: standard errors that ignore the correlation of amplitude and rate fail the same check.
    conditional = DECAY_SD / np.array([np.linalg.norm(fit.jacobian[0], axis=0) for fit in replicates])
    assert np.abs((error / conditional).std(axis=0, ddof=1) - 1).min() > 0.106


@pytest.mark.full
def test_residual_variance_is_unbiased(replicates: list[LeastSquaresFit]) -> None:
    ratio = np.mean([residual_sd_of(fit) ** 2 for fit in replicates]) / DECAY_SD**2
    # χ² with 18 degrees of freedom over 400 experiments: sd √(2 / 18 / 400).
    bound = 3 * np.sqrt(2 / 18 / 400)
    assert abs(ratio - 1) < bound
    # Control: dividing by n in place of n − d fails the same check.
    assert abs(ratio * 18 / 20 - 1) > bound


def test_too_few_steps_are_reported() -> None:
    fit = solve(RAT43.residual, RAT43.starts, Solver(max_steps=5))
    assert fit.stalled.tolist() == [True, True]


def test_a_start_without_finite_residuals_is_reported_and_the_others_go_on() -> None:
    x = np.arange(1.0, 6.0)
    fit = solve(lambda b: jnp.log(b[0] * x) - jnp.log(3.0 * x), np.array([[-1.0], [1.0]]))
    assert fit.stalled.tolist() == [True, False]
    assert best_of(fit) == 1
    np.testing.assert_allclose(fit.x[1], 3.0, rtol=1e-8)


def test_where_no_derivative_is_finite_is_no_minimum() -> None:
    """An end of a random decay without noise. (Before: a singular value decomposition that did not converge.)"""
    assert not _stationary(np.array([[1.0, np.nan], [0.0, 1.0], [2.0, np.inf]]), np.zeros(3), 1e-9)
    assert _stationary(np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 1.0]]), np.zeros(3), 1e-9)


def test_a_step_to_where_the_residuals_are_not_finite_is_taken_back() -> None:
    # The first undamped step from 10 leads to 10 − 10 ln 1000 < 0, where the logarithm is not a number.
    fit = solve(lambda b: jnp.log(b) - jnp.log(0.01) * jnp.ones(3), np.array([[10.0]]))
    assert not fit.stalled.any()
    assert fit.x[0, 0] == pytest.approx(0.01, rel=1e-8)


def test_rank_deficiency_is_reported_not_hidden() -> None:
    measured = 6.0 * DECAY_TIME
    fit = solve(lambda b: jnp.asarray(measured) - b[0] * b[1] * DECAY_TIME, np.array([[1.0, 1.0], [5.0, 0.2]]))
    np.testing.assert_allclose(np.prod(fit.x, axis=1), 6.0, rtol=1e-8)
    assert np.isposinf(errors_of(fit, residual_sd=1.0)).all()
    # Control: a pseudo-inverse would have printed harmless-looking numbers.
    jacobian = fit.jacobian[best_of(fit)]
    assert np.isfinite(np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)))).all()


def test_a_parameter_without_effect_is_reported() -> None:
    fit = solve(lambda b: 2.0 - b[0] * jnp.ones(4) + 0.0 * b[1], np.array([[1.0, 0.0]]))
    assert fit.x[0, 0] == pytest.approx(2.0, rel=1e-8)
    assert np.isposinf(errors_of(fit, residual_sd=1.0)).all()


def test_weak_or_badly_scaled_is_not_deficient() -> None:
    # Two nearly equal columns in units 24 orders apart: the exact inverse of this 2 x 2 matrix is known.
    tilt = 2.0**-16
    jacobian = np.array([[1.0, 1.0], [0.0, tilt]]) * np.array([2.0**40, 2.0**-40])
    expected = np.sqrt([1 + tilt**-2, tilt**-2]) / np.array([2.0**40, 2.0**-40])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance(jacobian))), expected, rtol=1e-9)


@pytest.mark.parametrize("starts", [np.ones(2), np.ones((0, 2)), np.array([[1.0, np.nan]])])
def test_starts_of_the_wrong_form_are_refused(starts: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"starts must be \(s, d\) and finite"):
        solve(RAT43.residual, starts)
