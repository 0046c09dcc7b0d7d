"""Clocks of two loggers: offset and drift with sds, from a signal that both record."""

from functools import cache

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.errors import InputError
from capsule_id.records.tones import Clock, estimate_clock

#: True clock of the second logger: s, and pure number.
OFFSET, DRIFT = 0.3e-3, 20e-6
RATE, OTHER_RATE, DURATION = 500.0, 320.0, 60.0  # Hz, s
NOISE = 20e-6  # m, of a motion of a few mm
TWINS = 20


@cache
def motion() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times of two loggers by their own clocks, s, and the capsule's x_rel at both, m: exact motion, no interpolation."""
    p = cid.CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    one = np.arange(int(DURATION * RATE)) / RATE
    other = np.arange(200, int((DURATION - 0.3) * OTHER_RATE)) / OTHER_RATE
    true = OFFSET + (1.0 + DRIFT) * other
    everything = np.unique(np.concatenate([one, true]))
    t = cid.simulate(p, cid.Excitation(P_d=4.0, Omega=34.56), everything)
    x = np.asarray(t.X1 - t.X2)
    return one, x[np.searchsorted(everything, one)], other, x[np.searchsorted(everything, true)]


def estimates(seeds: range, noise: float = NOISE) -> list[Clock]:
    one, x, other, y = motion()
    found = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        b = -250.0 * (y + noise * rng.standard_normal(len(y))) + 3.0  # another unit, sign and zero
        found.append(estimate_clock(one, x + noise * rng.standard_normal(len(x)), other, b))
    return found


@pytest.mark.full
def test_offset_and_drift_of_twenty_twins() -> None:
    found = estimates(range(TWINS))
    z = np.array([[(c.offset - OFFSET) / c.offset_sd, (c.drift - DRIFT) / c.drift_sd] for c in found])
    assert np.sum(np.all(np.abs(z) <= 3.0, axis=1)) >= 19
    assert max(c.offset_sd for c in found) <= 0.05e-3
    assert max(c.drift_sd for c in found) <= 5e-6
    # The sds are of the right size too: the pulls have an rms of 1 within their own error.
    assert np.all(np.abs(np.sqrt(np.mean(z**2, axis=0)) - 1.0) < 0.5)


def test_a_clock_without_offset_would_be_told_from_the_true_one() -> None:
    """Negative control: the truth is far from zero in units of the sd."""
    (found,) = estimates(range(1))
    assert found.offset > 10 * found.offset_sd
    assert found.drift > 10 * found.drift_sd


def test_the_roles_may_be_exchanged() -> None:
    one, x, other, y = motion()
    there, back = estimate_clock(one, x, other, y), estimate_clock(other, y, one, x)
    assert abs((1.0 + there.drift) * (1.0 + back.drift) - 1.0) < 1e-9
    assert abs(back.offset + there.offset / (1.0 + there.drift)) < 1e-8


@pytest.mark.parametrize("offset", [-7.3, 0.0, 12.8])
def test_large_offsets_of_an_event(offset: float) -> None:
    """A single pulse in noise; the loggers start seconds apart."""
    rng = np.random.default_rng(1)
    one, other = np.arange(0.0, 30.0, 1e-3), np.arange(0.0, 30.0, 1.7e-3)

    def pulse(t: np.ndarray) -> np.ndarray:
        return np.exp(-(((t - 15.0) / 0.05) ** 2))

    a = pulse(one) + 0.01 * rng.standard_normal(len(one))
    b = 5.0 * pulse(other + offset) + 0.05 * rng.standard_normal(len(other))
    found = estimate_clock(one, a, other, b)
    at_pulse = found.offset + (1.0 + found.drift) * (15.0 - offset) - 15.0
    assert abs(at_pulse) < 2e-4
    assert found.drift_sd > 5e-4  # one event says nothing of the drift, and the sd shows it


def test_different_signals_and_short_records_are_refused() -> None:
    rng = np.random.default_rng(2)
    time = np.arange(2000) * 1e-3
    noise = rng.standard_normal(2000)
    with pytest.raises(InputError, match="must record the same signal"):
        estimate_clock(time, np.sin(40.0 * time), time, noise)
    with pytest.raises(InputError, match="must record the same signal for 50 samples"):
        estimate_clock(time, noise, time[:30], noise[:30])
