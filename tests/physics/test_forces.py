"""The forces: limits and derivatives of the smoothed ones, a friction law and a contact of one's own."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from capsule_id.errors import InputError
from capsule_id.motions.response import response
from capsule_id.parameters import Parameter
from capsule_id.physics import forces as steps
from capsule_id.physics.drives import RodMotion
from capsule_id.physics.forces import CoulombStribeck, Force, Spring, sliding_friction
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import energy_balance, simulate
from capsule_id.physics.smooth.engine import breakaway, force_gate, friction_smooth
from tests.scipy_capsule import simulate_scipy

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
    "support": lambda x, w: Spring(18960.0, G=0.0).on_capsule(x, 0.0, w),
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
    for c, rounding in ((None, 0.0), (3.0, 1e-15)):
        support = Spring(18960.0, c, G=1e-3)
        exact = 18960.0 * np.maximum(r - 1e-3, 0.0) + (c or 0.0) * 0.2 * (r >= 1e-3)
        np.testing.assert_allclose(support.on_capsule(r, 0.2), exact, rtol=1e-12, atol=0.0)
        np.testing.assert_allclose(support.on_capsule(jnp.asarray(r), 0.2, 1e-6), exact, rtol=1e-12, atol=rounding)
    Y2 = jnp.asarray([-2.0, -1e-2, -1.6e-3, 1.6e-3, 1e-2, 2.0])
    for f in (-50.0, -F_B, -1.0, 0.0, 1.0, F_B, 50.0):
        held = friction_smooth(LAW, F_B, Y2, jnp.full(6, f), (1e-3, 0.05))
        np.testing.assert_allclose(held, sliding_friction(LAW, jnp.sign(Y2), Y2), rtol=1e-12)


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
    sliding = sliding_friction(LAW, jnp.sign(Y2), Y2)
    f = jnp.asarray([3.0, 9.0, -9.0, -3.0])
    gap = [np.abs(friction_smooth(LAW, F_B, Y2, f, (w, rounding)) - sliding).max() for w in (1e-2, 1e-3, 1e-4)]
    assert gap[0] > 1.0
    assert gap[2] < 1e-12


def test_contact_has_a_potential() -> None:
    k2, w = 18960.0, 1e-5
    energy, _ = quad(
        lambda x: float(Spring(k2, G=0.0).on_capsule(x, 0.0, w)), -2e-5, 2e-5, points=[-w, w], epsabs=1e-18
    )
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
    smooth = friction_smooth(_Ramped(), breakaway(_Ramped()), jnp.zeros(5), f, (1e-3, 0.01))
    np.testing.assert_allclose(smooth, [-3.0, -2.9, -1.0, 1.9, 2.0], rtol=1e-12)
    for Y2, expected in ((0.4, 2.2), (-0.4, -3.04)):
        moving = friction_smooth(_Ramped(), jnp.asarray(2.5), jnp.asarray(Y2), jnp.asarray(-7.0), (1e-3, 0.01))
        assert float(moving) == pytest.approx(expected, rel=1e-12)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Hertz(Force):
    """k d^p behind the gap G: a contact that the package does not know."""

    k: Any
    p: Any
    G: Any

    @property
    def gap(self) -> Any:
        return self.G

    def elastic(self, d: Any) -> Any:
        return -(-self.k * d**self.p)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Whole(_Hertz):
    """The same with a whole power, which the exact engine takes."""

    p: int = field(metadata={"static": True})


LEAVES = {"m1": 0.11, "m2": 0.53, "k1": 1420.0, "c": 3.89, "mu": 0.66, "v_s": 0.3, "g": 9.81}
DRIVE = {"P_d": 4.0, "Omega": 34.56}
TIMES = 2.0 * np.pi / DRIVE["Omega"] * np.arange(6)


def _run(*forces: Force, k2: float = 0.0, model: Any = "exact") -> Any:
    p = CapsuleParameters(**LEAVES, k2=k2, G=1e-3, forces=forces)
    return simulate(p, Excitation(**DRIVE), TIMES, model=model)


def _by_scipy(k: float, power: float) -> tuple[np.ndarray, int]:
    q = LEAVES | DRIVE | {"k2": k, "G": 1e-3, "power": power}
    return simulate_scipy(q, TIMES, rtol=1e-10, atol=1e-13, max_step=1e-3)


def test_a_contact_of_ones_own_is_smoothed_as_scipy_integrates_it() -> None:
    expected, closings = _by_scipy(1e6, 1.5)
    t = _run(_Hertz(1e6, 1.5, 1e-3), model="smooth")
    travel = np.abs(expected[-1, 2])
    assert int(t.contacts) == closings
    np.testing.assert_allclose(t.X2, expected[:, 2], rtol=0.0, atol=0.01 * travel)
    # The negative control: without the contact, or with a linear one, the capsule goes elsewhere.
    for k, power in ((0.0, 1.5), (18960.0, 1.0)):
        other = _run(_Hertz(k, power, 1e-3), model="smooth")
        assert abs(float(other.X2[-1]) - expected[-1, 2]) > 0.05 * travel


@pytest.mark.parametrize("call", [simulate, response, lambda p, e, _: energy_balance(p, e, (0.0, 1.0))])
@pytest.mark.parametrize("force", [_Hertz(1e6, 1.5, 1e-3), _Hertz(18960.0, 1.0, 1e-3), _Whole(18960.0, 0, 1e-3)])
def test_the_exact_engine_refuses_what_has_no_series_there(call: Callable[..., Any], force: Force) -> None:
    p = CapsuleParameters(**LEAVES, k2=0.0, G=np.inf, forces=(force,))
    arguments = (p, Excitation(**DRIVE)) if call is response else (p, Excitation(**DRIVE), TIMES)
    with pytest.raises(InputError, match=r'whole powers .* use simulate with model="smooth"'):
        call(*arguments)


def test_the_exact_engine_refuses_a_force_of_ones_own_on_a_prescribed_rod() -> None:
    """Nothing there would show where the series of the force ends: with d^9 the capsule never set off."""
    p = CapsuleParameters(**LEAVES, k2=0.0, G=np.inf, forces=(_Whole(1e3, 2, 1e-3),))
    rod = RodMotion(np.array([0.0, 1.0]), np.array([1e-3, 11e-3]), np.array([0.0, 30e-3]))
    with pytest.raises(
        InputError, match=r'the motion of the rod is prescribed, _Whole, use simulate with model="smooth"'
    ):
        simulate(p, rod, np.linspace(0.0, 1.0, 5))
    assert np.isfinite(np.asarray(simulate(p, rod, np.linspace(0.0, 1.0, 5), model="smooth").X2)).all()


@pytest.mark.full
def test_power_1_is_the_built_in_contact_in_both_engines() -> None:
    for force, model in ((_Hertz(18960.0, 1.0, 1e-3), "smooth"), (_Whole(18960.0, 1, 1e-3), "exact")):
        own, built_in = _run(force, model=model), _run(k2=18960.0, model=model)
        np.testing.assert_allclose(own.X2, built_in.X2, rtol=0.0, atol=1e-12)
        assert int(own.contacts) == int(built_in.contacts) > 5


def test_a_whole_power_is_exact() -> None:
    expected, closings = _by_scipy(1e8, 2.0)
    t = _run(_Whole(1e8, 2, 1e-3))
    assert int(t.contacts) == closings
    np.testing.assert_allclose(t.X2, expected[:, 2], rtol=0.0, atol=1e-9)


@pytest.mark.full
def test_the_energy_of_a_whole_power_is_balanced() -> None:
    balance = energy_balance(
        CapsuleParameters(**LEAVES, k2=0.0, G=1.0, forces=(_Whole(1e8, 2, 1e-3),)), Excitation(**DRIVE), (0.0, 1.0)
    )
    assert balance.relative_residual < 1e-9


@pytest.mark.full
def test_the_smoothed_contact_is_differentiable_in_its_own_leaves() -> None:
    def end(x: jax.Array) -> jax.Array:
        return _run(_Hertz(x[0], x[1], x[2]), model="smooth").X2[-1]

    x = np.array([1e6, 1.5, 1e-3])
    slopes = np.asarray(jax.grad(end)(x)), np.asarray(jax.jacfwd(end)(x))
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-8)
    assert np.isfinite(slopes[0]).all()
    assert (slopes[0] != 0.0).all()
