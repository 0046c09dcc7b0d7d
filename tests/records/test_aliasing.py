"""Frequencies that sampling cannot tell apart, and uneven sampling that can."""

import numpy as np
import pytest

from capsule_id.records.faults import aliasing
from capsule_id.records.faults.aliasing import RATES, aliases

#: Hz.
FREQUENCY, SAMPLING = 0.52, 10.0


def record(jitter: float) -> tuple[np.ndarray, np.ndarray]:
    """(time, s, decay) with a jitter of the times, s, and a damping rate halfway between two of those tried first."""
    rng = np.random.default_rng(0)
    time = np.arange(240) / SAMPLING + jitter * rng.standard_normal(240)
    rate = FREQUENCY * np.sqrt(RATES[8] * RATES[9])
    values = np.exp(-rate * time) * np.cos(2.0 * np.pi * FREQUENCY * time)
    return time, values + 1e-4 * rng.standard_normal(240)


def test_uneven_times_tell_frequencies_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: a real wheel sampled with a jitter of milliseconds was called aliased."""
    assert len(aliases(*record(1e-3), FREQUENCY * 1.01)) == 0
    # Negative control: an error of the frequency hides the difference.
    monkeypatch.setitem(aliasing.REFINEMENT, "maxiter", 1)
    assert len(aliases(*record(1e-3), FREQUENCY * 1.01)) > 0


def test_even_times_do_not() -> None:
    found = aliases(*record(0.0), FREQUENCY * 1.002)
    np.testing.assert_allclose(found[:2], [SAMPLING - FREQUENCY, SAMPLING + FREQUENCY], atol=0.01)


@pytest.mark.parametrize("decimals", [5, 4, 3])
def test_rounded_times_of_even_sampling_do_not(decimals: int) -> None:
    """30 frames a second: each step is rounded, and so is their median."""
    rng, time = np.random.default_rng(1), np.arange(200) / 30.0
    for f in (8.0, 11.3, 33.0):
        values = np.exp(-0.3 * time) * np.cos(2.0 * np.pi * f * time) + 1e-3 * rng.standard_normal(200)
        assert len(aliases(np.round(time, decimals), values, f)) > 0
