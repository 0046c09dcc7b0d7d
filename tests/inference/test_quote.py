"""Where value ± sd does not describe a posterior, the interval is quoted: one rule, the same words in every output."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from capsule_id.api import Fit
from capsule_id.inference.result import Result
from capsule_id.inference.tables import _limited, quote
from capsule_id.report.columns import table_rows, table_text
from capsule_id.report.html import latex_table, render
from capsule_id.report.write import parameters_json
from tests.report.conftest import make_result


def entry(distribution: stats.rv_continuous) -> dict[str, float]:
    """Columns of a sampled parameter with this posterior."""
    value, lower, upper = (float(x) for x in distribution.ppf([0.5, 0.025, 0.975]))
    return {"value": value, "sd": float(distribution.std()), "lower": lower, "upper": upper}


@pytest.mark.parametrize(
    ("distribution", "positive", "word"),
    [
        (stats.norm(1422.0, 2.8), True, "sd"),
        (stats.lognorm(0.1), True, "sd"),
        (stats.lognorm(0.34), True, "sd"),
        (stats.lognorm(0.36), True, "interval"),  # arms of exp(0.706) = 2.03
        (stats.t(3, 0.65, 0.005), True, "sd"),  # heavy tails alone are no skew
        (stats.halfnorm(0.0, 570.0), True, "interval"),
        (stats.norm(1.0, 0.6), True, "interval"),  # 1.0 ± 1.2 would hold negative values
        (stats.norm(0.0, 1.0), False, "sd"),  # of either sign, no bound
        (stats.gumbel_r(10.0, 1.0), False, "sd"),
        (stats.expon(10.0, 1.0), False, "interval"),
    ],
)
def test_the_rule(distribution: stats.rv_continuous, positive: bool, word: str) -> None:
    assert quote(entry(distribution), positive) == word


@pytest.mark.parametrize(("sd", "limit"), [(0.8, False), (0.95, True), (1.5, True)])
def test_an_upper_limit_begins_at_zero(sd: float, limit: bool) -> None:
    """Before: an undamped record gave c = 0.05 to 6.4 mN s/m, because the prior of its logarithm cannot reach 0."""
    posterior = entry(stats.lognorm(sd))
    assert _limited(posterior) == ({"lower": 0.0} if limit else {})
    assert quote({**posterior, **_limited(posterior)}, positive=True) == "interval"
    assert _limited({"value": 1.0, "sd": 0.2}) == {}


def test_without_a_sample_there_is_no_interval_to_quote() -> None:
    assert quote({"value": 400.0, "sd": 570.0}, True) == "sd"


@pytest.fixture(scope="module")
def skewed() -> Result:
    """v_s = 400 ± 570 with 95 % within 3.2 and 1900 (before: the first number on every screen)."""
    result = make_result()
    summary = result.summary.copy()
    columns = ["value", "sd", "lower", "upper", "quote"]
    summary.loc["v_s", columns] = np.array([400.0, 570.0, 3.2, 1904.0, "interval"], dtype=object)
    return dataclasses.replace(result, summary=summary.astype(dict.fromkeys(columns[:-1], float)))


def test_every_output_prints_the_interval(skewed: Result) -> None:
    (row,) = [row for row in table_rows(skewed.summary) if row.name == "v_s"]
    assert (row.quoted, row.concise) == ("400 (3.2 to 1900)", "400 (3.2 to 1900) m/s")
    table = table_text(skewed.summary, synthetic=False)
    assert "400 (3.2 to 1900)  trusted" in table
    assert "v_s: skewed; quote the value with its 95 % interval" in table
    page = render(skewed, ())
    assert '<td class="n quote">400 (3.2 to 1900) m/s</td>' in page
    assert "of skewed ones (v_s) the 95 % interval" in page
    assert r"$v_s$ & m/s & $400$ ($3.2$ to $1900$) & trusted \\" in latex_table(skewed)
    assert "of skewed posteriors, medians and central 95 % intervals" in page
    fit = Fit(**{field.name: getattr(skewed, field.name) for field in dataclasses.fields(skewed)})
    assert "v_s = 400 (3.2 to 1900) m/s" in repr(fit)
    for text in (table, page, latex_table(skewed), repr(fit)):
        assert "570" not in text
        assert "1421" in text  # symmetric ones keep their ±: the negative control
    assert r" \pm 3.1$" in latex_table(skewed)


def test_files_keep_value_and_sd_and_say_what_to_quote(skewed: Result, tmp_path: Path) -> None:
    content = json.loads(json.dumps(parameters_json(skewed)))["parameters"]
    assert {name: content["v_s"][name] for name in ("value", "sd", "ci95", "quote")} == {
        "value": 400.0, "sd": 570.0, "ci95": [3.2, 1904.0], "quote": "interval",
    }  # fmt: skip
    assert content["k1"]["quote"] == "sd"
