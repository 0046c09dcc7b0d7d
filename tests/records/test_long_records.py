"""Long records are looked at in pieces: the findings are those of the whole record."""

from collections.abc import Callable
from typing import cast

import numpy as np
import pytest

from capsule_id.records import duplicates, release
from capsule_id.records import tones as noise
from capsule_id.records.duplicates import Readings, reading_step, repeated_blocks
from capsule_id.records.faults import (
    Jump,
    clipped_samples,
    dropouts,
    find_gaps,
    frozen_samples,
    jump_or_noise,
    time_rounding,
)
from capsule_id.records.release import FreeDecay, find_free_decay
from capsule_id.rig import filters

PERIOD, SAMPLES = 40.0, 6000


@pytest.fixture(params=[331, 1000])
def short_pieces(request: pytest.FixtureRequest) -> Callable[[pytest.MonkeyPatch], None]:
    """Make pieces so short that the records of this file are long."""

    def shorten(patch: pytest.MonkeyPatch) -> None:
        for module in (filters, duplicates, release, noise):
            patch.setattr(module, "PIECE", request.param)

    return shorten


def record(seed: int) -> np.ndarray:
    """A decay with noise, read in steps of 1e-3."""
    t = np.arange(SAMPLES)
    x = 5.0 * np.exp(-t / 4000.0) * np.cos(2.0 * np.pi * t / PERIOD)
    return np.round(x + 0.01 * np.random.default_rng(seed).standard_normal(SAMPLES), 3)


def same(shorten: Callable[[pytest.MonkeyPatch], None], find: Callable[[], object]) -> object:
    """What ``find`` returns for the whole record; it returns the same in pieces."""
    whole = find()
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        np.testing.assert_equal(find(), whole)
    return whole


def test_drop_outs_frozen_and_clipped_samples(short_pieces: Callable[[pytest.MonkeyPatch], None]) -> None:
    x = record(1)
    places = np.array([13, 330, 331, 332, 661, 662, 999, 1000, 1999, 3333, 5990])
    x[places] = -20.0
    x[4000:4003] = -20.0
    found = same(short_pieces, lambda: dropouts(x))
    assert {*places.tolist(), 4000, 4001, 4002} <= set(np.asarray(found).tolist())
    np.testing.assert_array_equal(np.asarray(same(short_pieces, lambda: dropouts(record(2)))), [])
    y = record(3) + 1e-7 * np.arange(SAMPLES)
    y[990:1010] = y[990]
    np.testing.assert_array_equal(same(short_pieces, lambda: frozen_samples(y)), np.arange(990, 1010))
    z = np.clip(record(4), -3.0, 4.0)
    clipped = same(short_pieces, lambda: [(c.side, c.level, c.rows.tolist()) for c in clipped_samples(z, PERIOD)])
    assert [side for side, *_ in clipped] == ["upper", "lower"]  # type: ignore[union-attr]


def test_gaps_and_rounded_times(short_pieces: Callable[[pytest.MonkeyPatch], None]) -> None:
    time = np.delete(np.arange(SAMPLES) * 1e-3, [5, 331, 332, 700, 1000, 2000, 2001, 2002])
    gaps = same(short_pieces, lambda: (lambda g: (g.rows, g.lost, g.step))(find_gaps(time)))  # type: ignore[union-attr]
    np.testing.assert_array_equal(gaps[1], [1, 2, 1, 1, 3])  # type: ignore[index]
    assert same(short_pieces, lambda: find_gaps(np.arange(SAMPLES) * 1e-3)) is None
    rounded = np.round(np.arange(SAMPLES) * 1.37e-3, 3)
    assert same(short_pieces, lambda: time_rounding(rounded)) == pytest.approx(1e-3)


def test_repeated_blocks(short_pieces: Callable[[pytest.MonkeyPatch], None]) -> None:
    x = record(5)
    x[4000:4400] = x[650:1050]
    table = Readings("a", x[:, None], True)
    (found,) = same(short_pieces, lambda: repeated_blocks([table]))  # type: ignore[misc]
    assert (found.row, found.first_row, found.count) == (4000, 650, 400)
    assert same(short_pieces, lambda: repeated_blocks([Readings("a", record(6)[:, None], True)])) == []
    two = [Readings("a", np.stack([record(7), record(8)], axis=1), True)]
    two.append(Readings("b", two[0].values[1234:2345].copy(), True))
    (found,) = same(short_pieces, lambda: repeated_blocks(two))  # type: ignore[misc]
    assert (found.label, found.row, found.first_row, found.count) == ("b", 0, 1234, 1111)


@pytest.mark.full
def test_lost_samples_release_and_frequency(short_pieces: Callable[[pytest.MonkeyPatch], None]) -> None:
    x = np.delete(record(9), np.arange(1500, 1513))
    whole = cast(Jump, jump_or_noise(x, PERIOD))
    time = np.arange(SAMPLES) * 1e-3
    rest = np.concatenate([np.full(1200, 5.0), record(10)[: SAMPLES - 1200]])
    free = cast(FreeDecay, find_free_decay(time, rest))
    with pytest.MonkeyPatch.context() as patch:
        short_pieces(patch)
        found, decay = cast(Jump, jump_or_noise(x, PERIOD)), cast(FreeDecay, find_free_decay(time, rest))
        assert filters.dominant_frequency(time, record(10)) == pytest.approx(1e3 / PERIOD, rel=0.01)
        assert reading_step(record(10)) == pytest.approx(1e-3)
        assert noise.noise_level(record(10)) == pytest.approx(0.01, rel=0.1)
    assert abs(found.row - whole.row) <= 2
    assert decay.start == pytest.approx(free.start, abs=0.25e-3 * PERIOD)
    assert decay.rest == pytest.approx(free.rest, abs=0.25e-3 * PERIOD)
    assert decay.period == pytest.approx(free.period, rel=0.01)
