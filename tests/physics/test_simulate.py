"""The call itself: shapes, batches, chunks, transformations, errors."""

import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

import capsule_id as cid
from capsule_id.errors import InputError
from capsule_id.physics import batches
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import Cases, jit_quickly, states_of

P = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
E = Excitation(P_d=4.0, Omega=34.56)
TIMES = np.linspace(0.0, 0.3, 7)


def spread(n: int) -> CapsuleParameters:
    rng = np.random.default_rng(0)
    wide = {key: getattr(P, key) * (1.0 + 0.03 * rng.standard_normal(n)) for key in ("k1", "k2", "c", "mu", "v_s")}
    return CapsuleParameters(**(vars(P) | wide))


def test_importing_the_package_imports_no_jax() -> None:
    code = "import sys, capsule_id; sys.exit('jax' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_public_names() -> None:
    assert cid.simulate is simulate
    assert {"CapsuleParameters", "Excitation", "Trajectory", "Smoothing", "simulate", "response"} <= set(dir(cid))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = cid.nothing


def test_shapes_follow_the_leaves() -> None:
    one = simulate(P, E, TIMES)
    assert one.X1.shape == (7,)
    assert one.contacts.shape == one.status.shape == ()
    batch = simulate(spread(3), E, TIMES)
    assert batch.X1.shape == batch.times.shape == (3, 7)
    assert batch.contacts.shape == (3,)
    grids = simulate(P, E, np.stack([TIMES, 0.5 * TIMES]))
    assert grids.X1.shape == (2, 7)
    np.testing.assert_allclose(states_of(grids)[0], states_of(one), rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(states_of(grids)[1, -1], states_of(one)[3], rtol=0.0, atol=1e-12)
    starts = simulate(P, E, TIMES, (np.array([0.0, 1e-4]), 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(starts.X1[:, 0], [0.0, 1e-4])
    np.testing.assert_array_equal(one.x_rel, one.X1 - one.X2)


def test_a_single_time_is_the_initial_state() -> None:
    t = simulate(P, E, [0.5], (1e-4, 2e-3, 3e-4, 4e-3))
    np.testing.assert_array_equal(states_of(t), [[1e-4, 2e-3, 3e-4, 4e-3]])
    assert (int(t.status), int(t.steps)) == (0, 0)


def test_a_lane_is_the_same_to_the_last_bit_wherever_it_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole, in parts, in another order, from one thread: chunking changes nothing."""
    p = spread(150)
    whole = states_of(simulate(p, E, TIMES))

    def part(index: np.ndarray | slice) -> np.ndarray:
        return states_of(simulate(jax.tree.map(lambda x: x[index] if np.ndim(x) else x, p), E, TIMES))

    np.testing.assert_array_equal(np.concatenate([part(slice(0, 37)), part(slice(37, 150))]), whole)
    order = np.random.default_rng(1).permutation(150)
    np.testing.assert_array_equal(part(order), whole[order])
    monkeypatch.setattr(batches.os, "cpu_count", lambda: 1)
    batches.pool.cache_clear()
    np.testing.assert_array_equal(part(slice(0, 150)), whole)
    batches.pool.cache_clear()


@pytest.mark.full
def test_jit_and_vmap_give_the_same_motion(cases: Cases) -> None:
    p = spread(3)
    plain = states_of(simulate(p, E, TIMES))
    jitted = jit_quickly(lambda p: simulate(p, E, TIMES))(p)
    np.testing.assert_allclose(states_of(jitted), plain, rtol=0.0, atol=1e-13)
    axes = CapsuleParameters(*[0 if np.ndim(x) else None for x in vars(p).values()])
    mapped = jit_quickly(jax.vmap(lambda p: simulate(p, E, TIMES), in_axes=(axes,)))(p)
    np.testing.assert_allclose(states_of(mapped), plain, rtol=0.0, atol=1e-13)
    np.testing.assert_array_equal(mapped.contacts, jitted.contacts)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: simulate(P, E, TIMES, model="exakt"), "model must be"),
        (lambda: simulate(P, E, TIMES, semantics="eq3"), "semantics must be"),
        (lambda: simulate(P, E, TIMES, semantics="eq2"), "stick-slip semantics only"),
        (lambda: simulate(P, E, TIMES, smoothing=object()), "no smoothing"),
        (lambda: simulate(P, E, TIMES[::-1]), "times must increase"),
        (lambda: simulate(P, E, [0.0, np.nan]), "times must be finite"),
        (lambda: simulate(P, E, [0.0, np.inf]), "times must be finite"),
        (lambda: simulate(P, E, np.zeros((2, 2, 2))), "times must have shape"),
        (lambda: simulate(P, E, []), "times must have shape"),
        (lambda: simulate(spread(3), Excitation(np.ones(2), 30.0), TIMES), "one length"),
        (lambda: simulate(P, Excitation(np.ones((2, 2)), 30.0), TIMES), "shape"),
        (lambda: simulate(P, Excitation(np.ones(0), 30.0), TIMES), "at least one lane"),
    ],
)
def test_errors_say_what_is_wrong(call: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        call()  # pyright: ignore[reportCallIssue]


def test_values_traced_in_single_precision_are_refused() -> None:
    single = jax.ShapeDtypeStruct((), np.float32)
    with pytest.raises(InputError, match="float64"):
        jax.eval_shape(lambda k1: simulate(CapsuleParameters(**(vars(P) | {"k1": k1})), E, TIMES), single)


def test_reverse_mode_is_refused_by_jax() -> None:
    with pytest.raises(ValueError, match=r"[Rr]everse-mode"):
        jax.grad(lambda P_d: simulate(P, Excitation(P_d, 34.56), TIMES).X2[-1])(4.0)


def test_a_frequency_in_hertz_is_the_same_drive() -> None:
    """Numbers, batches, traced values and derivatives: f stands for Omega = 2 pi f."""
    times, f = np.linspace(0.0, 0.2, 20), np.array([5.0, 5.5])
    drive = Excitation(P_d=4.0, f=f)
    np.testing.assert_array_equal(drive.Omega, 2.0 * np.pi * f)
    np.testing.assert_allclose(drive.f, f, rtol=1e-15)
    np.testing.assert_array_equal(simulate(P, drive, times).X1, simulate(P, Excitation(4.0, 2.0 * np.pi * f), times).X1)

    # What a run is given is traced and differentiated as any other number.
    traced = jax.jvp(jax.jit(lambda f: Excitation(P_d=4.0, f=f).Omega), (5.5,), (1.0,))
    np.testing.assert_allclose(traced, (2.0 * np.pi * 5.5, 2.0 * np.pi), rtol=1e-14)
    assert replace(Excitation(4.0, f=5.5), P_d=3.0) == Excitation(3.0, 2.0 * np.pi * 5.5)


@pytest.mark.parametrize(("stated", "found"), [({}, "neither"), ({"Omega": 34.0, "f": 5.0}, "both")])
def test_a_harmonic_drive_has_one_frequency(stated: dict[str, float], found: str) -> None:
    with pytest.raises(InputError, match=f"one frequency, {found} of Omega and f, give Omega, rad/s, or f, Hz"):
        Excitation(P_d=4.0, **stated)
