"""Support springs of several lengths: the law of a cantilever, and files that are exchanged."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from capsule_id.experiments.base import Fitted
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.experiments.support_spring import SupportSpring, cantilever_exponent, check_cantilever
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.model import Quantity
from capsule_id.views import Finding
from tests.experiments import bench

#: Stiffness of a spring of 60 mm, N/m.
K2 = 20e3


def checked(stiffnesses: dict[str, float]) -> Finding:
    """The finding on springs of these stiffnesses, N/m, by length, mm."""
    (finding,) = all_findings(stiffnesses)
    return finding


def all_findings(stiffnesses: dict[str, float]) -> list[Finding]:
    rng, x, tables = np.random.default_rng(0), np.linspace(0.2e-3, 2e-3, 10), []
    for length, k2 in stiffnesses.items():
        columns = [bench.column("deflection", x), bench.column("force", k2 * x + 0.02 * rng.standard_normal(10))]
        settings = {"spring": f"L{length}", "length": Quantity(1e-3 * float(length), 5e-4)}
        tables.append(bench.table("support_spring", columns, f"spring_{length}", **settings))
    springs = [cast(SupportSpring, e) for e in make_experiments(bench.rig(*tables))]
    values = {row.name: 0.02 for e in springs for row in e.parameters}
    values |= {f"k2[L{length}]": k2 for length, k2 in stiffnesses.items()}
    return check_cantilever(springs, cast(Fitted, SimpleNamespace(values=values, flagged={})))


def test_springs_of_the_law_pass_and_a_soft_clamp_is_a_warning() -> None:
    lengths = ("50", "60", "75")
    assert checked({length: K2 * (float(length) / 60.0) ** -3.0 for length in lengths}).level == "ok"
    assert checked({length: K2 * (float(length) / 60.0) ** -2.0 for length in lengths}).level == "warn"


def test_springs_of_one_length_show_no_law() -> None:
    """Before: "k2 ~ L^(nan ± inf)", a failure, and neither spring was trusted."""
    assert all_findings({"60.0": K2, "60.1": 4.0 * K2}) == []


def test_exchanged_files_fail_and_are_named() -> None:
    """Before: a warning, all parameters trusted."""
    finding = checked({"50": K2 * 1.25**-3.0, "75": K2 * 1.2**3.0})
    assert finding.level == "fail"
    assert finding.parameters == ("k2[L50]", "k2[L75]")
    text = finding_text(finding, messages_of(default_registry()))
    assert "it rises from spring_50 to spring_75" in text
    assert "exchanged" in text


def test_the_exponent_and_its_error_are_those_of_a_line_through_logarithms() -> None:
    length, sd = np.array([0.05, 0.06, 0.075]), np.full(3, 5e-4)
    exponent, error, p = cantilever_exponent(length, sd, K2 * (length / 0.06) ** -2.5, np.full(3, 0.01))
    assert exponent == pytest.approx(-2.5)
    weight = 1.0 / (0.01**2 + (3.0 * sd / length) ** 2)
    covariance = np.linalg.inv((np.vander(np.log(length), 2) * weight[:, None]).T @ np.vander(np.log(length), 2))
    assert error == pytest.approx(np.sqrt(covariance[0, 0]))
    assert 0.0 < p < 1.0
