"""The table on standard output: aligned, narrow enough, loud where it must be."""

import numpy as np
import pytest

from capsule_id.inference.result import Result
from capsule_id.report.console_table import SYNTHETIC, WIDTH, table_text, verdict_text


def test_rows_in_order_and_aligned(result: Result) -> None:
    header, rule, *rows = table_text(result.summary, synthetic=False).splitlines()
    assert [row.split()[0] for row in rows] == list(result.summary.index)
    assert set(rule) == {"-"}
    # Right-aligned columns: the R-hat of every row ends under the end of its title.
    end = header.index("R-hat") + len("R-hat")
    assert {row[:end][-5:] for row in rows} == {"1.002"}


def test_row_holds_both_estimates_rounded_to_the_sd(result: Result) -> None:
    text = table_text(result.summary, synthetic=False)
    (row,) = [line for line in text.splitlines() if line.startswith("k1 ")]
    value = result.summary.at["k1", "value"]
    assert "1386.0" in row
    assert "1421.3 ± 3.0" in row
    assert f"{value:.1f} ± 3.1" in row
    assert row.index(f"{value:.1f} ± 3.1") < row.index("trusted") < row.index("1386.0")
    assert row.endswith("yes")


def test_uninformed_parameter_is_marked(result: Result) -> None:
    summary = result.summary.copy()
    summary.loc["K", "informed"] = False
    lines = table_text(summary, synthetic=False).splitlines()
    assert [line.split()[0] for line in lines if line.endswith("NO")] == ["K"]
    assert [line.split()[0] for line in lines if line.endswith("weighed")] == ["m1", "m2"]


@pytest.mark.parametrize("synthetic", [True, False])
def test_loud_line(result: Result, synthetic: bool) -> None:
    assert (SYNTHETIC in table_text(result.summary, synthetic=synthetic)) == synthetic


def test_the_verdict_is_one_line_with_the_word_and_the_failed_checks() -> None:
    assert verdict_text("trusted", []) == "verdict: trusted; no check failed"
    assert verdict_text("not trusted", ["linearity", "outliers"]) == "verdict: not trusted; failed: linearity, outliers"
    assert verdict_text("not judged", []).startswith("verdict: not judged; no check failed, but ")


def test_width_holds_for_long_names(result: Result) -> None:
    long = result.summary.rename(index={"k2[soft]": "k2[" + "x" * 80 + "]", "v_s": "ü" * 60})
    for frame in (result.summary, result.nuisances, long):
        lines = table_text(frame, synthetic=True).splitlines()
        assert max(map(len, lines)) <= WIDTH


def test_point_fit_only(unsampled: Result) -> None:
    text = table_text(unsampled.summary, synthetic=False)
    assert "MAP" not in text
    assert "1421.3 ± 3.0" in text
    assert text.count("not judged") == len(unsampled.summary)
    assert "nan" not in text


def test_exact_mass_has_no_plus_minus(result: Result) -> None:
    exact = result.summary.copy()
    exact.loc["m1", ["standard_error", "sd", "mean", "median", "lower", "upper", "ess", "rhat"]] = np.nan
    text = table_text(exact, synthetic=False)
    (row,) = [line for line in text.splitlines() if line.startswith("m1 ")]
    assert "0.11" in row
    assert "±" not in row
