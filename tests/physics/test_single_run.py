"""A single run: a program that XLA compiles as one function."""

import dataclasses
import re
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.parameters import Parameter, Prior
from capsule_id.physics.drives import RecordedDrive
from capsule_id.physics.exact.engine import SHORTEST, as_one_function
from capsule_id.physics.forces import Scaled
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import Cases, states_of
from tests.general_cases import read_general_cases

E = Excitation(P_d=4.0, Omega=34.56)


def loop(x: jax.Array, unused: jax.Array) -> jax.Array:
    """JAX does not see that ``unused`` has no effect; XLA does."""
    return jax.lax.while_loop(lambda y: y[0] < 5.0, lambda y: y + 1.0, x + 0 * unused[0])


def test_the_loop_is_inside_one_function() -> None:
    x = jnp.zeros(3000), jnp.arange(3)
    compiled = str(as_one_function(loop).lower(*x).compile().as_text())
    entry = compiled[compiled.index("\nENTRY ") :]
    assert re.search(r"call\(.*xla_cpu_small_call=\"true\"", entry)
    assert " while(" not in entry


def test_an_argument_without_use_does_no_harm() -> None:
    """XLA would end the process."""
    result, _ = as_one_function(loop)(jnp.zeros(300), jnp.arange(3))
    np.testing.assert_array_equal(result, 5.0)


@pytest.mark.parametrize("n", [2, 64 * SHORTEST + 1])
def test_a_single_run_is_that_of_a_batch(cases: Cases, n: int) -> None:
    p, e, T = cases.one("fig6_k2_20")
    both = simulate(CapsuleParameters(**{**vars(p), "c": np.full(2, p.c)}), e, np.linspace(0.0, 4.0 * T, n))
    one = simulate(p, e, np.linspace(0.0, 4.0 * T, n))
    np.testing.assert_allclose(states_of(one), states_of(both)[0], rtol=0.0, atol=1e-11)
    assert int(one.contacts) == both.contacts[0] > 0


@pytest.mark.full
def test_a_single_run_with_a_recorded_drive() -> None:
    batch = read_general_cases("recorded").one(1)
    assert batch.times.shape[0] == 1
    t = simulate(batch.p, batch.e, batch.times, cast(Any, batch.initial))
    assert np.abs(states_of(t) - batch.states)[:, :, [0, 2]].max() < 1e-9


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scattered:
    """Resistance by a scatter, which XLA cannot put into one function."""

    F: Any
    parameters: ClassVar = (Parameter("F", "N", "break-away force", "F", Prior("lognormal", 3.0, 5.0)),)

    def forward(self, speed: jax.Array) -> jax.Array:
        bins = (jnp.arange(5) + jnp.ravel(self.F)[0].astype(int)) % 2
        return jnp.zeros(2).at[bins].add(0.5)[1] * self.F + 0.1 * speed

    backward = forward


@pytest.mark.full
def test_a_law_of_the_user_may_hold_any_operation() -> None:
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    t = simulate(p, E, np.linspace(0.0, 0.4, 20), friction=Scattered(2.0))
    assert int(t.status) == Status.OK
    assert float(t.X2[-1]) != 0.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ScatteredForce(RecordedDrive):
    """A drive of the user with a scatter."""

    def _line(self, index: Any) -> tuple[Any, Any, Any]:
        begin, value, slope = super()._line(index)
        return begin, value * jnp.zeros(2).at[jnp.ravel(index) % 1].add(1.0)[0], slope


@pytest.mark.full
def test_no_part_of_the_user_is_put_into_one_function() -> None:
    """A law inside another one, and a drive: XLA refused both."""
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    times = np.linspace(0.0, 0.4, 20)
    inside = simulate(p, E, times, friction=Scaled(Scattered(2.0), 0.5))
    driven = simulate(p, ScatteredForce(times, 4.0 * np.cos(34.56 * times)), times)
    for t in (inside, driven):
        assert int(t.status) == Status.OK
        assert float(t.X2[-1]) != 0.0
