"""Hessian and Jacobian by differences against automatic differentiation; roots of inverses; fixed batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.inference.curvature import directions, hessian, jacobian, require_width
from capsule_id.physics.batches import in_batches
from capsule_id.precision import require_float64

require_float64()
SCALE = np.array([1e-4, 2e-2, 1.0, 0.1])
AT = np.array([3.0, -1.0, 0.5, 2.0])
NONE = np.zeros(0, dtype=int)


def smooth(u: jax.Array) -> jax.Array:
    """A log-density with mixed scales, strong correlation and a third derivative."""
    v = (u - jnp.asarray(AT)) / jnp.asarray(SCALE) + 0.3
    return -0.5 * (v @ v) - 0.8 * v[0] * v[1] - jnp.log1p(jnp.exp(v[2])) - 0.05 * v[3] ** 4


def whole(u: np.ndarray) -> np.ndarray:
    """(m, 1) ``smooth``: a log-density of one term."""
    return np.asarray(jax.vmap(smooth)(u))[:, None]


def test_hessian_against_automatic_differentiation() -> None:
    found = hessian(whole, AT, SCALE, NONE)
    scale = np.outer(SCALE, SCALE)
    np.testing.assert_allclose(found * scale, jax.hessian(smooth)(AT) * scale, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(found, found.T)


def of_terms(u: jax.Array) -> jax.Array:
    """A term of the coordinates 1 and 3, and one of 2 and of 0 with these."""
    v = (u - jnp.asarray(AT)) / jnp.asarray(SCALE)
    shared = v[1] + 0.3 * v[3]
    return jnp.stack([-(shared**2) - jnp.cosh(v[3]), -jnp.exp(v[2] - shared) - v[2] ** 2, -(v[0] ** 4) - v[0] * v[1]])


def test_coordinates_of_one_term_share_their_differences() -> None:
    found = hessian(lambda u: np.asarray(jax.vmap(of_terms)(u)), AT, SCALE, np.array([2, 0]))
    scale = np.outer(SCALE, SCALE)
    expected = jax.hessian(lambda u: jnp.sum(of_terms(u)))(AT)
    np.testing.assert_allclose(found * scale, expected * scale, rtol=1e-5, atol=1e-5)
    assert len(directions(500, np.arange(3, 500))) == 4


def test_the_hessian_beside_the_end_of_the_domain() -> None:
    """A decay near critical damping: the density ends at a step from the maximum (before: eigenvalues failed)."""

    def ending(u: np.ndarray) -> np.ndarray:
        return np.where(u[:, 1:2] > AT[1] + 1e-9, -np.inf, whole(u))

    found, everywhere = hessian(ending, AT, SCALE, NONE), hessian(whole, AT, SCALE, NONE)
    inside = np.ix_([0, 2, 3], [0, 2, 3])
    np.testing.assert_allclose(found[inside], everywhere[inside])
    assert found[1, 1] == -1.0 / SCALE[1] ** 2
    assert np.isfinite(found).all()


def test_a_density_that_is_no_number_shows() -> None:
    """Only -inf is the end of a domain."""

    def defective(u: np.ndarray) -> np.ndarray:
        return np.where(u[:, 1:2] > AT[1] + 1e-9, np.nan, whole(u))

    found = hessian(defective, AT, SCALE, NONE)
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[np.ix_([0, 2, 3], [0, 2, 3])]).all()


def test_jacobian_against_automatic_differentiation() -> None:
    def function(u: np.ndarray) -> np.ndarray:
        return np.array([np.sin(u[0] * u[1]), np.exp(u[2]), u[3] ** 3 * u[0]])

    expected = jax.jacobian(lambda u: jnp.array([jnp.sin(u[0] * u[1]), jnp.exp(u[2]), u[3] ** 3 * u[0]]))(AT)
    np.testing.assert_allclose(jacobian(function, AT, np.full(4, 1e-5)), expected, rtol=1e-8, atol=1e-9)


def test_batches_have_one_shape() -> None:
    shapes: list[int] = []

    def function(points: np.ndarray) -> np.ndarray:
        shapes.append(len(points))
        return np.sum(points, axis=1)

    points = np.arange(3.0 * 70).reshape(70, 3)
    np.testing.assert_array_equal(in_batches(function, points, 32), np.sum(points, axis=1))
    assert shapes == [32] * 3


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_a_posterior_narrower_than_digits_is_refused(size: float) -> None:
    """Three channels computed from one another left an internal failure: Matrix is not positive definite."""
    u = np.array([size, -2.0])
    require_width(["a", "b"], u, np.diag([(1e-10 * size) ** 2, 1.0]))
    with pytest.raises(InputError, match="more than the rounding of numbers") as caught:
        require_width(["a", "b"], u, np.diag([(1e-14 * size) ** 2, 1.0]))
    assert caught.value.value.startswith("a with")
    assert "--no-sample" in caught.value.remedy
    require_width([], np.empty(0), np.empty((0, 0)))
