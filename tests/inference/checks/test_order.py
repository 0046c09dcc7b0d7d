"""Trials in order and repeated readings off the line are named; false alarms keep to their level."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.experiments.point_test import lack_of_fit
from capsule_id.experiments.statistics import ORDERED, permutation_p
from capsule_id.inference.checks.settings import (
    ORDER_LEVEL,
    POWER,
    added_effect,
    at_each_load,
    between,
    heterogeneity,
    lag_1,
)
from tests.measured.folders import Entry, make_rig, quantity


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


def test_orders_of_a_long_table_are_made_in_parts_and_are_the_same_orders() -> None:
    """Before: 10,000 orders at once, 16 GB for 100,000 pulls at loads of their own."""
    values, shapes = np.random.default_rng(2).standard_normal(20_000), list[tuple[int, ...]]()

    def statistic(orders: np.ndarray) -> np.ndarray:
        shapes.append(orders.shape)
        return np.sum(orders[..., :50], axis=-1)

    orders = np.random.default_rng(0).permuted(np.tile(values, (300, 1)), axis=1)
    whole = (1 + np.sum(np.sum(orders[:, :50], axis=1) >= np.sum(values[:50]))) / 301
    assert permutation_p(values, statistic, 300) == pytest.approx(whole)
    assert max(map(np.prod, shapes)) <= ORDERED < orders.size
    assert sum(shape[0] for shape in shapes if len(shape) == 2) == 300


def test_rows_at_each_load_keep_their_order() -> None:
    load, values = np.array([2.0, 5.0, 2.0, 1.0, 5.0]), np.arange(5.0)
    found = [own.tolist() for own in at_each_load(values, load)]
    assert found == [values[load == one].tolist() for one in np.unique(load)]


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


@pytest.mark.full
def test_false_alarms_and_the_factor_of_tables_that_differ() -> None:
    rng = np.random.default_rng(1)
    p = [between([rng.standard_normal(n) for n in (5, 4, 12)])[1] for _ in range(200)]
    assert np.mean(np.array(p) < 0.1) == pytest.approx(0.1, abs=0.07)
    # Correlation r = 4/5 of the trials of one table: an sd that counts them all is too small by sqrt(1 + 9 r).
    factors = [
        between([2.0 * rng.standard_normal() + rng.standard_normal(10) for _ in range(40)])[0] for _ in range(20)
    ]
    assert float(np.mean(factors)) == pytest.approx(np.sqrt(1.0 + 9.0 * 0.8), rel=0.1)
    # Few tables: mean squares 56 between and 4 within of three tables with three rows, r = 52/64; and with other sizes.
    few = [np.array([-2.0, 0.0, 2.0]) + shift for shift in (-np.sqrt(56.0 / 3.0), 0.0, np.sqrt(56.0 / 3.0))]
    assert between(few)[0] == pytest.approx(np.sqrt(1.0 + 2.0 * 52.0 / 64.0))
    one, other = np.array([1.0, 3.0]), np.array([-1.0, -2.0, 0.0, -1.0, -1.0, -1.0])
    mean_rows, within = 8.0 - (4.0 + 36.0) / 8.0, 4.0 / 6.0
    variance = (13.5 - within) / mean_rows
    expected = np.sqrt(1.0 + (mean_rows - 1.0) * variance / (variance + within))
    assert between([one, other])[0] == pytest.approx(expected)


def pulls(folder: Path, mu: tuple[float, ...]) -> Fit:
    """Pulls with 3 % scatter at three loads; the wide prior is that which the conflict of the priors proposes."""
    rng = np.random.default_rng(3)
    entries = [
        Entry(
            "static_friction",
            f"load_{load:g}",
            {"force [N]": load * one * (1.0 + (0.001 if load == 10.0 else 0.03) * rng.standard_normal(5))},
            {"normal_force": quantity(load, "N")},
        )
        for load, one in zip((5.0, 10.0, 50.0), mu, strict=False)
    ]
    make_rig(folder, *entries)
    toml = folder / "rig.toml"
    toml.write_text(toml.read_text() + '\n[prior]\npull_scatter = { scale = 0.16, unit = "1" }\n')
    return cid.fit(cid.read_rig(folder), budget=None)


@pytest.mark.full
def test_tables_of_one_surface_that_disagree_are_named(tmp_path: Path) -> None:
    """A friction that grows with the load (before: mu = 0.200 ± 0.012, trusted; by table 0.16, 0.18 and 0.25)."""
    result = pulls(tmp_path / "grows", (0.162, 0.177, 0.2525))
    (found,) = [f for f in result.findings if f.code == "trials.tables"]
    assert found.level == "fail"
    assert "fit each table in a folder of its own" in result.text(found)
    assert result.summary.at["mu", "trust"] == "not trusted"
    by_table = [value for _, value in found.facts["estimates"]]
    assert by_table == pytest.approx([0.162, 0.177, 0.2525], rel=0.05)
    # The remedy, and tables that agree.
    assert pulls(tmp_path / "alone", (0.162,)).clean
    agreeing = pulls(tmp_path / "agree", (0.2, 0.2, 0.2))
    assert [f.level for f in agreeing.findings if f.code == "trials.tables"] == ["ok"]
    assert agreeing.clean


def test_false_alarms_and_the_factor_of_slopes_that_differ() -> None:
    """Three lines of 10 readings each: the scatter between their slopes, each with its own estimated sd."""
    rng = np.random.default_rng(4)

    def found(spread: float) -> tuple[float, float]:
        value = rng.standard_normal(3) * np.hypot([0.5, 1.0, 2.0], spread)
        return heterogeneity(list(zip(value, [0.5, 1.0, 2.0] * np.sqrt(rng.chisquare(8, 3) / 8), strict=True)), [8] * 3)

    p = [found(0.0)[1] for _ in range(2000)]
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.02)
    assert np.mean(np.array(p) < 0.005) < 0.01
    apart = [found(10.0) for _ in range(300)]
    assert np.mean([one[1] < 0.005 for one in apart]) > 0.8
    assert heterogeneity([(1.0, 0.1), (2.0, 0.1)], [np.inf, np.inf])[0] == pytest.approx(1.0 / 0.1 / np.sqrt(2.0))


def lines_of(folder: Path, slopes: tuple[float, ...], words: Mapping[str, str]) -> Fit:
    """Tables of force against current, each of ten readings with a scatter of 0.02 N."""
    rng = np.random.default_rng(6)
    current = np.linspace(0.3, 3.0, 10)
    force = [K * current + 0.02 * rng.standard_normal(10) + 0.05 for K in slopes]
    entries = [
        Entry("motor_current", f"m{i}", {"force [N]": y, "current [A]": current}, words) for i, y in enumerate(force)
    ]
    return cid.fit(make_rig(folder, *entries), budget=None)


@pytest.mark.parametrize(
    "words",
    [{}, {"force_sd": quantity(0.02, "N"), "current_sd": quantity(0.001, "A")}],
    ids=["estimated errors", "stated errors"],
)
def test_calibrations_that_disagree_are_named_and_widened(tmp_path: Path, words: Mapping[str, str]) -> None:
    """Before: three motors were trusted with the sd of the readings; with stated errors "the line is not straight"."""
    result = lines_of(tmp_path / "apart", (2.0, 2.1, 2.05), words)
    (found,) = [f for f in result.findings if f.code == "trials.tables"]
    assert found.level == "fail"
    assert "by m0" in result.text(found)
    assert "by m2" in result.text(found)
    row = result.summary.loc["K"]
    assert row["sd"] > 0.5 * np.std([0.5, 1.0 / 2.1, 1.0 / 2.05]) / np.sqrt(3.0)
    # The remedy: each in a folder of its own; and motors that are alike agree.
    alike = lines_of(tmp_path / "alike", (2.05, 2.05, 2.05), words)
    assert [f.level for f in alike.findings if f.code == "trials.tables"] == ["ok"]
    alone = lines_of(tmp_path / "alone", (2.1,), words)
    assert alone.clean


def test_lines_of_two_rows_show_nothing_of_their_scatter(tmp_path: Path) -> None:
    """Before: "they disagree by a factor of 7.7", from a misfit of rounding size."""
    rng = np.random.default_rng(6)
    current = np.array([0.5, 2.5])
    entries = [
        Entry(
            "motor_current",
            f"m{i}",
            {"force [N]": 2.0 * current + 0.02 * rng.standard_normal(2), "current [A]": current},
        )
        for i in range(3)
    ]
    result = cid.fit(make_rig(tmp_path, *entries), budget=None)
    assert [f for f in result.findings if f.code == "trials.tables"] == []


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


@pytest.mark.full
@pytest.mark.parametrize("rows", [4, 8])
def test_the_error_that_a_check_of_loads_states_is_seen_in_8_of_10_cases(rows: int) -> None:
    """Pulls in proportion to loads from 1 to 4, and a constant force beside them, in units of the scatter."""
    rng, load = np.random.default_rng(rows), np.linspace(1.0, 4.0, rows)
    columns, effect = np.ones((rows, 1)), 1.0 / load
    _, (unseen,) = added_effect(rng.standard_normal(rows), columns, effect)
    force = unseen / (np.mean(effect) * np.sqrt(rows))

    def p(size: float) -> float:
        return added_effect(rng.standard_normal(rows) + size * effect, columns, effect)[0]

    assert np.mean([p(force) < ORDER_LEVEL for _ in range(400)]) == pytest.approx(POWER, abs=0.07)
    # Without the force, p is uniform.
    assert np.mean([p(0.0) < 0.1 for _ in range(400)]) == pytest.approx(0.1, abs=0.05)


def test_too_few_rows_see_no_error() -> None:
    p, unseen = added_effect(np.array([0.3, -0.3]), np.ones((2, 1)), np.array([1.0, 0.5]))
    assert (p, unseen[0]) == (1.0, np.inf)


@pytest.mark.parametrize(("loop", "level", "sign"), [(0.0, "ok", 1.0), (0.04, "warn", 1.0), (0.04, "warn", -1.0)])
def test_loading_and_unloading_are_compared(tmp_path: Path, loop: float, level: str, sign: float) -> None:
    """A spring loaded and unloaded: the finding names both branches, and k2 of both holds the truth within its sd.

    Before: those of a spring that is pulled, with negative readings, were not compared.
    """
    up, rng = np.linspace(0.1, 2.0, 12), np.random.default_rng(1)
    x = np.concatenate([up, up[::-1][1:]])
    y = 19.0 * x - np.where(np.arange(23) < 12, 0.0, loop * 76.0 * x * (1.0 - x / 2.0)) + 0.05 * rng.standard_normal(23)
    columns = {"deflection [mm]": sign * x, "force [N]": sign * y}
    entry = Entry("support_spring", "spring", columns, {"spring": '"a"'})
    result = cid.fit(make_rig(tmp_path / "loop", entry), budget=None)
    (found,) = [f for f in result.findings if f.code == "lines.branches"]
    assert found.level == level
    k2 = result["k2[a]"]
    assert abs(k2.value - 19e3) < 3.0 * k2.sd
    if loop:
        assert "hysteresis" in result.text(found)
        assert found.facts["rising"] == pytest.approx(19e3, rel=0.01)
        assert 0.01 < found.facts["share"] < 0.1
        assert k2.trust != "trusted"
