"""Forward and reverse mode of the smoothed model against each other and against central differences."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.physics.model import CapsuleParameters, Excitation, Status, Trajectory
from capsule_id.physics.simulation import simulate
from capsule_id.physics.smooth.engine import Smoothing
from tests.capsule_cases import Cases, jit_quickly

WEIGHTS = np.random.default_rng(5).standard_normal((4, 12)) * np.array([[1e3], [1.0], [1e3], [1.0]])


def _score(inputs: Any) -> jax.Array:
    """A number that depends on every sample of all four states."""
    p, e, initial, smoothing, times = inputs
    t: Trajectory = simulate(p, e, times, initial, model="smooth", smoothing=smoothing)
    return jnp.sum(jnp.asarray(WEIGHTS) * jnp.stack([t.X1, t.Y1, t.X2, t.Y2]))


_value, _grad, _jacfwd = jax.jit(_score), jit_quickly(jax.grad(_score)), jit_quickly(jax.jacfwd(_score))


@pytest.fixture(scope="module")
def inputs(cases: Cases) -> Any:
    p, e, T = cases.one("fig6_k2_30")
    fine = Smoothing(velocity=1e-3, penetration=1e-5, rounding=0.05, tolerance=1e-8)
    start = (1e-4, 0.01, 0.0, -0.02)
    # No term at the edge of its domain, where a central difference has one side only.
    p = replace(p, k_cubic=1e7, c2=0.5, k2_back=5e3, G_back=5e-4, slope=0.02, N0=0.1, ratio=0.6, viscous=0.1)
    e = replace(e, reaction=0.1)
    return jax.tree.map(jnp.asarray, (p, e, start, fine, np.linspace(0.01, 0.01 + 0.6 * T, 12)))


def _names(inputs: Any) -> list[str]:
    """Names of the leaves, in their order."""
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(inputs)[0]]


def _central(function: Callable[[Any], jax.Array], inputs: Any, i: int, step: float, j: int | None = None) -> float:
    leaves, structure = jax.tree.flatten(inputs)

    def at(h: float) -> float:
        moved = leaves[i] + h if j is None else leaves[i].at[j].add(h)
        return float(function(jax.tree.unflatten(structure, [*leaves[:i], moved, *leaves[i + 1 :]])))

    return (at(step) - at(-step)) / (2.0 * step)


@pytest.mark.full
def test_reverse_mode_is_forward_mode(inputs: Any) -> None:
    coarse = (*inputs[:3], replace(inputs[3], tolerance=jnp.asarray(2e-5)), inputs[4])
    for case in (inputs, coarse):
        reverse, forward = jax.tree.leaves(_grad(case)), jax.tree.leaves(_jacfwd(case))
        for name, a, b in zip(_names(case), reverse, forward, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(np.asarray(b)).max(), err_msg=name)


@pytest.mark.full
def test_every_leaf_against_central_differences(inputs: Any) -> None:
    gradient = jax.tree.leaves(_grad(inputs))
    leaves = jax.tree.leaves(inputs)
    *names, _ = _names(inputs)
    for i, name in enumerate(names):
        if name.endswith("tolerance"):
            assert float(gradient[i]) == 0.0
            continue
        size = max(abs(float(leaves[i])), 1e-3)
        expected = [_central(_value, inputs, i, step * size) for step in (3e-5, 1e-5)]
        # How far apart the differences are says how well they are known.
        spread = abs(expected[0] - expected[1])
        assert float(gradient[i]) == pytest.approx(expected[1], rel=1e-3, abs=3.0 * spread), name


@pytest.mark.full
def test_derivatives_in_the_times(inputs: Any) -> None:
    gradient = np.asarray(_grad(inputs)[4])
    for j in (0, 3, 11):
        assert gradient[j] == pytest.approx(_central(_value, inputs, len(_names(inputs)) - 1, 1e-6, j), rel=1e-4)


@pytest.mark.full
def test_derivatives_tend_to_those_of_the_exact_model(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_30")
    # Within the first period, before the second impact: the smoothed switch changes the slope by its width only.
    times = jnp.asarray([0.0, 0.2 * T])

    def advance(mu: jax.Array, velocity: jax.Array) -> jax.Array:
        widths = Smoothing(velocity, 1e-6, 0.02, 1e-7)
        return simulate(replace(p, mu=mu), e, times, model="smooth", smoothing=widths).X2[-1]

    def exact_advance(mu: jax.Array) -> jax.Array:
        return simulate(replace(p, mu=mu), e, times).X2[-1]

    slope, exact = jit_quickly(jax.grad(advance)), jit_quickly(jax.jacfwd(exact_advance))(0.66)
    error = [abs(float(slope(jnp.asarray(0.66), jnp.asarray(w))) / float(exact) - 1.0) for w in (1e-2, 1e-4)]
    assert error[1] < 0.01
    assert error[1] < 0.3 * error[0]


@pytest.mark.slow
def test_batches_and_vmap_have_the_derivatives_of_their_lanes(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")
    times = jnp.asarray([0.0, 0.1 * T, 0.3 * T])

    def advance(mu: jax.Array) -> jax.Array:
        return simulate(replace(p, mu=mu), e, times, model="smooth").X2[..., -1]

    mu = jnp.asarray([0.5, 0.66, 0.8])
    lanes = jax.jacrev(advance)(mu)
    mapped = jax.vmap(jax.grad(advance))(mu)
    # Other programs, so other rounding and in the end other steps: equal to the solver's accuracy.
    np.testing.assert_allclose(np.diag(lanes), mapped, rtol=2e-2)
    np.testing.assert_allclose(lanes - np.diag(np.diag(lanes)), 0.0, atol=0.0)
    np.testing.assert_allclose(jax.vmap(advance)(mu), advance(mu), rtol=1e-3)


@pytest.mark.slow
def test_a_failed_lane_has_no_derivative_and_leaves_the_others_theirs(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")

    def advance(k2: jax.Array) -> jax.Array:
        t = simulate(replace(p, k2=k2), e, [0.0, 0.1 * T], model="smooth")
        return jnp.sum(t.X2[:, -1])

    gradient = jax.grad(advance)(jnp.asarray([2e4, -1.0]))
    assert np.isfinite(gradient[0])
    assert np.isnan(gradient[1])


@pytest.mark.full
def test_second_derivatives_are_refused(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")

    def advance(mu: jax.Array) -> jax.Array:
        return simulate(replace(p, mu=mu), e, [0.0, 0.01 * T], model="smooth").X2[-1]

    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.grad(jax.grad(advance))(0.66)


@pytest.mark.full
def test_frictionless_rest_has_finite_derivatives() -> None:
    p = CapsuleParameters(0.11, 0.53, 1420.0, 18960.0, 3.89, 0.0, 0.3, 1e-3)

    def motion(mu: jax.Array) -> Trajectory:
        return simulate(replace(p, mu=mu), Excitation(1.0, 30.0), [0.0, 0.05], model="smooth")

    t, tangent = jit_quickly(lambda mu: jax.jvp(motion, (mu,), (1.0,)))(0.0)
    assert int(t.status) == Status.OK
    assert np.isfinite(tangent.X2).all()
