"""Trials in order and repeated readings off the line are named; false alarms keep to their level."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.experiments.families.line_replicates import lack_of_fit
from capsule_id.inference.checks.order import lag_1
from tests.measured.folders import Entry, make_rig


def drifting(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    """(n,) AR(1) deviations of unit sd."""
    e = rng.standard_normal(n)
    for i in range(1, n):
        e[i] = rho * e[i - 1] + np.sqrt(1.0 - rho**2) * e[i]
    return e


@pytest.mark.parametrize("n", [6, 30, 300])
def test_the_tail_probability_of_random_orders_is_uniform(n: int) -> None:
    rng = np.random.default_rng(n)
    p = np.array([lag_1(rng.standard_normal(n))[1] for _ in range(100)])
    assert np.mean(p < 0.1) == pytest.approx(0.1, abs=0.09)
    assert np.mean(p < 0.005) <= 0.02


def tilts(folder: Path, angle: np.ndarray) -> Fit:
    return cid.fit(make_rig(folder, Entry("static_friction", "tilt", {"angle [deg]": angle})), budget=None)


def test_trials_in_order_are_named_and_in_random_order_pass(tmp_path: Path) -> None:
    """Thirty tilts of a surface that wears in: lag-1 correlation 0.62."""
    angle = 33.0 + drifting(np.random.default_rng(9), 30, 0.8)
    assert lag_1(angle)[0] == pytest.approx(0.62, abs=0.01)
    result = tilts(tmp_path / "order", angle)
    (found,) = [f for f in result.findings if f.code == "trials.order"]
    assert (found.level, found.experiment) == ("fail", "tilt")
    assert "in random order" in result.text(found)
    assert result.summary.at["mu", "trust"] == "not trusted"
    shuffled = tilts(tmp_path / "shuffled", np.random.default_rng(0).permutation(angle))
    assert [f.level for f in shuffled.findings if f.code == "trials.order"] == ["ok"]


def levels(rng: np.random.Generator, deviation: float) -> tuple[np.ndarray, np.ndarray]:
    """Eight levels of four readings each, with a deviation of every level from the line, in sd of a reading."""
    x = np.repeat(np.arange(1.0, 9.0), 4)
    return x, 2.0 * x + 0.05 * (np.repeat(deviation * rng.standard_normal(8), 4) + rng.standard_normal(32))


def test_false_alarms_and_power_of_repeated_readings() -> None:
    rng = np.random.default_rng(0)

    def share(sample: Callable[[], tuple[np.ndarray, np.ndarray]], level: float) -> float:
        found = [lack_of_fit(*sample()) for _ in range(300)]
        return float(np.mean([pair is not None and pair[1] < level for pair in found]))

    assert share(lambda: levels(rng, 0.0), 0.1) == pytest.approx(0.1, abs=0.05)
    assert share(lambda: levels(rng, 2.0), 0.002) > 0.9


def test_readings_that_repeat_off_the_line_fail(tmp_path: Path) -> None:
    x, y = levels(np.random.default_rng(1), 3.0)
    columns = {"current [A]": x, "force [N]": y}
    result = cid.fit(make_rig(tmp_path / "off", Entry("motor_current", "motor", columns)), budget=None)
    (found,) = [f for f in result.findings if f.code == "lines.replicates"]
    assert (found.level, found.experiment) == ("fail", "motor")
    assert "Set current anew before each reading" in result.text(found)
    # Set anew, each reading has the deviation of its own level: the same scatter is now seen as scatter.
    anew, off = np.linspace(1.0, 8.0, 32), np.random.default_rng(2).permutation(y - 2.0 * x)
    again = {"current [A]": anew, "force [N]": 2.0 * anew + off}
    clean = cid.fit(make_rig(tmp_path / "anew", Entry("motor_current", "motor", again)), budget=None)
    assert clean.clean
