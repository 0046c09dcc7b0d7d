"""Friction laws that the package does not know, through both engines: against SciPy, another program, differences."""

import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import capsule_id as cid
from capsule_id.parameters import TABLE, Parameter
from capsule_id.physics.energy import energy_balance
from capsule_id.physics.exact import friction_series
from capsule_id.physics.friction import CoulombStribeck, FrictionLaw, friction_law, slide_distance
from capsule_id.physics.model import CapsuleParameters, Excitation, Status, simulate
from tests.capsule_cases import Cases, states_of
from tests.scipy_capsule import simulate_scipy

# mu and v_s are undefined: a law replaces them.
P = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=np.nan, v_s=np.nan, G=1e-3)
E = Excitation(P_d=4.0, Omega=34.56)
T = 2.0 * np.pi / 34.56
NORMAL = Parameter("N", "N", "normal force", "N", sign="not negative")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PlainStribeck:
    """Eq. (1) as a user writes it: without a Taylor recursion of its own."""

    mu: float | np.ndarray | jax.Array
    N: float | np.ndarray | jax.Array
    v_s: float | np.ndarray | jax.Array

    parameters: ClassVar[tuple[Parameter, ...]] = (TABLE["mu"], NORMAL, TABLE["v_s"])

    def forward(self, speed: jax.Array) -> jax.Array:
        return 0.5 * self.mu * self.N * (1.0 + jnp.exp(-speed / self.v_s))

    backward = forward


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WeakeningTwoWay:
    """F_c + (F_s - F_c)/(1 + (v/v_0)^2) + b v forward, ``back`` times that backward: Lorentzian, direction-dependent."""

    F_s: float | np.ndarray | jax.Array = 3.9
    F_c: float | np.ndarray | jax.Array = 1.7
    v_0: float | np.ndarray | jax.Array = 0.06
    b: float | np.ndarray | jax.Array = 2.5
    back: float | np.ndarray | jax.Array = 0.45

    parameters: ClassVar[tuple[Parameter, ...]] = tuple(
        Parameter(symbol, unit, "", symbol)
        for symbol, unit in {"F_s": "N", "F_c": "N", "v_0": "m/s", "b": "N s/m", "back": "1"}.items()
    )

    def forward(self, speed: jax.Array) -> jax.Array:
        return self.F_c + (self.F_s - self.F_c) / (1.0 + (speed / self.v_0) ** 2) + self.b * speed

    def backward(self, speed: jax.Array) -> jax.Array:
        return self.back * self.forward(speed)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExtendedStribeck:
    """N mu (ratio + (1 - ratio) exp(-v/v_s)) + viscous v, with mu_back backward."""

    mu: float
    mu_back: float
    N: float
    v_s: float
    ratio: float
    viscous: float

    parameters: ClassVar[tuple[Parameter, ...]] = (
        TABLE["mu"], replace(TABLE["mu"], symbol="mu_back"), NORMAL, TABLE["v_s"],
        Parameter("ratio", "1", "", "r"), Parameter("viscous", "N s/m", "", "b", sign="not negative"),
    )  # fmt: skip

    def forward(self, speed: jax.Array) -> jax.Array:
        weakened = self.ratio + (1.0 - self.ratio) * jnp.exp(-speed / self.v_s)
        return self.N * self.mu * weakened + self.viscous * speed

    def backward(self, speed: jax.Array) -> jax.Array:
        return replace(self, mu=self.mu_back).forward(speed)


def plain(p: CapsuleParameters) -> PlainStribeck:
    own = friction_law(p)
    assert isinstance(own, CoulombStribeck)
    return PlainStribeck(own.mu, own.N, own.v_s)


def scipy_motion(law: FrictionLaw, times: np.ndarray) -> tuple[np.ndarray, int]:
    """SciPy's states and closings for P and E with the law's functions of speed."""
    numbers = {field.name: float(getattr(law, field.name)) for field in fields(law)}  # type: ignore[arg-type]
    if isinstance(law, WeakeningTwoWay):
        F_s, F_c, v_0, b, back = numbers.values()

        def forward(speed: float) -> float:
            return F_c + (F_s - F_c) / (1.0 + (speed / v_0) ** 2) + b * speed

        pair = forward, lambda speed: back * forward(speed)
    else:
        mu, mu_back, N, v_s, ratio, viscous = numbers.values()

        def weakened(mu: float) -> Callable[[float], float]:
            return lambda u: N * mu * (ratio + (1.0 - ratio) * np.exp(-u / v_s)) + viscous * u

        pair = weakened(mu), weakened(mu_back)
    q = {**vars(P), **vars(E)}
    return simulate_scipy(q, times, rtol=1e-12, atol=1e-15, max_step=2e-4, law=pair)


def test_eq_1_without_its_own_recursion_is_the_same_motion(cases: Cases) -> None:
    fast, slow = (simulate(cases.p, cases.e, cases.times, friction=law) for law in (None, plain(cases.p)))
    np.testing.assert_allclose(states_of(slow)[..., [0, 2]], states_of(fast)[..., [0, 2]], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(states_of(slow), states_of(fast), rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(slow.contacts, fast.contacts)
    np.testing.assert_array_equal(slow.status, Status.OK)


@pytest.mark.parametrize(
    "law", [WeakeningTwoWay(), ExtendedStribeck(0.5, 0.7, 6.2784, 0.1, 0.7, 1.5)], ids=["Lorentzian", "extended"]
)
def test_another_law_against_scipy(law: FrictionLaw) -> None:
    times = T * np.linspace(0.0, 4.0, 33)
    expected, contacts = scipy_motion(law, times)
    t = simulate(P, E, times, friction=law)
    error = np.abs(states_of(t) - expected).max(axis=0)
    assert error[[0, 2]].max() < 1e-9
    assert error[[1, 3]].max() < 1e-7
    assert int(t.contacts) == contacts
    # Both directions of sliding are in the run, so both sides of the law are.
    assert expected[:, 3].min() < -1e-3
    assert expected[:, 3].max() > 1e-3


def test_a_wrong_derivative_of_the_law_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control: the same values with a slope that is 1 % off miss SciPy's motion."""
    exact_jet = friction_series.jet

    def wrong(function: Callable, primals: tuple, series: tuple) -> tuple:
        value, derivatives = exact_jet(function, primals, series)
        return value, [1.01 * derivatives[0], *derivatives[1:]]

    monkeypatch.setattr(friction_series, "jet", wrong)
    times = T * np.linspace(0.0, 4.0, 33)
    law = WeakeningTwoWay()
    t = jax.jit(lambda law: simulate(P, E, times, friction=law))(law)
    assert np.abs(states_of(t) - scipy_motion(law, times)[0]).max(axis=0)[[0, 2]].max() > 1e-7


def test_the_general_reference_case_that_differs_by_friction_alone() -> None:
    case = json.loads((Path(__file__).parent / "friction_case.json").read_text())["case"]
    own = {name: case[name] for name in ("m1", "m2", "k1", "k2", "c", "G", "g")}
    drive = {name: case["drive"][name] for name in ("P_d", "Omega", "phase")}
    N = (case["m1"] + case["m2"]) * case["g"]
    law = ExtendedStribeck(case["mu"], case["mu"], N, case["v_s"], case["ratio"], 0.0)
    p = CapsuleParameters(**own, mu=np.nan, v_s=np.nan)
    t = simulate(p, Excitation(**drive), [0.0, *case["times"]], friction=law)
    error = np.abs(states_of(t)[1:] - case["states"]).max(axis=0)
    assert error[[0, 2]].max() < 2e-10
    assert error[[1, 3]].max() < 1e-8
    assert int(t.contacts) == case["front_closings"]


def test_derivatives_in_every_leaf_of_a_law() -> None:
    law = WeakeningTwoWay()
    times = np.linspace(0.0, 2.5 * T, 7)
    start = (2e-4, 1e-2, 0.0, 3e-3)

    @jax.jit
    def states(law: WeakeningTwoWay) -> jax.Array:
        t = simulate(P, E, times, start, friction=law)
        return jnp.stack([t.X1, t.Y1, t.X2, t.Y2])

    jacobian = jax.jit(jax.jacfwd(states))(law)
    for field in fields(law):
        value = getattr(law, field.name)
        errors = []
        for h in (1e-5 * value, 1e-6 * value):
            up, down = (states(replace(law, **{field.name: value + step})) for step in (h, -h))
            difference = np.asarray(up - down) / (2.0 * h)
            largest = np.abs(difference).max(axis=1)
            assert (largest > 0.0).all()
            errors.append((np.abs(np.asarray(getattr(jacobian, field.name)) - difference).max(axis=1) / largest).max())
        assert min(errors) < 1e-5, field.name


def test_batches_of_laws_and_vmap() -> None:
    v_0 = np.array([0.03, 0.06, 0.2])
    times = np.linspace(0.0, 2.0 * T, 5)
    batch = simulate(P, E, times, friction=WeakeningTwoWay(v_0=v_0))
    for i, single in enumerate(v_0):
        alone = simulate(P, E, times, friction=WeakeningTwoWay(v_0=float(single)))
        np.testing.assert_allclose(states_of(batch)[i], states_of(alone), rtol=0.0, atol=1e-12)
    mapped = jax.jit(jax.vmap(lambda v_0: simulate(P, E, times, friction=WeakeningTwoWay(v_0=v_0)).X2))(v_0)
    np.testing.assert_allclose(mapped, batch.X2, rtol=0.0, atol=1e-12)
    assert np.ptp(np.asarray(batch.X2[:, -1])) > 1e-5


def test_the_smoothed_engine_takes_the_same_law() -> None:
    law, times = WeakeningTwoWay(), np.array([0.0, 4.0 * T])
    exact = simulate(P, E, times, friction=law)
    smooth = simulate(P, E, times, model="smooth", friction=law)
    assert float(smooth.X2[-1]) == pytest.approx(float(exact.X2[-1]), rel=0.02)
    without = simulate(replace(P, mu=0.66, v_s=0.3), E, times)
    assert abs(float(without.X2[-1]) - float(exact.X2[-1])) > 0.1 * abs(float(exact.X2[-1]))


def test_response_takes_a_law() -> None:
    own = replace(P, mu=0.66, v_s=0.3)
    for law in (plain(own), friction_law(own)):
        expected, seen = cid.response(own, E), cid.response(P, E, friction=law)
        assert seen.label == expected.label
        assert seen.mean_velocity == pytest.approx(expected.mean_velocity, rel=1e-8)
        assert seen.work_per_period == pytest.approx(expected.work_per_period, rel=1e-8)


def test_energy_balance_of_another_law() -> None:
    balance = energy_balance(P, E, (0.0, 10.0 * T), friction=WeakeningTwoWay())
    assert float(balance.relative_residual) < 1e-9
    assert float(balance.friction) > 0.0


def test_inadmissible_leaves_of_a_law() -> None:
    law = WeakeningTwoWay(v_0=np.array([0.06, -0.06, np.nan, np.inf]))
    for model in ("exact", "smooth"):
        t = simulate(P, E, [0.0, 0.01], model=model, friction=law)
        np.testing.assert_array_equal(t.status, [Status.OK] + [Status.INVALID] * 3)


def test_thresholds_of_both_directions() -> None:
    """At rest the capsule holds forces up to forward(0) = 3.9 N and backward(0) = 1.755 N, and no more."""
    law = WeakeningTwoWay()
    far = replace(P, G=1.0, k2=0.0, c=0.0)
    for force, moves in ((3.89, 0), (3.91, 1), (-1.75, 0), (-1.76, -1)):
        balanced = Excitation(force, 0.0)
        t = simulate(far, balanced, [0.0, 1e-3], (force / 1420.0, 0.0, 0.0, 0.0), friction=law)
        assert np.sign(float(t.X2[-1])) == moves


def test_slide_of_any_law() -> None:
    """m v' = -(F + b v) in closed form."""
    law, m, v = ExtendedStribeck(0.5, 0.5, 4.0, 0.3, 1.0, 3.0), 0.64, np.array([0.05, 0.3, 1.0])
    F, b = 2.0, 3.0
    expected = m / b * (v - F / b * np.log1p(b * v / F))
    np.testing.assert_allclose(slide_distance(law, m, v), expected, rtol=1e-12)
