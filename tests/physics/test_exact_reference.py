"""The exact engine against solutions of two other programs."""

import numpy as np
import pytest

from capsule_id.physics.exact import engine as exact
from capsule_id.physics.exact import taylor
from capsule_id.physics.forces import friction_law
from capsule_id.physics.model import Status, without_absent
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import Cases, jit_quickly, states_of
from tests.scipy_capsule import simulate_scipy


def test_every_period_end_of_every_reference_case(cases: Cases) -> None:
    t = simulate(cases.p, cases.e, cases.times)
    error = np.abs(states_of(t) - cases.states).max(axis=(0, 1))
    # The bar is 1e-8 m and 1e-5 m/s; 1e-10 m is what the engine is built for.
    assert (error[[0, 2]] < 1e-10).all()
    assert (error[[1, 3]] < 1e-9).all()
    np.testing.assert_array_equal(t.contacts, cases.contacts)
    np.testing.assert_array_equal(t.status, Status.OK)


def test_single_run_agrees_with_its_lane_of_the_batch(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")
    t = simulate(p, e, T * np.arange(11))
    i = [case["name"] for case in cases.raw].index("fig6_k2_20")
    assert t.X1.shape == (11,)
    np.testing.assert_allclose(states_of(t), cases.states[i], rtol=0.0, atol=1e-9)
    assert int(t.contacts) == cases.contacts[i]


@pytest.mark.parametrize(
    "tolerance", [1e-6, *(pytest.param(tolerance, marks=pytest.mark.full) for tolerance in (1e-8, 1e-10))]
)
def test_error_is_within_ten_tolerances(cases: Cases, monkeypatch: pytest.MonkeyPatch, tolerance: float) -> None:
    monkeypatch.setattr(taylor, "SERIES_TOLERANCE", tolerance)
    at_rest, bound = tuple(np.zeros((4, len(cases.T)))), np.full(len(cases.T), 100_000)
    run = jit_quickly(lambda *lanes: exact.run(*lanes))
    p, e = without_absent(cases.p, cases.e)
    t = run(p, e, friction_law(p), at_rest, cases.times, cases.times[:, -1], bound)
    # In units of the motion: the rod's travel in mm, and the rate that goes with it at the drive's frequency.
    travel = np.abs(cases.states[..., 0]).max(axis=1)
    rate = travel * cases.e.Omega
    size = np.stack([travel, rate, travel, rate], axis=1)[:, None]
    error = np.abs(states_of(t) - cases.states) / size
    assert np.median(error.max(axis=(1, 2))) < tolerance
    assert error.max() < 10.0 * tolerance + 1e-9


def test_ten_cases_against_scipy(cases: Cases) -> None:
    for i in range(0, 20, 2):
        q = {key: cases.raw[i][key] for key in ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "G", "g", "P_d", "Omega")}
        p, e, T = cases.one(cases.raw[i]["name"])
        times = np.linspace(0.0, 2.0 * T, 9)
        expected, contacts = simulate_scipy(q, times, rtol=1e-10, atol=1e-13, max_step=T / 300)
        t = simulate(p, e, times)
        assert np.abs(states_of(t) - expected)[:, [0, 2]].max() < 1e-9
        assert np.abs(states_of(t) - expected)[:, [1, 3]].max() < 1e-7
        assert int(t.contacts) == contacts


def test_dense_output_is_the_same_motion_whatever_the_samples(cases: Cases) -> None:
    sparse = simulate(cases.p, cases.e, cases.times)
    dense = simulate(cases.p, cases.e, cases.T[:, None] * np.arange(0.0, 10.01, 0.02))
    np.testing.assert_allclose(states_of(dense)[:, ::50], states_of(sparse), rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(dense.contacts, sparse.contacts)


def test_velocities_are_the_derivatives_of_the_positions(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_20")
    t = simulate(p, e, np.linspace(0.0, T, 8001))
    for X, Y in ((t.X1, t.Y1), (t.X2, t.Y2)):
        travelled = np.cumsum(0.5 * (T / 8000) * np.asarray(Y[1:] + Y[:-1]))
        # The trapezoid rule's own error is step^2/12 times the change of acceleration, about 1e-9 m here.
        np.testing.assert_allclose(travelled, X[1:], rtol=0.0, atol=1e-8)
