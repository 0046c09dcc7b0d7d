"""Where a check fails, sds widen by the scatter between parts of the data; a clean fit keeps its sds."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.inference import tables
from capsule_id.inference.checks.verdict import beside_stated, widening
from capsule_id.inference.point_stage import Widening
from tests.experiments.bench import K1, M1, released
from tests.inference.checks.test_order import drifting
from tests.measured.folders import Entry, make_rig, quantity


def test_the_factor_is_that_of_birge_and_the_interval_that_of_student() -> None:
    value, sd = np.array([1.0, 2.0, 4.0, 3.0]), np.array([0.5, 0.25, 0.5, 1.0])
    found = widening(list(zip(value, sd, strict=True)))
    mean = np.sum(value / sd**2) / np.sum(sd**-2.0)
    assert found.factor == pytest.approx(np.sqrt(np.sum(((value - mean) / sd) ** 2) / 3.0))
    assert found.quantile == pytest.approx(3.182446 / 1.959964, rel=1e-6)
    assert widening([(1.0, 1.0)] * 4).factor == 1.0


def test_the_factor_is_near_1_without_model_error() -> None:
    rng = np.random.default_rng(0)
    factor = [
        widening([(2.0 + s * rng.standard_normal(), s) for s in (0.1, 0.2, 0.1, 0.3, 0.2)]).factor for _ in range(300)
    ]
    assert np.median(factor) == pytest.approx(max(1.0, np.sqrt(stats.chi2.median(4) / 4.0)), abs=0.05)
    assert np.max(factor) < 2.5


def test_the_share_of_a_stated_mass_is_not_widened() -> None:
    """k1 is 3 times the error of the readings from that of m1: by 1 and 9 parts in 10 of its variance."""
    covariance = np.array([[10.0, 3.0], [3.0, 1.0]])
    s: Any = SimpleNamespace(target=SimpleNamespace(names=("k1", "m1")), fit=SimpleNamespace(covariance=covariance))
    found = beside_stated(s, {"k1": Widening(5.0, 1.2, 6)})["k1"]
    assert found.factor**2 == pytest.approx(0.9 + 0.1 * 25.0)
    assert found.stretch**2 == pytest.approx(0.9 + 0.1 * 36.0)
    alone: Any = SimpleNamespace(target=SimpleNamespace(names=("k1", "c")), fit=s.fit)
    assert beside_stated(alone, {"k1": Widening(5.0, 1.2, 6)})["k1"].factor == pytest.approx(5.0)
    assert beside_stated(s, {"k1": Widening(1.01, 1.2, 6)}) == {}


def tilts(folder: Path, angle: np.ndarray, budget: int | None = None) -> Fit:
    return cid.fit(make_rig(folder, Entry("static_friction", "tilt", {"angle [deg]": angle})), budget=budget)


@pytest.mark.full
def test_trials_in_sessions_are_widened_and_not_trusted(tmp_path: Path) -> None:
    """Six sessions of five trials: the mean of a session is off by 1 degree, a trial by 0.2."""
    rng = np.random.default_rng(0)
    angle = 33.0 + np.repeat(rng.standard_normal(6), 5) + 0.2 * rng.standard_normal(30)
    result = tilts(tmp_path, angle, 2_000)
    mu = result.summary.loc["mu"]
    assert mu["trust"] == "not trusted"
    assert mu["sd"] == pytest.approx(mu["widening"] * mu["sd_unwidened"])
    # The six session means alone give this sd of mu; 30 independent trials would give half of it.
    honest = np.std(np.tan(np.deg2rad(angle.reshape(6, 5).mean(axis=1))), ddof=1) / np.sqrt(6.0)
    assert 0.8 * honest < mu["sd"] < 6.0 * honest
    assert mu["lower"] < mu["lower_unwidened"] < mu["value"] < mu["upper_unwidened"] < mu["upper"]
    (found,) = [f for f in result.findings if f.code == "model.error"]
    assert "parts)" in result.text(found)


@pytest.mark.parametrize(
    ("one", "lower", "upper", "sd"),
    [
        (Widening(1.0, 1.0, 0, (5.0, 11.0)), 5.0, 12.0, 6.0 / 3.92),
        (Widening(3.0, 1.0, 4, (5.0, 11.0)), 4.0, 16.0, 3.0),  # the parts say more than the limits
        (Widening(3.0, 1.0, 4, (1.0, 20.0)), 1.0, 20.0, 19.0 / 3.92),
        (Widening(3.0, 1.0, 4), 4.0, 16.0, 3.0),
    ],
)
def test_an_interval_holds_what_parts_and_what_limits_say(one: Widening, lower: float, upper: float, sd: float) -> None:
    """Before: a failed check of any record took the limits away, and the text still said that the interval holds them."""
    entry = {"value": 10.0, "sd": 1.0, "lower": 8.0, "upper": 12.0}
    found = tables._widened(entry, one, positive=False)
    assert (found["lower"], found["upper"], found["sd"]) == pytest.approx((lower, upper, sd), rel=1e-3)
    assert (found["lower_unwidened"], found["sd_unwidened"]) == (8.0, 1.0)
    # Without a sample there is an sd alone.
    alone = tables._widened({"value": 10.0, "sd": 1.0}, one, positive=False)
    assert alone.keys() == {"widening", "sd", "sd_unwidened"}
    assert alone["sd"] == pytest.approx(
        max(3.0 if one.parts else 1.0, np.ptp(one.limits) / 3.92 if one.limits else 0.0), rel=1e-3
    )


def test_a_clean_fit_is_not_widened(tmp_path: Path) -> None:
    result = tilts(tmp_path, 33.0 + np.random.default_rng(1).standard_normal(30))
    assert result.clean
    assert np.isnan(result.summary.at["mu", "sd_unwidened"])
    assert result.summary.at["mu", "sd"] == result.summary.at["mu", "standard_error"]


@pytest.mark.full
def test_coloured_noise_of_a_decay_widens_k1(tmp_path: Path) -> None:
    time = np.arange(1200) / 1000.0
    noise = drifting(np.random.default_rng(3), 1200, 0.95)
    columns = {"time [s]": time, "x_rel [mm]": 2.0 * 1e3 * released(time, 1e-3, c=0.3) + 0.02 * noise}
    # Stated words keep the model, so there is no second fit with coloured noise.
    words = {"damping": '"viscous"', "stiffness": '"linear"', "noise": '"white"', "drift": '"none"', "thin": "1"}
    rig = make_rig(tmp_path, Entry("free_vibration", "decay", columns, words), head={"m1": quantity(M1, "kg")})
    k1 = cid.fit(rig, budget=None).summary.loc["k1"]
    assert k1["trust"] == "not trusted"
    assert k1["widening"] > 1.0
    assert abs(k1["value"] - K1) < 4.0 * k1["sd"]


@pytest.mark.full
def test_records_that_contradict_each_other_widen_k1(tmp_path: Path) -> None:
    """The clock of one of three records is 2 % fast. Before: each record agreed with itself, and k1 was widened by 1.1."""
    time, rng = np.arange(800) / 2000.0, np.random.default_rng(1)
    words = {"damping": '"viscous"', "stiffness": '"linear"', "noise": '"white"', "drift": '"none"', "thin": "1"}
    entries = [
        Entry(
            "free_vibration",
            f"d{i}",
            {"time [s]": fast * time, "x_rel [mm]": 2e3 * released(time, 1e-3) + 0.01 * rng.standard_normal(800)},
            words,
        )
        for i, fast in enumerate((1.0, 1.0, 1.02))
    ]
    k1 = cid.fit(make_rig(tmp_path, *entries, head={"m1": quantity(M1, "kg")}), budget=None).summary.loc["k1"]
    assert k1["trust"] == "not trusted"
    assert k1["widening"] > 3.0
    assert abs(k1["value"] - K1) < 2.0 * k1["sd"]
    assert abs(k1["value"] - K1) > 3.0 * k1["sd_unwidened"]
