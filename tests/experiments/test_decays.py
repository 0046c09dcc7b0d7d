"""Decays and their moments: against direct sums and against SciPy's DOP853 with event location."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from bench import K1, M1, C, released
from scipy.integrate import solve_ivp

from capsule_id.experiments.free_vibration.decay_models import dry_decay, quadratic_decay, rates, viscous_basis
from capsule_id.experiments.free_vibration.decay_moments import decay_moments, fold, uniform_step

TIME = np.arange(900) / 2000.0
GAMMA, OMEGA = C / (2 * M1), np.sqrt(K1 / M1 - (C / (2 * M1)) ** 2)
Rate = Callable[[float, np.ndarray], list[float]]


def integrate(rate: Rate, state: list[float], time: np.ndarray) -> np.ndarray:
    """(n,) x at ``time``."""
    solution = solve_ivp(rate, (time[0], time[-1]), state, method="DOP853", t_eval=time, rtol=1e-11, atol=1e-16)
    return solution.y[0]


@pytest.mark.parametrize("n", [1, 2, 37, 900])
@pytest.mark.parametrize("gamma", [GAMMA, 1e-2, 1e-9])
def test_moments_equal_direct_sums(n: int, gamma: float) -> None:
    y = np.random.default_rng(2).standard_normal(n) + 3.0
    a = np.stack([np.exp(-gamma * TIME[:n]) * f(OMEGA * TIME[:n]) for f in (np.cos, np.sin)] + [np.ones(n)], axis=1)
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
    gamma, omega = rates(K1, C, M1, xp)  # type: ignore[arg-type]
    cosine, sine = np.asarray(viscous_basis(TIME, K1, C, M1, xp)).T  # type: ignore[arg-type]
    x = 2e-3 * (cosine + float(gamma / omega) * sine)
    np.testing.assert_allclose(x, released(TIME, 2e-3), rtol=0, atol=1e-17)
    expected = integrate(lambda t, s: [s[1], -(K1 * s[0] + C * s[1]) / M1], [2e-3, 0.0], TIME)
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-12)


def dry_reference(time: np.ndarray, F_dry: float, amplitude: float) -> np.ndarray:
    """Half cycle by half cycle: integrate to the turning point (an event), stop where the spring cannot move it."""
    x, start, state, side = np.full(len(time), np.nan), 0.0, [amplitude, 0.0], -1.0
    while abs(state[0]) > F_dry / K1 and start < time[-1]:

        def rate(t: float, s: np.ndarray, side: float = side) -> list[float]:
            return [s[1], -(K1 * s[0] + C * s[1] + F_dry * side) / M1]

        def turning(t: float, s: np.ndarray, start: float = start, away: float = side) -> float:
            return s[1] if t > start + 1e-3 else away

        turning.terminal = True  # type: ignore[attr-defined]
        part = solve_ivp(
            rate,
            (start, start + 1.0),
            state,
            method="DOP853",
            rtol=1e-11,
            atol=1e-16,
            events=turning,
            dense_output=True,
        )
        inside = (time >= start) & (time <= part.t[-1])
        assert part.sol is not None
        x[inside] = part.sol(time[inside])[0]
        start, state, side = part.t[-1], [float(part.y[0, -1]), 0.0], -side
    x[np.isnan(x)] = state[0]
    return x


@pytest.mark.parametrize("F_dry", [0.0, 0.05, 0.4])
def test_dry_decay(F_dry: float) -> None:
    """With 0.4 N the rod stops for good within the record."""
    x = dry_decay(TIME, K1, C, M1, F_dry, 2e-3, 0.0, half_cycles=20)
    np.testing.assert_allclose(x, dry_reference(TIME, F_dry, 2e-3), rtol=0, atol=1e-12)


def test_dry_decay_before_its_turning_point() -> None:
    """Turned back in time: the half cycle that leads to the turning point, on the other side."""
    x = np.asarray(dry_decay(TIME, K1, C, M1, 0.05, 2e-3, 0.012, half_cycles=20))
    later = dry_reference(TIME[TIME >= 0.012] - 0.012, 0.05, 2e-3)
    np.testing.assert_allclose(x[TIME >= 0.012], later, rtol=0, atol=1e-12)
    back = integrate(
        lambda t, s: [s[1], -(K1 * s[0] + C * s[1] + 0.05) / M1],
        [2e-3, 0.0],
        np.append(0.012, TIME[TIME < 0.012][::-1]),
    )
    np.testing.assert_allclose(x[TIME < 0.012][::-1], back[1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("c_q", [0.0, 20.0, 200.0])
@pytest.mark.parametrize("substeps", [1, 4])
def test_quadratic_decay(c_q: float, substeps: int) -> None:
    """x'|x'| has a kink in its second derivative at every turning point; the bound is that of its documentation."""
    x = quadratic_decay(TIME, K1, C, M1, c_q, 2e-3, -0.05, substeps=substeps)
    expected = integrate(
        lambda t, s: [s[1], -(K1 * s[0] + C * s[1] + c_q * s[1] * abs(s[1])) / M1], [2e-3, -0.05], TIME
    )
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-6 * 2e-3 / substeps**2)


def test_dry_is_not_viscous() -> None:
    """Negative control of the bounds above: 1 % of the smallest dry force moves the record by 1e-7 m."""
    x = dry_decay(TIME, K1, C, M1, 0.05, 2e-3, 0.0, half_cycles=20)
    moved = dry_decay(TIME, K1, C, M1, 0.0505, 2e-3, 0.0, half_cycles=20)
    assert 1e-8 < np.max(np.abs(x - moved)) < 1e-5
