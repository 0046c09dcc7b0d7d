"""Errors in both columns of a calibration line: the slope must not be drawn to ordinary least squares."""

from types import SimpleNamespace

import bench
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

import capsule_id as cid
from capsule_id.experiments.base import LEVEL
from capsule_id.experiments.motor_current import MotorCurrent
from capsule_id.experiments.point_test import check_linearity, origin_test
from capsule_id.experiments.support_spring import SupportSpring
from capsule_id.inference.checks.settings import outliers

K, CURRENT_SD, FORCE_SD = 2.0, 0.15, 0.1
CURRENTS = np.linspace(0.0, 2.0, 40)


def slopes(replicates: int, along: bool) -> np.ndarray:
    """MAP slopes of replicates; ``along=False`` leaves the measure along the line out, a prior flat in the current."""
    rng = np.random.default_rng(11)
    found = []
    for _ in range(replicates):
        force = K * CURRENTS + FORCE_SD * rng.standard_normal(CURRENTS.size)
        current = CURRENTS + CURRENT_SD * rng.standard_normal(CURRENTS.size)
        columns = [bench.column("force", force, FORCE_SD), bench.column("current", current, CURRENT_SD)]
        line = MotorCurrent(table := bench.table("motor_current", columns), bench.rig(table))

        def objective(slope: float, line: MotorCurrent = line) -> float:
            theta = {"K": slope}
            value = float(line.log_likelihood(theta, np))
            return -(value if along else value - float(np.sum(line.misfit(theta).log_measure)))

        found.append(minimize_scalar(objective, bounds=(1.0, 3.0), method="bounded").x)
    return np.array(found)


@pytest.mark.parametrize("moved", [0.0, 0.1])
def test_rounding_of_exact_readings_is_no_bend_and_no_outlier(moved: float) -> None:
    """Before: a bend of 0.0 % of the range, and a reading 2e8 sds off the others; both failed."""
    current = 0.2 * np.arange(1, 11)
    force = np.round(K * current + moved * (np.arange(10) == 3), 1)

    def found(force: np.ndarray) -> set[str]:
        rig = bench.rig(bench.table("motor_current", [bench.column("force", force), bench.column("current", current)]))
        return {finding.code for finding in cid.fit(rig, budget=None).findings if finding.level != "ok"}

    judged = {"lines.straight", "lines.origin", "outliers"}
    assert not judged & found(force)
    # The control: a bend of five digits at mid range.
    assert "lines.straight" in found(np.round(force + 2.0 * (current / 2.0) ** 2, 1))


def test_slope_is_unbiased_under_errors_in_both_columns() -> None:
    found = slopes(300, along=True)
    error = np.std(found, ddof=1) / np.sqrt(found.size)
    assert np.mean(found) == pytest.approx(K, abs=3.0 * error)


@pytest.mark.full
def test_a_prior_flat_in_the_current_would_bias_it() -> None:
    """Negative control: low by (sd_x / sd of the currents)^2 = 6 %, as ordinary least squares."""
    found = slopes(300, along=False)
    expected = K * (1.0 - CURRENT_SD**2 / (np.var(CURRENTS) + CURRENT_SD**2))
    assert np.mean(found) == pytest.approx(expected, abs=0.02)
    assert np.mean(found) < K - 0.05


def test_deming_regression_by_hand() -> None:
    """With both errors stated the MAP slope is the closed form of Deming regression (Fuller 1987, section 1.3)."""
    rng = np.random.default_rng(3)
    force = K * CURRENTS + FORCE_SD * rng.standard_normal(CURRENTS.size)
    current = CURRENTS + CURRENT_SD * rng.standard_normal(CURRENTS.size)
    columns = [bench.column("force", force, FORCE_SD), bench.column("current", current, CURRENT_SD)]
    line = MotorCurrent(table := bench.table("motor_current", columns), bench.rig(table))
    ratio = (FORCE_SD / CURRENT_SD) ** 2
    (sxx, sxy), (_, syy) = np.cov(current, force)
    deming = (syy - ratio * sxx + np.sqrt((syy - ratio * sxx) ** 2 + 4.0 * ratio * sxy**2)) / (2.0 * sxy)

    def objective(slope: float) -> float:
        # Deming regression maximises over the intercept; integrating it out multiplies by its conditional sd.
        spread = 0.5 * np.log(FORCE_SD**2 + (slope * CURRENT_SD) ** 2)
        return spread - float(line.log_likelihood({"K": slope}, np))

    found = minimize_scalar(objective, bounds=(1.0, 3.0), method="bounded", options={"xatol": 1e-9})
    # The intercept's prior is wide, not flat: it moves the slope by about (noise / prior width)^2.
    assert found.x == pytest.approx(deming, rel=1e-5)


MOTOR = np.linspace(0.5, 4.0, 8)


def doubtful(force: np.ndarray, scale_known: bool) -> float:
    """Share of 400 noisy replicates of a motor's readings whose zero, or straightness, is in doubt at the level 0.002."""
    rng, sd, count = np.random.default_rng(7), np.full(8, 0.04), 0
    for _ in range(400):
        y = force + sd * rng.standard_normal(8)
        _, p, at_origin = origin_test(MOTOR, y, sd, scale_known)
        count += at_origin is not None and p < LEVEL
        assert at_origin is None or scale_known or 0.8 * K < at_origin < 1.2 * K
    return count / 400


@pytest.mark.parametrize("scale_known", [True, False])
def test_a_motor_that_saturates_is_told_from_a_wrong_zero(scale_known: bool) -> None:
    """Negative controls: a straight line, and one that begins at 0.1 A, whose slope is K."""
    assert doubtful(K * 9.0 * np.tanh(MOTOR / 9.0), scale_known) > (0.9 if scale_known else 0.4)
    assert doubtful(K * MOTOR, scale_known) < 0.01
    assert doubtful(K * (MOTOR - 0.1), scale_known) < 0.06


@pytest.mark.parametrize(("force", "codes"), [(18.0 * np.tanh(MOTOR / 9.0), ["lines.origin"]), (K * MOTOR, [])])
def test_the_slope_of_a_motor_that_saturates_is_not_judged(force: np.ndarray, codes: list[str]) -> None:
    """Readings without noise, whose bend of 3 sd alone is no finding."""
    columns = [bench.column("force", force, 0.055), bench.column("current", MOTOR, 0.005)]
    line = MotorCurrent(table := bench.table("motor_current", columns), bench.rig(table))
    found = check_linearity([line], SimpleNamespace(values={"K": line.ordinary_line()[0]}, flagged={}))
    assert [(f.code, f.parameters) for f in found if f.level != "ok"] == [(code, ("K",)) for code in codes]


@pytest.mark.parametrize(("reading", "struck"), [(0.15, False), (0.30, True)])
def test_readings_within_their_digit_step_are_no_outliers(reading: float, struck: bool) -> None:
    """Nine readings on one line and one a step beside it (before: 2.5e150 sds off). Negative control: 15 steps."""
    x = 0.05 * np.arange(1.0, 11.0)
    force = np.append(reading, np.round(3.0 * x[1:] - 0.01, 2))
    columns = [bench.column("deflection", x), bench.column("force", force)]
    line = SupportSpring(table := bench.table("support_spring", columns, spring="soft"), bench.rig(table))
    theta = {"k2": line.ordinary_line()[0], "scatter": 1e-6}
    assert bool(outliers(line, theta, 0.01)) == struck


#: Weights, N, and readings of a ruler, m, with 5 mm stated: they scatter about the line by much more.
WEIGHTS, RULER = np.array([0.0, 0.981, 1.962, 2.943, 4.905]), np.array([0.0, 0.048, 0.077, 0.104, 0.222])


def scatter_and_error(**settings: object) -> tuple[float, float]:
    """Scatter at the maximum, N, and standard error of k2, N/m; ruler with 5 mm, or with these settings."""
    columns = [bench.column("force", WEIGHTS), bench.column("deflection", RULER, None if settings else 5e-3)]
    rig = bench.rig(bench.table("support_spring", columns, "ruler", spring="F5", **settings))
    rows = cid.fit(rig, budget=None)
    return float(rows.nuisances.loc["scatter[ruler]", "map"]), float(rows.summary.loc["k2[F5]", "sd"])


def test_a_scatter_beside_one_stated_error_does_not_vanish() -> None:
    """Before: the density grew without limit as the scatter went to 0; k2 was trusted with an sd 3.5 times too small."""
    scatter, sd = scatter_and_error()
    assert 0.1 < scatter < 0.6
    # Ordinary least squares: 22.5 N/m with a standard error of 2.5 N/m from three degrees of freedom.
    assert 1.2 < sd < 4.0
    line = SupportSpring(
        table := bench.table(
            "support_spring",
            [bench.column("force", WEIGHTS), bench.column("deflection", RULER, 5e-3)],
            "ruler",
            spring="F5",
        ),
        bench.rig(table),
    )
    # Independent route: a normal density of y about the line, intercept with its wide prior.
    for own in (1e-9, 0.3):
        theta = {"k2": 22.5, "scatter": own}
        covariance = ((22.5 * 5e-3) ** 2 + own**2) * np.eye(5) + line.width**2
        apart = WEIGHTS - np.mean(WEIGHTS) - 22.5 * (RULER - np.mean(RULER))
        expected = stats.multivariate_normal(np.zeros(5), covariance).logpdf(apart)
        assert float(line.log_likelihood(theta, np)) == pytest.approx(expected, abs=1e-6)


def test_a_ratio_beside_one_stated_error_has_a_density_with_a_limit() -> None:
    columns = [bench.column("force", WEIGHTS), bench.column("deflection", RULER, 5e-3)]
    line = SupportSpring(
        table := bench.table("support_spring", columns, "ruler", spring="F5", sd_ratio=20.0), bench.rig(table)
    )
    small, fitted = (float(line.log_likelihood({"k2": 22.5, "scatter": own}, np)) for own in (1e-9, 0.3))
    assert small < fitted


@pytest.mark.parametrize("sd", [None, 2e-6])
def test_zeros_far_from_the_readings_change_nothing(sd: float | None) -> None:
    """Before: the intercept's prior stood at (0, 0), ten ranges wide, and k2 was 267 for 5000 N/m, trusted."""
    deflection = np.linspace(0.0, 1e-3, 8)
    force = 5000.0 * deflection + 0.05 * np.random.default_rng(1).standard_normal(8)
    densities = []
    for x, y in ((0.0, 0.0), (0.25, 0.0), (0.0, 8e3)):
        columns = [bench.column("force", y + force, sd and 0.05), bench.column("deflection", x + deflection, sd)]
        line = SupportSpring(table := bench.table("support_spring", columns, spring="a"), bench.rig(table))
        densities.append([line.log_likelihood({"k2": k2, "scatter": 0.05}, np) for k2 in (4900.0, 5000.0, 5100.0)])
    np.testing.assert_allclose(densities[1:], [densities[0]] * 2, rtol=1e-9)
