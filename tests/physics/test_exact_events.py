"""Awkward starts and awkward instants: on an event, at the threshold, in contact, two events at once, chatter."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from capsule_id.physics.drives import Pulses
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import energy_balance, simulate
from tests.capsule_cases import Cases, states_of

# The threshold force is 2 N: F_b = mu (m1 + m2) g with round numbers.
RIG = CapsuleParameters(m1=0.1, m2=0.4, k1=1000.0, k2=20_000.0, c=2.0, mu=0.4, v_s=0.2, G=1e-3, g=10.0)


@pytest.mark.full
def test_restart_anywhere_continues_the_same_motion(cases: Cases) -> None:
    """Every sample of a run, in whatever mode, is a valid start of the rest of it."""
    p, e, T = cases.one("fig6_k2_20")
    times = np.linspace(0.0, 2.0 * T, 41)
    whole = states_of(simulate(p, e, times))
    for i in range(1, 40):
        rest = simulate(p, e, np.array([times[i], times[-1]]), tuple(whole[i]))
        np.testing.assert_allclose(states_of(rest)[-1], whole[-1], rtol=0.0, atol=2e-9)


@pytest.mark.parametrize("rate", [0.05, 0.0, -0.05])
def test_start_exactly_at_the_gap(rate: float) -> None:
    """Against starts that are a hair to either side: the motion is continuous there, the count is of closings only."""
    times, hair = np.linspace(0.0, 0.02, 5), 1e-13
    exactly, inside, outside = (
        simulate(RIG, Excitation(1.0, 30.0), times, (RIG.G + offset, rate, 0.0, 0.0)) for offset in (0.0, hair, -hair)
    )
    np.testing.assert_allclose(states_of(exactly), states_of(inside), rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(states_of(exactly), states_of(outside), rtol=0.0, atol=1e-10)
    assert int(exactly.contacts) == int(inside.contacts) == int(outside.contacts) - (rate > 0.0)


def test_start_in_contact_is_no_closing_of_the_gap() -> None:
    t = simulate(RIG, Excitation(0.0, 1.0), np.array([0.0, 1e-3]), (1.05e-3, 0.0, 0.0, 0.0))
    assert (int(t.contacts), int(t.status)) == (0, Status.OK)


@pytest.mark.parametrize(
    ("side", "drive", "moves"), [(1, 3.0, True), (1, 1.0, False), (-1, 1.0, True), (-1, 3.0, False)]
)
def test_start_at_rest_exactly_at_the_threshold(side: int, drive: float, moves: bool) -> None:
    """|f| = F_b at rest: the capsule sets off if and only if the drive stretches the spring further."""
    far = CapsuleParameters(m1=0.1, m2=0.4, k1=1000.0, k2=0.0, c=0.0, mu=0.4, v_s=0.2, G=1.0, g=10.0)
    start = (side * 2e-3, 0.0, 0.0, 0.0)
    balance = 2.0
    t = simulate(far, Excitation(drive if side > 0 else drive - 2.0 * balance, 1e-3), np.array([0.0, 1e-3]), start)
    assert (float(t.X2[-1]) != 0.0) == moves
    assert np.sign(t.X2[-1]) == (side if moves else 0)


def test_rest_at_the_threshold_in_equilibrium_stays() -> None:
    far = CapsuleParameters(m1=0.1, m2=0.4, k1=1000.0, k2=0.0, c=0.0, mu=0.4, v_s=0.2, G=1.0, g=10.0)
    t = simulate(far, Excitation(2.0, 0.0), np.linspace(0.0, 5.0, 6), (2e-3, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(t.X2, 0.0)
    np.testing.assert_allclose(t.X1, 2e-3, rtol=0.0, atol=1e-15)


def test_slip_and_impact_at_the_same_instant() -> None:
    """k1 G = F_b: the gap closes in the very instant that the capsule sets off; compared with gaps a hair apart."""
    ends = []
    for hair in (-1e-12, 0.0, 1e-12):
        p = CapsuleParameters(m1=0.1, m2=0.4, k1=1000.0, k2=20_000.0, c=0.0, mu=0.4, v_s=0.2, G=2e-3 + hair, g=10.0)
        t = simulate(p, Excitation(0.0, 1.0), np.linspace(0.0, 0.05, 6), (0.0, 0.4, 0.0, 0.0))
        assert int(t.status) == Status.OK
        ends.append(states_of(t))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(ends[1], ends[2], rtol=0.0, atol=1e-9)


def test_zero_gap_from_rest() -> None:
    """G = 0: at rest on the support, pushed against it, pulled off it."""
    p = CapsuleParameters(m1=0.1, m2=0.4, k1=1000.0, k2=20_000.0, c=2.0, mu=0.4, v_s=0.2, G=0.0, g=10.0)
    for P_d in (1.0, -1.0):
        near = CapsuleParameters(*[1e-13 if leaf == "G" else x for leaf, x in vars(p).items()])
        times = np.linspace(0.0, 0.3, 7)
        t, other = (simulate(q, Excitation(P_d, 40.0), times) for q in (p, near))
        np.testing.assert_allclose(states_of(t), states_of(other), rtol=0.0, atol=1e-9)
        assert int(t.status) == Status.OK


@pytest.mark.parametrize(
    "drive",
    [Pulses(4.0, 0.2, 0.5, 0.0, phase=np.pi), Pulses(4.0, 0.2, 0.5, 0.0, lag=0.01), Excitation(4.0, 34.56, np.pi / 2)],
)
@pytest.mark.parametrize("back", [False, True])
def test_zero_gap_without_a_rate_until_the_drive_sets_in(drive: Any, back: bool) -> None:
    """The gap opens and closes where the first force does. Before: the contact was passed (8.3 mm for 5.5 mm)."""
    gaps = ({"k2": 0.0, "G": 1.0, "k2_back": 20_000.0, "G_back": gap} if back else {"G": gap} for gap in (0.0, 1e-10))
    times = np.linspace(0.0, 0.6, 7)
    t, near = (simulate(replace(RIG, **own), drive, times) for own in gaps)
    assert int(t.status) == Status.OK
    np.testing.assert_allclose(states_of(t), states_of(near), rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(t.X2, near.X2, rtol=0.0, atol=1e-7)
    other = {"k2": 0.0, "G": 1.0, "k2_back": 20_000.0, "G_back": 0.0} if back else {"G": 0.0}
    assert energy_balance(replace(RIG, **other), drive, (0.0, 0.6)).relative_residual < 1e-8


def test_a_capsule_without_friction_turns_where_the_drive_sets_in() -> None:
    """Before: the turn was passed, and 5 % of the energy was missing."""
    p = replace(RIG, mu=0.0, viscous=5.0, G=np.inf, k2=0.0)
    balance = energy_balance(p, Pulses(4.0, 0.2, 0.5, 0.0, phase=np.pi), (0.0, 0.6))
    assert balance.relative_residual < 1e-8


def test_stick_slip_chatter_is_resolved() -> None:
    """A steep Stribeck curve and a drive just above the threshold: short slips, each with an onset and a stop."""
    p = CapsuleParameters(m1=0.1, m2=0.02, k1=1e5, k2=0.0, c=5.0, mu=0.5, v_s=1e-3, G=1.0)
    t = simulate(p, Excitation(0.6, 20.0), np.linspace(0.0, 1.0, 50))
    assert int(t.status) == Status.OK
    assert 20 < int(t.events) < 10_000
    assert np.isfinite(states_of(t)).all()


@pytest.mark.parametrize("zero", ["mu", "c", "G", "k2", "k1"])
def test_zero_of_every_parameter_that_may_be_zero(cases: Cases, zero: str) -> None:
    """The limit is the value: the motion at 0 is the motion at next to nothing."""
    p, e, T = cases.one("fig6_k2_20")
    tiny = {"mu": 1e-13, "c": 1e-12, "G": 1e-14, "k2": 1e-9, "k1": 1e-9}[zero]
    times = np.linspace(0.0, 0.5 * T, 6)
    at_zero, near = (simulate(CapsuleParameters(**(vars(p) | {zero: value})), e, times) for value in (0.0, tiny))
    assert int(at_zero.status) == Status.OK
    np.testing.assert_allclose(states_of(at_zero), states_of(near), rtol=0.0, atol=1e-9)


def test_zero_drive_from_rest_stays_at_rest() -> None:
    t = simulate(RIG, Excitation(0.0, 30.0), np.linspace(0.0, 10.0, 4))
    np.testing.assert_array_equal(states_of(t), 0.0)
