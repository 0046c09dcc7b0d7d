"""Calibration in the small: do 95 % intervals cover 95 %, is z standard normal, and do clean rigs come out clean?

All numbers of a rig share its masses and its friction curve, so bounds count rigs, not numbers.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from capsule_id.inference import sampling
from tests.inference.calibration import Outcome, study, summarise


@pytest.mark.full
@pytest.mark.parametrize("rigs", [2, pytest.param(10, marks=pytest.mark.slow)])
def test_a_few_rigs(rigs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small version of the next test at a fixed seed: ten numbers of each rig.

    Walkers start near the posterior, so a quarter of the burn-in serves intervals of so few rigs.
    """
    monkeypatch.setattr(sampling, "BURN_IN_IN_TAU", 5.0)
    outcomes = list(study(tmp_path, range(rigs), budget=400))
    found = summarise(outcomes)
    print(found.describe())
    n = found.numbers
    assert n == 10 * rigs
    # Two-sided 99.9 % of a binomial, of chi and of a mean.
    low, high = stats.binom.ppf([0.0005, 0.9995], n, 0.95) / n
    assert low <= found.coverage <= high
    low, high = np.sqrt(stats.chi2.ppf([0.0005, 0.9995], n) / n)
    assert low < found.sd < high
    assert abs(found.mean) < stats.norm.ppf(0.9995) / np.sqrt(n)
    # The budget is short: chains may be found wanting, which fails no check.
    assert [check for outcome in outcomes for check, _ in outcome.failed] == []


@pytest.mark.slow
def test_hundred_rigs(tmp_path: Path) -> None:
    outcomes = list(study(tmp_path, range(1000, 1100)))
    found = summarise(outcomes)
    print(found.describe())
    assert 0.92 <= found.coverage <= 0.98
    assert 0.9 <= found.sd <= 1.1
    assert found.clean >= 0.95


@pytest.mark.parametrize(("shift", "scale"), [(0.0, 1.4), (0.0, 0.7), (0.6, 1.0)], ids=["narrow", "wide", "biased"])
def test_wrong_intervals_fail(shift: float, scale: float) -> None:
    """Negative control on perfect scores: intervals 30 % narrow or wide, or off by 0.6 sd, leave the bounds."""
    z = stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
    perfect = summarise([Outcome({str(i): float(v) for i, v in enumerate(z)}, ())])
    assert 0.92 <= perfect.coverage <= 0.98
    assert perfect.sd == pytest.approx(1.0, abs=0.01)
    wrong = summarise([Outcome({str(i): float(shift + scale * v) for i, v in enumerate(z)}, ())])
    assert not (0.92 <= wrong.coverage <= 0.98 and 0.9 <= wrong.sd <= 1.1)
