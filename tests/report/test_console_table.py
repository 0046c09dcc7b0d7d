"""The table on standard output: aligned, narrow enough, loud where it must be."""

import math

import numpy as np
import pytest

from capsule_id.inference.result import Result
from capsule_id.report.columns import SYNTHETIC, WIDTH, table_rows, table_text, verdict_text


def test_rows_in_order_and_aligned(result: Result) -> None:
    header, rule, *rows = table_text(result.summary, synthetic=False, width=WIDTH).splitlines()
    assert [row.split()[0] for row in rows] == list(result.summary.index)
    assert set(rule) == {"-"}
    # Right-aligned columns: the R-hat of every row ends under the end of its title.
    end = header.index("R-hat") + len("R-hat")
    assert {row[:end][-5:] for row in rows} == {"1.002"}


def test_row_holds_both_estimates_rounded_to_the_sd(result: Result) -> None:
    text = table_text(result.summary, synthetic=False, width=WIDTH)
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
    lines = table_text(summary, synthetic=False, width=WIDTH).splitlines()
    assert [line.split()[0] for line in lines if line.endswith("NO")] == ["K"]
    assert [line.split()[0] for line in lines if line.endswith("weighed")] == ["m1", "m2"]


@pytest.mark.parametrize("synthetic", [True, False])
def test_loud_line(result: Result, synthetic: bool) -> None:
    assert (SYNTHETIC in table_text(result.summary, synthetic=synthetic)) == synthetic


def test_the_verdict_is_one_line_with_the_word_and_the_failed_checks() -> None:
    assert verdict_text("trusted", [("ok", "outliers")]) == "verdict: trusted; no check failed"
    warned = [("warn", "outliers")] * 8
    assert verdict_text("trusted", warned) == "verdict: trusted; no check failed; 8 warnings"
    failed = [("fail", "outliers"), ("fail", "linearity"), ("fail", "outliers")]
    assert verdict_text("not trusted", failed) == "verdict: not trusted; failed: outliers, linearity"
    said = verdict_text("not trusted", [*failed, *warned[:1]])
    assert said == "verdict: not trusted; failed: outliers, linearity; 1 warning"
    assert verdict_text("not judged", []).startswith("verdict: not judged; no check failed, but ")


@pytest.mark.parametrize("width", [200, 110, 80, 60])
def test_columns_give_way_to_the_width_of_the_terminal(result: Result, width: int) -> None:
    lines = table_text(result.summary, synthetic=False, width=width).splitlines()
    assert max(map(len, lines)) <= width
    left_out = " ".join(lines).partition("wider terminal")[2]
    for header in ("95 % interval", "paper", "R-hat", "informed"):
        assert (header in lines[0]) != (header in left_out)
    assert ("wider terminal" in " ".join(lines)) == (width < 110)


def test_names_are_never_cut(result: Result) -> None:
    spring = "k2[" + "x" * 80 + "]"
    text = table_text(result.summary.rename(index={"k2[soft]": spring}), synthetic=False, width=80)
    (row,) = [line for line in text.splitlines() if line.startswith(spring)]
    assert row.endswith("trusted")
    assert "…" not in text


def test_the_width_is_that_of_the_terminal(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    widest = {}
    for columns in ("60", "110"):
        monkeypatch.setenv("COLUMNS", columns)
        widest[columns] = max(map(len, table_text(result.summary, synthetic=False).splitlines()))
    assert widest["60"] <= 60 < widest["110"] <= WIDTH


def test_one_unit_for_all_rows_of_a_symbol(result: Result) -> None:
    """Gaps of 0.99926 mm and 1.50037 mm: before, the first was in µm and the second in m."""
    gaps = result.summary.loc[["k1", "k1"]].set_axis(["G[run_1]", "G[run_2]"])
    gaps = gaps.assign(unit="m", value=[9.9926e-4, 1.50037e-3], map=[9.9926e-4, 1.50037e-3], sd=5e-6)
    assert [row.unit for row in table_rows(gaps)] == ["mm", "mm"]
    assert [row.number("value") for row in table_rows(gaps)] == ["0.9993", "1.5004"]


@pytest.mark.parametrize(
    ("quote", "value", "sd", "ends", "maximum", "unit", "expected"),
    [
        ("sd", 1.01, 0.12, (0.8, 1.2), 1e-6, "N", "1.01 ± 0.12 N"),  # before: 1010000 ± 120000 µN
        ("interval", 0.8, 0.5, (0.21, 2.05), 1e-6, "N", "0.80 (0.21 to 2.05) N"),
        ("interval", 2e-6, 0.5, (1e-7, 2.05), 1e-6, "N", "0.0000020 (0.00000010 to 2.0500000) N"),
        ("sd", 1e-9, 0.12, (-0.2, 0.2), 1e-9, "N", "0.00 ± 0.12 N"),
        ("sd", 2e-5, 4e-7, (1.9e-5, 2.1e-5), 2e-5, "N", "20.00 ± 0.40 µN"),
        ("sd", math.nan, math.nan, (math.nan, math.nan), 2e-5, "N", "– µN"),
    ],
)
def test_the_prefix_follows_the_quoted_numbers(
    result: Result,
    quote: str,
    value: float,
    sd: float,
    ends: tuple[float, float],
    maximum: float,
    unit: str,
    expected: str,
) -> None:
    """The maximum of the joint posterior may be a million times smaller, as of dry friction that a decay hardly shows."""
    row = result.summary.loc[["k1"]].assign(quote=quote, value=value, sd=sd, standard_error=sd, unit=unit, map=maximum)
    (printed,) = table_rows(row.assign(lower=ends[0], upper=ends[1]))
    assert f"{printed.quoted} {printed.unit}" == expected


@pytest.mark.parametrize(
    ("value", "sd", "unit", "expected"),
    [
        (1422.43, 1.64, "N/m", "1422.4(16) N/m"),
        (18968.2, 37.1, "N/m", "18968(37) N/m"),
        (18968.2, 371.0, "N/m", "18970(370) N/m"),
        (0.65138, 0.0056, "1", "0.6514(56)"),
        (0.11, 0.0, "kg", "0.11 kg"),
        (2.02e-5, 4.6e-7, "m", "20.20(46) µm"),
        (3.0, 0.996, "N", "3.0(10) N"),
    ],
)
def test_the_concise_form_has_the_digits_of_the_sd(
    result: Result, value: float, sd: float, unit: str, expected: str
) -> None:
    row = result.summary.loc[["k1"]].assign(value=value, map=value, sd=sd, standard_error=sd, unit=unit)
    assert table_rows(row)[0].concise == expected


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
