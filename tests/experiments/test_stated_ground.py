"""A slope and a pressing force with an sd: parameters with a normal prior, shared where the statements are equal."""

from dataclasses import replace

import numpy as np
import pytest

from capsule_id.experiments.base import refit
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.rig.model import Quantity, Rig
from tests.experiments import bench
from tests.experiments.test_slope import MU, N0, SLOPE, THETA, V_S, readings, run_table, slid
from tests.inference.stub import log_likelihood

#: A slope known to 1 deg, and a pressing force known to 0.3 N.
LOOSE = {"slope": Quantity(SLOPE, np.deg2rad(1.0)), "N0": Quantity(N0, 0.3)}
#: The quantity that is moved by its sd, and the kinds whose mu follows it.
CASES = [("slope", 1), ("N0", 1), ("slope", 0), ("N0", 2)]


def target_of(rig: Rig) -> LogPosterior:
    return LogPosterior(rig, make_experiments(rig))


def fitted(kind: int, **ground: Quantity) -> PointFit:
    """Point fit of pulls (0), pushes of about one speed (1) or steady sliding (2) along the slope."""
    table = readings("forward", np.random.default_rng(3), **ground)[kind]
    if kind == 1:
        # Pushes of several speeds inform the slope too, which no delta method knows.
        speed = np.linspace(0.55, 0.65, 8)
        scatter = 1.0 + 0.02 * np.random.default_rng(3).standard_normal(8)
        distance = [slid(v, 1.0, MU * m) for v, m in zip(speed, scatter, strict=True)]
        columns = {name: bench.column(name, values) for name, values in (("speed", speed), ("distance", distance))}
        table = replace(table, columns=columns)
    # v_s is known, so that mu alone follows the slope.
    known = {"v_s": Prior("lognormal", V_S, 1.01)}
    return point_fit(target_of(bench.rig(table, priors=known)), 0, 1)


@pytest.mark.full
@pytest.mark.parametrize(("name", "kind"), CASES)
def test_the_sd_of_mu_grows_as_the_delta_method_says(name: str, kind: int) -> None:
    """sd^2 = sd_exact^2 + (d mu/d stated)^2 sd_stated^2, the derivative from fits with exact values."""
    exact = {other: Quantity(stated.value) for other, stated in LOOSE.items()}
    stated = LOOSE[name]
    low, without, high = (
        fitted(kind, **exact | {name: Quantity(stated.value + shift * stated.sd)}) for shift in (-1.0, 0.0, 1.0)
    )
    loose = fitted(kind, **exact | {name: stated})
    expected = np.hypot(without.standard_errors["mu"], 0.5 * (high.values["mu"] - low.values["mu"]))
    assert loose.standard_errors["mu"] == pytest.approx(expected, rel=0.03)
    assert expected > 1.2 * without.standard_errors["mu"]  # negative control: an ignored sd gives the smaller one
    assert loose.values["mu"] == pytest.approx(without.values["mu"], abs=0.1 * expected)
    row = next(row for row in loose.names if row.startswith(name))
    assert loose.standard_errors[row] == pytest.approx(stated.sd, rel=0.05)


def test_equal_statements_are_one_quantity_and_an_exact_one_is_none() -> None:
    slope, own = LOOSE["slope"], Quantity(0.0, np.deg2rad(0.2))
    pulls, pushes, sliding = readings("forward", np.random.default_rng(3), slope=slope)
    shared = replace(bench.rig(pulls, pushes, sliding), slope=slope)
    assert [name for name in target_of(shared).names if "slope" in name] == ["slope"]
    others = [replace(table, settings=replace(table.settings, slope=own)) for table in (pushes, sliding)]
    names = target_of(replace(bench.rig(pulls, *others), slope=slope)).names
    assert [name for name in names if "slope" in name] == ["slope", f"slope[{pushes.label}]"]
    level = replace(pushes, settings=replace(pushes.settings, slope=Quantity(0.0)))
    assert "slope" not in " ".join(target_of(replace(bench.rig(level), slope=slope)).names)


def test_exact_and_sampled_slopes_stand_side_by_side() -> None:
    """Three tables of pushes: at the stated values their likelihood is that of three exact slopes."""
    base = readings("forward", np.random.default_rng(3), slope=Quantity(SLOPE))[1]

    def rig(*slopes: Quantity | None) -> LogPosterior:
        settings = [replace(base.settings, slope=slope) for slope in slopes]
        return target_of(bench.rig(*(replace(base, label=f"p{i}", settings=s) for i, s in enumerate(settings))))

    exact = rig(Quantity(SLOPE), Quantity(0.1), None)
    loose = rig(Quantity(SLOPE, 0.01), Quantity(0.1), None)

    def likelihood(target: LogPosterior, slope: float) -> float:
        values = {**THETA, "slope": slope}
        theta = np.array([values[name.split("[")[0]] for name in target.names])
        return log_likelihood(target, target.unconstrain(theta))

    assert likelihood(loose, SLOPE) == pytest.approx(likelihood(exact, 0.0), rel=1e-12)
    assert likelihood(loose, 0.0) != pytest.approx(likelihood(exact, 0.0), rel=1e-3)


@pytest.mark.full
def test_a_forced_run_moves_on_the_sampled_slope() -> None:
    exact, loose = (
        make_experiments(bench.rig(run_table(start="stuck", slope=slope)))[0]
        for slope in (Quantity(SLOPE), LOOSE["slope"])
    )
    theta = {**THETA, "mu": MU, "phase": 0.4, "x_start": 2e-4, "y_start": 0.05}
    expected = exact.motion(theta).X2  # type: ignore[attr-defined] # pyright: ignore[reportAttributeAccessIssue]
    found = loose.motion({**theta, "slope": SLOPE}).X2  # type: ignore[attr-defined] # pyright: ignore[reportAttributeAccessIssue]
    assert np.array_equal(found, expected)
    assert any(row.name == f"slope[{loose.label}]" for row in loose.parameters)


@pytest.mark.parametrize("kind", [0, 2])
def test_estimates_of_one_experiment_hold_what_the_rig_states(kind: int) -> None:
    """Tables and checks fit parts of an experiment: with and without an sd of the slope these estimates are equal."""
    found = []
    for slope in (Quantity(SLOPE), LOOSE["slope"]):
        (e,) = make_experiments(bench.rig(readings("forward", np.random.default_rng(3), slope=slope)[kind]))
        theta = {
            **THETA,
            "mu": MU,
            "v_s": V_S,
            "slope": SLOPE,
            **{row.name: 0.02 for row in e.parameters if row.scatter},
        }
        found.append(refit(e, theta, [2]))
    exact, loose = found
    assert list(loose) == list(exact)
    for name in exact:
        assert loose[name] == pytest.approx(exact[name], rel=1e-9)


def test_pulls_and_pushes_of_one_surface_are_fitted_together() -> None:
    """Pulls give no starting point of v_s, because nothing slides there."""
    pulls, pushes, _ = readings("forward", np.random.default_rng(3), slope=Quantity(SLOPE), N0=Quantity(N0))
    fit = point_fit(target_of(bench.rig(pulls, pushes)), 0, 1)
    assert abs(fit.values["mu"] - MU) < 4.0 * fit.standard_errors["mu"]
