"""What would improve a result: the input that decides an sd is named."""

from dataclasses import replace

import pytest

import capsule_id as cid
from capsule_id.inference.result import STATED, Result
from capsule_id.report.html import next_steps
from tests.cli_tools import DATA

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
