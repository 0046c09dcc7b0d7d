"""The smoothed forces: limits, derivatives over widths and velocities, and a friction law of one's own."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from capsule_id.parameters import Parameter
from capsule_id.physics import forces as steps
from capsule_id.physics.forces import support, support_smooth
from capsule_id.physics.friction import CoulombStribeck, friction
from capsule_id.physics.smooth.engine import breakaway, force_gate, friction_smooth

LAW = CoulombStribeck(mu=jnp.asarray(0.66), N=jnp.asarray(6.2784), v_s=jnp.asarray(0.3))
F_B = 0.66 * 6.2784
WIDTHS = np.geomspace(1e-8, 1.0, 9)
# Multiples of the width, inside, at the edge's neighbourhood and far outside of the smoothed range, both signs.
MULTIPLES = np.concatenate([sign * np.geomspace(1e-3, 1e3, 25) for sign in (-1.0, 1.0)])

SMOOTHED: dict[str, Callable[[jax.Array, float], jax.Array]] = {
    "sign": steps.smooth_sign,
    "heaviside": steps.smooth_heaviside,
    "abs": steps.smooth_abs,
    "ramp": steps.smooth_ramp,
    "support": lambda x, w: support_smooth(18960.0, 0.0, x, w),
    "friction": lambda x, w: friction_smooth(LAW, F_B, x, jnp.full_like(x, 1.3), (w, 0.05)),
}


@pytest.mark.full
@pytest.mark.parametrize("name", SMOOTHED)
def test_derivatives_are_right_for_every_width_and_argument(name: str) -> None:
    derivative = jax.jit(jax.vmap(jax.grad(SMOOTHED[name]), in_axes=(0, None)))
    for w in WIDTHS:
        x = w * MULTIPLES
        # Central differences of a C2 function: error of order h^2 in units of the width, and rounding of the argument.
        h = 1e-4 * np.minimum(w, np.abs(x) + 1e-2 * w)
        forward, backward = SMOOTHED[name](jnp.asarray(x + h), w), SMOOTHED[name](jnp.asarray(x - h), w)
        expected = np.asarray(forward - backward) / ((x + h) - (x - h))
        actual = np.asarray(derivative(jnp.asarray(x), w))
        scale = np.abs(expected).max()
        assert np.all(np.isfinite(actual))
        np.testing.assert_allclose(actual, expected, rtol=0.0, atol=2e-6 * scale)


@pytest.mark.parametrize("name", SMOOTHED)
def test_extreme_arguments_keep_value_and_slope_finite(name: str) -> None:
    slope = jax.grad(SMOOTHED[name])
    for x in (0.0, 1e-300, -1e-300, 1e12, -1e12):
        assert np.isfinite(SMOOTHED[name](jnp.asarray(x), 1e-9))
        assert np.isfinite(slope(jnp.asarray(x), 1e-9))


def test_documented_values_and_slopes_at_zero() -> None:
    w = 1e-3
    for function, value, first, second in (
        (steps.smooth_sign, 0.0, 15.0 / (8.0 * w), 0.0),
        (steps.smooth_heaviside, 0.5, 15.0 / (16.0 * w), 0.0),
        (steps.smooth_abs, 0.0, 0.0, 15.0 / (4.0 * w)),
        (steps.smooth_ramp, 5.0 * w / 32.0, 0.5, 15.0 / (16.0 * w)),
    ):
        assert float(function(0.0, w)) == pytest.approx(value, abs=1e-18)
        assert float(jax.grad(function)(0.0, w)) == pytest.approx(first, abs=1e-12)
        assert float(jax.grad(jax.grad(function))(0.0, w)) == pytest.approx(second, abs=1e-9)


def test_smoothed_is_exact_outside_its_width() -> None:
    r = 1e-3 + np.array([-1.0, -1e-3, -1e-6, 1e-6, 1e-3, 1.0])
    exact = support(18960.0, 1e-3, jnp.asarray(r))
    np.testing.assert_allclose(support_smooth(18960.0, 1e-3, jnp.asarray(r), 1e-6), exact, rtol=1e-12, atol=0.0)
    Y2 = jnp.asarray([-2.0, -1e-2, -1.6e-3, 1.6e-3, 1e-2, 2.0])
    for f in (-50.0, -F_B, -1.0, 0.0, 1.0, F_B, 50.0):
        held = friction_smooth(LAW, F_B, Y2, jnp.full(6, f), (1e-3, 0.05))
        np.testing.assert_allclose(held, friction(LAW, Y2, jnp.full(6, f)), rtol=1e-12)


def test_exact_friction_sticks_up_to_the_threshold_and_no_further() -> None:
    f = jnp.asarray([-5.0, -F_B, -1.0, 0.0, 1.0, F_B, 5.0])
    held = friction(LAW, jnp.zeros(7), f)
    np.testing.assert_allclose(held, [-F_B, -F_B, -1.0, 0.0, 1.0, F_B, F_B], rtol=1e-15)
    # Moving, it does not depend on the force, and falls to half of the threshold.
    np.testing.assert_allclose(friction(LAW, jnp.full(7, -1e6), f), -0.5 * F_B, rtol=1e-15)


def test_smoothed_friction_does_not_creep_where_tanh_does() -> None:
    f, velocity = jnp.asarray(0.9 * F_B), 1e-3
    at_rest = friction_smooth(LAW, F_B, jnp.asarray(0.0), f, (velocity, 0.05))
    assert float(f - at_rest) == pytest.approx(0.0, abs=1e-14)
    # Negative control: with F_s tanh(Y2 / velocity) nothing holds the capsule until it creeps at 1.5 mm/s.
    assert float(f - LAW.forward(0.0) * jnp.tanh(0.0 / velocity)) == pytest.approx(0.9 * F_B)
    assert float(LAW.forward(1.5e-3) * jnp.tanh(1.5)) == pytest.approx(0.9 * F_B, rel=0.01)


@pytest.mark.parametrize("rounding", [0.01, 0.1])
def test_narrow_switch_tends_to_the_exact_rule(rounding: float) -> None:
    Y2 = jnp.asarray([-0.3, -1e-3, 1e-3, 0.3])
    f = jnp.asarray([3.0, 9.0, -9.0, -3.0])
    gap = [
        np.abs(friction_smooth(LAW, F_B, Y2, f, (w, rounding)) - friction(LAW, Y2, f)).max() for w in (1e-2, 1e-3, 1e-4)
    ]
    assert gap[0] > 1.0
    assert gap[2] < 1e-12


def test_contact_has_a_potential() -> None:
    k2, w = 18960.0, 1e-5
    energy, _ = quad(lambda x: float(support_smooth(k2, 0.0, x, w)), -2e-5, 2e-5, points=[-w, w], epsabs=1e-18)
    assert energy == pytest.approx(0.5 * k2 * (2e-5) ** 2 + k2 * w**2 / 14.0, rel=1e-9)


def test_force_gate_is_blind_to_velocity() -> None:
    f = jnp.asarray([-9.0, -F_B, -1.0, 0.0, 1.0, F_B, 9.0])
    np.testing.assert_allclose(force_gate(LAW, F_B, f, 0.05), [1.0, 0.5, 0.0, 0.0, 0.0, 0.5, 1.0], atol=1e-14)


@pytest.mark.full
def test_no_friction_gives_no_force_and_finite_derivatives() -> None:
    def held(mu: jax.Array, Y2: jax.Array, f: jax.Array) -> jax.Array:
        law = CoulombStribeck(mu, jnp.asarray(6.0), jnp.asarray(0.3))
        return friction_smooth(law, breakaway(law), Y2, f, (1e-3, 0.05))

    for Y2 in (0.0, 1e-4, 0.3):
        for f in (0.0, 2.0):
            assert float(held(jnp.asarray(0.0), jnp.asarray(Y2), jnp.asarray(f))) == pytest.approx(0.0, abs=1e-15)
            gradient = jax.grad(held, argnums=(0, 1, 2))(jnp.asarray(0.0), jnp.asarray(Y2), jnp.asarray(f))
            assert np.all(np.isfinite(gradient))


def test_documented_law() -> None:
    speed = jnp.asarray([0.0, 0.3, 1e9])
    np.testing.assert_allclose(LAW.forward(speed), F_B * np.array([1.0, 0.5 * (1.0 + np.exp(-1.0)), 0.5]), rtol=1e-15)
    assert float(jax.grad(LAW.forward)(0.0)) == pytest.approx(-F_B / 0.6)


@dataclass(frozen=True)
class _Ramped:
    """Downhill is easier than uphill, with a viscous part: a law that the package does not know."""

    parameters: ClassVar[tuple[Parameter, ...]] = ()

    def forward(self, speed: jax.Array) -> jax.Array:
        return 2.0 + 0.5 * speed

    def backward(self, speed: jax.Array) -> jax.Array:
        return 3.0 + 0.1 * speed


def test_a_law_with_two_thresholds() -> None:
    f = jnp.asarray([-5.0, -2.9, -1.0, 1.9, 5.0])
    np.testing.assert_allclose(friction(_Ramped(), jnp.zeros(5), f), [-3.0, -2.9, -1.0, 1.9, 2.0], rtol=1e-15)
    smooth = friction_smooth(_Ramped(), breakaway(_Ramped()), jnp.zeros(5), f, (1e-3, 0.01))
    np.testing.assert_allclose(smooth, [-3.0, -2.9, -1.0, 1.9, 2.0], rtol=1e-12)
    for Y2, expected in ((0.4, 2.2), (-0.4, -3.04)):
        moving = friction_smooth(_Ramped(), jnp.asarray(2.5), jnp.asarray(Y2), jnp.asarray(-7.0), (1e-3, 0.01))
        assert float(moving) == pytest.approx(expected, rel=1e-12)
