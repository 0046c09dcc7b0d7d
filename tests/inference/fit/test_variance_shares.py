"""Shares of the inputs in the variance of a parameter: against a closed form, and against fits with one exact input."""

from dataclasses import replace

import pytest

import capsule_id as cid
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.result import STATED, PointFit
from capsule_id.inference.tables import share_table
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import Quantity
from tests.cli_tools import DATA

WEIGHING = f"{STATED}m1"
#: Tables of data/ that are fitted.
TABLES = ("free_vibration_1", "static_friction", "dynamic_friction", "motor_current")


@pytest.fixture(scope="module")
def targets() -> dict[float, LogPosterior]:
    """Some bench tests of data/, with two sds of the weighing of m1, kg."""
    rig = cid.read_rig(DATA)
    rig = replace(rig, tables=tuple(table for table in rig.tables if table.label in TABLES))
    rigs = {sd: replace(rig, m1=Quantity(rig.mass("m1"), sd)) for sd in (2e-4, 2e-6)}
    return {sd: LogPosterior(one, make_experiments(one)) for sd, one in rigs.items()}


@pytest.fixture(scope="module")
def fits(targets: dict[float, LogPosterior]) -> dict[float, PointFit]:
    return {sd: point_fit(target, 0, 1) for sd, target in targets.items()}


def relative_sd(fit: PointFit, name: str) -> float:
    return fit.standard_errors[name] / fit.values[name]


@pytest.mark.full
def test_the_weighing_of_m1_is_the_part_of_k1_that_eq_2_gives(fits: dict[float, PointFit]) -> None:
    """k1 = m1 (omega^2 + gamma^2): the relative sd of m1 is a part of that of k1, whatever the decay."""
    fit = fits[2e-4]
    expected = (2e-4 / fit.values["m1"] / relative_sd(fit, "k1")) ** 2
    assert fit.shares["k1"][WEIGHING] == pytest.approx(expected, rel=1e-3)
    assert 0.6 < expected < 0.9


def test_an_exact_input_removes_its_share(fits: dict[float, PointFit]) -> None:
    rough, exact = fits.values()
    for name in ("k1", "c"):
        left = (relative_sd(exact, name) / relative_sd(rough, name)) ** 2
        assert 1.0 - rough.shares[name][WEIGHING] == pytest.approx(left, rel=0.01)
        assert exact.shares[name][WEIGHING] < 1e-3  # negative control: the same record, a better balance


def test_the_report_names_the_two_largest_inputs(
    targets: dict[float, LogPosterior], fits: dict[float, PointFit]
) -> None:
    (table,) = share_table(targets[2e-4], fits[2e-4])
    first, share, second, other = table.frame.loc["k1"]
    assert (first, second) == (WEIGHING, "free_vibration_1")
    assert [share, other] == [pytest.approx(fits[2e-4].shares["k1"][name], abs=1e-3) for name in (first, second)]
    assert share_table(targets[2e-4], replace(fits[2e-4], shares={})) == []


def test_shares_add_up_and_belong_to_the_tests_that_inform(fits: dict[float, PointFit]) -> None:
    shares = fits[2e-4].shares
    assert {name: sum(parts.values()) for name, parts in shares.items()} == pytest.approx(dict.fromkeys(shares, 1.0))
    assert all(share >= 0.0 for parts in shares.values() for share in parts.values())
    largest = {name: max(parts, key=lambda key: parts[key]) for name, parts in shares.items()}
    assert (largest["K"], largest["mu"]) == ("motor_current", "static_friction")
    assert shares["v_s"]["free_vibration_1"] < 1e-9
