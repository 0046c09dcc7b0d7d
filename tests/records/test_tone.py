"""Harmonic least squares: standard errors against the Cramér–Rao bound and against 500 replicates."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from capsule_id.errors import InputError
from capsule_id.records.tones import Harmonic, fit_harmonic, tone_at

TIME = np.arange(2000) / 1000.0
OMEGA, AMPLITUDE, PHASE, OFFSET, NOISE_SD = 34.56, 2.0, -1.1, 0.02, 5e-3
REPLICATES = 500


def tone(rng: np.random.Generator, time: np.ndarray = TIME, Omega: float = OMEGA, phase: float = PHASE) -> np.ndarray:
    return AMPLITUDE * np.cos(Omega * time + phase) + OFFSET + NOISE_SD * rng.standard_normal(len(time))


@pytest.fixture(scope="module")
def replicates() -> list[Harmonic]:
    rng = np.random.default_rng(1)
    return [fit_harmonic(TIME, tone(rng), OMEGA) for _ in range(REPLICATES)]


@pytest.mark.full
def test_standard_errors_are_calibrated(replicates: list[Harmonic]) -> None:
    truth = {"Omega": OMEGA, "amplitude": AMPLITUDE, "phase": PHASE}
    for name, value in truth.items():
        pulls = np.array([(getattr(fit, name) - value) / getattr(fit, f"{name}_sd") for fit in replicates])
        # standard errors of 500 replicates: 0.045 of the mean, 0.032 of the sd
        assert abs(pulls.mean()) < 0.16, name
        assert np.std(pulls) == pytest.approx(1.0, abs=0.11), name
    assert not any(fit.disagrees for fit in replicates)
    offsets = np.array([fit.offset for fit in replicates])
    assert offsets.mean() == pytest.approx(OFFSET, abs=4.0 * NOISE_SD / np.sqrt(len(TIME) * REPLICATES))


@pytest.mark.full
def test_the_scatter_is_at_the_cramer_rao_bound(replicates: list[Harmonic]) -> None:
    """Rife and Boorstyn's closed forms for a single tone of unknown frequency, real-valued, time from the first sample."""
    n, ratio, step = len(TIME), (NOISE_SD / AMPLITUDE) ** 2, TIME[1]
    bounds = {
        "amplitude": NOISE_SD * np.sqrt(2.0 / n),
        "Omega": np.sqrt(24.0 * ratio / (step**2 * n * (n**2 - 1.0))),
        "phase": np.sqrt(4.0 * ratio * (2.0 * n - 1.0) / (n * (n + 1.0))),
    }
    for name, bound in bounds.items():
        values = [getattr(fit, name) for fit in replicates]
        assert np.std(values) == pytest.approx(bound, rel=0.13), name
        # the finite number of periods moves the stated error off the long record's bound by little
        assert np.mean([getattr(fit, f"{name}_sd") for fit in replicates]) == pytest.approx(bound, rel=0.03), name


@pytest.mark.full
def test_a_known_frequency_would_understate_the_phase(replicates: list[Harmonic]) -> None:
    """Negative control of the pulls: with a known frequency the bound is half as large."""
    known = NOISE_SD / AMPLITUDE * np.sqrt(2.0 / len(TIME))
    assert np.std([(fit.phase - PHASE) / known for fit in replicates]) > 1.7


def test_right_frequencies_are_not_questioned_and_wrong_ones_are() -> None:
    rng = np.random.default_rng(2)
    assert not any(fit_harmonic(TIME, tone(rng), OMEGA).disagrees for _ in range(20))
    for stated in (0.5, 0.9, 0.99, 1.01, 1.3, 3.0):
        fit = fit_harmonic(TIME, tone(rng), stated * OMEGA)
        assert pytest.approx(OMEGA, abs=5.0 * fit.Omega_sd) == fit.Omega
        assert fit.disagrees
        assert fit.stated_Omega == stated * OMEGA


def test_phase_is_that_of_the_records_own_time() -> None:
    rng = np.random.default_rng(3)
    for start, phase in ((0.0, 3.0), (7.3, -3.0), (-2.0, 0.5)):
        fit = fit_harmonic(TIME + start, tone(rng, TIME + start, phase=phase), OMEGA)
        assert abs(np.angle(np.exp(1j * (fit.phase - phase)))) < 5.0 * fit.phase_sd
        assert pytest.approx(NOISE_SD, rel=0.08) == fit.noise_sd


def test_uneven_sampling_will_do() -> None:
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0.0, 2.0, 900))
    fit = fit_harmonic(time, tone(rng, time), 1.01 * OMEGA)
    assert pytest.approx(OMEGA, abs=5.0 * fit.Omega_sd) == fit.Omega


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(InputError, match="at least 8 samples"):
        fit_harmonic(TIME[:7], TIME[:7], OMEGA)


@pytest.mark.parametrize("samples", [8, *(pytest.param(n, marks=pytest.mark.full) for n in (10, 20))])
def test_a_record_of_far_less_than_a_period_does_not_refute_the_stated_frequency(samples: int) -> None:
    """A tenth of a period at most: the normal equations are singular to rounding for some seeds."""
    time = np.arange(samples) / 1000.0
    for seed in range(100):
        fit = fit_harmonic(time, tone(np.random.default_rng(seed), time), OMEGA)
        assert fit.Omega > 0.0
        assert not fit.disagrees


def test_an_alias_does_not_replace_the_stated_frequency() -> None:
    """5.5 Hz read at 20/3 Hz looks like 1.17 Hz; the same record refutes 4 Hz."""
    time = np.arange(30) * 0.15
    values = tone(np.random.default_rng(0), time)
    fit = fit_harmonic(time, values, OMEGA)
    assert fit.Omega == pytest.approx(OMEGA, abs=5.0 * fit.Omega_sd)
    assert not fit.disagrees
    assert fit_harmonic(time, values, 8.0 * np.pi).disagrees


def test_a_wrong_shape_is_refused_in_the_tests() -> None:
    """The import hook of ``conftest.py`` checks shapes: without it this call broadcasts and returns a number."""
    with pytest.raises(TypeCheckError, match="values"):
        tone_at(np.linspace(0.0, 1.0, 20), np.zeros((20, 1)), 30.0)
