"""The smoothed model against the exact one: bias, order of the smoothing, samples, failures, semantics."""

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from capsule_id.errors import InputError
from capsule_id.parameters import Parameter
from capsule_id.physics.batches import CHUNK
from capsule_id.physics.forces import Spring, friction_law, smooth_abs
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import simulate, smoothing_bias
from capsule_id.physics.smooth import engine as smooth
from capsule_id.physics.smooth.engine import Smoothing
from tests.capsule_cases import Cases, jit_quickly, states_of

# Runs of one capsule have eleven samples, as the reference cases have: they share their compiled programs.
# So small a tolerance that the solver's error does not show beside the smoothing.
FINE = Smoothing(velocity=1e-4, penetration=1e-6, rounding=0.02, tolerance=3e-7)


def _mean_velocity_error(cases: Cases, smoothing: Smoothing) -> np.ndarray:
    """(25,), in units of the bar 2 % + 1e-6 m/s, against the other program's states."""
    t = simulate(cases.p, cases.e, cases.times, model="smooth", smoothing=smoothing)
    exact = cases.states[:, -1, 2] / (10.0 * cases.T)
    error = np.abs(np.asarray(t.X2[:, -1]) / (10.0 * cases.T) - exact)
    return error / (0.02 * np.abs(exact) + 1e-6)


@pytest.mark.full
def test_default_widths_are_certified_on_every_reference_case(cases: Cases) -> None:
    error = _mean_velocity_error(cases, Smoothing())
    assert error.max() < 0.5
    assert np.median(error) < 0.05
    t = simulate(cases.p, cases.e, cases.times, model="smooth")
    np.testing.assert_array_equal(t.status, Status.OK)
    np.testing.assert_array_equal(t.contacts, cases.contacts)


@pytest.mark.full
def test_wide_switch_fails_the_bar(cases: Cases) -> None:
    error = _mean_velocity_error(cases, replace(Smoothing(), velocity=1e-2))
    assert (error > 1.0).sum() > 15


def test_every_period_end_approaches_the_exact_state(cases: Cases) -> None:
    t = simulate(cases.p, cases.e, cases.times, model="smooth", smoothing=FINE)
    error = np.abs(states_of(t) - cases.states).max(axis=(0, 1))
    # The advance over ten periods is of the order of a millimetre.
    assert error[0] < 5e-6
    assert error[2] < 5e-6


@pytest.mark.full
def test_order_of_the_smoothing(cases: Cases) -> None:
    coarse = replace(FINE, tolerance=1e-6)
    velocity = [replace(coarse, velocity=width) for width in np.geomspace(1e-3, 1e-2, 4)]
    assert 1.6 < _slope(cases, velocity, "velocity") < 2.2
    penetration = [replace(coarse, penetration=width) for width in np.geomspace(1e-5, 1e-4, 3)]
    assert 1.6 < _slope(cases, penetration, "penetration") < 2.4


def _slope(cases: Cases, smoothings: list[Smoothing], kind: str) -> float:
    """d log(median bias) / d log(width) by least squares."""
    medians = [np.median(smoothing_bias(cases.p, cases.e, widths).relative) for widths in smoothings]
    return float(np.polyfit(np.log([getattr(widths, kind) for widths in smoothings]), np.log(medians), 1)[0])


def _tanh_field(system: smooth.System, semantics: str, piece: jnp.ndarray | None = None) -> smooth.Field:
    del semantics, piece  # a harmonic drive has one
    p, e, law, widths = system

    def field(t: jnp.ndarray, r: jnp.ndarray, Y1: jnp.ndarray, Y2: jnp.ndarray) -> tuple[jnp.ndarray, ...]:
        f = p.k1 * r + p.c * (Y1 - Y2) + Spring(p.k2, G=p.G).on_capsule(r, 0.0, widths.penetration)
        held = law.forward(smooth_abs(Y2, widths.velocity)) * jnp.tanh(Y2 / widths.velocity)
        return (e.P_d * jnp.cos(e.Omega * t + e.phase) - f) / p.m1, Y2, (f - held) / p.m2

    return field


@pytest.mark.full
def test_switch_in_velocity_alone_turns_the_capsule_round(cases: Cases, monkeypatch: pytest.MonkeyPatch) -> None:
    p, e, T = cases.one("fig6_k2_20")
    widths = replace(FINE, velocity=1e-2)
    ours = simulate(p, e, T * np.arange(11), model="smooth", smoothing=widths)
    monkeypatch.setattr(smooth, "field_of", _tanh_field)
    smooth._compiled.cache_clear()
    tanh = simulate(p, e, T * np.arange(11), model="smooth", smoothing=widths)
    smooth._compiled.cache_clear()
    truth = cases.states[[c["name"] for c in cases.raw].index("fig6_k2_20"), -1, 2]
    assert truth > 5e-4
    # The creep of F_s tanh(Y2 / velocity) carries the capsule backward, further than it goes forward in truth.
    assert float(tanh.X2[-1]) < -truth
    assert abs(float(ours.X2[-1]) - truth) < 0.2 * abs(float(tanh.X2[-1]) - truth)


@pytest.mark.full
def test_eq2_converges_to_another_motion(cases: Cases) -> None:
    p, e, T = cases.one("fig11_Pd_1.5")
    e = replace(e, P_d=1.4)
    times = 4.0 * T * np.arange(11)
    settled = slice(5, 11, 5)
    exact = np.diff(np.asarray(simulate(p, e, times).X2)[settled])[0]
    excess = []
    for rounding, tolerance in ((0.05, 2e-5), (0.01, 5e-6)):
        widths = Smoothing(1e-4, 1e-6, rounding, tolerance)
        t = simulate(p, e, times, model="smooth", semantics="eq2", smoothing=widths)
        excess.append(np.diff(np.asarray(t.X2)[settled])[0] / exact - 1.0)
    # The narrower the gate, the less it changes; the limit is not the exact motion.
    assert np.all(np.abs(np.array(excess) - 1.6) < 0.1)
    stick_slip = np.diff(np.asarray(simulate(p, e, times, model="smooth").X2)[settled])[0]
    assert stick_slip / exact == pytest.approx(1.0, abs=0.01)


def test_eq2_freezes_a_sliding_capsule(cases: Cases) -> None:
    p, e, _ = cases.one("fig6_k2_20")
    times = np.linspace(0.0, 0.02, 11)
    sliding = (0.0, 0.05, 0.0, 0.05)
    frozen = simulate(p, replace(e, P_d=0.0), times, sliding, model="smooth", semantics="eq2")
    np.testing.assert_allclose(frozen.X2, 0.0, atol=1e-12)
    assert float(frozen.Y2[-1]) == pytest.approx(0.05, abs=1e-12)
    moving = simulate(p, replace(e, P_d=0.0), times, sliding, model="smooth")
    assert float(moving.X2[-1]) > 1e-4
    assert float(moving.Y2[-1]) == pytest.approx(0.0, abs=1e-9)


def test_smooth_field_against_scipy(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_30")
    widths = Smoothing(velocity=1e-3, penetration=1e-5, rounding=0.05)
    field = jax.jit(smooth.field_of((p, e, friction_law(p), widths), "stick-slip"))

    def rate(t: float, y: np.ndarray) -> list[float]:
        a1, v2, a2 = field(jnp.asarray(t), jnp.asarray(y[0] - y[2]), jnp.asarray(y[1]), jnp.asarray(y[3]))
        return [y[1], float(a1), float(v2), float(a2)]

    times = np.linspace(0.0, 0.12 * T, 11)
    expected = solve_ivp(rate, (0.0, times[-1]), np.zeros(4), "LSODA", times, rtol=1e-9, atol=1e-11).y.T
    actual = states_of(simulate(p, e, times, model="smooth", smoothing=replace(widths, tolerance=1e-9)))
    assert np.abs(actual - expected)[:, [0, 2]].max() < 3e-9
    assert np.abs(actual - expected)[:, [1, 3]].max() < 1e-6


def test_error_follows_the_tolerance(cases: Cases) -> None:
    widths = Smoothing(velocity=1e-3, penetration=1e-5, rounding=0.05, tolerance=1e-8)
    times = 0.1 * cases.times

    def states(tolerance: float) -> np.ndarray:
        t = simulate(cases.p, cases.e, times, model="smooth", smoothing=replace(widths, tolerance=tolerance))
        return states_of(t)[:, [0, -1]]

    truth = states(1e-8)
    tolerances = np.array([1e-4, 1e-5, 1e-6])
    errors = np.array([np.median(np.abs(states(tol) - truth)[..., [0, 2]].max(axis=(1, 2))) for tol in tolerances])
    travel = np.median(np.abs(truth[..., 0]).max(axis=1))
    assert np.all(errors < 10.0 * tolerances * travel + 1e-11)
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    assert 0.6 < slope < 1.2


def test_samples_do_not_change_the_motion(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_30")
    dense = simulate(p, e, np.linspace(0.0, 3.0 * T, 301), model="smooth")
    sparse = simulate(p, e, np.linspace(0.0, 3.0 * T, 11), model="smooth")
    np.testing.assert_allclose(states_of(dense)[::30], states_of(sparse), rtol=0.0, atol=1e-7)
    # Velocity is the derivative of position in the interpolated samples as well.
    X2 = np.asarray(dense.X2)
    rate = (X2[2:] - X2[:-2]) / (6.0 * T / 300)
    assert np.median(np.abs(rate - np.asarray(dense.Y2)[1:-1])) < 1e-4


def test_a_lane_does_not_depend_on_its_neighbours(cases: Cases) -> None:
    t = simulate(cases.p, cases.e, cases.times, model="smooth")
    order = np.random.default_rng(3).permutation(25)
    spread = np.concatenate([order, np.arange(CHUNK), order]) % 25
    p, e = (
        replace(x, **{name: np.asarray(leaf)[spread] if np.ndim(leaf) else leaf for name, leaf in vars(x).items()})
        for x in (cases.p, cases.e)
    )
    shuffled = simulate(p, e, cases.times[spread], model="smooth")
    np.testing.assert_array_equal(states_of(shuffled), states_of(t)[spread])


def test_bad_lanes_say_so_and_leave_the_others_alone(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")
    k2, P_d = np.array([p.k2, -1.0, np.nan, p.k2]), np.array([0.0, 4.0, 4.0, 4.0])
    t = simulate(replace(p, k2=k2), replace(e, P_d=P_d), T * np.arange(3), model="smooth", max_steps=100)
    np.testing.assert_array_equal(t.status, [Status.OK, Status.INVALID, Status.INVALID, Status.TOO_MANY_STEPS])
    states = states_of(t)
    assert np.all(np.isfinite(states[0]))
    assert np.all(np.isnan(states[1:3]))
    assert np.isnan(states[3, -1]).all()
    assert int(t.steps[3]) == 100


@pytest.mark.full
@pytest.mark.parametrize("change", [{"mu": 0.0}, {"c": 0.0}, {"G": 0.0}, {"k1": 0.0}, {"g": 0.0}, {"k2": 0.0}])
def test_zero_parameters_run(cases: Cases, change: dict[str, float]) -> None:
    p, e, T = cases.one("fig6_k2_20")
    times = T * np.linspace(0.0, 2.0, 11)
    t, exact = (simulate(replace(p, **change), e, times, model=model) for model in ("smooth", "exact"))
    assert int(t.status) == Status.OK
    np.testing.assert_allclose(t.X1, exact.X1, rtol=0.0, atol=2e-3 * np.abs(exact.X1).max())


def test_rest_without_drive_stays(cases: Cases) -> None:
    p, _, _ = cases.one("fig6_k2_20")
    t = simulate(p, Excitation(0.0, 0.0), np.linspace(0.0, 1.0, 11), model="smooth")
    np.testing.assert_array_equal(states_of(t), 0.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Viscous:
    """Resistance F + b |Y2|: not among the package's laws."""

    b: float

    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("b", "N s/m", "viscous friction", "b"),)

    def forward(self, speed: jnp.ndarray) -> jnp.ndarray:
        return 1.0 + self.b * speed

    backward = forward


@pytest.mark.full
def test_a_law_of_ones_own_needs_no_change_of_the_engine() -> None:
    # The rod moves with the capsule (rigid spring at rest length): m v' = -(F + b v), in closed form.
    m, v0 = 0.64, 0.4
    p = CapsuleParameters(0.11, 0.53, 1e7, 0.0, 1e3, mu=np.nan, v_s=np.nan, G=1.0)
    times, start = np.array([0.0, 0.02, 0.05]), (0.0, v0, 0.0, v0)

    def Y2(b: float) -> jnp.ndarray:
        drive, widths = Excitation(0.0, 0.0), Smoothing(tolerance=1e-7)
        return simulate(p, drive, times, start, model="smooth", smoothing=widths, friction=_Viscous(b)).Y2

    def closed_form(b: float) -> np.ndarray:
        return (v0 + 1.0 / b) * np.exp(-b / m * times) - 1.0 / b

    velocity, tangent = jit_quickly(lambda b: jax.jvp(Y2, (b,), (1.0,)))(4.0)
    np.testing.assert_allclose(velocity, closed_form(4.0), rtol=2e-4)
    slope = (closed_form(4.0 + 1e-4) - closed_form(4.0 - 1e-4)) / 2e-4
    np.testing.assert_allclose(tangent, slope, rtol=2e-3, atol=1e-7)
    assert jit_quickly(jax.grad(lambda b: Y2(b)[-1]))(4.0) == pytest.approx(slope[-1], rel=2e-3)


def test_bias_is_data(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_51.05")
    bias = smoothing_bias(p, e)
    assert bias.exact[0] == pytest.approx(
        cases.raw[[c["name"] for c in cases.raw].index("fig6_k2_51.05")]["states_at_period_ends"][-1][2] / (10.0 * T),
        rel=1e-6,
    )
    assert bias.relative[0] < 0.005
    assert bias.largest[0] < 1e-5
    assert bias.exact_contacts[0] == bias.smooth_contacts[0]
    wide = smoothing_bias(p, e, Smoothing(velocity=1e-2))
    assert wide.relative[0] > 10.0 * bias.relative[0]


def test_usage_errors(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")
    with pytest.raises(InputError, match="stick-slip semantics only"):
        simulate(p, e, [0.0, T], semantics="eq2")
    with pytest.raises(InputError, match="at least one period"):
        smoothing_bias(p, e, periods=0)
    with pytest.raises(InputError, match=r"whole ones, periods = 2\.5"):
        smoothing_bias(p, e, periods=2.5)  # type: ignore[arg-type]  # pyright: ignore
    with pytest.raises(InputError, match="Omega <= 0"):
        smoothing_bias(p, replace(e, Omega=0.0))
