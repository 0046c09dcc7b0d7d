"""Absurd sets of the general capsule: a status for each lane, an InputError for concrete values, never a hang."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.physics.drives import Pulses, RecordedDrive, RodMotion
from capsule_id.physics.model import CapsuleParameters, Status, Trajectory
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import jit_quickly, states_of

BOUND = 2_000
WEIGHT = 0.64 * 9.81
P = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=0.0, c=3.89, mu=0.66, v_s=0.3, G=np.inf)


def random_sets(rng: np.random.Generator, n: int) -> tuple[CapsuleParameters, np.ndarray]:
    """(p, period): decades of everything, level to vertical ground, pressed and lifted, gaps of 0 and infinity."""

    def decades(low: float, high: float, zero: float = 0.3) -> np.ndarray:
        return np.where(rng.uniform(size=n) < zero, 0.0, 10.0 ** rng.uniform(low, high, n))

    def gap() -> np.ndarray:
        return rng.choice([0.0, 1e-4, 1e-3, 1.0, np.inf], n)

    p = CapsuleParameters(
        m1=10.0 ** rng.uniform(-3, 1, n), m2=10.0 ** rng.uniform(-3, 1, n), k1=decades(1, 5), k2=decades(2, 6),
        c=decades(-2, 2), mu=decades(-2, 1), v_s=10.0 ** rng.uniform(-3, 1, n), G=gap(),
        k_cubic=rng.choice([-1.0, 1.0], n) * decades(3, 10), c2=decades(-1, 3), k2_back=decades(2, 6), G_back=gap(),
        slope=np.radians(rng.choice([0.0, 90.0, -90.0, 45.0, 120.0], n)), N0=rng.choice([-100.0, 0.0, 0.0, 5.0], n),
        mu_back=decades(-2, 1), ratio=rng.choice([0.0, 0.5, 1.0, 2.0], n), viscous=decades(-2, 2),
    )  # fmt: skip
    return p, 10.0 ** rng.uniform(-3, 1, n)


def random_pulses(rng: np.random.Generator, period: np.ndarray) -> Pulses:
    n = len(period)
    lag = np.where(rng.uniform(size=n) < 0.2, 0.0, 10.0 ** rng.uniform(-15, 3, n))
    force = rng.standard_normal((2, n)) * 10.0 ** rng.uniform(-1, 2, n)
    duty = rng.choice([-1.0, 0.0, 1.0, 2.0, 0.3, 0.99, 1e-17], n)
    return Pulses(force[0], period, duty, force[1], rng.uniform(-10, 10, n), lag, rng.choice([0.0, 0.5, 1.0], n))


def random_record(rng: np.random.Generator, period: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and values: some records too short, some with a time twice."""
    n = len(period)
    times = period[:, None] * np.linspace(0.0, 1.0, points) * rng.choice([2.0, 2.0, 2.0, 1.5], n)[:, None]
    twice = rng.uniform(size=n) < 0.2
    times[twice, points // 2] = times[twice, points // 2 - 1]
    return times, rng.standard_normal((n, points)) * 10.0 ** rng.uniform(-1, 2, n)[:, None]


@jit_quickly
def run(p: CapsuleParameters, e: Any, times: jax.Array) -> Trajectory:
    """The motion of traced lanes: bad values give a status."""
    return simulate(p, e, times, max_steps=BOUND)


def check(p: CapsuleParameters, e: Any, period: np.ndarray, defined: np.ndarray) -> np.ndarray:
    """Status codes under ``jit``, after the promises have been checked; ``defined`` (n,): the drive covers the run."""
    N = (p.m1 + p.m2) * p.g * np.cos(p.slope) + p.N0
    times = period[:, None] * np.linspace(0.0, 2.0, 5)
    t = run(p, e, times)
    status, states = np.asarray(t.status), states_of(t)
    assert (np.asarray(t.steps) <= BOUND).all()
    usable = status <= Status.GRAZING
    assert np.isfinite(states[usable]).all()
    assert np.isnan(states[~usable, -1]).all()
    np.testing.assert_array_equal(status == Status.INVALID, (N <= 1e-9) | ~defined)
    return status


def study(seed: int, n: int) -> None:
    """n sets of each drive that has pieces."""
    rng = np.random.default_rng(seed)
    p, period = random_sets(rng, n)
    status = check(p, random_pulses(rng, period), period, np.ones(n, bool))
    assert (status == Status.OK).mean() > 0.2
    times, values = random_record(rng, period, 7)
    whole = (np.diff(times, axis=1) > 0.0).all(axis=1) & (times[:, -1] >= 2.0 * period)
    check(p, RecordedDrive(times, values, rng.choice([0.0, 1.0], n)), period, whole)
    check(p, RodMotion(times, 1e-3 * values, 1e-2 * values), period, whole)


@pytest.mark.full
def test_a_few_absurd_sets() -> None:
    rng = np.random.default_rng(0)
    p, period = random_sets(rng, 256)
    status = check(p, random_pulses(rng, period), period, np.ones(256, bool))
    assert (status == Status.OK).mean() > 0.2


@pytest.mark.slow
def test_ten_thousand_absurd_sets() -> None:
    for seed in range(1, 15):
        study(seed, 256)


@pytest.mark.parametrize(
    ("p", "e", "rule", "remedied"),
    [
        (replace(P, slope=np.pi / 2), None, "normal force .* must be positive, N = ", (replace(P, slope=0.3), None)),
        (replace(P, N0=-WEIGHT), None, "raise N0", (replace(P, N0=-0.9 * WEIGHT), None)),
        (P, RecordedDrive(np.zeros(1), np.ones(1)), "must cover the run", None),
        (P, RecordedDrive(np.array([0.0, 0.1, 0.1, 1.0]), np.ones(4)), "own times must increase", None),
        (P, RecordedDrive(np.linspace(0.0, 0.1, 4), np.ones(4)), "must cover the run.* from 0 to 0.2 s", None),
        (P, RodMotion(np.linspace(0.1, 0.5, 4), np.zeros(4), np.zeros(4)), "must cover the run", None),
    ],
)
def test_concrete_values_are_refused(p: CapsuleParameters, e: Any, rule: str, remedied: Any) -> None:
    times = np.linspace(0.0, 0.2, 3)
    drive = Pulses(3.0, 0.1, 0.5) if e is None else e
    with pytest.raises(InputError, match=rule):
        simulate(p, drive, times)
    if remedied is not None:
        assert int(simulate(remedied[0], drive, times).status) == Status.OK


def test_a_record_of_a_motion_is_checked() -> None:
    with pytest.raises(InputError, match="times must increase"):
        RodMotion.through([0.0, 0.1, 0.1], [0.0, 1.0, 2.0])
    with pytest.raises(InputError, match="two or more finite times"):
        RodMotion.through([0.0], [0.0])
