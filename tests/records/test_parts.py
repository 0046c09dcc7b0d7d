"""Period, mean velocity and folding on constructed signals."""

import numpy as np
import pytest

from capsule_id.parameters import STANDING
from capsule_id.records.motion import fit_mean_velocity
from capsule_id.records.periods import find_period, intervals_above, local_polynomials
from capsule_id.records.tones import noise_level

TIME = np.arange(2000) / 1000.0
T = 2.0 * np.pi / 73.58
NOISE_SD = 10e-6


def motion(n: int, part: float = 0.2, time: np.ndarray = TIME) -> np.ndarray:
    """1 mm at the drive's frequency, and ``part`` of it at 1/n of that."""
    return 1e-3 * (np.cos(2.0 * np.pi * time / T) + part * np.cos(2.0 * np.pi * time / (n * T) + 0.4))


def noise(seed: int, sd: float = NOISE_SD) -> np.ndarray:
    return sd * np.random.default_rng(seed).standard_normal(len(TIME))


@pytest.mark.full
@pytest.mark.parametrize("n", [1, 2, 3, 5, 8, 11])
def test_the_period_is_the_smallest_that_repeats(n: int) -> None:
    for seed in range(20):
        assert find_period(TIME, motion(n) + noise(seed), T).period == n


def test_what_does_not_repeat_is_aperiodic_if_the_record_is_long_enough() -> None:
    golden = motion(1) + 2e-4 * np.cos(2.0 * np.pi * TIME / T * 0.5 * (np.sqrt(5.0) - 1.0) + 0.3) + noise(0)
    assert find_period(TIME, golden, T).period == 0
    shorter = find_period(TIME[:1200], golden[:1200], T)
    assert shorter.period is None
    assert "too short" in shorter.reason


def test_a_long_period_needs_two_of_them() -> None:
    found = find_period(TIME, motion(13) + noise(1), T)
    assert found.period is None
    assert "repeats after 13" in found.reason


def test_noise_limits_the_visible_part() -> None:
    """``hidden`` states the largest part of another period that noise hides."""
    quiet = find_period(TIME, motion(1) + noise(2), T)
    assert quiet.hidden < 0.003 * quiet.motion
    found = [find_period(TIME, motion(2, 0.016) + noise(seed), T).period for seed in range(20)]
    assert set(found) == {2}  # 11 um, where the noise is 10 um
    below = [find_period(TIME, motion(2, 0.7 * quiet.hidden / 1e-3) + noise(seed), T).period for seed in range(20)]
    assert 2 not in below
    loud = [find_period(TIME, motion(n, part) + noise(4, 2e-4), T) for n, part in ((2, 0.2), (2, 0.03), (1, 0.0))]
    assert [one.period for one in loud] == [None, None, None]
    assert "they hide a part of another period below" in loud[2].reason
    assert find_period(TIME, motion(2) + noise(4, 2e-3), T).reason.startswith("noise: its standard deviation is")


@pytest.mark.full
def test_no_false_second_period_in_noise() -> None:
    assert {find_period(TIME, motion(1) + noise(seed), T).period for seed in range(300)} == {1}


def uneven(seed: int, part: float, scatter: float = 0.01) -> np.ndarray:
    """Period two by ``part`` of the motion; its size scatters from cycle to cycle."""
    z = np.random.default_rng(seed).standard_normal(60)
    size = 1.0 + scatter * np.interp(TIME / T, np.arange(60) - 0.5, z)
    return size * motion(2, part) + noise(seed)


def test_a_small_second_period_is_not_called_the_first() -> None:
    """Negative control of the labels of records that scatter."""
    for part in (0.01, 0.02, 0.04):
        found = [find_period(TIME, uneven(seed, part), T) for seed in range(8)]
        assert all(one.period in (None, 2) for one in found)
    assert all(one.period == 2 for one in found)  # 4 % of the motion
    plain = [find_period(TIME, uneven(seed, 0.0), T) for seed in range(8)]
    assert [one.period for one in plain].count(1) >= 7
    assert np.median([one.scatter / one.motion for one in plain]) == pytest.approx(
        0.007, rel=0.3
    )  # interpolated: below 1 %


def test_noise_estimate_and_its_stated_scatter() -> None:
    squares = np.array([noise_level(motion(2) + noise(seed), 6) ** 2 for seed in range(1000)]) / NOISE_SD**2
    assert squares.mean() == pytest.approx(1.0, abs=0.02)
    assert squares.var() * len(TIME) == pytest.approx(12.0, rel=0.2)  # 1000 replicates: 4.5 %
    assert find_period(TIME, motion(2), T, floor=3e-6).noise_sd == 3e-6


def stick_slip(velocity: float) -> np.ndarray:
    """A capsule that slips during a fifth of every period and sticks otherwise."""
    cycles = TIME / T
    slip = np.clip((cycles % 1.0) / 0.2, 0.0, 1.0)
    return velocity * T * (np.floor(cycles) + 0.5 - 0.5 * np.cos(np.pi * slip))


@pytest.mark.full
def test_mean_velocity_and_its_standard_error() -> None:
    velocity = 0.6e-3
    found = [fit_mean_velocity(TIME, stick_slip(velocity) + noise(seed, 5e-6), T, 1) for seed in range(200)]
    pulls = np.array([(p.velocity - velocity) / p.velocity_sd for p in found])
    # 200 replicates: standard errors 0.07 and 0.05; steps are no sum of harmonics, hence a wider bound for the mean
    assert abs(pulls.mean()) < 0.35
    assert np.std(pulls) == pytest.approx(1.0, abs=0.17)
    # negative control: a straight line alone treats the steps as noise and states too large an error
    line_sd = np.std(stick_slip(velocity) - velocity * TIME) / np.sqrt(len(TIME)) / np.std(TIME)
    assert np.mean([p.velocity_sd for p in found]) < 0.6 * line_sd


@pytest.mark.parametrize(
    ("advance", "noise_sd", "direction"),
    [
        (5e-6, 5e-6, "F"),
        pytest.param(-5e-6, 5e-6, "B", marks=pytest.mark.full),
        (0.0, 5e-6, "S"),
        (STANDING, 5e-6, None),
        pytest.param(2e-7, 1e-4, None, marks=pytest.mark.full),
    ],
)
def test_direction(advance: float, noise_sd: float, direction: str | None) -> None:
    found = [fit_mean_velocity(TIME, stick_slip(advance / T) + noise(seed, noise_sd), T, 1) for seed in range(30)]
    decided = [p.direction for p in found]
    assert decided.count(direction) >= 27  # 99 % intervals
    assert all("direction" in p.reason for p in found if p.direction is None)


def test_without_a_period_the_advances_scatter() -> None:
    rng = np.random.default_rng(5)
    ends = np.concatenate([[0.0], np.cumsum(1e-5 + 2e-5 * rng.standard_normal(40))])
    wander = np.interp(TIME / 0.1, np.arange(41.0), ends)  # straight from period to period, corners on the samples
    found = fit_mean_velocity(TIME, wander, 0.1, None)
    assert found.velocity == pytest.approx(ends[19] / 1.9, rel=1e-9)
    assert found.velocity_sd == pytest.approx(np.std(np.diff(ends[:20]), ddof=1) / np.sqrt(19.0) / 0.1, rel=1e-9)
    one = fit_mean_velocity(TIME[:150], wander[:150], 0.1, None)
    assert one.direction is None


def test_folded_polynomials_are_exact_on_cubics_and_state_their_noise() -> None:
    rng = np.random.default_rng(6)
    phase = rng.uniform(0.0, 0.1, 4000)
    places = np.array([0.02, 0.05, 0.08])

    def cubic(t: np.ndarray) -> np.ndarray:
        return 1.0 - 20.0 * t + 300.0 * t**2 + 4e3 * t**3

    found, sd = local_polynomials(phase, cubic(phase), 0.1, places, 2e-3, 3)
    np.testing.assert_allclose(found[0], cubic(places), rtol=1e-9)
    np.testing.assert_allclose(found[1], -20.0 + 600.0 * places + 1.2e4 * places**2, rtol=1e-6)
    drawn = [local_polynomials(phase, rng.standard_normal(4000), 0.1, places, 2e-3, 3)[0] for _ in range(400)]
    np.testing.assert_allclose(np.std(drawn, axis=0), sd, rtol=0.15)


def test_folding_goes_round() -> None:
    phase = np.linspace(0.0, 1.0, 200, endpoint=False)
    wave = np.cos(2.0 * np.pi * phase)
    found, _ = local_polynomials(phase, wave, 1.0, np.array([0.0, 0.999]), 0.05, 3)
    np.testing.assert_allclose(found[0], [1.0, np.cos(2.0 * np.pi * 0.999)], atol=1e-3)
    mean, sd = local_polynomials(phase, wave, 1.0, np.array([0.5]), 0.02, 0)
    assert sd[0, 0] == pytest.approx(8.0**-0.5)
    assert mean.shape == (1, 1)  # a value without a rate


@pytest.mark.parametrize(
    ("z", "stretches"),
    [
        ([0, 0, 0, 0, 0, 0], []),
        ([0, 9, 9, 0, 9, 0], [(1, 2), (4, 1)]),
        ([9, 0, 0, 0, 9, 9], [(4, 3)]),  # one stretch through the end
        ([0, 9, 3, 9, 0, 0], [(1, 3)]),  # the dip stays above the lower level
        ([0, 3, 9, 3, 0, 3], [(2, 2)]),  # begins above the higher level, ends below the lower
        ([9, 9, 3, 9, 9, 9], [(0, 6)]),
        ([3, 3, 3, 3, 3, 3], []),
    ],
)
def test_stretches_between_two_levels(z: list[float], stretches: list[tuple[int, int]]) -> None:
    assert intervals_above(np.array(z, float), 2.0, 5.0) == stretches


def test_a_record_coarser_than_the_drive_is_undecided() -> None:
    time = np.arange(14) * 0.15
    found = find_period(time, np.cos(34.56 * time), 2.0 * np.pi / 34.56)
    assert found.period is None
    assert found.reason
