"""Repeated blocks in a record of an encoder whose levels are unevenly spaced."""

import numpy as np
import pytest

from capsule_id.records import duplicates
from capsule_id.records.duplicates import Readings, repeated_blocks

#: Spacing of the levels of one grid, and the shift of the other one.
SPACING, SHIFT = 4.36e-4, 3.14e-5


def swing() -> np.ndarray:
    """A slow free decay at 1 kHz, read on two grids, with noise of 0.4 spacings."""
    rng, t = np.random.default_rng(0), np.arange(20_000) * 1e-3
    x = 0.05 * np.exp(-0.2 * t) * np.cos(2.0 * np.pi * t) + 0.4 * SPACING * rng.standard_normal(len(t))
    grids = np.stack([np.round(x / SPACING) * SPACING, np.round((x - SHIFT) / SPACING) * SPACING + SHIFT])
    return np.take_along_axis(grids, rng.integers(0, 2, (1, len(t))), axis=0)[0]


def test_chance_is_no_repetition_and_a_copy_is(monkeypatch: pytest.MonkeyPatch) -> None:
    x = swing()
    assert repeated_blocks([Readings("swing", x[:, None], record=True)]) == []
    copied = np.concatenate([x[:3000], x[500:1500], x[3000:]])
    (found,) = repeated_blocks([Readings("swing", copied[:, None], record=True)])
    assert (found.row, found.first_row, found.count) == (3000, 500, 1000)
    # Negative control: the smallest gap between levels counts as the reading step.
    monkeypatch.setattr(duplicates, "_uneven_spacing", lambda *_: 0.0)
    assert repeated_blocks([Readings("swing", x[:, None], record=True)]) != []


@pytest.mark.parametrize("motion", ["spike", "pushes", "square", "impacts", "decay"])
def test_copies_are_found_in_coarse_records_with_jumps(motion: str) -> None:
    """Readings in even steps of a noise level, or somewhat more; a jump of the motion leaves levels without readings."""
    rng, t = np.random.default_rng(1), np.arange(4000) / 500.0
    noise = 0.6 if motion == "decay" else 1.0
    decay = 0.1 * np.exp(-0.3 * t) * np.cos(8.0 * t)
    x = {
        "spike": decay + 0.3 * (np.arange(4000) == 2000),
        "pushes": 0.2 * np.floor(t / 2.0),
        "square": 0.1 * np.sign(np.sin(3.0 * t)),
        "impacts": 0.5 * (rng.uniform(size=4000) < 0.002),
        "decay": decay,
    }[motion]
    x = np.round((x + 1e-3 * noise * rng.standard_normal(4000)) / 1e-3) * 1e-3
    copied = np.concatenate([x[:3000], x[500:1000], x[3000:]])
    (found,) = repeated_blocks([Readings(motion, copied[:, None], record=True)])
    assert found.row - found.first_row == 2500
    assert 500 <= found.count < 510  # a neighbour may agree by chance
