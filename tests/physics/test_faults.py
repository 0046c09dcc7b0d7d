"""Random parameter sets far outside the plausible range: no hang, no exception, no NaN without a word."""

import numpy as np
import pytest

from capsule_id.physics.model import CapsuleParameters, Excitation, Status, status_message
from capsule_id.physics.simulation import simulate
from tests.capsule_cases import states_of

# Steps of a lane in these tests: the bound on the time that a set with a period of 1e7 time scales can take.
BOUND = 3_000


def random_sets(seed: int, n: int) -> tuple[CapsuleParameters, Excitation, np.ndarray, tuple[np.ndarray, ...]]:
    """(p, e, times, initial): six decades of masses, 1..1e7 N/m, zeros everywhere, gaps never reached."""
    rng = np.random.default_rng(seed)

    def decades(low: float, high: float) -> np.ndarray:
        return 10.0 ** rng.uniform(low, high, n)

    def or_zero(x: np.ndarray, chance: float = 0.1) -> np.ndarray:
        return np.where(rng.uniform(size=n) < chance, 0.0, x)

    p = CapsuleParameters(
        m1=decades(-4, 2),
        m2=decades(-4, 2),
        k1=decades(0, 7),
        k2=or_zero(decades(0, 7)),
        c=or_zero(decades(-3, 3)),
        mu=or_zero(decades(-2, 1)),
        v_s=decades(-4, 1),
        G=or_zero(np.where(rng.uniform(size=n) < 0.1, 1e3, decades(-6, 0))),
    )
    e = Excitation(or_zero(decades(-2, 3)), decades(-1, 3), rng.uniform(-np.pi, np.pi, n))
    times = 2.0 * np.pi / np.asarray(e.Omega)[:, None] * np.linspace(0.0, 3.0, 13)
    initial = tuple(or_zero(rng.standard_normal(n) * decades(-5, -1), 0.5) for _ in range(4))
    return p, e, times, initial


def check(seed: int, n: int) -> np.ndarray:
    """Status codes of n sets, after the promises have been checked."""
    p, e, times, initial = random_sets(seed, n)
    t = simulate(p, e, times, initial, max_steps=BOUND)
    status, states = np.asarray(t.status), states_of(t)
    usable = status <= Status.GRAZING
    assert np.isin(status, list(Status)).all()
    assert np.isfinite(states[usable]).all()
    assert np.isnan(states[~usable, -1]).all()
    assert (np.asarray(t.steps) <= BOUND).all()
    assert (np.asarray(t.steps)[status == Status.TOO_MANY_STEPS] == BOUND).all()
    np.testing.assert_allclose(states[:, 0], np.stack(initial, axis=1), rtol=0.0, atol=1e-15)
    # A lane that is given up needs many steps indeed: many time scales, or a damper much faster than they are.
    stiff = (p.k1 + p.k2) * (1.0 / p.m1 + 1.0 / p.m2)
    fastest = np.maximum(np.sqrt(stiff), p.c * (1.0 / p.m1 + 1.0 / p.m2))
    assert (fastest * times[:, -1] > 50.0)[status == Status.TOO_MANY_STEPS].all()
    return status


def test_three_hundred_random_sets() -> None:
    status = check(seed=0, n=320)
    assert (status == Status.OK).mean() > 0.5
    assert (status < Status.INVALID).all()


@pytest.mark.slow
def test_ten_thousand_random_sets() -> None:
    status = np.concatenate([check(seed, 1000) for seed in range(1, 11)])
    assert (status == Status.OK).mean() > 0.5
    assert (status < Status.INVALID).all()


BAD = {
    "m1": [0.0, -1.0, np.nan],
    "m2": [0.0, np.inf],
    "k1": [-1.0, np.nan],
    "k2": [-1.0],
    "c": [-1.0],
    "mu": [-0.1, np.nan],
    "v_s": [0.0, -0.3],
    "G": [-np.inf, np.nan],
    "g": [np.nan],
}


def test_inadmissible_parameters_are_told_per_lane() -> None:
    good = {"m1": 0.11, "m2": 0.53, "k1": 1420.0, "k2": 2e4, "c": 3.89, "mu": 0.66, "v_s": 0.3, "G": 1e-3, "g": 9.81}
    sets = [good] + [good | {key: value} for key, values in BAD.items() for value in values]
    p = CapsuleParameters(**{key: np.array([s[key] for s in sets]) for key in good})
    t = simulate(p, Excitation(4.0, 34.56), np.linspace(0.0, 0.2, 3))
    np.testing.assert_array_equal(t.status, [Status.OK] + [Status.INVALID] * (len(sets) - 1))
    assert np.isnan(states_of(t)[1:]).all()
    assert np.isfinite(states_of(t)[0]).all()
    alone = simulate(CapsuleParameters(**good), Excitation(np.nan, 34.56), np.linspace(0.0, 0.2, 3))
    assert int(alone.status) == Status.INVALID
    alone = simulate(CapsuleParameters(**good), Excitation(4.0, 34.56), np.array([0.0, 0.1]), (0.0, np.inf, 0.0, 0.0))
    assert int(alone.status) == Status.INVALID


def test_a_run_that_is_given_up_says_so_and_keeps_what_it_has() -> None:
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=2e4, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    times = np.linspace(0.0, 2.0, 21)
    whole, part = (simulate(p, Excitation(4.0, 34.56), times, max_steps=n) for n in (100_000, 200))
    assert (int(part.status), int(part.steps)) == (Status.TOO_MANY_STEPS, 200)
    kept = np.isfinite(states_of(part)).all(axis=1)
    assert 5 < kept.sum() < 21
    np.testing.assert_array_equal(kept, np.sort(kept)[::-1])
    np.testing.assert_array_equal(states_of(part)[kept], states_of(whole)[kept])
    assert "max_steps" in status_message(part.status)


def test_numbers_that_overflow_are_told() -> None:
    p = CapsuleParameters(m1=1e-300, m2=1.0, k1=0.0, k2=0.0, c=0.0, mu=0.1, v_s=0.3, G=1.0)
    t = simulate(p, Excitation(1e300, 1e-3), np.array([0.0, 1.0]))
    assert int(t.status) in (Status.NOT_FINITE, Status.TOO_MANY_STEPS)
    assert np.isnan(states_of(t)[-1]).all()


def test_status_message_speaks_for_a_batch() -> None:
    assert status_message(Status.OK) == Status.OK.sentence
    assert status_message([0, 2, 2, 1]).startswith("2 of 4 runs: The run was given up")
