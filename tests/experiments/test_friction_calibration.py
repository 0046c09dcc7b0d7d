"""Friction tests under misfit: which word tables of a wrong law and of few rows get, and whether intervals cover."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tests.experiments.friction_calibration import MISFITS, outcome, tiny_outcome, tiny_study


def test_outcomes_of_one_twin_of_each_misfit() -> None:
    default, free, sessions = (outcome(misfit, 100) for misfit in MISFITS)
    assert (default.clean, free.clean, sessions.clean) == (False, True, False)
    assert np.max(np.abs(free.z)) < 4.0
    # The widened interval of the sessions covers the truth, by Student's quantile for up to eight parts; that of the
    # wrong law does not cover v_s.
    assert np.max(np.abs(sessions.z)) < stats.t.ppf(0.975, 7)
    assert np.max(np.abs(default.z)) > 4.0


@pytest.mark.full
@pytest.mark.parametrize(("rows", "seed"), [(4, 1), (5, 0)])
def test_few_pulls_with_a_constant_force_are_not_trusted(rows: int, seed: int) -> None:
    """Before: trusted, four sds or more off, because no check could see the force in so few rows."""
    found = tiny_outcome("pulls at loads", rows, 0.3, seed)
    assert not found.covers["mu"]
    assert found.trust["mu"] != "trusted"


@pytest.mark.full
@pytest.mark.parametrize(
    ("kind", "rows"), [("tilts", 3), ("slides", 3), ("pulls at loads", 8), ("slides at speeds", 8)]
)
def test_clean_tables_of_few_rows_are_trusted(kind: str, rows: int) -> None:
    """Negative control. Before: three tilts were not judged. One clean table of pulls in 20 is doubted, that of seed 0 too."""
    found = tiny_outcome(kind, rows, 0.0, 1)
    assert set(found.trust.values()) == {"trusted"}
    assert all(found.covers.values())


@pytest.mark.full
@pytest.mark.parametrize(("kind", "rows"), [("tilts", 1), ("pulls", 2), ("pulls at loads", 5)])
def test_the_sd_without_a_sample_is_that_of_the_sample(kind: str, rows: int) -> None:
    """Before: of one tilt 100 times too small, because the most probable scatter of one row is 0."""
    found = tiny_outcome(kind, rows, 0.0, 1)
    assert found.sd_of_point["mu"] == pytest.approx(found.sd["mu"], rel=0.1)


@pytest.mark.slow
def test_words_and_intervals_of_tables_of_few_rows(tmp_path: Path) -> None:
    """Two tables of each kind, number of rows and offset; 10 of each gave the shares in the report of the issue."""
    cover, clean_trusted = tiny_study(2, tmp_path / "tiny.jsonl")
    assert cover > 0.91
    # Of two tables one may be doubted by chance: of clean pulls at loads that of seed 0 is, one in 20.
    assert min(clean_trusted.values()) >= 0.5
    assert list(clean_trusted.values()).count(1.0) >= len(clean_trusted) - 1, clean_trusted
