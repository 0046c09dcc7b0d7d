"""Decays and their moments: against direct sums and against SciPy's DOP853 with located turning points."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bench import K1, M1, C, released
from scipy.integrate import solve_ivp

from capsule_id.experiments.free_vibration.decrement import viscous_basis
from capsule_id.experiments.free_vibration.models import decay, decay_moments, fold, uniform_step
from tests.capsule_cases import jit_quickly
from tests.scipy_decay import scipy_decay

TIME = np.arange(900) / 2000.0
GAMMA, OMEGA = C / (2 * M1), np.sqrt(K1 / M1 - (C / (2 * M1)) ** 2)
Rate = Callable[[float, np.ndarray], list[float]]


def integrate(rate: Rate, state: list[float], time: np.ndarray) -> np.ndarray:
    """(n,) x at ``time``."""
    solution = solve_ivp(rate, (time[0], time[-1]), state, method="DOP853", t_eval=time, rtol=1e-11, atol=1e-16)
    return solution.y[0]


@pytest.mark.full
@pytest.mark.parametrize("n", [1, 2, 37, 900])
@pytest.mark.parametrize("gamma", [GAMMA, 1e-2, 1e-9])
def test_moments_equal_direct_sums(n: int, gamma: float) -> None:
    y = np.random.default_rng(2).standard_normal(n) + 3.0
    cosine, sine = (np.exp(-gamma * TIME[:n]) * f(OMEGA * TIME[:n]) for f in (np.cos, np.sin))
    a = np.stack([cosine + gamma / OMEGA * sine, np.hypot(gamma, OMEGA) / OMEGA * sine, np.ones(n)], axis=1)
    yy, ay, aa = decay_moments(fold(y), n, 1.0 / 2000.0, gamma, OMEGA)
    assert float(yy) == pytest.approx(float(y @ y), rel=1e-13)
    np.testing.assert_allclose(ay, a.T @ y, rtol=1e-12, atol=1e-13 * n)
    np.testing.assert_allclose(aa, a.T @ a, rtol=1e-12, atol=1e-13 * n)


def test_uniform_step() -> None:
    assert uniform_step(TIME) == pytest.approx(5e-4, rel=1e-13)
    shifted = TIME.copy()
    shifted[400] += 1e-8
    assert uniform_step(shifted) is None


@pytest.mark.parametrize("xp", [np, jnp])
def test_viscous_decay(xp: object) -> None:
    at_rest, struck = np.asarray(viscous_basis(TIME, K1, C, M1, xp)).T  # type: ignore[arg-type]
    x = 2e-3 * at_rest
    np.testing.assert_allclose(x, released(TIME, 2e-3), rtol=0, atol=1e-17)
    np.testing.assert_allclose(
        struck, np.sqrt(K1 / M1) / OMEGA * np.exp(-GAMMA * TIME) * np.sin(OMEGA * TIME), atol=1e-15
    )
    expected = integrate(lambda t, s: [s[1], -(K1 * s[0] + C * s[1]) / M1], [2e-3, 0.0], TIME)
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("ratio", [0.3, 0.999, 1.0 - 1e-9, 1.0 + 1e-9, 1.01, 1.5, 30.0])
def test_viscous_decay_of_any_damping(ratio: float) -> None:
    """Both solutions against DOP853; their derivatives in k1 and c against central differences of those of SciPy."""
    c = 2.0 * ratio * np.sqrt(K1 * M1)

    def scipy(k1: float, c: float) -> np.ndarray:
        omega = np.sqrt(k1 / M1)
        states: list[list[float]] = [[1.0, 0.0], [0.0, float(omega)]]
        return np.stack(
            [integrate(lambda t, s: [s[1], -(k1 * s[0] + c * s[1]) / M1], state, TIME) for state in states], axis=1
        )

    basis = partial(viscous_basis, xp=jnp)
    found = jit_quickly(basis)(jnp.asarray(TIME), K1, c, M1)
    np.testing.assert_allclose(found, scipy(K1, c), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found, viscous_basis(TIME, K1, c, M1, np), rtol=0, atol=1e-14)
    slopes = jax.jacfwd(basis, (1, 2))(jnp.asarray(TIME), K1, c, M1)
    for slope, (up, down), step in zip(
        slopes, (((1.001 * K1, c), (0.999 * K1, c)), ((K1, 1.001 * c), (K1, 0.999 * c))), (K1, c), strict=True
    ):
        quotient = (scipy(*up) - scipy(*down)) / 2e-3
        np.testing.assert_allclose(step * slope, quotient, rtol=0, atol=2e-5)


#: Forces besides viscous damping and linear spring, all signs and sums.
FORCES = [
    {},
    {"F_dry": 0.05},
    {"F_dry": 0.4},
    {"c_q": 20.0},
    {"k_cubic": 1e8},
    {"k_cubic": -1e8},
    {"F_dry": 0.05, "c_q": 20.0, "k_cubic": 5e7},
    {"F_dry": 0.3, "c_q": 20.0, "k_cubic": -1e8},
]


@pytest.mark.parametrize("extra", FORCES, ids=str)
def test_decay_against_scipy(extra: dict[str, float]) -> None:
    """x_rel, rate and acceleration; dry friction stops the rod within the record."""
    forces = {"k1": K1, "c": C, "m1": M1, **extra}
    found = decay(TIME, forces, 2e-3, 0.0, 20)
    expected = scipy_decay(TIME, forces, 2e-3, 0.0)
    unit = np.sqrt(K1 / M1) ** np.arange(3)
    for values, own, bound in zip(found, expected / unit[:, None], (1e-8, 1e-7, 5e-6), strict=True):
        np.testing.assert_allclose(np.asarray(values) / unit[0], own, rtol=0, atol=bound * 2e-3)
        unit = unit[1:]
    assert ("F_dry" in extra) == bool(np.all(np.asarray(found.velocity)[-100:] == 0.0))


def test_strong_quadratic_damping() -> None:
    """A half cycle loses three quarters of the amplitude; the phase still increases."""
    forces = {"k1": K1, "c": C, "m1": M1, "c_q": 200.0}
    x = np.asarray(decay(TIME, forces, 2e-3, 0.0, 20).x_rel)
    np.testing.assert_allclose(x, scipy_decay(TIME, forces, 2e-3, 0.0)[0], rtol=0, atol=3e-4 * 2e-3)


@pytest.mark.parametrize(
    "extra",
    [pytest.param({"F_dry": 0.05}, marks=pytest.mark.full), {"F_dry": 0.3, "c_q": 20.0, "k_cubic": -1e8}],
    ids=str,
)
def test_forward_derivatives_of_a_decay(extra: dict[str, float]) -> None:
    """Against central differences of SciPy's solution, in every force, the amplitude and the turning time."""
    forces = {"k1": K1, "c": C, "m1": M1, **extra}
    place = {**forces, "amplitude": 2e-3, "turning_time": -0.003}
    time = TIME[::7]

    def model(v: Any) -> Any:
        values = dict(zip(place, v, strict=True))
        return decay(
            time, {name: values[name] for name in forces}, values["amplitude"], values["turning_time"], 20
        ).x_rel

    found = np.asarray(jit_quickly(jax.jacfwd(model))(np.array(list(place.values()))))
    for column, (name, value) in enumerate(place.items()):
        step = 1e-4 * value
        ends = []
        for moved in (value + step, value - step):
            own = {**place, name: moved}
            ends.append(scipy_decay(time, own, own["amplitude"], own["turning_time"])[0])
        expected = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(found[:, column], expected, rtol=0, atol=1e-4 * np.max(np.abs(expected)))


def test_samples_before_the_turning_point_continue_the_motion() -> None:
    """To the second order they mirror the samples after it."""
    forces = {"k1": K1, "c": C, "m1": M1, "F_dry": 0.05}
    time = 0.002 + np.array([-1e-3, 1e-3])
    before, after = np.asarray(decay(time, forces, 2e-3, 0.002, 5).x_rel)
    assert before == pytest.approx(after, abs=1e-3 * 2e-3)
    assert after < 2e-3 * (1.0 - 4e-3)


def test_dry_is_not_viscous() -> None:
    """Negative control of the bounds above: 1 % of the smallest dry force moves the record by 1e-7 m."""
    x, moved = (
        np.asarray(decay(TIME, {"k1": K1, "c": C, "m1": M1, "F_dry": F}, 2e-3, 0.0, 20).x_rel) for F in (0.05, 0.0505)
    )
    assert 1e-8 < np.max(np.abs(x - moved)) < 1e-5
