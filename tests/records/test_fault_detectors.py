"""Detectors of faulty readings: each finds its fault in a decay, and finds nothing without it."""

from collections.abc import Callable
from typing import cast

import numpy as np
import pytest
from scipy import signal

from capsule_id.records import duplicates
from capsule_id.records.duplicates import Readings, reading_step, repeated_blocks
from capsule_id.records.faults import (
    Gaps,
    Jump,
    clipped_samples,
    dropouts,
    find_gaps,
    frozen_samples,
    jump_or_noise,
    phasor,
    time_rounding,
)
from tests.experiments.bench import K1, M1, C, released

RATE = 2000.0
PERIOD = 2.0 * np.pi / np.sqrt(K1 / M1)
SAMPLES = PERIOD * RATE
TIME = np.arange(1200) / RATE


def phase_jump(values: np.ndarray, period: float, alone: bool = False) -> Jump | None:
    """The largest jump of a smooth oscillation that is not noisy."""
    found = jump_or_noise(values, period, alone)
    return None if found is None or found.noisy else found


def decay(seed: int = 0, noise: float = 0.01, time: np.ndarray = TIME) -> np.ndarray:
    """A release from 2 mm with a noise sd of ``noise`` of it, mm."""
    return 2e3 * (released(time, 1e-3) + noise * 1e-3 * np.random.default_rng(seed).standard_normal(len(time)))


def encoder(seed: int = 0) -> np.ndarray:
    """The same without noise, read in steps of 0.005 mm."""
    return 0.005 * np.round(decay(seed, 0.0) / 0.005)


def test_the_reading_step_is_the_spacing_of_the_levels() -> None:
    assert reading_step(np.array([1.25, 3.5, 2.75, 8.0])) == pytest.approx(0.01)
    assert reading_step(encoder()) == pytest.approx(0.005)
    # Steps of a third of a millimetre are no power of ten.
    assert reading_step(np.round(decay() * 30.0) / 30.0) == pytest.approx(1.0 / 30.0)
    assert reading_step(np.zeros(9)) == 0.0


@pytest.mark.parametrize("level", [0.95, 0.85])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("make", [decay, encoder])
def test_clipped_tops_and_no_smooth_ones_are_found(make: Callable[[], np.ndarray], level: float, sign: float) -> None:
    clear = sign * make()
    limit = level * np.max(np.abs(clear))
    (found,) = clipped_samples(np.clip(clear, -limit, limit), SAMPLES)
    assert found.side == ("upper" if sign > 0 else "lower")
    assert found.level == pytest.approx(sign * limit)
    assert set(found.rows) <= set(np.flatnonzero(np.abs(clear) >= limit))
    assert clipped_samples(clear, SAMPLES) == []


def test_readings_with_as_many_digits_near_zero_are_not_clipped() -> None:
    """Before: steps of 0.00039 and 0.0006 among the smallest readings gave a step of 1e-7 at the limit."""
    swing = np.round(-0.107 * np.exp(-TIME / 40.0) * np.cos(2.0 * np.pi / PERIOD * TIME), 3)
    swing[np.abs(swing) < 5e-4] = 6.104e-4
    assert clipped_samples(swing, SAMPLES) == []
    assert len(clipped_samples(np.clip(swing, -0.09, 1.0), SAMPLES)) == 1


def test_a_held_deflection_is_no_clipping() -> None:
    held = np.concatenate([np.full(400, 2.0), decay(noise=0.0)])
    assert clipped_samples(held, SAMPLES) == []


def test_a_record_that_begins_on_its_coarsely_read_top_is_not_clipped() -> None:
    """It holds the whole top, longer by some samples before the release, and the values below it of one side only."""
    swing = 0.01 * np.round(200.0 * np.cos(0.2 * 2.0 * np.pi / PERIOD * TIME[:400]))
    begun = np.concatenate([np.full(12, 2.0), swing])
    assert clipped_samples(begun, 5.0 * SAMPLES) == []
    assert len(clipped_samples(np.clip(begun, -2.0, 1.9), 5.0 * SAMPLES)) == 1


def test_a_sensor_that_is_read_several_times_before_it_has_a_new_value_is_not_clipped() -> None:
    """Before: "clipped at its upper limit", and lines of a later start without end."""
    k = np.arange(400)
    swing = np.round(np.exp(-0.004 * k) * np.cos(0.11 * k) + 0.01 * np.random.default_rng(3).standard_normal(400), 3)
    assert clipped_samples(np.repeat(swing, 3), 170.0) == []
    assert len(clipped_samples(np.repeat(np.clip(swing, -2.0, 0.7), 3), 170.0)) == 1


@pytest.mark.parametrize(("step", "limit"), [(0.005, 0.9), (0.01, 0.8), (0.02, 0.7)])
@pytest.mark.parametrize("begin", [0, 40])
def test_a_record_that_begins_saturated_is_clipped(step: float, limit: float, begin: int) -> None:
    sample = np.arange(begin, 1600)
    swing = np.exp(-sample / 1500.0) * np.cos(2.0 * np.pi * sample / 200.0)
    found = clipped_samples(step * np.round(np.clip(swing, -limit, limit) / step), 200.0)
    assert {one.side for one in found} >= ({"lower"} if begin and limit > 0.85 else {"lower", "upper"})
    assert clipped_samples(step * np.round(swing / step), 200.0) == []


def coarse_encoder(clip: float = np.inf) -> np.ndarray:
    """A swing of 1.4 rad whose encoder has steps of 0.09 or 0.1 degrees in two decimals; most levels are read once."""
    angle = np.rad2deg(1.4) * np.exp(-TIME / 4.0) * np.cos(2.0 * np.pi * 1.7 * TIME)
    return np.round(np.round(np.clip(angle, -clip, clip) * 4000.0 / 360.0) * 360.0 / 4000.0 + 0.003, 2)


def test_the_levels_of_a_swing_are_its_steps_though_most_are_read_once() -> None:
    values = coarse_encoder()
    assert len(np.unique(values)) > 0.5 * len(values)
    assert reading_step(values) == pytest.approx(0.09)
    assert clipped_samples(values, RATE / 1.7) == []
    for level in (0.95, 0.85):
        clipped = clipped_samples(coarse_encoder(level * np.rad2deg(1.4)), RATE / 1.7)
        assert {one.side for one in clipped} >= {"upper"}


def test_a_peak_that_sticks_is_not_clipped() -> None:
    """The rod approaches its turning point smoothly, stays there, and leaves at once."""
    rise = -(np.arange(60, 0, -1) ** 2) / 300.0
    stuck = np.round(np.concatenate([np.full(60, -30.0), rise, np.zeros(28), -np.arange(1.0, 40.0)]))
    assert clipped_samples(stuck, 600.0) == []
    abrupt = np.concatenate([np.arange(-39.0, 0.0), np.zeros(28), -np.arange(1.0, 40.0)])
    assert [one.side for one in clipped_samples(abrupt, 600.0)] == ["upper"]


def test_gaps_are_multiples_of_the_sampling_step() -> None:
    kept = np.delete(TIME, [*range(300, 310), 700])
    gaps = cast(Gaps, find_gaps(kept))
    assert gaps.rows.tolist() == [299, 689]
    assert gaps.lost.tolist() == [10, 1]
    assert find_gaps(TIME) is None
    jittered = TIME + 0.2 / RATE * np.random.default_rng(0).uniform(-1, 1, len(TIME))
    assert find_gaps(jittered) is None


def test_rounded_times_are_found() -> None:
    third = np.arange(900) / 3000.0
    assert time_rounding(np.round(third, 4)) == pytest.approx(1e-4)
    assert time_rounding(third) is None
    assert time_rounding(TIME) is None


def test_drop_outs_repeat_one_value_far_from_their_neighbours() -> None:
    values = decay()
    for value in (-8388.608, 0.0):
        broken = values.copy()
        places = [17, 31, 60] if value else [0, 1, 2]
        places = [place + 5 for place in places] if value == 0.0 else places
        broken[places] = value
        found = dropouts(broken)
        assert set(found) <= set(places)
        assert len(found) == len(places)
    assert len(dropouts(values)) == 0
    # Noise of a hold that is a small part of a record at rest; and a drop-out there.
    rest = 0.01 * np.random.default_rng(3).standard_normal(44_000)
    rest[42_000:43_000] += 2.0
    for noise_of in (rest, np.round(rest, 2)):
        assert len(dropouts(noise_of)) == 0
    rest[42_500] = 1000.0
    assert dropouts(rest).tolist() == [42_500]
    # Impacts are short peaks of different heights.
    hits = 0.1 * np.random.default_rng(1).standard_normal(1200)
    hits[50::100] += np.random.default_rng(2).uniform(2.0, 6.0, 12)
    assert len(dropouts(hits)) == 0


def test_a_frozen_channel_keeps_its_value() -> None:
    values = decay()
    frozen = values.copy()
    frozen[100:120] = frozen[99]
    assert frozen_samples(frozen).tolist() == list(range(99, 120))
    assert len(frozen_samples(values)) == 0
    assert len(frozen_samples(encoder())) == 0


@pytest.mark.parametrize("lost", [20, 40])
@pytest.mark.parametrize("place", [40, 70, 110, 150])
def test_lost_samples_show_as_a_jump(lost: int, place: int) -> None:
    values = np.delete(decay(place), slice(place, place + lost))
    jump = cast(Jump, phase_jump(values, SAMPLES))
    assert abs(jump.row - place) <= 10
    assert phase_jump(decay(place), SAMPLES) is None
    assert phase_jump(encoder(), SAMPLES) is None


def test_few_lost_samples_show_in_a_quiet_record() -> None:
    values = np.delete(decay(noise=1e-4), slice(80, 83))
    jump = cast(Jump, phase_jump(values, SAMPLES))
    assert abs(jump.row - 80) <= 5


def test_a_jump_of_an_oversampled_record_is_found_by_fft() -> None:
    """2 Hz at 100 kHz, 10 s: the sums of products of 12,500 samples at every place took minutes of CPU time."""
    period, lost = 50_000.0, 600_000
    time = np.arange(1_000_000) / period
    x = np.exp(-time / 8.0) * np.cos(2.0 * np.pi * time) + 1e-3 * np.random.default_rng(0).standard_normal(time.size)
    assert phase_jump(x, period) is None
    jump = cast(Jump, phase_jump(np.delete(x, slice(lost, lost + 4000)), period))
    assert abs(jump.row - lost) < 0.1 * period


@pytest.mark.parametrize("correlation", [0.5, 0.7, 0.95, 0.98])
def test_coloured_noise_is_no_jump(correlation: float) -> None:
    """Its deviation is large everywhere, not at one place. The white noise level alone named a jump in every record."""
    rng = np.random.default_rng(7)
    found = 0
    for _ in range(20):
        shocks = np.sqrt(1.0 - correlation**2) * rng.standard_normal(1500)
        noise = np.asarray(signal.lfilter([1.0], [1.0, -correlation], shocks))[300:]
        found += phase_jump(decay(noise=0.0) + 0.03 * noise, SAMPLES) is not None
    assert found <= 1


def rows(values: np.ndarray, label: str = "a", record: bool = True) -> Readings:
    return Readings(label, values.reshape(len(values), -1), record)


def test_repeated_blocks_within_and_across_records() -> None:
    first, second = decay(1), decay(2)
    assert repeated_blocks([rows(first), rows(second, "b")]) == []
    second[200:260] = first[40:100]
    (found,) = repeated_blocks([rows(first), rows(second, "b")])
    assert (found.label, found.row, found.first, found.first_row, found.count) == ("b", 200, "a", 40, 60)
    twice = np.concatenate([first[:300], first[200:]])
    (found,) = repeated_blocks([rows(twice)])
    assert (found.row, found.first_row, found.count) == (300, 200, 100)
    assert repeated_blocks([rows(encoder())]) == []


def test_repeated_rows_of_a_table_of_readings() -> None:
    rng = np.random.default_rng(3)
    table = np.stack([np.linspace(0.0, 1.0, 8), rng.standard_normal(8)], axis=1)
    assert repeated_blocks([rows(table, record=False)]) == []
    (found,) = repeated_blocks([rows(np.concatenate([table, table[2:3]]), record=False)])
    assert (found.row, found.first_row, found.count) == (8, 2, 1)
    # Coarse readings agree by chance.
    assert repeated_blocks([rows(np.round(5.0 * rng.standard_normal(40)), record=False)]) == []


def test_the_decay_of_these_tests_is_that_of_the_bench() -> None:
    assert C / (2.0 * np.sqrt(K1 * M1)) == pytest.approx(0.156, abs=1e-3)


def test_equal_readings_of_a_coarse_angle_are_no_repeated_rows() -> None:
    """Tilts read to 0.1 deg agree by chance; in rad their step is no decimal one."""
    angles = np.round(33.0 + np.random.default_rng(0).standard_normal(12), 1)
    assert len(np.unique(angles)) < len(angles)
    degrees = Readings("tilts", np.deg2rad(angles)[:, None], False, (180.0 / np.pi,))
    assert repeated_blocks([degrees]) == []
    # Negative control: angles read to 1e-6 deg do not agree by chance.
    fine = angles + 1e-6 * np.arange(12) ** 2
    fine[5:7] = fine[2:4]
    (found,) = repeated_blocks([Readings("tilts", np.deg2rad(fine)[:, None], False, (180.0 / np.pi,))])
    assert (found.row, found.first_row, found.count) == (5, 2, 2)


def test_coarse_trials_of_one_load_are_no_repeated_rows() -> None:
    """Pulls read to 0.1 N, as coefficients: 64 fine numbers in all, but two or three at each load."""
    rng = np.random.default_rng(2)
    loads = np.repeat([5.458, 9.382, 54.51, 103.6], 16)
    pulls = np.round(0.17 * loads * (1.0 + 0.05 * rng.standard_normal(64)) / 0.1) * 0.1
    pulls[:12] = [1.1, 1.0, 0.9, 1.0, 0.9, 0.9, 0.9, 1.0, 0.9, 0.9, 0.9, 0.9]
    table = Readings("pulls", np.round(pulls / loads, 5)[:, None], False)
    assert repeated_blocks([table]) == []
    both = Readings("pulls", np.stack([np.round(pulls, 1), np.round(loads, 3)], axis=1), False)
    assert repeated_blocks([both]) == []
    # Negative control: eight readings at as many loads, copied.
    loads = np.linspace(5.0, 60.0, 64)
    fine = np.round(0.17 * loads * (1.0 + 0.05 * rng.standard_normal(64)) / loads, 5)
    fine[40:48] = fine[10:18]
    (found,) = repeated_blocks([Readings("pulls", fine[:, None], False)])
    assert (found.row, found.first_row, found.count) == (40, 10, 8)


@pytest.mark.parametrize("seed", range(3))
def test_a_noisy_place_is_no_jump(seed: int) -> None:
    """Eight times the usual noise for a third of a period (before: a jump of 1 %)."""
    t = np.arange(3000.0)
    noise = 1e-3 * np.random.default_rng(seed).standard_normal(3000) * np.where(np.abs(t - 1000.0) < 18.0, 8.0, 1.0)
    values = np.exp(-t / 1500.0) * np.cos(2.0 * np.pi * t / 100.0) + noise
    assert phase_jump(values, 100.0, alone=True) is None
    lost = np.delete(values, slice(2025, 2028))  # negative control
    jump = cast(Jump, jump_or_noise(lost, 100.0, alone=True))
    assert not jump.noisy
    assert abs(jump.row - 2025) < 25


@pytest.mark.parametrize("coarse", [1e-5, 1e-2, 1.0])
def test_pairs_that_share_no_window_are_not_compared(coarse: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: all pairs, 5 ms each. The blocks are those of all pairs: rest and coarse readings recur everywhere."""
    rng, time = np.random.default_rng(5), np.arange(300) * 0.002
    decays = np.exp(-4.0 * time) * np.cos(118.0 * time + rng.uniform(0.0, 6.0, (40, 1))) * 5.0
    decays = np.round((decays + 0.01 * rng.standard_normal(decays.shape)) / coarse) * coarse
    decays[:, 260:] = 0.0
    decays[7, 40:90], decays[30, 20:70], decays[39] = decays[3, 100:150], decays[30, 150:200], decays[12]
    tables = [Readings(f"d{k}", decay[:, None], True) for k, decay in enumerate(decays)]
    compared, longest = [], duplicates._longest_block
    monkeypatch.setattr(duplicates, "_longest_block", lambda *words: (compared.append(words[:2]), longest(*words))[1])
    found = repeated_blocks(tables)
    assert len(compared) < 2 * len(tables)
    pairs = [(i, j) for j in range(len(tables)) for i in range(j + 1)]
    monkeypatch.setattr(duplicates, "_candidates", lambda *_: pairs)
    assert found == repeated_blocks(tables)
    assert len(found) >= (1 if coarse == 1.0 else 3)


def test_a_harmonic_is_told_from_the_drive_and_a_trend() -> None:
    """8.8 periods of the drive. Before: 2 % of the drive in a harmonic that is not there, and right columns named wrong."""
    time, Omega = np.arange(1600) / 1000.0, 34.5
    x = 1e-3 * np.cos(Omega * time + 0.3) + 2e-4 * time + 1e-7 * np.random.default_rng(1).standard_normal(1600)
    found = phasor(time, x + 1e-6 * np.cos(2.0 * Omega * time), Omega, (2, 1, 3))
    assert abs(found.value - 1e-6) < 5.0 * found.sd
    assert abs(phasor(time, x, 2.0 * Omega).value) > 100.0 * found.sd
