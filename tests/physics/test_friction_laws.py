"""Friction laws that the package does not know, through both engines: against SciPy, another program, differences."""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import capsule_id as cid
from capsule_id.parameters import Parameter
from capsule_id.physics.exact.taylor import by_chain_rule
from capsule_id.physics.forces import (
    CoulombStribeck,
    FrictionLaw,
    FrictionSeries,
    friction_law,
    slide_distance,
    sliding_friction,
)
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import energy_balance, simulate
from tests.capsule_cases import Cases, assert_both_ways_as_scipy, jit_quickly, states_of
from tests.scipy_capsule import simulate_scipy

# mu and v_s are undefined: a law replaces them.
P = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=np.nan, v_s=np.nan, G=1e-3)
E = Excitation(P_d=4.0, Omega=34.56)
T = 2.0 * np.pi / 34.56
NORMAL_FORCE = (0.11 + 0.53) * 9.81  # N
# Of every run: all batches share their compiled programs.
SAMPLES = 33
Number = float | np.ndarray | jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TwoWay:
    """A law as a user writes it, without a Taylor recursion of its own; N and m/s.

    F_c + (F_s - F_c) (share / (1 + (v/v_0)^2) + (1 - share) exp(-v/v_0)) + b v forward, ``back`` times that backward.
    """

    F_s: Number = 3.9
    F_c: Number = 1.7
    v_0: Number = 0.06
    b: Number = 2.5
    back: Number = 0.45
    share: Number = 1.0

    parameters: ClassVar[tuple[Parameter, ...]] = tuple(
        Parameter(symbol, unit, "", symbol, sign="positive" if symbol == "v_0" else "not negative")
        for symbol, unit in {"F_s": "N", "F_c": "N", "v_0": "m/s", "b": "N s/m", "back": "1", "share": "1"}.items()
    )

    def forward(self, speed: jax.Array) -> jax.Array:
        ratio = speed / self.v_0
        weakening = self.share / (1.0 + ratio**2) + (1.0 - self.share) * jnp.exp(-ratio)
        return self.F_c + (self.F_s - self.F_c) * weakening + self.b * speed

    def backward(self, speed: jax.Array) -> jax.Array:
        return self.back * self.forward(speed)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EasierBackward(CoulombStribeck):
    """Eq. (1) forward, 0.45 times that backward, with a recursion of its own whose v_s is ``slope`` times too small."""

    slope: Number = 1.0

    def backward(self, speed: jax.Array) -> jax.Array:
        return 0.45 * self.forward(speed)

    def series(self, sigma: jax.Array, v: jax.Array, breakaway: tuple[jax.Array, jax.Array]) -> FrictionSeries:
        F_b = jnp.where(sigma < 0.0, breakaway[1], breakaway[0])
        own = CoulombStribeck(self.mu, self.N, self.v_s / self.slope).series(sigma, v, (F_b, F_b))
        return FrictionSeries(sliding_friction(self, sigma, v), own.rate, own.extend)


def as_a_user_writes_it(p: CapsuleParameters) -> TwoWay:
    """Eq. (1) without its own recursion."""
    F_b = p.mu * (p.m1 + p.m2) * p.g
    return TwoWay(F_b, 0.5 * F_b, p.v_s, 0.0, 1.0, 0.0)


def in_a_batch(law: FrictionLaw) -> FrictionLaw:
    """Leaves (1,): all batches share one compiled program."""
    return jax.tree.map(lambda leaf: np.full(1, leaf), law)


LORENTZIAN, EXPONENTIAL = TwoWay(), TwoWay(3.1, 2.2, 0.1, 1.5, 1.4, 0.0)


@pytest.mark.parametrize(
    "law", [LORENTZIAN, pytest.param(EXPONENTIAL, marks=pytest.mark.full)], ids=["Lorentzian", "exponential"]
)
def test_another_law_against_scipy(law: TwoWay) -> None:
    def forward(speed: float) -> float:
        ratio = speed / law.v_0
        weakening = law.share / (1.0 + ratio**2) + (1.0 - law.share) * np.exp(-ratio)
        return law.F_c + (law.F_s - law.F_c) * weakening + law.b * speed

    times = np.linspace(0.0, 4.0 * T, SAMPLES)
    pair = forward, lambda speed: law.back * forward(speed)
    expected, contacts = simulate_scipy({**vars(P), **vars(E)}, times, rtol=1e-12, atol=1e-15, max_step=5e-4, law=pair)
    t = simulate(P, E, times, friction=in_a_batch(law))
    assert_both_ways_as_scipy(t, expected, contacts)


def test_laws_with_as_many_numbers_are_different_pytrees() -> None:
    """Else JAX may run the compiled program of another law: jaxlib 0.10 holds dataclasses of as many fields for equal."""
    eq_1 = CoulombStribeck(0.5, NORMAL_FORCE, 0.1, 0.5)
    assert len(jax.tree.leaves(eq_1)) == len(jax.tree.leaves(LORENTZIAN))
    assert jax.tree.structure(eq_1) != jax.tree.structure(LORENTZIAN)


def test_eq_1_without_its_own_recursion_is_the_same_motion(cases: Cases) -> None:
    fast, slow = (simulate(cases.p, cases.e, cases.times, friction=law) for law in (None, as_a_user_writes_it(cases.p)))
    np.testing.assert_allclose(states_of(slow)[..., [0, 2]], states_of(fast)[..., [0, 2]], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(states_of(slow), states_of(fast), rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(slow.contacts, fast.contacts)
    np.testing.assert_array_equal(slow.status, Status.OK)


@pytest.mark.full
def test_a_recursion_of_a_law_is_used_and_a_wrong_one_is_seen() -> None:
    """The negative control: the same values with slopes that are 1 % off miss the motion of the functions of speed."""
    times = np.linspace(0.0, 4.0 * T, SAMPLES)
    slopes = simulate(P, E, times, friction=EasierBackward(0.66, NORMAL_FORCE, 0.3, slope=np.array([1.0, 1.01])))
    F_b = 0.66 * NORMAL_FORCE
    expected = simulate(P, E, times, friction=in_a_batch(TwoWay(F_b, 0.5 * F_b, 0.3, 0.0, 0.45, 0.0)))
    right, wrong = np.abs(states_of(slopes) - states_of(expected)).max(axis=1)[:, [0, 2]].max(axis=1)
    assert right < 1e-11
    assert wrong > 1e-7


def test_the_general_reference_case_that_differs_by_friction_alone() -> None:
    case = json.loads((Path(__file__).parent / "friction_case.json").read_text())["case"]
    own = {name: case[name] for name in ("m1", "m2", "k1", "k2", "c", "G", "g")}
    drive = {name: case["drive"][name] for name in ("P_d", "Omega", "phase")}
    F_b = case["mu"] * (case["m1"] + case["m2"]) * case["g"]
    law = in_a_batch(TwoWay(F_b, F_b * case["ratio"], case["v_s"], 0.0, 1.0, 0.0))
    p = CapsuleParameters(**own, mu=np.nan, v_s=np.nan)
    before = np.linspace(0.0, case["times"][0], SAMPLES - len(case["times"]), endpoint=False)
    t = simulate(p, Excitation(**drive), [*before, *case["times"]], friction=law)
    error = np.abs(states_of(t)[0, len(before) :] - case["states"]).max(axis=0)
    assert error[[0, 2]].max() < 2e-10
    assert error[[1, 3]].max() < 1e-8
    assert int(t.contacts[0]) == case["front_closings"]


@pytest.mark.full
@pytest.mark.parametrize(
    "law",
    [
        pytest.param(CoulombStribeck(0.66, NORMAL_FORCE, 0.3, 0.45, 0.7, 1.5), id="own recursion"),
        pytest.param(replace(LORENTZIAN, share=0.8), id="functions of speed", marks=pytest.mark.slow),
    ],
)
def test_derivatives_in_every_parameter_of_a_law_and_vmap(law: CoulombStribeck | TwoWay) -> None:
    """One program: a lane per parameter, whose tangent is that parameter's own; against differences of a plain batch."""
    times, start = np.linspace(0.0, 2.5 * T, SAMPLES), (2e-4, 1e-2, 0.0, 3e-3)
    names = [row.symbol for row in law.parameters]
    base, number = np.array([getattr(law, name) for name in names]), len(names)

    def with_values(values: jax.Array | np.ndarray) -> FrictionLaw:
        return replace(law, **dict(zip(names, values, strict=True)))

    def states(values: jax.Array) -> jax.Array:
        t = simulate(P, E, times, start, friction=with_values(values))
        return jnp.stack([t.X1, t.Y1, t.X2, t.Y2])

    def differentiated(tangent: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(states, (jnp.asarray(base),), (tangent,))

    values, derivatives = jit_quickly(jax.vmap(differentiated))(jnp.eye(number))
    steps = np.concatenate([h * np.diag(base) for h in (1e-5, -1e-5, 1e-6, -1e-6)])
    moved = states_of(simulate(P, E, times, start, friction=with_values((base + np.vstack([steps, 0.0 * base])).T)))
    np.testing.assert_allclose(np.moveaxis(values, 1, -1), np.repeat(moved[-1:], number, axis=0), rtol=0.0, atol=1e-12)
    up, down, near_up, near_down = np.split(moved[:-1], 4)
    differences = [(up - down) / (2e-5 * base[:, None, None]), (near_up - near_down) / (2e-6 * base[:, None, None])]
    for i, name in enumerate(names):
        errors = []
        for difference in differences:
            largest = np.abs(difference[i]).max(axis=0)
            assert (largest > 0.0).all()
            errors.append((np.abs(np.asarray(derivatives[i]).T - difference[i]).max(axis=0) / largest).max())
        assert min(errors) < 1e-5, name


@pytest.mark.parametrize("sigma", [1.0, -1.0])
def test_derivatives_of_the_coefficients_of_a_law_without_recursion(sigma: float) -> None:
    """In every leaf and in the velocity, against central differences; the coefficients against those of R(x(s))."""
    velocity = sigma * np.array([0.08, 0.02, -0.03, 0.01, 0.02])
    base = np.array([*(getattr(LORENTZIAN, field.name) for field in fields(LORENTZIAN)), *velocity])
    base[5] = 0.8

    def coefficients(values: jax.Array) -> jax.Array:
        law, v = TwoWay(*values[:6]), [x[None] for x in values[6:]]
        found = by_chain_rule(law, jnp.full(1, sigma), v[0])
        return jnp.concatenate([found.start, *(found.extend(v[: k + 1]) for k in range(1, len(v)))])

    at = jit_quickly(coefficients)
    values = np.asarray(at(base))
    law, s = TwoWay(*base[:6]), 0.1 * np.cos(np.pi * (np.arange(15) + 0.5) / 15)
    exact = sigma * (law.forward if sigma > 0 else law.backward)(sigma * np.polynomial.polynomial.polyval(s, velocity))
    np.testing.assert_allclose(
        values, np.polynomial.polynomial.polyfit(s / 0.1, exact, 12)[:5] / 0.1 ** np.arange(5), rtol=1e-7
    )
    jacobian = np.asarray(jit_quickly(jax.jacfwd(coefficients))(base))
    for i, value in enumerate(base):
        step = 1e-5 * abs(value) * np.eye(len(base))[i]
        difference = np.asarray(at(base + step) - at(base - step))
        np.testing.assert_allclose(
            jacobian[:, i], difference / (2.0 * step[i]), rtol=1e-6, atol=1e-7 * np.abs(values).max()
        )


def test_lanes_of_a_batch_of_laws_do_not_depend_on_each_other() -> None:
    v_0 = np.array([0.03, 0.06, 0.2])
    times = np.linspace(0.0, 2.0 * T, SAMPLES)
    batch = simulate(P, E, times, friction=TwoWay(v_0=v_0))
    for i in range(len(v_0)):
        alone = simulate(P, E, times, friction=TwoWay(v_0=v_0[i : i + 1]))
        np.testing.assert_array_equal(states_of(batch)[i], states_of(alone)[0])
    assert np.ptp(np.asarray(batch.X2[:, -1])) > 1e-5


@pytest.mark.full
def test_the_smoothed_engine_takes_the_same_law() -> None:
    law, times = in_a_batch(LORENTZIAN), np.linspace(0.0, 4.0 * T, SAMPLES)
    exact = simulate(P, E, times, friction=law)
    smooth = simulate(P, E, times, model="smooth", friction=law)
    assert (int(smooth.status[0]), int(smooth.contacts[0])) == (Status.OK, int(exact.contacts[0])), smooth
    assert float(smooth.X2[0, -1]) == pytest.approx(float(exact.X2[0, -1]), rel=0.02), smooth
    without = simulate(replace(P, mu=np.array([0.66]), v_s=0.3), E, times)
    assert abs(float(without.X2[0, -1]) - float(exact.X2[0, -1])) > 0.1 * abs(float(exact.X2[0, -1]))


OWN = replace(P, mu=0.66, v_s=0.3)


@pytest.mark.full
@pytest.mark.parametrize(
    "law",
    [
        pytest.param(friction_law(OWN), id="own recursion"),
        pytest.param(as_a_user_writes_it(OWN), id="functions of speed", marks=pytest.mark.slow),
    ],
)
def test_response_takes_a_law(law: FrictionLaw) -> None:
    """P has no mu: what is seen is the law's."""
    expected, seen = cid.response(OWN, E), cid.response(P, E, friction=law)
    assert seen.label == expected.label
    assert seen.mean_velocity == pytest.approx(expected.mean_velocity, rel=1e-8)
    assert seen.work_per_period == pytest.approx(expected.work_per_period, rel=1e-8)


@pytest.mark.full
@pytest.mark.parametrize(
    "law",
    [
        pytest.param(EasierBackward(0.66, NORMAL_FORCE, 0.3), id="own recursion"),
        pytest.param(LORENTZIAN, id="functions of speed", marks=pytest.mark.slow),
    ],
)
def test_energy_balance_of_another_law(law: FrictionLaw) -> None:
    balance = energy_balance(P, E, (0.0, 10.0 * T), friction=law, max_steps=2000)
    assert float(balance.relative_residual) < 1e-9
    assert float(balance.friction) > 0.0


def test_inadmissible_leaves_of_a_law() -> None:
    law = TwoWay(v_0=np.array([0.06, -0.06, np.nan, np.inf]))
    for model in ("exact", "smooth"):
        t = simulate(P, E, np.linspace(0.0, 0.01, SAMPLES), model=model, friction=law)
        np.testing.assert_array_equal(t.status, [Status.OK] + [Status.INVALID] * 3)


def test_thresholds_of_both_directions() -> None:
    """At rest the capsule holds forces up to forward(0) = 3.9 N and backward(0) = 1.755 N, and no more."""
    force = np.array([3.89, 3.91, -1.75, -1.76])
    far = replace(P, G=1.0)
    times, start = np.linspace(0.0, 1e-3, SAMPLES), (force / 1420.0, 0.0, 0.0, 0.0)
    t = simulate(far, Excitation(force, 0.0), times, start, friction=LORENTZIAN)
    np.testing.assert_array_equal(np.sign(t.X2[:, -1]), [0, 1, 0, -1])


def test_slide_of_any_law() -> None:
    """m v' = -(F + b v) in closed form."""
    m, F, b, v = 0.64, 2.0, 3.0, np.array([0.05, 0.3, 1.0])
    expected = m / b * (v - F / b * np.log1p(b * v / F))
    np.testing.assert_allclose(slide_distance(TwoWay(F, F, 0.3, b), m, v), expected, rtol=1e-12)
