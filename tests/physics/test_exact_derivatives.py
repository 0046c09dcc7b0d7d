"""Forward-mode derivatives through the events, against central differences and with a negative control."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.physics.exact import engine as exact
from capsule_id.physics.exact.taylor import GAP, NONE, VELOCITY, CapsuleState, Constants, Mode, StepSeries
from capsule_id.physics.forces import friction_law
from capsule_id.physics.model import CapsuleParameters, Excitation, Status, without_absent
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import Cases, jit_quickly, states_of

LEAVES = ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "G", "g", "P_d", "Omega", "phase", "X1", "Y1", "X2", "Y2")
# Sizes of the leaves that have none of their own: a radian, a centimetre, metres per second.
SIZES = {"phase": 1.0, "X1": 1e-2, "Y1": 1.0, "X2": 1e-2, "Y2": 1.0}
STEPS = (1e-5, 1e-6, 1e-7)
RELATIVE = 1e-5
# Derivatives that move no state by this part of its size when the leaf moves by its own are noise in the differences.
INSENSITIVE = 1e-3
#: Reference cases of the core, one or two of each figure of the paper; the others.
CHOSEN = list(range(0, 25, 5))
OTHERS = [i for i in range(25) if i not in CHOSEN]


def thetas(cases: Cases) -> np.ndarray:
    """(25, 16): every float leaf, started in gentle motion so that nothing is at a threshold at first."""
    start = np.tile([2e-4, 1e-2, 0.0, 3e-3], (len(cases.T), 1))
    return np.column_stack(
        [*(getattr(cases.p, x) for x in LEAVES[:9]), *(getattr(cases.e, x) for x in LEAVES[9:12]), start]
    )


def run(theta: jax.Array | np.ndarray, times: jax.Array | np.ndarray) -> tuple[jax.Array, jax.Array]:
    """(states (..., n, 4), status) of theta (16,) or (16, lanes)."""
    t = simulate(CapsuleParameters(*theta[:9]), Excitation(*theta[9:12]), times, tuple(theta[12:]))
    return jnp.stack([t.X1, t.Y1, t.X2, t.Y2], axis=-1), t.status


def central(theta: np.ndarray, times: np.ndarray, step: float) -> np.ndarray:
    """(16, n, 4): central differences with steps relative to the leaves' sizes."""
    h = step * sizes(theta)
    states = np.asarray(run(np.concatenate([theta + np.diag(h), theta - np.diag(h)]).T, times)[0])
    return (states[:16] - states[16:]) / (2.0 * h[:, None, None])


def sizes(theta: np.ndarray) -> np.ndarray:
    """(16,): sizes of the leaves."""
    return np.array([SIZES.get(leaf, x) for leaf, x in zip(LEAVES, theta, strict=True)])


def relative_error(derivative: np.ndarray, differences: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(16, 4): largest error over the samples, relative to the largest derivative of the same component."""
    largest = np.maximum(np.abs(derivative).max(axis=1), floor)
    return np.abs(derivative - differences).max(axis=1) / largest


@pytest.mark.parametrize("chosen", [CHOSEN, pytest.param(OTHERS, marks=pytest.mark.full)], ids=["five", "others"])
def test_every_leaf_of_every_reference_case_against_central_differences(cases: Cases, chosen: list[int]) -> None:
    jacobian = jax.jit(jax.jacfwd(run, has_aux=True))
    every = thetas(cases)
    for i in chosen:
        theta = every[i]
        times = np.linspace(0.0, 2.5 * cases.T[i], 7)
        derivative, status = jacobian(theta, times)
        derivative = np.moveaxis(np.asarray(derivative), -1, 0)
        assert int(status) == Status.OK
        assert np.isfinite(derivative).all()
        travel = np.abs(cases.states[i, :, 0]).max()
        rate = travel * theta[10]
        floor = INSENSITIVE * np.array([travel, rate, travel, rate]) / sizes(theta)[:, None]
        errors = [relative_error(derivative, central(theta, times, step), floor) for step in STEPS]
        worst = np.min(errors, axis=0).max(axis=1)
        assert worst.max() < RELATIVE, (cases.raw[i]["name"], dict(zip(LEAVES, worst, strict=True)))


@pytest.mark.full
def test_without_the_event_correction_the_friction_derivative_is_wrong(
    cases: Cases, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The negative control; the support spring's force is continuous, so its derivative survives."""

    def uncorrected(
        constants: Constants, mode: Mode, step: StepSeries, s: jax.Array, at: CapsuleState, kind: jax.Array
    ) -> tuple[CapsuleState, jax.Array]:
        held = jax.lax.stop_gradient(at)
        (d,), v = at.gaps, jnp.where(kind == VELOCITY, at.v - held.v, at.v)
        return at._replace(gaps=(jnp.where(kind == GAP, d - held.gaps[0], d),), v=v), kind == NONE - 1

    def at_rest(mu_and_k2: jax.Array) -> jax.Array:
        p, e, T = cases.one("fig10_Om_37.33")
        p, e = without_absent(replace(p, mu=mu_and_k2[0], k2=mu_and_k2[1]), e)
        p, e = jax.tree.map(lambda x: jnp.reshape(jnp.asarray(x), (1,)), (p, e))
        zero, end = jnp.zeros(1), jnp.full(1, 1.5 * T)
        t = exact.run(
            p, e, friction_law(p), (zero, zero, zero, zero), jnp.linspace(0.0, end, 7).T, end, jnp.full(1, 10_000)
        )
        return jnp.stack([t.X1[0], t.X2[0]])

    point = jnp.array([0.66, 59410.0])
    states = jax.jit(at_rest)
    states(point)
    right = np.asarray(jit_quickly(jax.jacfwd(at_rest))(point))
    monkeypatch.setattr(exact, "correct", uncorrected)
    wrong = np.asarray(jit_quickly(jax.jacfwd(lambda x: at_rest(x)))(point))
    h = 1e-6 * np.asarray(point)
    differences = np.stack(
        [np.asarray(states(point + dx) - states(point - dx)) / (2.0 * dx.sum()) for dx in np.diag(h)], axis=-1
    )
    size = np.abs(differences).max(axis=(0, 1))
    assert (np.abs(right - differences).max(axis=(0, 1)) / size < 1e-5).all()
    error = np.abs(wrong - differences).max(axis=(0, 1)) / size
    assert error[0] > 0.1


@pytest.mark.full
def test_transformations_agree(cases: Cases) -> None:
    """jvp of a batch and vmap of the jvp of a lane are the same numbers, and the primal is what simulate gives."""
    theta, times = thetas(cases)[:3], np.linspace(0.0, 0.2, 5)
    direction = np.zeros_like(theta)
    direction[:, [3, 5]] = theta[:, [3, 5]]
    whole = jit_quickly(lambda x, v: jax.jvp(lambda x: run(x.T, times)[0], (x,), (v,)))
    lane = jit_quickly(jax.vmap(lambda x, v: jax.jvp(lambda x: run(x, times)[0], (x,), (v,))))
    (states, rates), (mapped_states, mapped_rates) = whole(theta, direction), lane(theta, direction)
    np.testing.assert_allclose(mapped_states, states, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(mapped_rates, rates, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(states, run(theta.T, times)[0], rtol=0.0, atol=1e-12)


@pytest.mark.full
def test_samples_move_with_their_time(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")
    times = np.array([0.0, 0.31, 0.77, 1.0]) * T

    def rod(shift: jax.Array) -> jax.Array:
        return simulate(p, e, times + shift * np.array([0.0, 1.0, 1.0, 1.0])).X1

    rate = jit_quickly(lambda shift: jax.jvp(rod, (shift,), (1.0,))[1])(0.0)
    np.testing.assert_allclose(rate[1:], states_of(simulate(p, e, times))[1:, 1], rtol=1e-7)


@pytest.mark.full
def test_grazing_is_flagged_and_its_derivative_stays_finite() -> None:
    """An undamped rod on a capsule that cannot move swings just beyond the gap: the flag tells how closely."""
    m1, k1, G = 0.1, 1000.0, 1e-3

    def motion(k1: jax.Array | float, start: tuple[float, ...]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        p = CapsuleParameters(m1=m1, m2=0.5, k1=k1, k2=1e4, c=0.0, mu=1.0, v_s=0.3, G=G)
        t = simulate(p, Excitation(0.0, 1.0), np.linspace(0.0, 0.006, 4), start)
        return t.X1, (t.status, t.contacts)

    grazed = jit_quickly(lambda k1, start: jax.jvp(lambda k1: motion(k1, start), (k1,), (1.0,), has_aux=True))
    flags = []
    for overshoot in (1e-6, 1e-13):
        amplitude, X1 = G * (1.0 + overshoot), 0.95 * G
        start = (X1, np.sqrt(k1 / m1 * (amplitude**2 - X1**2)), 0.0, 0.0)
        _, tangent, (status, contacts) = grazed(k1, start)
        assert np.isfinite(tangent).all()
        assert int(contacts) == 1
        flags.append(int(status))
    assert flags == [Status.OK, Status.GRAZING]
