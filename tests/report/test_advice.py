"""What would improve a result: the input that decides an sd is named."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.inference.result import STATED, Result
from capsule_id.report.html import next_steps
from capsule_id.views import SYMPTOMS, Finding
from tests.cli_tools import DATA
from tests.experiments.bench import M1, released
from tests.measured.folders import Entry, make_rig, quantity

RECORDS = [f"free_vibration_{i}" for i in (1, 2, 3)]


@pytest.fixture(scope="module")
def sourced(result: Result) -> Result:
    """The fake result with the tables of data/ and a weighing that causes 84 % of the variance of k1."""
    shares = {
        "k1": {f"{STATED}m1": 0.84, **dict.fromkeys(RECORDS, 0.16 / 3)},
        "c": {f"{STATED}m1": 0.25, **dict.fromkeys(RECORDS, 0.25)},
        "v_s": {"dynamic_friction": 0.87, "static_friction": 0.12, "prior of v_s": 0.01},
    }
    return replace(result, rig=cid.read_rig(DATA), point_fit=replace(result.point_fit, shares=shares))


def with_shares(result: Result, **shares: dict[str, float]) -> Result:
    return replace(result, point_fit=replace(result.point_fit, shares={**result.point_fit.shares, **shares}))


def test_a_weighing_that_decides_k1_is_named(sourced: Result) -> None:
    """1/sqrt(1 - 0.84) = 2.5."""
    steps = dict(next_steps(sourced))
    assert "The sd of k1 comes mainly from the stated sd of m1. With an exact m1" in steps["Weigh m1 more precisely"]
    assert "at least 2.5 times smaller" in steps["Weigh m1 more precisely"]


def test_a_precise_weighing_is_not_named(sourced: Result) -> None:
    """Negative control: with the same numbers, the records cause the sd."""
    other = with_shares(sourced, k1={f"{STATED}m1": 0.16, **dict.fromkeys(RECORDS, 0.28)})
    assert not [heading for heading, _ in next_steps(other) if heading.startswith("Weigh")]


def test_the_tests_that_decide_the_widest_parameter_are_named(sourced: Result) -> None:
    """Four times as many pushes leave 1 - 3/4 0.87 of the variance of v_s, and four times as many records 1/4 of c."""
    text = dict(next_steps(sourced))["Narrow v_s"]
    assert "v_s has the largest relative sd, 11 %, mainly from dynamic_friction" in text
    assert "With four times as many such rows (now 5) it would be at least 1.7 times smaller" in text
    summary = sourced.summary.copy()
    summary.loc[["mu", "v_s"], "trust"] = "not trusted"
    # A parameter that a check contradicts is to be corrected first: advice on its sd would mislead.
    steps = dict(next_steps(with_shares(replace(sourced, summary=summary), c=dict.fromkeys(RECORDS, 1 / 3))))
    assert "Narrow v_s" not in steps
    assert (
        f"mainly from {', '.join(RECORDS)}. With four times as many such records it would be at least 2 "
        in steps["Narrow c"]
    )


def test_nothing_is_advised_where_the_inputs_are_unknown(result: Result) -> None:
    assert not [heading for heading, _ in next_steps(result) if heading.startswith(("Weigh", "Measure", "Narrow"))]


def test_a_factor_of_a_hundred_is_written_out(sourced: Result) -> None:
    """Before: "at least 1e+02 times smaller"."""
    shares = with_shares(sourced, k1={f"{STATED}m1": 0.99999})
    assert "at least 100 times smaller" in dict(next_steps(shares))["Weigh m1 more precisely"]


def spikes(x: np.ndarray) -> np.ndarray:
    x[[450, 713, 818, 872]] += 0.6
    return x


def clipped(x: np.ndarray) -> np.ndarray:
    return np.clip(x, -1.3, 1.3)


def lost(x: np.ndarray) -> np.ndarray:
    return np.delete(x, slice(300, 340))


def frozen(x: np.ndarray) -> np.ndarray:
    x[500:540] = x[500]
    return x


def second_mode(x: np.ndarray) -> np.ndarray:
    t = np.arange(len(x)) / 2000.0
    return x + 0.3 * np.exp(-3.0 * t) * np.cos(2.0 * np.pi * 47.0 * t)


def warming(x: np.ndarray) -> np.ndarray:
    """k1 falls by 8 % within the record."""
    t = np.arange(len(x)) / 2000.0
    noise = x - 2e3 * released(t, 1e-3, c=1.5)
    return noise + 2.0 * np.exp(-1.5 / (2.0 * M1) * t) * np.cos(np.sqrt(1420.0 / M1) * (t - 0.025 * t**2))


Fault = Callable[[np.ndarray], np.ndarray]
FAULTS: dict[Fault, str] = {
    spikes: "readings.spike",
    clipped: "readings.clipped",
    lost: "readings.jump",
    frozen: "readings.frozen",
    second_mode: "decays.tone",
    warming: "decays.changing",
}

TIERS: dict[Fault, Any] = {spikes: (), lost: pytest.mark.slow, frozen: pytest.mark.slow}


@pytest.mark.parametrize("fault", [pytest.param(fault, marks=TIERS.get(fault, pytest.mark.full)) for fault in FAULTS])
def test_the_cause_of_failed_checks_is_the_first_step(tmp_path: Path, fault: Fault) -> None:
    """The other failures of the record follow it in one sentence. Before: each had a step, and a remedy, of its own."""
    time = np.arange(1600) / 2000.0
    x = 2e3 * released(time, 1e-3, c=1.5) + 0.01 * np.random.default_rng(0).standard_normal(1600)
    read = np.round(fault(x), 5)
    entry = Entry("free_vibration", "d", {"time [s]": time[: len(read)], "x_rel [mm]": read})
    result = cid.fit(make_rig(tmp_path, entry, head={"m1": quantity(M1, "kg", 5e-5)}), budget=None)
    (first, *_) = [found for found in result.findings if found.cause]
    assert first.code == FAULTS[fault]
    failed = {found.code for found in result.findings if found.level == "fail"}
    steps = [text for heading, text in next_steps(result) if heading.startswith(("Correct", "Look"))]
    assert bool(failed & {*SYMPTOMS}) == (fault is not spikes)
    assert steps[0].startswith("Probably the cause of further failed checks (") == (fault is not spikes)
    assert result.text(first) in steps[0]
    assert not [text for text in steps[1:] if "white" in text or "like random noise" in text]


def test_a_bend_explains_the_rows_at_its_ends(tmp_path: Path) -> None:
    """Before: the first step was to remove the rows that stand off a straight line."""
    x = np.linspace(1.0, 8.0, 12)
    words = {"spring": '"a"', "force_sd": quantity(0.02, "N"), "deflection_sd": quantity(0.002, "mm")}
    entry = Entry("support_spring", "s", {"deflection [mm]": x, "force [N]": 5.0 * x + 0.3 * x**2}, words)
    result = cid.fit(make_rig(tmp_path, entry, head={"m1": quantity(M1, "kg", 5e-5)}), budget=None)
    assert result.failed[0] == "linearity"
    assert "outliers" in result.failed
    (first, *_) = [text for heading, text in next_steps(result) if heading.startswith("Correct")]
    assert "expected a straight line" in first
    assert "outliers" in first.partition(")")[0]


def test_a_cause_explains_its_own_experiment_alone(result: Result) -> None:
    """Negative control; a finding about a parameter belongs to the experiments that inform it."""
    spike = Finding(
        "lines.rise", "fail", {"name": "K", "slope": -1.0, "unit": "N/A", "x": "i", "y": "F"}, "motor_current"
    )
    white = Finding("starts.agree", "fail", {}, "free_vibration_1")
    forces = Finding("model.error", "fail", {"factors": [("c", 40.0, 6)]}, parameters=("c",))
    shares = {"c": {"free_vibration_1": 0.9, "motor_current": 0.01}}
    known = replace(result, rig=cid.read_rig(DATA), point_fit=replace(result.point_fit, shares=shares))
    two = replace(known, findings=(replace(spike, experiment="free_vibration_1"), forces))
    two = with_shares(two, c={"free_vibration_1": 0.5, "free_vibration_2": 0.5})
    assert "Correct c" in dict(next_steps(two))
    for place, headings in (
        ("motor_current", ["Correct experiment motor_current", "Correct experiment free_vibration_1", "Correct c"]),
        ("free_vibration_1", ["Correct experiment free_vibration_1"]),
    ):
        found = replace(known, findings=(replace(spike, experiment=place), white, forces))
        assert [heading for heading, _ in next_steps(found) if heading.startswith("Correct")] == headings
