"""Printed numerical claims of the paper that the stick-slip model holds, and one that it does not."""

from itertools import groupby

import numpy as np
import pytest

from capsule_id.motions.response import response
from capsule_id.physics.model import CapsuleParameters, Excitation, Status

RIG = {"m1": 0.11, "m2": 0.53, "k1": 1420.0, "c": 3.89, "mu": 0.66, "v_s": 0.3}
MM = 1e3


def test_figure_10_counts_of_impacts_and_the_capsule_from_nearly_stationary_to_forward() -> None:
    Omega = np.array([26.58, 37.33, 46.0, 54.6])
    r = response(CapsuleParameters(**RIG, k2=59410.0, G=1.5e-3), Excitation(2.5, Omega))
    np.testing.assert_array_equal(r.label, ["P-1-F-3", "P-1-F-2", "P-1-F-2", "P-1-F-2"])
    np.testing.assert_allclose(MM * r.mean_velocity, [0.0083, 0.115, 0.271, 0.529], rtol=0.01)


@pytest.mark.full
def test_figure_8_is_period_one_at_every_frequency_and_forward_up_to_6_hz() -> None:
    f = np.linspace(2.5, 6.5, 10)
    r = response(CapsuleParameters(**RIG, k2=18960.0, G=1.5e-3), Excitation(4.0, 2.0 * np.pi * f))
    np.testing.assert_array_equal(r.period, 1)
    np.testing.assert_array_equal(r.direction[f <= 6.0], "F")
    # Printed: forward at every frequency. At 6.5 Hz the model goes backward.
    assert r.direction[-1] == "B"
    assert abs(MM * r.mean_velocity[-1] + 0.655) < 1e-3


@pytest.mark.full
def test_figure_6_is_period_one_at_every_stiffness_and_turns_three_times() -> None:
    k2 = np.linspace(1e3, 55e3, 109)
    r = response(CapsuleParameters(**RIG, k2=k2, G=1e-3), Excitation(4.0, 34.56))
    np.testing.assert_array_equal(r.status, Status.OK)
    np.testing.assert_array_equal(r.period, 1)
    assert [direction for direction, _ in groupby(r.direction)] == ["B", "F", "B", "F"]
