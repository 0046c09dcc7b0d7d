"""Calibration in the small: do 95 % intervals cover 95 %, is z standard normal, and do clean rigs come out clean?

All numbers of a rig share its masses and its friction curve, so bounds count rigs, not numbers.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from capsule_id.cli import capsule_id
from capsule_id.commands import calibrate
from capsule_id.inference import sampling
from tests.inference.calibration import Outcome, summarise


def study(folder: Path, rigs: int) -> tuple[pd.DataFrame, list[list[str]]]:
    """The table of ``capsule-id calibrate`` without the priors' density, and the failed checks of each rig."""
    assert capsule_id(["calibrate", str(folder), "--rigs", str(rigs), "--quiet"]) == 0
    lines = (folder / calibrate.RIGS).read_text().splitlines()[1:]
    table = pd.read_csv(folder / "calibration.csv", index_col="parameter").drop(calibrate.LOG_PRIOR)
    return table, [json.loads(line)["failed"] for line in lines]


@pytest.mark.full
@pytest.mark.parametrize("rigs", [2, pytest.param(10, marks=pytest.mark.slow)])
def test_a_few_rigs(rigs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small version of the next test at a fixed seed: twelve numbers of each rig.

    Walkers start near the posterior, so a quarter of the burn-in serves intervals of so few rigs.
    """
    monkeypatch.setattr(sampling, "BURN_IN_IN_TAU", 5.0)
    monkeypatch.setattr(calibrate, "DEFAULT_MAX_STEPS", 400)
    table, _ = study(tmp_path / "study", rigs)
    print(table)
    n = 12 * rigs
    assert table["rigs"].sum() == n
    # Two-sided 99.9 % of a binomial, of chi and of a mean.
    low, high = stats.binom.ppf([0.0005, 0.9995], n, 0.95) / n
    assert low <= table["inside 95 %"].mean() <= high
    low, high = np.sqrt(stats.chi2.ppf([0.0005, 0.9995], n) / n)
    assert low < np.sqrt(np.mean(table["sd z"] ** 2 + table["mean z"] ** 2)) < high
    assert abs(table["mean z"].mean()) < stats.norm.ppf(0.9995) / np.sqrt(n)


@pytest.mark.slow
def test_hundred_rigs(tmp_path: Path) -> None:
    table, failed = study(tmp_path / "study", 100)
    print(table)
    assert 0.92 <= table["inside 95 %"].mean() <= 0.98
    assert np.all(np.abs(table["sd z"] - 1.0) <= 0.25)
    assert np.mean([not codes for codes in failed]) >= 0.95


@pytest.mark.parametrize(("shift", "scale"), [(0.0, 1.4), (0.0, 0.7), (0.6, 1.0)], ids=["narrow", "wide", "biased"])
def test_wrong_intervals_fail(shift: float, scale: float) -> None:
    """Negative control on perfect scores: intervals 30 % narrow or wide, or off by 0.6 sd, leave the bounds."""
    z = stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
    perfect = summarise([Outcome({str(i): float(v) for i, v in enumerate(z)}, ())])
    assert 0.92 <= perfect.coverage <= 0.98
    assert perfect.sd == pytest.approx(1.0, abs=0.01)
    wrong = summarise([Outcome({str(i): float(shift + scale * v) for i, v in enumerate(z)}, ())])
    assert not (0.92 <= wrong.coverage <= 0.98 and 0.9 <= wrong.sd <= 1.1)
