"""Savitzky–Golay filters: exact on polynomials, gain on cosines, and the reason for raw records in likelihoods."""

from importlib.metadata import version

import numpy as np
import pytest
from scipy.signal import savgol_coeffs, savgol_filter

from capsule_id.errors import InputError
from capsule_id.rig.filters import (
    SMALLEST_GAIN,
    TIMING_TOLERANCE,
    choose_window,
    dominant_frequency,
    filter_gain,
    sampling_step,
    savitzky_golay,
    window_samples,
)

STEP = 1.0 / 2000.0  # s
#: What SciPy's coefficients lose at least on long windows. From 1.17 on they lose the order in use, before only digits.
LOST = 1e-3 if tuple(map(int, version("scipy").split(".")[:2])) >= (1, 17) else 1e-9


def test_polynomials_pass_unchanged_up_to_the_edges() -> None:
    time = 0.3 + STEP * np.arange(200)
    t = time - time[0]
    cubic = 2.0 - 3.0 * t + 50.0 * t**2 + 700.0 * t**3
    exact = [cubic, -3.0 + 100.0 * t + 2100.0 * t**2, 100.0 + 4200.0 * t, np.full_like(t, 4200.0)]
    for derivative, expected in enumerate(exact):
        found = savitzky_golay(time, cubic, 31 * STEP, 3, derivative)
        # rounding, which each derivative divides by another step
        bound = (1e-13, 1e-12, 1e-10, 1e-9)[derivative]
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=bound * np.max(np.abs(expected)))


def test_edges_are_the_polynomial_of_the_first_and_last_window() -> None:
    time = STEP * np.arange(60)
    values = np.random.default_rng(3).normal(size=60)
    found = savitzky_golay(time, values, 11 * STEP, 2)
    for window, inside in ((slice(0, 11), slice(0, 6)), (slice(49, 60), slice(54, 60))):
        index = np.arange(60.0)
        polynomial = np.polyfit(index[window] - 30.0, values[window], 2)
        np.testing.assert_allclose(found[inside], np.polyval(polynomial, index[inside] - 30.0), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("samples", "order"), [(5, 2), (21, 2), (21, 4), (51, 3)])
def test_gain_is_what_the_filter_does_to_cosines(samples: int, order: int) -> None:
    time = STEP * np.arange(401)
    for frequency in (0.0, 0.004, 0.02, 0.1, 0.37, 0.5):
        cosine = np.cos(2.0 * np.pi * frequency * (np.arange(401) - 200))
        filtered = savitzky_golay(time, cosine, samples * STEP, order)
        assert filtered[200] == pytest.approx(float(filter_gain(frequency, samples, order)), abs=1e-12)
    assert filter_gain(np.array([0.0, 0.0]), samples, order) == pytest.approx([1.0, 1.0], abs=1e-14)


@pytest.mark.parametrize(("samples", "order"), [(5, 2), (21, 2), (21, 4), (51, 3)])
def test_gain_of_derivatives_is_what_the_filter_does_to_waves(samples: int, order: int) -> None:
    """Compare with the true derivative of cos(2 pi f k + 0.7), which is neither even nor odd."""
    time = STEP * np.arange(401)
    for derivative in (1, 2):
        for frequency in (0.004, 0.02, 0.1, 0.37):
            angle = 2.0 * np.pi * frequency * (np.arange(401) - 200) + 0.7
            filtered = savitzky_golay(time, np.cos(angle), samples * STEP, order, derivative)[200]
            true = (2.0 * np.pi * frequency / STEP) ** derivative * np.cos(0.7 + 0.5 * np.pi * derivative)
            assert filtered / true == pytest.approx(float(filter_gain(frequency, samples, order, derivative)), abs=1e-9)
        assert filter_gain(np.array([0.0, 1e-3]), samples, order, derivative) == pytest.approx([1.0, 1.0], abs=0.02)


@pytest.mark.parametrize(("samples", "order"), [(1, 0), (3, 0), (5, 4), (11, 2), (31, 3), (31, 4)])
def test_short_windows_agree_with_scipy(samples: int, order: int) -> None:
    time = STEP * np.arange(100)
    values = np.random.default_rng(4).normal(size=100)
    for derivative in range(min(order, 3) + 1):
        found = savitzky_golay(time, values, samples * STEP, order, derivative)
        expected = savgol_filter(values, samples, order, deriv=derivative, delta=STEP, mode="interp")
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10 * np.max(np.abs(expected)))


def test_long_windows_keep_their_digits_where_powers_lose_them() -> None:
    time = STEP * np.arange(1500)
    t = time / time[-1]
    quintic = 1.0 + t - 3.0 * t**2 + t**5
    assert np.max(np.abs(savitzky_golay(time, quintic, 1001 * STEP, 5) - quintic)) < 1e-13
    assert abs(savgol_coeffs(1001, 5, use="dot") @ quintic[:1001] - quintic[500]) > LOST


def test_scipy_loses_the_order_in_use_on_very_long_windows() -> None:
    """SciPy's filter fails on a parabola at order 3 and 30,001 samples."""
    t = np.linspace(-1.0, 1.0, 30_001)
    parabola = 1.0 + t**2
    assert abs(savitzky_golay(STEP * np.arange(30_001), parabola, 30_001 * STEP, 3)[15_000] - 1.0) < 1e-12
    assert abs(savgol_coeffs(30_001, 3, use="dot") @ parabola - 1.0) > LOST


def test_the_chosen_window_is_the_longest_that_passes_the_motion() -> None:
    time = STEP * np.arange(1000)
    frequency = 17.9  # Hz, the paper's rod
    values = np.exp(-17.7 * time) * np.cos(2.0 * np.pi * frequency * time) + 0.3 + 0.1 * time
    assert dominant_frequency(time, values) == pytest.approx(frequency, abs=0.5)
    for order in (2, 3, 5):
        window = choose_window(time, values, order)
        samples = window_samples(window, STEP)
        seen = dominant_frequency(time, values) * STEP
        passing = [n for n in range(order + 1 + order % 2, 1000, 2) if filter_gain(seen, n, order) >= SMALLEST_GAIN]
        assert samples == passing[-1]
        assert passing == list(range(passing[0], samples + 2, 2))  # what lets the search halve


def test_the_chosen_window_is_bounded_by_the_record() -> None:
    time = STEP * np.arange(60)
    for n in (59, 60):
        once = np.sin(2.0 * np.pi * time / STEP / 60.0)
        assert window_samples(choose_window(time[:n], once[:n], 12), STEP) == 59


def test_dominant_frequency_of_a_pure_tone() -> None:
    time = 5.0 + STEP * np.arange(2000)
    for frequency in (5.0, 17.9, 333.3):
        # grid of 1/8 of 1 Hz; leakage of a tone of few periods and the trend that is removed shift it by less
        assert dominant_frequency(time, np.sin(2.0 * np.pi * frequency * time) + 4.0 * time) == pytest.approx(
            frequency, abs=0.13
        )


def test_window_in_samples() -> None:
    assert [window_samples(n * STEP, STEP) for n in (0.2, 1.0, 1.9, 2.1, 3.0, 10.9, 11.1, 12.1)] == [
        1,
        1,
        1,
        3,
        3,
        11,
        11,
        13,
    ]


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"time": np.array([0.0, 1, 2, 3, 4.02, 5])}, "a filter needs evenly spaced samples"),
        ({"time": np.array([0.0, 1, 2, 3, np.nan, 5])}, "a filter needs evenly spaced samples"),
        ({"time": np.array([0.0, 1, 2, 4, 8, 16])}, "a filter needs evenly spaced samples"),
        ({"time": np.array([0.0]), "values": np.array([0.0])}, "a filter needs at least 2 samples"),
        ({"window": 7.0}, "the window must fit into the record"),
        ({"order": 5}, "the window must hold more samples than the order"),
    ],
)
def test_refused(change: dict, rule: str) -> None:
    arguments = {"time": np.arange(6.0), "values": np.arange(6.0), "window": 5.0, "order": 2, "derivative": 0, **change}
    with pytest.raises(InputError, match=rule) as caught:
        savitzky_golay(**arguments)
    assert caught.value.remedy


def test_jitter_below_the_stated_share_of_a_step_is_even_enough() -> None:
    time = STEP * np.arange(100)
    time[50] += 0.9 * TIMING_TOLERANCE * STEP
    assert sampling_step(time) == pytest.approx(STEP, rel=1e-12)
    time[50] += 0.2 * TIMING_TOLERANCE * STEP
    with pytest.raises(InputError, match="resample"):
        sampling_step(time)


def estimates(record: np.ndarray, model: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Least squares of records (m, n) on a known shape (n,): amplitude, its stated sd, noise sd, lag-1 correlation."""
    amplitude = record @ model / (model @ model)
    residual = record - amplitude[:, None] * model
    noise_sd = np.sqrt((residual**2).sum(axis=1) / (record.shape[1] - 1))
    lag_1 = (residual[:, 1:] * residual[:, :-1]).sum(axis=1) / (residual**2).sum(axis=1)
    return amplitude, noise_sd / np.sqrt(model @ model), noise_sd, lag_1


def test_filtered_records_understate_the_noise() -> None:
    """A likelihood of independent errors is right on raw records; on filtered ones (the negative control) it is not."""
    records, true_sd, frequency = 2000, 0.02, 17.9
    time = STEP * np.arange(600)
    model = np.exp(-17.7 * time) * np.cos(2.0 * np.pi * frequency * time)
    raw = model + true_sd * np.random.default_rng(11).normal(size=(records, 600))
    window = choose_window(time, model, 3)
    filtered = np.array([savitzky_golay(time, record, window, 3) for record in raw])
    covered = {}
    for name, record in (("raw", raw), ("filtered", filtered)):
        amplitude, sd, noise_sd, lag_1 = estimates(record, model)
        covered[name] = float(np.mean(np.abs(amplitude - 1.0) < 1.959964 * sd))
        if name == "raw":
            # 2000 records: standard errors 0.0007 of the noise sd (relative), 0.0009 of the correlation
            assert np.mean(noise_sd) / true_sd == pytest.approx(1.0, abs=0.003)
            assert np.mean(lag_1) == pytest.approx(0.0, abs=0.005)
        else:
            assert np.mean(noise_sd) < 0.5 * true_sd
            assert np.mean(lag_1) > 0.8
    # binomial standard error of 2000 at 95 %: 0.005
    assert covered["raw"] == pytest.approx(0.95, abs=0.015)
    assert covered["filtered"] < 0.6


def test_a_low_frequency_is_read_from_the_whole_of_a_long_record() -> None:
    """5 Hz at 1 MS/s: the loudest part holds 1.3 periods."""
    time = np.arange(1_200_000) * 1e-6
    values = np.exp(-0.3 * time) * np.cos(2.0 * np.pi * 5.0 * time)
    assert dominant_frequency(time, values) == pytest.approx(5.0, rel=0.03)
