"""Settled motions: the labels of the reference cases, longer periods, aperiodic motion, the paper's claims."""

import jax
import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.motions.response import Settling, period_of, response, settle
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import energy_balance, simulate
from tests.capsule_cases import Cases

# Motions of other periods, found by a scan: (m2, k2, c, mu, G, P_d, Omega) -> label.
OTHERS = {
    "P-2-F-9/2": (0.11, 5000.0, 0.5, 0.66, 0.5e-3, 4.0, 34.56),
    "P-2-B-2": (0.3, 5000.0, 0.5, 0.66, 0.5e-3, 8.0, 73.58),
    "P-3-F-3": (0.53, 18960.0, 0.5, 0.2, 0.5e-3, 4.0, 60.0),
    "P-4-B-11/2": (0.3, 18960.0, 0.5, 0.2, 1e-3, 8.0, 20.0),
    "aperiodic": (0.3, 56410.0, 0.5, 0.2, 0.5e-3, 8.0, 34.56),
}


@pytest.mark.full
def test_a_slow_transient_is_not_settled() -> None:
    """Of c = 0.02 N s/m 0.7 % of the start is left after 300 periods. (Before: "aperiodic", and an exponent below 0.)"""
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=0.02, mu=0.66, v_s=0.3, G=0.1)
    e = Excitation(0.5, 34.56)
    r = response(p, e)
    assert (r.label, r.period, r.direction) == ("not settled", 0, "S")
    assert r.lyapunov == pytest.approx(-0.02 / 0.22, rel=0.1)
    later = response(p, e, settling=Settling(dropped=3000))
    assert (later.label, later.period, np.isnan(later.lyapunov)) == ("P-1-S-0", 1, True)
    assert response(p, e, settling=Settling(exponent_periods=0)).label == "aperiodic"  # nothing contradicts it


@pytest.mark.full
def test_labels_and_mean_velocities_of_the_reference_cases(cases: Cases) -> None:
    r = response(cases.p, cases.e)
    np.testing.assert_array_equal(r.label, [case["label"] for case in cases.raw])
    expected = np.array([case["mean_velocity_mm_per_s"] for case in cases.raw])
    # One in a thousand, and half of the last printed digit.
    assert (np.abs(1e3 * r.mean_velocity - expected) <= 1e-3 * np.abs(expected) + 5e-7).all()
    np.testing.assert_array_equal(r.period, 1)
    np.testing.assert_array_equal(r.status, Status.OK)
    for i, label in enumerate(r.label):
        assert label == f"P-1-{r.direction[i]}-{r.contacts_per_period[i]:.0f}"


@pytest.mark.full
def test_longer_periods_and_aperiodic_motion() -> None:
    m2, k2, c, mu, G, P_d, Omega = np.array(list(OTHERS.values())).T
    p = CapsuleParameters(m1=0.11, m2=m2, k1=1420.0, k2=k2, c=c, mu=mu, v_s=0.3, G=G)
    r = response(p, Excitation(P_d, Omega))
    np.testing.assert_array_equal(r.label, list(OTHERS))
    np.testing.assert_array_equal(r.period, [2, 2, 3, 4, 0])
    assert r.contacts_per_period[0] == 4.5
    assert 6.0 < r.contacts_per_period[-1] < 7.0


def test_a_single_run_and_one_that_fails() -> None:
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=56410.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    r = response(p, Excitation(0.8, 73.58))
    assert (r.label, r.period, r.direction, r.contacts_per_period, r.mean_velocity) == ("P-1-S-0", 1, "S", 0.0, 0.0)
    failed = response(p, Excitation(0.8, 73.58), max_steps=1000)
    assert (failed.label, failed.period, failed.direction) == ("failed", 0, "")
    assert failed.status == Status.TOO_MANY_STEPS
    assert np.isnan(failed.mean_velocity)


def test_grazing_load_of_the_resting_capsule() -> None:
    """P_graze = G k1 sqrt((1 - rho^2)^2 + (2 zeta rho)^2): contacts begin between 0.1 % below and 0.1 % above."""
    m1, k1, c, G, Omega = 0.11, 1420.0, 3.89, 1e-3, 73.58
    rho, zeta = Omega * np.sqrt(m1 / k1), c / (2.0 * np.sqrt(k1 * m1))
    P_graze = G * k1 * np.hypot(1.0 - rho**2, 2.0 * zeta * rho)
    p = CapsuleParameters(m1=m1, m2=0.53, k1=k1, k2=56410.0, c=c, mu=0.66, v_s=0.3, G=G)
    r = response(p, Excitation(P_graze * np.array([0.999, 1.001]), Omega))
    assert list(r.label) == ["P-1-S-0", "P-1-S-1"]


def test_period_is_the_shortest_that_repeats() -> None:
    k = np.arange(49)
    for n in (1, 2, 5, 16):
        x, w = 1e-3 * np.cos(2.0 * np.pi * k / n), 0.02 * np.sin(2.0 * np.pi * k / n)
        assert period_of(x, w, 0.0 * k, 30.0) == n
        # A capsule that gets faster without end repeats nothing. Before: period n, and a mean velocity.
        assert period_of(x, w, 0.1 * k, 30.0) == 0
    # A motion of a tenth of a micrometre must repeat to its own scale.
    small = 1e-7 * np.cos(2.0 * np.pi * k / 3)
    assert period_of(small, 0.0 * small, 0.0 * small, 30.0) == 3
    assert period_of(1e-3 * np.cos(k), 0.02 * np.sin(k), 0.0 * k, 30.0) == 0
    assert period_of(1e-3 * np.cos(2.0 * np.pi * k / 17), 0.0 * k, 0.0 * k, 30.0) == 0
    assert period_of(0.0 * k, 0.0 * k, 0.0 * k, 30.0) == 1


def _contacts_a_period(
    p: CapsuleParameters, e: Excitation, start: tuple, T: float, merge: tuple[float, ...]
) -> list[int]:
    """Contacts in the second of two periods, those parted by less than each of ``merge`` as one, from 4,000 samples."""
    grid = np.linspace(0.0, 2.0 * T, 64 * 63 + 1)[1:].reshape(64, 63)
    times = np.concatenate([np.zeros((64, 1)), grid], axis=1)
    touching = np.asarray(simulate(p, e, times, start).x_rel)[:, 1:].ravel() >= p.G
    change = np.diff(touching.astype(int))
    closings, openings = (grid.ravel()[1:][change == sign] for sign in (1, -1))
    before = openings[np.searchsorted(openings, closings) - 1]
    return [int(((closings > T) & (closings - before >= least)).sum()) for least in merge]


@pytest.mark.full
def test_contacts_parted_by_less_than_the_stated_time_are_one(cases: Cases) -> None:
    p, e, T = cases.one("fig6_k2_51.05")
    settled, merge = settle(p, e), (0.0, 4e-3, 8e-3, 2e-2)
    start = tuple(x[0] for x in settled.end)
    seen = [settle(p, e, settled.end, Settling(dropped=2, observed=6, merge_contacts=least)) for least in merge]
    assert [r.label[0] for r in seen] == ["P-1-F-7", "P-1-F-4", "P-1-F-2", "P-1-F-1"]
    assert [r.contacts_per_period[0] for r in seen] == _contacts_a_period(p, e, start, T, merge)
    assert response(p, e, settling=Settling(merge_contacts=merge[1])).label == "P-1-F-4"
    with pytest.raises(InputError, match="less than half a period"):
        response(p, e, settling=Settling(merge_contacts=0.6 * T))


@pytest.mark.full
def test_work_of_the_drive_is_what_damper_and_friction_take(cases: Cases) -> None:
    """Over a period of a periodic motion nothing is stored; the dissipation comes from another quadrature."""
    seen = settle(cases.p, cases.e)
    for i in (0, 4, 6, 12, 18, 21):
        lane = jax.tree.map(lambda leaf, i=i: leaf[i], (cases.p, cases.e, seen.end))
        balance = energy_balance(lane[0], lane[1], (0.0, float(cases.T[i])), lane[2])
        np.testing.assert_allclose(seen.work_per_period[i], balance.damper + balance.friction, rtol=1e-6)


@pytest.mark.full
def test_settled_state_starts_the_same_motion_again(cases: Cases) -> None:
    seen = settle(cases.p, cases.e)
    again = settle(cases.p, cases.e, seen.end, Settling(dropped=0, observed=3))
    np.testing.assert_array_equal(again.label, seen.label)
    np.testing.assert_allclose(again.x_rel[:, 0], seen.x_rel[:, -1], rtol=0.0, atol=0.0)
    np.testing.assert_allclose(again.mean_velocity, seen.mean_velocity, rtol=1e-4, atol=1e-8)


def test_errors() -> None:
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=2e4, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    with pytest.raises(InputError, match="Omega must be positive"):
        response(p, Excitation(1.0, 0.0))
    with pytest.raises(InputError, match="Omega must be positive and finite"):
        response(p, Excitation(1.0, np.inf))
    with pytest.raises(InputError, match="concrete values"):
        jax.jit(lambda P_d: response(p, Excitation(P_d, 30.0)))(1.0)
    for wrong in ({"dropped": -1}, {"observed": 2}, {"merge_contacts": float("nan")}, {"max_steps": 0}):
        with pytest.raises(InputError, match=f"{next(iter(wrong))} must"):
            Settling(**wrong)
    for wrong in ({"observed": 10.5}, {"dropped": np.inf}, {"exponent_periods": 2.5}):
        with pytest.raises(InputError, match=f"{next(iter(wrong))} must be a whole number"):
            Settling(**wrong)
