"""Synthetic robots through the whole fit: do intervals hold the truth, and is a wrong law found by a first comparison?"""

from pathlib import Path

import numpy as np
import pytest

from capsule_id.inference import compare
from capsule_id.inference import joint_fit as joint_starts
from capsule_id.inference.joint_fit import joint_fit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from tests.inference.calibration import summarise
from tests.inference.robots import WRONG_LAWS, found_by_points, study

#: Of 25 settings, and of the small versions.
PERIODS, FEW = 1e-3 * np.arange(35.0, 160.0, 5.0), 1e-3 * np.arange(40.0, 150.0, 15.0)


@pytest.fixture
def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enough for the seeds of the small versions."""
    for name, value in (("CANDIDATES", 256), ("CONTENDERS", 2), ("FIRST_STEPS", 3)):
        monkeypatch.setattr(joint_starts, name, value)


@pytest.mark.slow
def test_twenty_robots(tmp_path: Path) -> None:
    """All numbers of a robot share its masses, so that the bounds are wider than those of independent numbers."""
    outcomes = list(study(tmp_path, range(20), PERIODS))
    found = summarise(outcomes)
    print(found.describe())
    assert 0.90 <= found.coverage <= 0.99
    assert max(abs(z) for outcome in outcomes for z in outcome.z.values()) <= 4.0


@pytest.mark.slow
@pytest.mark.usefixtures("few_starts")
def test_a_missing_lag_is_found_and_the_right_fit_is_near_the_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A small version of both studies: one robot, and no sample."""
    fits = list[tuple[LogPosterior, PointFit]]()

    def fitted(target: LogPosterior, known: dict[str, float], seed: int) -> PointFit:
        fits.append((target, joint_fit(target, known, seed)))
        return fits[-1][1]

    monkeypatch.setattr(compare, "joint_fit", fitted)
    choice, truth = found_by_points(tmp_path, "lag", 10, FEW)
    assert choice.recommended == "free lag"
    assert "Rejected: as stated" in choice.text
    target, fit = fits[-1]
    u = target.unconstrain(np.array([truth.get(name, fit.values[name]) for name in target.names]))
    z = ((fit.u - u) / np.sqrt(np.diag(fit.covariance)))[target.located]
    assert np.count_nonzero(z) == 9
    assert np.max(np.abs(z)) < 4.0, z


@pytest.mark.slow
@pytest.mark.parametrize("law", WRONG_LAWS)
def test_wrong_laws_are_found_by_points(law: str, tmp_path: Path) -> None:
    """In nine of ten robots."""
    recommended = [found_by_points(tmp_path, law, seed, PERIODS)[0].recommended for seed in range(10, 20)]
    print(law, recommended)
    assert recommended.count(WRONG_LAWS[law].right) >= 9
