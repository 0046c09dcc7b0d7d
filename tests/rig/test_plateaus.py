"""Readings of a time trace of steps, and outliers that a stated rule drops."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import capsule_id
from capsule_id import cli
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.inference.pipeline import provenance
from capsule_id.rig.filters import hampel_outliers
from capsule_id.rig.model import Rig
from capsule_id.rig.plateaus import MOST_BLOCKS, find_steps
from tests.measured.sources import load_cells, measured_file

LEVELS = [0.0, 10.0, 20.0, 30.0, 40.0, 30.0, 20.0, 10.0, 0.0]
#: Counts per lbf, offset, and noise of a sample, counts.
SENSITIVITY, OFFSET, NOISE = 1000.0, 5800.0, 60.0
LBF = 4.4482216152605
COLUMNS = 'columns = { time = { from = 1, unit = "ms" }, reading = { from = 2, unit = "1" } }'
PLATEAUS = f'plateaus = {{ levels = {LEVELS}, unit = "lbf", guard = "2 s" }}'
REJECT = 'reject = { rule = "hampel", window = "1 s", n_sd = 8 }'


def trace(seed: int, drop_outs: int = 4) -> tuple[str, np.ndarray]:
    """A calibration at 10 Hz with slow steps, noise, and drop-outs of the converter; and the rows of the drop-outs."""
    rng = np.random.default_rng(seed)
    time = np.arange(1300) * 0.1
    steps = np.sort(rng.uniform(0.0, 3.0, 8) + 14.0 * np.arange(1, 9))
    level = np.interp(time, np.repeat(steps, 2) + np.tile([-0.8, 0.8], 8), np.repeat(LEVELS, 2)[1:-1])
    reading = np.round(OFFSET + SENSITIVITY * level + NOISE * rng.standard_normal(len(time)))
    lost = np.sort(rng.choice(np.arange(20, 1280, 9), drop_outs, replace=False))
    reading[lost] = -8388608.0
    return "".join(f"{1e3 * t:.0f},{value:.0f}\n" for t, value in zip(time, reading, strict=True)), lost


def rig_of(folder: Path, text: str, *lines: str) -> Rig:
    folder.mkdir(exist_ok=True)
    (folder / "cell.csv").write_text(text, encoding="utf-8")
    entry = '[rig]\nname = "cells"\n[[experiment]]\nkind = "transducer"\nfile = "cell.csv"\n' + "\n".join(lines) + "\n"
    (folder / "rig.toml").write_text(entry, encoding="utf-8")
    return capsule_id.read_rig(folder)


def slope(rig: Rig) -> tuple[float, float]:
    """Slope of the ordinary line and its standard error, readings per N."""
    (table,) = rig.tables
    (value, _), covariance = np.polyfit(table["force"], table["reading"], 1, cov=True)
    return float(value), float(np.sqrt(covariance[0, 0]))


def test_plateaus_give_the_sensitivity(tmp_path: Path) -> None:
    text, lost = trace(1)
    rig = rig_of(tmp_path, text, COLUMNS, PLATEAUS, REJECT)
    (table,) = rig.tables
    assert len(table.rows) == len(LEVELS)
    assert table.rejected >= len(lost)
    np.testing.assert_allclose(table["force"], np.array(LEVELS) * LBF)
    np.testing.assert_allclose(table["reading"], OFFSET + SENSITIVITY * np.array(LEVELS), atol=5 * NOISE / np.sqrt(90))
    value, sd = slope(rig)
    assert abs(value - SENSITIVITY / LBF) < 4 * sd
    assert sd < 1e-3 * value
    assert provenance(rig, 0, "all", "").rejected == {"cell": table.rejected}


def test_without_the_rule_nothing_is_dropped_and_the_drop_outs_show(tmp_path: Path) -> None:
    """Negative control."""
    text, _ = trace(1)
    with pytest.raises(InputError, match=r"a plateau must have 3 samples|the readings must follow the levels"):
        rig_of(tmp_path, text, COLUMNS, PLATEAUS)


@pytest.mark.parametrize("block", [1, 3])
def test_steps_are_found_at_their_samples(block: int) -> None:
    rng = np.random.default_rng(2)
    edges = np.array([0, 40, 100, 130, 200]) * block * (MOST_BLOCKS // 200)
    trace = np.repeat([0.0, 3.0, -1.0, 2.0], np.diff(edges)) + 0.1 * rng.standard_normal(edges[-1])
    found, size = find_steps(trace[:, None], 4)
    assert size == block
    assert np.max(np.abs(found - edges)) < size


def test_remedies_of_plateaus_work(tmp_path: Path) -> None:
    text, _ = trace(3, drop_outs=0)
    for wrong, rule, right in (
        ("guard = ‸2", "guard must be a string", 'guard = "2 s"'),
        ('guard = ‸"2 m"', "unit must have the dimension of s", 'guard = "2 s"'),
        ('guard = ‸"9 s"', "a plateau must have 3 samples", 'guard = "2 s"'),
    ):
        lines = PLATEAUS.replace('guard = "2 s"', wrong.replace("‸", ""))
        with pytest.raises(InputError, match=rule):
            rig_of(tmp_path, text, COLUMNS, lines)
        rig_of(tmp_path, text, COLUMNS, lines.replace(wrong.replace("‸", ""), right))
    with pytest.raises(InputError, match="plateaus of transducer need a map of time") as caught:
        rig_of(tmp_path, text, COLUMNS.replace("time", "force").replace('"ms"', '"N"'), PLATEAUS)
    assert "map time and" in caught.value.remedy
    for wrong in ('"0 to 40"', f"[0, 1{400 * '0'}]"):
        with pytest.raises(InputError, match="levels must be a list of numbers"):
            rig_of(tmp_path, text, COLUMNS, re.sub(r"\[.*\]", wrong, PLATEAUS))


@pytest.mark.parametrize("levels", [[0.0, 10.0, 20.0, 30.0, 40.0, 25.0, 15.0, 5.0, 0.0], [0.0, 5.0, 15.0, 40.0]])
def test_levels_in_reverse_order_are_named(tmp_path: Path, levels: list[float]) -> None:
    time = np.arange(100 * len(levels)) * 0.1
    noise = NOISE * np.random.default_rng(6).standard_normal(len(time))
    reading = np.round(OFFSET + SENSITIVITY * np.repeat(levels, 100) + noise)
    text = "".join(f"{1e3 * t:.0f},{value:.0f}\n" for t, value in zip(time, reading, strict=True))
    stated = f'plateaus = {{ levels = {levels[::-1]}, unit = "lbf", guard = "2 s" }}'
    with pytest.raises(InputError, match=r"rig\.toml:7:\d+: the levels must stand in the order of time") as caught:
        rig_of(tmp_path, text, COLUMNS, stated)
    assert "reverse the levels" in caught.value.remedy
    right = rig_of(tmp_path, text, COLUMNS, stated.replace(str(levels[::-1]), str(levels)))
    assert slope(right)[0] == pytest.approx(SENSITIVITY / LBF, rel=1e-2)
    # A sensor of the other sign.
    mirrored = "".join(f"{1e3 * t:.0f},{-value:.0f}\n" for t, value in zip(time, reading, strict=True))
    forward = stated.replace(str(levels[::-1]), str(levels))
    turned = rig_of(tmp_path, mirrored, COLUMNS.replace('unit = "1"', 'unit = "1", scale = -1'), forward)
    assert slope(turned)[0] == pytest.approx(SENSITIVITY / LBF, rel=1e-2)


def test_outliers_of_a_record_are_dropped_by_the_rule_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time = np.arange(400) * 1e-3
    x = np.round(3.0 * np.exp(-4.0 * time) * np.cos(60.0 * time), 3)
    x[[57, 203]] += 9.0
    text = "time [s],x_rel [mm]\n" + "".join(f"{t:.3f},{value:.3f}\n" for t, value in zip(time, x, strict=True))
    (tmp_path / "d.csv").write_text(text, encoding="utf-8")
    head = '[rig]\nname = "d"\nm1 = { value = 0.1, sd = 0.001, unit = "kg" }\n'
    head += '[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n'
    for rule, rows in (("", 400), ('reject = { rule = "hampel", window = "20 ms", n_sd = 5 }\n', 398)):
        (tmp_path / "rig.toml").write_text(head + rule, encoding="utf-8")
        (table,) = capsule_id.read_rig(tmp_path).tables
        assert (len(table.rows), table.rejected) == (rows, 400 - rows)
    np.testing.assert_array_equal(table.rows, np.delete(np.arange(2, 402), [57, 203]))
    assert cli.capsule_id(["check", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "2 rows with an outlier not used" in out
    assert "the rule reject drops 2 rows as outliers, the fit uses 398" in out
    for wrong, part in (
        ('{ rule = "hampel", window = "20 ms" }', "must have a n_sd"),
        ('{ rule = "grubbs", window = "20 ms", n_sd = 5 }', 'rule must be "hampel"'),
        ('{ rule = "hampel", window = "20 ms", n_sd = 0 }', "n_sd must be a number, 1 or more"),
        (f'{{ rule = "hampel", window = "20 ms", n_sd = 1{400 * "0"} }}', "n_sd must be a number, 1 or more"),
    ):
        (tmp_path / "rig.toml").write_text(f"{head}reject = {wrong}\n", encoding="utf-8")
        with pytest.raises(InputError, match=part):
            capsule_id.read_rig(tmp_path)


def test_the_rule_drops_few_samples_of_noise() -> None:
    """The median distance in 21 samples varies, so five sds drop 1 in 1000 of white noise; two sds drop several percent."""
    noise = np.random.default_rng(4).standard_normal(50_000)
    assert np.mean(hampel_outliers(noise, 21, 5.0)) < 2e-3
    assert 0.02 < np.mean(hampel_outliers(noise, 21, 2.0)) < 0.1


def test_reject_needs_times(tmp_path: Path) -> None:
    text = "reading [1],force [N]\n1,2\n3,4\n5,6\n"
    with pytest.raises(InputError, match="reject needs a record with times") as caught:
        rig_of(tmp_path, text, REJECT)
    assert "remove reject" in caught.value.remedy
    rig_of(tmp_path, text)


def test_a_transducer_is_fitted(tmp_path: Path) -> None:
    text, _ = trace(5)
    rig_of(tmp_path, text, COLUMNS, PLATEAUS, REJECT)
    out = tmp_path / "out"
    assert cli.fit_params([str(tmp_path), "--no-sample", "--quiet", "--out", str(out)]) == 0
    found = json.loads((out / "parameters.json").read_text(encoding="utf-8"))
    row = found["parameters"]["sensitivity[cell]"]
    assert row["unit"] == "1/N"
    assert abs(row["value"] - SENSITIVITY / LBF) < 4 * row["sd"] < 1e-2 * row["value"]
    assert "transducer" in default_registry()


@pytest.mark.parametrize(("cell", "expected"), [(0, 997.1), (1, 1003.7)])
def test_measured_load_cells(tmp_path: Path, cell: int, expected: float) -> None:
    """The authors' file as it is, weights in lbf, drop-outs included; expected: a fit of hand-cut plateaus, counts/lbf."""
    text = measured_file("loadcell_cie324/LoadCellCalibrationData.txt").read_text(encoding="utf-8")
    rig = rig_of(tmp_path, text, COLUMNS.replace("from = 2", f"from = {11 + cell}"), PLATEAUS, REJECT)
    assert rig.tables[0].rejected >= np.sum(load_cells()[1][:, cell] < -8e6) > 0
    value, _ = slope(rig)
    assert abs(value * LBF - expected) < 1.0


@pytest.mark.parametrize("levels", [[0.0, 10.0, 20.0, 30.0], [0.0, 10.0]])
def test_fewer_levels_than_plateaus_are_refused(tmp_path: Path, levels: list[float]) -> None:
    """Eight plateaus with half as many levels, or a quarter: the slope would be wrong by a factor."""
    rng = np.random.default_rng(2)
    reading = np.repeat(np.arange(8.0), 60) * 1000.0 + rng.normal(0.0, 20.0, 480)
    text = "".join(f"{100 * k},{value:.0f}\n" for k, value in enumerate(reading))
    every = [10.0 * k for k in range(8)]
    assert len(rig_of(tmp_path, text, COLUMNS, PLATEAUS.replace(str(LEVELS), str(every))).tables[0].rows) == 8
    with pytest.raises(InputError, match="must be constant on each plateau"):
        rig_of(tmp_path, text, COLUMNS, PLATEAUS.replace(str(LEVELS), str(levels)))


@pytest.mark.parametrize("window", ["1e9 s", "1 us", "-5 ms"])
def test_a_window_that_no_record_has_is_refused(tmp_path: Path, window: str) -> None:
    text, _ = trace(1)
    with pytest.raises(InputError, match=r"window must (hold two sampling steps|be greater than 0)"):
        rig_of(tmp_path, text, COLUMNS, PLATEAUS, REJECT.replace("1 s", window))
