"""Frequencies that sampling cannot tell apart, and uneven sampling that can."""

from functools import partial

import numpy as np
import pytest

from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.parameters import Prior
from capsule_id.records import faults as aliasing
from capsule_id.records.faults import RATES, aliases, sampling
from tests.experiments import bench

KINDS = default_registry()

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
    monkeypatch.setattr(aliasing, "least_squares", partial(aliasing.least_squares, max_nfev=1))
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


def test_stamps_rounded_to_significant_digits_do_not() -> None:
    """Nine samples over 30 periods, stamps of four digits. Before: rounding was sought in decimal places alone."""
    time = np.array([float(f"{t:.4g}") for t in 2.1178e-3 * np.arange(9)])
    values = np.exp(-10.0 * time) * np.cos(2.0 * np.pi * 1762.0 * time)
    rate, even = sampling(time)
    assert even
    assert np.min(np.abs(aliases(time, values, 3.0 * rate - 1762.0 + rate) - 1762.0)) < 1.0


@pytest.mark.parametrize("digits", [3, 6, 8])
def test_evenness_allows_for_rounding_and_lost_samples_alone(digits: int) -> None:
    rng = np.random.default_rng(digits)
    time = 0.0137 * np.delete(np.arange(90), slice(40, 47))
    unit = 10.0 ** (np.floor(np.log10(np.maximum(time, 1e-9))) - digits + 1)
    assert sampling(as_written(time, digits))[1]
    # Negative control: jitter of five units of the last digit.
    assert not sampling(as_written(time + 5.0 * np.max(unit) * rng.uniform(-1.0, 1.0, len(time)) / 2.0, digits))[1]


def as_written(time: np.ndarray, digits: int) -> np.ndarray:
    return np.array([float(f"{t:.{digits}g}") for t in time])


def drawn(aliased: bool, jitter: str, seed: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """(stamps, s; record; k1; true samples per period) of a decay: 0.1 to 1.95 samples per period, else 4 to 40.

    The stamps have 3 to 8 digits. ``jitter``: none, less than their rounding, or three to a hundred times as much.
    """
    rng = np.random.default_rng([seed, aliased, len(jitter)])
    while True:
        digits, k1 = int(rng.integers(3, 9)), 10.0 ** (rng.uniform(1.0, 8.0) if aliased else rng.uniform(1.5, 5.0))
        frequency = np.sqrt(k1 / bench.M1) / (2.0 * np.pi)
        per_period = rng.uniform(0.1, 1.95) if aliased else 4.0 * 10.0 ** rng.uniform(0.0, 1.0)
        number = int(rng.integers(9, 300)) if aliased else max(9, int(rng.uniform(5.0, 60.0) * per_period))
        step = 1.0 / (frequency * per_period)
        time = step * (np.arange(number) + rng.uniform() * rng.integers(2))
        unit = 10.0 ** (np.floor(np.log10(np.maximum(time, 1e-3 * step))) - digits + 1)
        size = {"none": 0.0, "less": 0.45 * unit, "more": np.max(unit) * 10.0 ** rng.uniform(0.5, 2.0)}[jitter]
        true = time + size * rng.uniform(-1.0, 1.0, number)
        stamps = as_written(true, digits)
        if np.max(size) <= 0.2 * step and np.all(np.diff(stamps) > 0.0) and np.all(np.diff(true) > 0.0):
            break
    rate = rng.uniform(0.2, 2.0) / (number * step)
    values = np.exp(-rate * true) * np.cos(np.sqrt(k1 / bench.M1 - rate**2) * true + rng.uniform(0.0, 2.0 * np.pi))
    return stamps, 1e-3 * (values + 10.0 ** rng.uniform(-3.0, -2.0) * rng.standard_normal(number)), k1, per_period


def word(stamps: np.ndarray, values: np.ndarray, prior: Prior | None = None) -> str:
    """What the findings on the readings leave of the trust in k1."""
    table = bench.table("free_vibration", [bench.column("time", stamps), bench.column("x_rel", values)])
    rig = bench.rig(table, priors=None if prior is None else {"k1": prior})
    found = lint(rig, KINDS, rig.tables)
    if any(finding.level == "fail" for finding in found):
        return "not trusted"
    return "not judged" if any("k1" in f.parameters for f in found if f.level == "warn") else "trusted"


def words(aliased: bool, jitter: str, number: int) -> list[tuple[str, float]]:
    """Word and true samples per period of ``number`` records; those that are not aliased have a prior of factor 1.5."""
    found = []
    for seed in range(number):
        stamps, values, k1, per_period = drawn(aliased, jitter, seed)
        wrong = float(np.random.default_rng(seed).uniform(0.8, 1.25))
        found.append((word(stamps, values, None if aliased else Prior("lognormal", wrong * k1, 1.5)), per_period))
    return found


@pytest.mark.full
@pytest.mark.parametrize("number", [10, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("jitter", ["none", "less", "more"])
def test_aliased_records_are_not_trusted_and_others_are(jitter: str, number: int) -> None:
    """Before, 45, 32 and 23 of 100 aliased records were trusted; now none is."""
    assert [one for one, _ in words(True, jitter, number)].count("trusted") == 0
    # Negative control. Of 100 each, all of those with jitter are trusted, and all even ones with 20 samples per period.
    judged = [one for one, per_period in words(False, jitter, number) if jitter == "more" or per_period >= 20.0]
    assert judged.count("trusted") >= 0.9 * len(judged) > 0.0
