"""Lyapunov exponents: closed forms, Floquet multipliers by differences, and motions that are known to be chaotic."""

import jax
import numpy as np
import pytest

from capsule_id.motions.response import largest_exponent, response, settle
from capsule_id.physics.drives import Pulses
from capsule_id.physics.model import CapsuleParameters, Excitation, Status
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import Cases


@pytest.mark.full
def test_a_rod_on_a_capsule_that_sticks_contracts_as_its_damper_says() -> None:
    """The rate of the slower root: c/(2 m1) where the roots are complex, else (c - sqrt(c^2 - 4 k1 m1))/(2 m1)."""
    m1, k1, c = 0.11, 1420.0, np.array([3.89, 60.0])  # underdamped, overdamped
    p = CapsuleParameters(m1=m1, m2=0.53, k1=k1, k2=5e4, c=c, mu=0.66, v_s=0.3, G=5e-3)
    exponent, status = largest_exponent(p, Excitation(0.5, 30.0), periods=400)
    expected = -(c - np.sqrt(np.maximum(c * c - 4.0 * k1 * m1, 0.0))) / (2.0 * m1)
    # A tangent that turns (complex roots) is never quite aligned: an error of order one, divided by the time.
    assert exponent[0] == pytest.approx(expected[0], rel=2e-3)
    assert exponent[1] == pytest.approx(expected[1], rel=1e-9)
    np.testing.assert_array_equal(status, Status.OK)


def _multiplier(p: CapsuleParameters, e: Excitation, start: np.ndarray, T: float, sticks: bool) -> float:
    """Size of the largest Floquet multiplier of the period-1 orbit through start (x_rel, rate, Y2), by differences."""
    free = [0, 1] if sticks else [0, 1, 2]
    size = np.array([1e-6, 1e-5, 1e-5])[free]
    moved = np.repeat(start[None], 2 * len(free), axis=0)
    moved[np.arange(2 * len(free)), np.tile(free, 2)] += np.concatenate([size, -size])
    x, w, v = moved.T
    t = simulate(p, e, np.array([0.0, T]), (x, w + v, np.zeros_like(x), v))
    end = np.stack([t.x_rel[:, -1], (t.Y1 - t.Y2)[:, -1], t.Y2[:, -1]], axis=1)[:, free]
    jacobian = (end[: len(free)] - end[len(free) :]).T / (2.0 * size)
    return float(np.abs(np.linalg.eigvals(jacobian)).max())


@pytest.mark.full
def test_a_periodic_orbit_has_the_logarithm_of_its_largest_multiplier(cases: Cases) -> None:
    single = [cases.one(name) for name in ("fig10_Om_26.58", "fig11_Pd_2.05", "rand_46")]
    p, e, _ = jax.tree.map(lambda *leaves: np.array(leaves), *single)
    seen = settle(p, e)
    found = largest_exponent(p, e, seen.end, periods=300)[0]
    for i, (own_p, own_e, T) in enumerate(single):
        start = np.array([seen.x_rel[i, -1], seen.rate[i, -1], seen.Y2[i, -1]])
        multiplier = _multiplier(own_p, own_e, start, T, sticks=start[2] == 0.0)
        assert found[i] < 0.0
        # Roots may be complex: the error falls as one over the number of periods.
        assert abs(found[i] - np.log(multiplier) / T) * T < 0.02


#: Before, a lag began anew in every period: -0.4 for 0.7 per period, "not settled".
LAGGING = Pulses(21.694, 0.1413, 0.5, -6.109, lag=0.02826)


@pytest.mark.full
@pytest.mark.parametrize(
    ("p", "e"),
    [
        (CapsuleParameters(0.11, 0.3, 1420.0, 56410.0, 0.5, mu=0.2, v_s=0.3, G=0.5e-3), Excitation(8.0, 34.56)),
        (CapsuleParameters(0.11, 0.53, 1420.0, 13735.0, 0.6962, mu=0.66, v_s=0.3, G=0.559e-3), LAGGING),
    ],
    ids=["harmonic", "lag"],
)
def test_chaos_has_a_positive_exponent_which_is_the_rate_at_which_neighbours_part(
    p: CapsuleParameters, e: Excitation | Pulses
) -> None:
    T = float(e.period)
    seen = settle(p, e)
    assert (seen.label[0], seen.lyapunov[0] > 0.0) == ("aperiodic", True)
    # Neighbours 1e-10 m away, over two periods, from 48 points of the attractor: no derivative is used.
    x, w, v = seen.x_rel[0, :-1], seen.rate[0, :-1], seen.Y2[0, :-1]
    ends = []
    for shift in (0.0, 1e-10):
        t = simulate(p, e, T * np.array([400.0, 401.0, 402.0]), (x + shift, w + v, np.zeros_like(x), v))
        ends.append(np.stack([t.x_rel, (t.Y1 - t.Y2) * T / (2.0 * np.pi), t.Y2 * T / (2.0 * np.pi)], axis=2))
    apart = np.linalg.norm(ends[1] - ends[0], axis=2)
    rate = np.log(apart[:, 2] / apart[:, 1]).mean() / T
    assert seen.lyapunov[0] == pytest.approx(rate, rel=0.35)


@pytest.mark.full
def test_periodic_and_failed_motions_carry_no_exponent_and_say_why() -> None:
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=2e4, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    r = response(p, Excitation(4.0, 34.56))
    assert (r.period, np.isnan(r.lyapunov)) == (1, True)
    exponent, status = largest_exponent(p, Excitation(4.0, 34.56), periods=5, max_steps=20)
    assert (np.isnan(exponent[0]), status[0]) == (True, Status.TOO_MANY_STEPS)
